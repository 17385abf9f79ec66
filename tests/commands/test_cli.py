"""The command, run as a user runs it: what it prints and writes."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from lunar_mjx import __version__
from lunar_mjx.commands.diagnosis import print_probabilities
from lunar_mjx.diagnosis.verdict import Diagnosis, Verdict
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.presets import FLAWS, MEANT_FOR, PRESETS, UNSAID
from lunar_mjx.effects.wheel.paper import REGULARISATIONS
from lunar_mjx.model import make_model
from lunar_mjx.model.file import load_model, save_model
from lunar_mjx.resources import shipped
from lunar_mjx.rover import load_rover
from lunar_mjx.simulate import command_channels
from tests.cli_harness import Run, subprocess_run

DATA = Path(__file__).parents[1] / "rover" / "data"
COMMANDS = [
    [],
    ["demo"],
    ["convert"],
    ["simulate"],
    ["preset"],
    ["figures"],
    ["terrain"],
    ["terrain", "info"],
    ["terrain", "export"],
    ["effect"],
    ["effect", "list"],
    ["effect", "show"],
    ["version"],
]


def plain(text: str) -> str:
    """Without the folding of tables."""
    return " ".join(text.split())


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: " ".join(c) or "lunar-mjx")
def test_help(command: list[str], run: Run) -> None:
    result = run(*command, "--help")
    assert result.status == 0 and "Usage: lunar-mjx" in result.out and not result.err


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys, json\nfrom lunar_mjx.cli import main\nsys.argv = ['lunar-mjx', sys.argv[1], '--help']\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\nprint(json.dumps(sorted(sys.modules)))"
    )
    result = subprocess_run(code, "simulate")
    assert result.returncode == 0, result.stderr
    modules = set(json.loads(result.stdout.splitlines()[-1]))
    assert "typer" in modules and not modules & {"jax", "mujoco", "numpy", "pandas", "scipy", "trimesh", "pint"}


def test_version(run: Run) -> None:
    assert run("version") == (0, f"{__version__}\n", "")


def test_usage_errors(run: Run) -> None:
    for arguments in (["--no-such-option"], ["fly"], ["simulate", "--drive", "fast"], ["preset"], ["effect", "show"]):
        result = run(*arguments)
        assert result.status == 2 and "--help" in result.err and result.err.count("\n") == 1, arguments


def test_effect_list(run: Run) -> None:
    result = run("effect", "list")
    assert result.status == 0
    column = result.out.splitlines()[0].index(" in ") + 1
    for name, effect in CATALOGUE.items():
        line = next(text for text in result.out.splitlines() if text.split()[:1] == [name] and text.startswith("   "))
        marks = line[column : column + 2 * len(PRESETS)].split()
        for preset, listed in PRESETS.items():
            assert (preset[0] in marks) == (name in listed), (name, preset)
        assert plain(effect.doc.split("\n")[0]) in plain(result.out)


@pytest.mark.parametrize(
    "command",
    [
        ["effect", "list"],
        ["effect", "show", "slip_sinkage"],
        ["preset", "paper"],
        ["preset", "list"],
        ["log", "manoeuvres"],
    ],
)
def test_tables_read_well_on_a_narrow_terminal(command: list[str], run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is cut at 80 columns, and no column of words is squeezed until each line holds one or two of them."""
    monkeypatch.setenv("COLUMNS", "80")
    lines = run(*command).out.splitlines()
    assert max(map(len, lines)) <= 80
    words = [len(line.split()) for line in lines if line.strip()]
    assert np.mean(words) > 3.5
    assert len(lines) < (200 if command[0] != "effect" or command[1] == "show" else 3 * len(CATALOGUE) + 20)


