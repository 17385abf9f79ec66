"""A fixed part of the hidden-effect benchmark: tables of the test bed, a few in every test and all of them as a proof.

The short drive is in `test_hidden_drives`, the single effects that take longest in `test_hidden_singles`. The
thresholds are what the tool reaches on these cases; the whole benchmark, with seeds drawn after the code, is
`benchmarks/hidden_effects.py`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.hidden import cases, drive_effects, drives, runner
from benchmarks.hidden.bed import effects as bed_effects
from benchmarks.hidden.judge import outcome
from benchmarks.hidden.solve import table_row
from benchmarks.hidden.summary import GROUPS, summarise, wilson
from lunar_mjx.backends import NativeBackend
from lunar_mjx.logs import check, read_log
from lunar_mjx.logs.findings import is_bad
from lunar_mjx.model import make_model
from lunar_mjx.simulate import joint_channels

SEED = 20261
DRIVE_KINDS = {**drive_effects.KNOWN, **drive_effects.OUTSIDE}
FEW_NULLS, MORE_NULLS = (1,), (0, 2, 3, 4, 5, 6)
QUICK, MORE = (2,), (4, 5, 6, 7)
"""Single effects of the test bed that are refitted fast: exit angle; grousers, friction circle, rolling, radius."""
NOISY, PAIRS = (5, 6), (7,)
FEW_UNDECIDABLE, MORE_UNDECIDABLE = (4,), (5, 6, 8)


def chosen(group: str, numbers: Sequence[int]) -> list[dict[str, Any]]:
    return [table_row(group, n, SEED) for n in numbers]


def told(found: list[dict[str, Any]]) -> list[str]:
    return [f"{r['case']}: {r['outcome']}, {r['sentence']}" for r in found if not r["right"]]


@pytest.mark.optimised
@pytest.mark.parametrize(
    ("numbers", "noises"),
    [(FEW_NULLS, {"coloured"}), pytest.param(MORE_NULLS, {"white", "coloured", "quantised"}, marks=pytest.mark.slow)],
    ids=["few", "more"],
)
def test_nothing_is_found_where_nothing_is_hidden(numbers: Sequence[int], noises: set[str]) -> None:
    """White, coloured and quantised noise by turns, with a little unmodelled dirt."""
    found = chosen("nulls", numbers)
    assert {r["noise"] for r in found} == noises
    assert not any(r["wrong_name"] for r in found), told(found)
    assert all(r["outcome"] == "quiet" for r in found), told(found)


@pytest.mark.optimised
@pytest.mark.parametrize(
    ("group", "numbers", "misses"),
    [
        ("singles", QUICK, 0),
        pytest.param("singles", MORE, 0, marks=pytest.mark.slow),
        pytest.param("singles_x5", NOISY, 2, marks=pytest.mark.slow),
        pytest.param("pairs", PAIRS, 0, marks=pytest.mark.slow),
    ],
)
def test_what_is_hidden_is_named(group: str, numbers: Sequence[int], misses: int) -> None:
    """One effect alone; one at five times the noise, of which none is named and none wrongly; two together.

    At five times the noise a friction circle is called unlisted and a rolling resistance undecidable: a known loss.
    """
    found = chosen(group, numbers)
    assert not any(r["wrong_name"] for r in found), told(found)
    assert len(told(found)) <= misses, told(found)


@pytest.mark.optimised
@pytest.mark.parametrize(
    "numbers", [FEW_UNDECIDABLE, pytest.param(MORE_UNDECIDABLE, marks=pytest.mark.slow)], ids=["few", "more"]
)
def test_what_cannot_be_told_is_called_undecidable(numbers: Sequence[int]) -> None:
    found = chosen("undecidable", numbers)
    assert {r["explained"] for r in found} == {"UNDECIDABLE"}, told(found)


def test_sabotaged_tables_are_bad_data(tmp_path: Path) -> None:
    """The gate alone; nothing else runs on a table that it refuses."""
    caught = []
    for n in range(2 * len(cases.SABOTAGE)):
        case = cases.make("sabotaged", n, SEED)
        case.write(tmp_path / case.name)
        caught.append(is_bad(check([read_log(tmp_path / case.name)])))
    assert sum(caught) >= 19, [cases.make("sabotaged", n, SEED).sabotage for n, ok in enumerate(caught) if not ok]


def test_sound_tables_pass_the_gate(tmp_path: Path) -> None:
    for n in range(30):
        case = cases.make("nulls", n, SEED)
        case.write(tmp_path / case.name)
        assert not is_bad(check([read_log(tmp_path / case.name)])), case.name


def test_a_case_is_sealed_and_comes_back_the_same(tmp_path: Path) -> None:
    one, again, other = (cases.make("singles", 0, s) for s in (5, 5, 6))
    assert one.commitment() == again.commitment() != other.commitment()
    assert one.frame.equals(again.frame)
    one.write(tmp_path / "log")
    text = (tmp_path / "log" / "log.toml").read_text(encoding="utf-8")
    assert one.commitment() in text
    assert not any(word in text for word in (*bed_effects.KNOWN, one.nonce))


@pytest.fixture(scope="module")
def plain_drive() -> dict[str, np.ndarray]:
    return short_drive({})


def short_drive(effects: dict[str, dict[str, float]]) -> dict[str, np.ndarray]:
    """The rover's last step after a short drive with hidden effects."""
    model = make_model(drives.ROVER, terrain="flat", timestep=drives.STEP)
    driven = np.array(["drive" in j for j in joint_channels(model.rover)], float)
    hooks = [make(p, driven) for n, p in effects.items() if (make := DRIVE_KINDS[n].hook) is not None]
    backend = NativeBackend(model, hooks)
    backend.reset()
    for k in range(220):
        backend.step((0.0 if k < 20 else 2.0) * driven)
    return backend.observe()


