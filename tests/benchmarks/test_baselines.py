"""The other tools' side of the comparison: fits, formulas and rules on problems with known answers."""

from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import baseline_tools as tools
from benchmarks import baselines
from lunar_mjx.inference.observations import Observations, Series
from tests.inference.toy_problem import Linear

CHANNELS = ("drawbar_pull_N", "side_force_N", "driving_torque_Nm", "sinkage_m")


@pytest.fixture
def sysid() -> None:
    from mujoco import sysid as module

    if not hasattr(module, "optimize"):
        pytest.skip("mujoco.sysid is not complete")


def table(points: int = 81) -> Observations:
    """Four channels at the same points of slip ratio, slip angle and load; two of five slip angles are held out."""
    rng = np.random.default_rng(0)
    angle = np.repeat(np.arange(5), points // 5 + 1)[:points]
    place = np.column_stack([rng.uniform(-0.1, 0.7, points), 11.0 * angle, rng.uniform(20.0, 60.0, points)])
    series = tuple(Series(0, c, i * points, (i + 1) * points, None, 1.0) for i, c in enumerate(CHANNELS))
    return Observations(
        np.zeros(4 * points),
        series,
        ("log",),
        ("fit",),
        np.tile(angle, 4),
        ("fit", "select", "fit", "select", "fit"),
        tuple(map(str, range(5))),
        np.tile(place, (4, 1)),
    )


def problem(amount: float = 0.0, seed: int = 1, **limits: float) -> tuple[Linear, dict[str, np.ndarray]]:
    """Two baseline columns; candidates `slip` (in the torque), `angle` (in the side force), `dead` (nowhere). What is
    measured is the baseline at (3, -2) and `amount` of the first."""
    rng = np.random.default_rng(seed)
    seen = table()
    n = len(seen.value) // 4
    x = seen.place
    assert x is not None
    extra = {"slip": np.zeros(4 * n), "angle": np.zeros(4 * n), "dead": np.zeros(4 * n)}
    extra["slip"][2 * n : 3 * n] = x[:n, 0]
    extra["angle"][n : 2 * n] = x[:n, 1] / 44.0
    # the baseline knows slip and angle only in the sinkage, so that it absorbs neither candidate
    base = np.column_stack([np.r_[np.zeros(3 * n), x[:n, 2] / 60.0], np.r_[np.zeros(3 * n), np.ones(n)]])
    value = base @ [3.0, -2.0] + amount * extra["slip"] + rng.normal(size=4 * n)
    observations = Observations(
        value, seen.series, seen.logs, seen.split, seen.unit, seen.unit_split, seen.unit_names, seen.place
    )
    return Linear(base, extra, observations, **limits), extra


def test_sysid_finds_the_least_squares(sysid: None) -> None:
    made, _ = problem(5.0)
    fitted = made.observations.in_split("fit")
    found = tools.sysid_fit(made, "slip", made.origin())
    columns = made.matrix[:, found.free]
    exact = np.linalg.lstsq(columns[fitted], made.observations.value[fitted], rcond=None)[0]
    np.testing.assert_allclose(found.u[found.free], exact, rtol=1e-4)
    assert found.u[3] == 0.0 and found.evaluations > 3


def test_sysid_stays_within_bounds(sysid: None) -> None:
    made, _ = problem(0.0, low=-1.0, high=1.0)
    found = tools.sysid_fit(made, "", made.origin())
    assert np.all(np.abs(found.u[:2]) <= 1.0) and found.u[0] == pytest.approx(1.0, abs=1e-3)


def test_the_rules_name_what_is_hidden(sysid: None) -> None:
    made, _ = problem(8.0)
    found = tools.refits(made)
    assert [f.effect for f in found] == ["", "slip", "angle"], "what changes nothing is not refitted"
    said = tools.answers(made, found)
    assert said["smallest"] == said["careful"] == {"verdict": "KNOWN", "named": ["slip"]}
    assert said["at_noise"] == {"": False, "slip": True, "angle": False}


def refit(made: Linear, effect: str, error: float) -> tools.Refit:
    """A fit whose residual is noise of a size everywhere."""
    residual = error * np.random.default_rng(3).normal(size=len(made.observations.value))
    return tools.Refit(effect, made.origin(), made.free([]), residual, 1)


@pytest.mark.parametrize(
    ("soil", "slip", "smallest", "careful"),
    [
        (0.98, 0.97, "slip", "NOISE_ONLY"),
        (0.97, 0.98, "NOISE_ONLY", "NOISE_ONLY"),
        (3.0, 0.98, "slip", "slip"),
        (3.0, 2.0, "slip", "UNKNOWN"),
    ],
)
def test_rules(soil: float, slip: float, smallest: str, careful: str) -> None:
    made, _ = problem()
    said = tools.answers(made, [refit(made, "", soil), refit(made, "slip", slip), refit(made, "angle", 4.0)])
    for rule, wanted in (("smallest", smallest), ("careful", careful)):
        named = [wanted] if wanted == "slip" else []
        assert said[rule] == {"verdict": "KNOWN" if named else wanted, "named": named}, rule


def soil_alone(made: Linear) -> tools.Refit:
    u = np.array([3.0, -2.0, 0.0, 0.0, 0.0])
    return tools.Refit("", u, made.baseline, made.predict(u)[0] - made.observations.value, 1)


def test_sindy_finds_a_polynomial_and_keeps_silent_on_noise() -> None:
    pytest.importorskip("pysindy")
    made, _ = problem(20.0)
    found = tools.sindy(made, soil_alone(made))
    assert not found["silent"] and found["at_noise"]
    assert max(found["strength"], key=lambda c: found["strength"][c]) == "driving_torque_Nm"
    assert "slip" in found["terms"]["driving_torque_Nm"][0][0]
    made, _ = problem(0.0)
    quiet = tools.sindy(made, soil_alone(made))
    assert quiet["silent"] and quiet["number_of_terms"] == 0


class Truth:
    """A truth that shows in the torque, and a third as strongly in the sinkage."""

    sigma, channels = dict.fromkeys(CHANNELS, 2.0), CHANNELS

    def __init__(self, effects: dict[str, Any]):
        self.effects = effects

    def clean(self) -> dict[str, np.ndarray]:
        size = dict(zip(CHANNELS, (0.0, 0.0, 9.0, 3.0), strict=True)) if self.effects else dict.fromkeys(CHANNELS, 0.0)
        return {c: np.full(5, v) for c, v in size.items()}


@pytest.mark.parametrize(
    ("channel", "term", "right"),
    [
        ("driving_torque_Nm", "slip load", True),
        ("driving_torque_Nm", "slip^2", True),
        ("driving_torque_Nm", "1", False),
        ("sinkage_m", "slip", False),
    ],
)
def test_where_a_formula_points(monkeypatch: pytest.MonkeyPatch, channel: str, term: str, right: bool) -> None:
    monkeypatch.setattr(baselines.dataclasses, "replace", lambda truth, effects: Truth(effects))
    truth = Truth({"slip_sinkage": {}})
    assert baselines.shows_in(truth) == {"driving_torque_Nm"}
    strength = {c: float(c == channel) for c in CHANNELS}
    found = {"silent": False, "strength": strength, "terms": {channel: [(term, 5.0), ("angle", 1.0)]}}
    assert baselines.points_right(found, truth) is right
    assert not baselines.points_right({"silent": True}, truth)


def test_every_hidden_effect_has_its_quantities() -> None:
    from benchmarks.hidden.bed import effects as bed_effects

    assert set(baselines.QUANTITIES_OF) == {*bed_effects.KNOWN, *bed_effects.OUTSIDE}
    assert set().union(*baselines.QUANTITIES_OF.values()) == {*tools.FEATURES, "1"}


def test_figures_count_crashes_as_wrong() -> None:
    good = {
        "smallest": {"right": False, "wrong_name": True},
        "careful": {"right": True, "wrong_name": False},
        "seconds": 2.0,
    }
    rows = [
        {
            "group": "nulls",
            "right": True,
            "wrong_name": False,
            "refit": good,
            "sindy": {"silent": True},
            "seconds": 1.0,
        },
        {"group": "nulls", "right": False, "wrong_name": False, "verdict": "CRASH"},
    ]
    found = baselines.figures(rows)["nulls"]
    hits = {k: (v["hits"], v["of"]) for k, v in found.items()}
    assert hits["mujoco.sysid careful, right"] == (1, 2) and hits["mujoco.sysid smallest, wrong name"] == (1, 2)
    assert hits["pySINDy, silent"] == (1, 2) and hits["lunar_mjx.criticism, right"] == (1, 2)


def test_a_missing_tool_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco.sysid", types.ModuleType("mujoco.sysid"))
    monkeypatch.setattr("mujoco.sysid", sys.modules["mujoco.sysid"], raising=False)
    monkeypatch.setattr(sys, "argv", ["baselines.py", "run", "--out", str(tmp_path / "a.jsonl")])
    assert baselines.main() == 2
    told = capsys.readouterr().err.strip()
    assert told.count("\n") == 0 and "mujoco.sysid" in told and "lunar-mjx[baselines]" in told
    assert not (tmp_path / "a.jsonl").exists()