def test_a_long_hypothesis_leaves_room_for_its_probability(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    name = "calibration.current_left + rolling_resistance + unlisted at motor_torque: current for a torque"
    diagnosis = Diagnosis(Verdict.UNDECIDABLE, (), "", probabilities={name: 0.123, "rolling_resistance": 0.877})
    console = Console(record=True, file=io.StringIO())
    print_probabilities(diagnosis, console)
    lines = console.export_text().splitlines()
    assert sum(line.rstrip().endswith(("0.123", "0.877")) for line in lines) == 2
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("name", CATALOGUE)
def test_effect_show(name: str, run: Run) -> None:
    result = run("effect", "show", name)
    effect = CATALOGUE[name]
    assert result.status == 0 and result.out.startswith(f"{name}: {', '.join(effect.ports)}")
    assert plain(effect.doc) in plain(result.out)
    for key, parameter in effect.parameters.items():
        about = plain(result.out).split(f"{key}: {plain(parameter.meaning)}")[1]
        unit = "" if parameter.unit == "1" else f" {parameter.unit}"
        assert about.startswith(f" nominal {parameter.nominal:g}{unit} bounds {parameter.bounds[0]:g} ..")
        assert f"source {plain(parameter.source)}" in about


def test_show_a_users_effect_with_brackets_in_its_text(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "from lunar_mjx.effects import Parameter, effect\n"
        '@effect("command", a=Parameter(0.0, None, (0.0, 1.0), "1", "in [/bold] [0, 1]", "[red]me"))\n'
        'def mine(ctx, p, x, command):\n    "Text with [/] and [link=x]."\n    return command\n'
    )
    result = run("effect", "show", path)
    assert result.status == 0 and "Text with [/] and [link=x]." in result.out
    assert "in [/bold] [0, 1]" in result.out and "[red]me" in result.out


def test_preset_list_tells_what_each_is_for(run: Run) -> None:
    result = run("preset", "list")
    assert result.status == 0 and set(MEANT_FOR) == set(PRESETS)
    for name, text in MEANT_FOR.items():
        assert f"{name} {len(PRESETS[name])} {text}" in plain(result.out)


def test_preset_paper(run: Run) -> None:
    result = run("preset", "paper")
    text = plain(result.out)
    assert result.status == 0
    for title, rows in (("left unsaid", UNSAID), ("undefined in print", REGULARISATIONS)):
        assert title in text
        for what, choice in rows.items():
            assert plain(f"{what} {choice}") in text, what
    for flaw in FLAWS:
        assert plain(f"{flaw.number} {flaw.where} paper {flaw.paper} consistent {flaw.consistent}") in text


def test_preset_consistent(run: Run) -> None:
    result = run("preset", "consistent", "--rover", "luvmi_x")
    assert result.status == 0 and "left unsaid" not in result.out
    assert "what consistent leaves out, and field has" in result.out
    for name in PRESETS["consistent"]:
        assert re.search(rf"^ {name} ", result.out, re.MULTILINE), name


def rows_of(text: str, key: str) -> str:
    """What is printed from a parameter's line to the one before the next parameter's."""
    after = text[text.index(f"\n   {key} ") :].splitlines()[1:]
    rows = [after[0]]
    for line in after[1:]:
        if len(line) - len(line.lstrip()) < 5:
            break
        rows.append(line)
    return plain("\n".join(rows))


def test_sources_are_those_of_the_values_shown(run: Run) -> None:
    paper, own = run("preset", "paper").out, run("preset", "consistent").out
    ratio = load_rover("viper").groups[1].gear_ratio
    assert rows_of(paper, "cohesion") == "cohesion 462.3 Pa preset paper"
    assert rows_of(own, "cohesion").endswith(CATALOGUE["soil"].parameters["cohesion"].source)
    assert rows_of(paper, "alpha").endswith(CATALOGUE["motor"].parameters["alpha"].source)
    assert rows_of(paper, "gear_ratio") == (
        f"gear_ratio drive 62 preset paper steer, suspension {ratio:g} rover.toml of viper"
    )
    assert "preset" not in rows_of(own, "gear_ratio") and "rover.toml of viper" in rows_of(own, "gear_ratio")


def test_preset_save(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "paper.toml"
    result = run("preset", "paper", "--rover", "luvmi_x", "--save", path)
    assert result.status == 0 and result.out.splitlines()[-1] == str(path)
    assert load_model(path).preset == "paper"


def test_terrain_info(run: Run) -> None:
    result = run("terrain", "info", "flat")
    assert result.status == 0 and "median 0.0, 95 % below 0.0 deg" in result.out
    assert "median 12.0" in run("terrain", "info", "slope:12deg").out


def test_terrain_seed(run: Run, tmp_path: Path) -> None:
    config = tmp_path / "rough.toml"
    config.write_text("[surface]\nwidth = 20.0\nheight = 20.0\ncell = 0.5\n[surface.roughness]\n")
    outs = [run("terrain", "info", config, "--seed", seed).out for seed in (1, 2, 1)]
    assert "height" in outs[0] and outs[0] == outs[2] != outs[1]


def test_terrain_dem(run: Run, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.add.outer(np.zeros(9), np.arange(9.0)))
    config = tmp_path / "mine.toml"
    config.write_text("[dem]\ncell = 2.0\n")
    result = run("terrain", "info", config, "--dem", tmp_path / "a.npy")
    assert result.status == 0 and "9 x 9, cell 2 m" in result.out


def test_terrain_export(run: Run, tmp_path: Path) -> None:
    result = run("terrain", "export", "flat", tmp_path / "x.stl")
    assert result == (0, f"{tmp_path / 'x.stl'}\n", "")
    count = int.from_bytes((tmp_path / "x.stl").read_bytes()[80:84], "little")
    assert count == 2 * 200**2


def test_convert(run: Run, tmp_path: Path) -> None:
    result = run("convert", shipped("models") / "luvmi_x" / "luvmi_x.urdf", "--out", tmp_path / "mine")
    rover = load_rover(tmp_path / "mine")
    assert result.status == 0 and result.out.splitlines()[-1] == str(rover.mjcf)
    assert f"{rover.mass:g} kg, 4 wheels, 12 motors" in result.out


def test_simulate(run: Run, tmp_path: Path) -> None:
    model = tmp_path / "model.toml"
    save_model(make_model("luvmi_x", "flat").set("soil", cohesion=250.0), model)
    result = run(
        "simulate", "--model", model, "--duration", 0.2, "--steer", 0.1, "--device", "cpu", "--out", tmp_path / "o"
    )
    assert result.status == 0, result.err
    assert not result.err, "and nothing but the result is printed"
    first, last = result.out.splitlines()
    assert re.fullmatch(r"luvmi_x drove 0\.\d{3} m in 0\.\d s", first) and last == str(tmp_path / "o" / "drive.csv")
    assert sorted(p.name for p in (tmp_path / "o").iterdir()) == ["drive.csv", "model.toml"]
    assert (tmp_path / "o" / "model.toml").read_bytes() == model.read_bytes()
    table = pd.read_csv(tmp_path / "o" / "drive.csv")
    assert len(table) == 4 and table.columns[0] == "time_s" and np.isfinite(table.to_numpy()).all()
    for name in ("wheel_rr_slip_ratio", "joint_lf_sus_angle_rad", "motor_rf_steer_current_A", "quaternion_w"):
        assert name in table.columns
    assert set(command_channels(load_model(model))) <= set(table.columns)
    assert (table["command_lf_steer_angle_rad"] == 0.1).all() and (table["command_lr_steer_angle_rad"] == 0.0).all()