@pytest.mark.parametrize("name", [n for n, kind in DRIVE_KINDS.items() if kind.hook is not None])
def test_every_hidden_effect_changes_the_drive(name: str, plain_drive: dict[str, np.ndarray]) -> None:
    seen = short_drive({name: DRIVE_KINDS[name].draw(np.random.default_rng(0))})
    assert all(np.isfinite(v).all() for v in seen.values())
    keys = ("position", "joint_speed", "current", "winding_temperature", "housing_temperature", "sinkage")
    assert any(np.abs(seen[k] - plain_drive[k]).max() > 1e-7 for k in keys)


@pytest.mark.parametrize("name", [n for n, kind in DRIVE_KINDS.items() if kind.sensor is not None])
def test_every_hidden_sensor_effect_changes_the_log(name: str) -> None:
    t = np.arange(0.0, 10.0, 0.05)
    frame = pd.DataFrame(
        {
            "time_s": t,
            "position_x_m": 0.1 * t,
            "motor_lf_drive_current_A": np.sin(t),
            "motor_lf_drive_voltage_V": 5.0 + 0.0 * t,
            "winding_lf_drive_temperature_degC": 25.0 + t,
            "housing_lf_drive_temperature_degC": 25.0 + 0.1 * t,
        }
    )
    kind = DRIVE_KINDS[name]
    assert kind.sensor is not None
    changed = kind.sensor(frame, kind.draw(np.random.default_rng(0)))
    assert np.isfinite(changed.to_numpy()).all() and list(changed) == list(frame)
    assert np.abs(changed.to_numpy() - frame.to_numpy()).max() > 1e-3


def row(group: str, verdict: str, named: list[str], hidden: list[str], **more: Any) -> Mapping[str, Any]:
    return {"group": group, "verdict": verdict, "named": named, "truth": {"effects": {n: {} for n in hidden}}, **more}


