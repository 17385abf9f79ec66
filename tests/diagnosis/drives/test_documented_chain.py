"""The commands of `docs/real_drives.md` one after another, each reading the files that those before it wrote."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.diagnosis.drives.windows import bench, problem
from lunar_mjx.diagnosis.report.read import read_result
from lunar_mjx.diagnosis.report.steps import chain, error
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.dynamics.imposed import Seen
from lunar_mjx.logs.example import copy_example
from lunar_mjx.model.file import load_model
from tests.cli_harness import Run

PAGE = Path(__file__).parents[3] / "docs" / "real_drives.md"
GROUNDS = {"FLOORING": ("floor", 4), "ASPHALT": ("floor", 2), "SNOW": ("sand", 4)}
"""The shipped recording that stands for a ground's, and into how many it is cut: from three recordings on, a fit
teaches what differs between them."""


class Skid:
    """A rover that skids as a formula says, in the place of its simulation: a thousand windows in a millisecond."""

    def __init__(self, model: Any, bin_s: float):
        self.model = model
        self.soft = "soft_ground" in model.effect_names
        self.left = np.array([j.startswith("l") for j in model.rover.joints])

    def run(self, params: Any, windows: Any) -> Seen:
        of = {k: {n: np.asarray(v, float) for n, v in p.items()} for k, p in params.effects.items()}

        def whole(effect: str, name: str) -> np.ndarray:
            value = of.get(effect, {}).get(name, np.zeros(len(windows.speed)))
            return value.reshape(len(value), -1)[:, :1]

        radius, track = self.model.rover.wheels[0].radius, 0.57
        edges = np.asarray(windows.speed, float)
        speed = 0.5 * (edges[:, :-1] + edges[:, 1:])
        rim = radius * np.stack([speed[..., mine].mean(-1) for mine in (self.left, ~self.left)])
        grade = 0.5 * (windows.up_x[:, :-1] + windows.up_x[:, 1:])
        turn = rim[1] - rim[0]
        friction, drag = 0.5 * whole("hard_ground", "mu"), whole("rolling_resistance", "coefficient")
        if self.soft:
            friction, drag = np.tan(whole("soft_ground", "friction_angle")), drag + 0.05
        load = 0.25 * 70.0
        scrub = friction * np.tanh(turn / 0.1)
        sides = []
        for sign, r in zip((-1.0, 1.0), rim, strict=True):
            rolling = drag * 9.81 * np.tanh(r / 0.02)
            gear = whole("coulomb_friction", "torque") * np.tanh(r / 0.02)
            gear = gear + whole("viscous_friction", "damping") * r / radius
            sides.append(radius * load * (grade + rolling + 9.81 * sign * scrub) + gear)
        torque = np.stack([sides[0 if left else 1] for left in self.left], axis=-1)
        motor = [whole("motor", n)[..., None] for n in ("torque_constant", "gear_ratio", "gear_efficiency")]
        slip = 1.0 + 4.0 * whole("hard_ground", "slip_scale") * whole("hard_ground", "side")
        yaw_rate = turn / (track * slip)
        return Seen(torque / np.prod(motor, axis=0), torque, yaw_rate, rim.mean(axis=0), 0.0 * yaw_rate)


def cut_up(raw: Path, recording: str, parts: int, out: Path) -> None:
    """A recording of the shipped Husky as several, each with clocks of its own."""
    out.mkdir(parents=True)
    for kind in ("pro", "imu"):
        whole = pd.read_csv(raw / f"{kind}_{recording}.csv")
        seconds = whole["time"].max() / parts
        for part in range(parts):
            mine = whole[whole["time"] // seconds == part]
            mine.assign(time=mine["time"] - part * seconds).to_csv(out / f"{kind}_{part}.csv", index=False)


def documented() -> list[list[str]]:
    """The page's first commands, each as its words."""
    block = PAGE.read_text(encoding="utf-8").partition("## Commands")[2]
    return [line.split()[1:] for line in re.findall(r"^    (lunar-mjx .*)$", block.partition("\n|")[0], re.M)]


@pytest.mark.parametrize("simulated", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_every_command_reads_what_those_before_it_wrote(simulated: bool, tmp_path: Path, monkeypatch, run: Run) -> None:
    if not simulated:
        monkeypatch.setattr(problem, "_program", Skid)
    monkeypatch.setattr(bench, "MOST_WINDOWS", 12)
    monkeypatch.chdir(tmp_path)
    raw = copy_example("raw")
    for ground, (recording, parts) in GROUNDS.items():
        cut_up(raw, recording, parts, tmp_path / "BorealTC" / ground)
    commands = documented()
    assert [c[0] for c in commands] == ["log", "log", "log", "compare", "compare", "why", "add", "report"]
    for words in commands:
        more = ["--only", "soft_ground", "--only", "hard_ground.mu"] if words[0] == "why" else []
        found = run(*words, *more)
        if words[0] == "why":
            verdict = json.loads(Path("runs/snow/verdict.json").read_text(encoding="utf-8"))
            assert found.status == Verdict[verdict["verdict"]].exit_status, found.err
            assert verdict["sentence"][:40] in found.out
        else:
            assert found.status == 0, (words, found.err)
    taught, used = load_model("runs/hard/fitted.toml"), load_model("runs/snow/model.toml")
    assert any(k.startswith("between_drives.") for k in taught.priors)
    assert used.priors == taught.priors
    # one number for one error, whichever command tells it
    results = [read_result(Path("runs") / name) for name in ("snow", "snow2")]
    steps = {(s.run, s.short): s for s in chain(results)}
    for result, short in zip(results, ("refitted", "+ soft_ground"), strict=True):
        assert result.comparison is not None
        for split, of in (("fit", ("fit",)), ("held_out", ("select", "test"))):
            told = error(steps[result.name, short], of)
            assert told is not None
            assert told.value == pytest.approx(result.comparison["refitted"][split], rel=1e-6)
    assert Path("report.html").is_file()