@pytest.mark.parametrize(
    ("case", "twins", "right", "wrong_name"),
    [
        (row("nulls", "NOISE_ONLY", [], []), 0.0, True, False),
        (row("nulls", "KNOWN", ["a"], []), 0.0, False, True),
        (row("nulls", "UNKNOWN", [], []), 0.0, False, False),
        (row("singles", "KNOWN", ["a"], ["a"]), 0.0, True, False),
        (row("singles", "KNOWN", ["b"], ["a"]), 0.0, False, True),
        (row("singles", "KNOWN_CLASS", ["a", "b"], ["a"]), 1.0, True, False),
        (row("singles", "KNOWN_CLASS", ["a", "b"], ["a"]), 50.0, False, False),
        (row("singles", "KNOWN_CLASS", ["c", "b"], ["a"]), 1.0, False, True),
        (row("singles", "MULTIPLE", ["a", "b"], ["a"]), 0.0, False, True),
        (row("singles", "UNKNOWN", ["a"], ["a"]), 0.0, False, False),
        (row("pairs", "MULTIPLE", ["b", "a"], ["a", "b"]), 0.0, True, False),
        (row("pairs", "KNOWN", ["a"], ["a", "b"]), 0.0, False, False),
        (row("pairs", "MULTIPLE", ["a", "c"], ["a", "b"]), 0.0, False, True),
        (row("outside", "UNKNOWN", [], ["x"]), 0.0, True, False),
        (row("outside", "KNOWN", ["a"], ["x"]), 0.0, False, True),
        (row("undecidable", "NOISE_ONLY", [], ["a"], explained="UNDECIDABLE"), 0.0, True, False),
        (row("undecidable", "NOISE_ONLY", [], ["a"], explained="NOISE_ONLY"), 0.0, False, False),
        (row("dirt", "UNKNOWN", [], ["a"]), 0.0, True, False),
        (row("dirt", "KNOWN", ["b"], ["a"]), 0.0, False, True),
        (row("sabotaged", "NOISE_ONLY", [], []), 0.0, False, False),
    ],
)
def test_answers_are_judged(case: Mapping[str, Any], twins: float, right: bool, wrong_name: bool) -> None:
    found = outcome(case, lambda other: twins)
    assert (found["right"], found["wrong_name"]) == (right, wrong_name)


def test_wilson_interval() -> None:
    # Wilson 1927; the figures of 0 of 400 and 57 of 58 by hand
    assert wilson(0, 400)[1] == pytest.approx(1.959964**2 / (400 + 1.959964**2), rel=1e-9)
    low, high = wilson(57, 58)
    assert low == pytest.approx(0.9086, abs=2e-4) and high == pytest.approx(0.9969, abs=2e-4)


def small(group: str, number: int, seed: int, limit: int = 9) -> dict[str, Any]:
    if number >= limit:
        raise ValueError("a crash")
    return {
        "case": f"{group}-{number:03d}",
        "kind": "tables",
        "group": group,
        "seed": str(seed),
        "named": [],
        "verdict": "NOISE_ONLY",
        "truth": {"effects": {}},
        "right": True,
        "outcome": "quiet",
        "wrong_name": False,
        "noise": "white",
        "seconds": 0.0,
    }


def test_a_stopped_benchmark_goes_on(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    seed = int(runner.campaign(out, None)["seed"])
    assert int(runner.campaign(out, None)["seed"]) == seed
    with pytest.raises(SystemExit):
        runner.campaign(out, seed + 1)
    jobs = runner.order({"nulls": 4, "singles": 2})
    assert runner.work(small, jobs[:3], out, seed, 1.0, 1) == 3
    with out.open("a", encoding="utf-8") as file:
        file.write('{"case": "cut')
    assert len(runner.read_rows([out])) == 3
    assert runner.work(small, jobs[3:], out, seed, 0.0, 1) == 0


def test_a_crash_counts_as_wrong(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    runner.work(small, [("nulls", 0), ("nulls", 1)], out, 3, 1.0, 1, limit=1)
    found = runner.read_rows([out])
    assert [r["verdict"] for r in found] == ["NOISE_ONLY", "CRASH"]
    figures = summarise(found)["all"]
    assert figures["nulls, false alarm"]["of"] == 2 and figures["nulls, not answered"]["hits"] == 1
    json.dumps(figures)


def test_the_figure_counts_the_cases_of_the_record() -> None:
    root = Path(__file__).parents[2]
    record = json.loads((root / "benchmarks" / "hidden_effects.json").read_text(encoding="utf-8"))
    counts = record["answers"]
    missed = [m for m in record["missed"] if m["case"].rsplit("-", 1)[0] in GROUPS]
    assert sum(short + wrong for _, short, wrong in counts.values()) == len(missed)
    page = (root / "docs" / "criticism_history.md").read_text(encoding="utf-8")
    for title in ("one effect", "two effects", "three effects"):
        right, _, _ = counts[title]
        assert f"{right} of {sum(counts[title])}" in page
