"""The foreign worlds stand on their own, and their physics has the right signs."""

from __future__ import annotations

import ast
import dataclasses
import tomllib
from pathlib import Path

import numpy as np
import pytest

from benchmarks.foreign import bed, cases, kinds, told, wheel
from benchmarks.foreign.laws import granular_stress
from benchmarks.foreign.misfit import Field
from benchmarks.foreign.wheel import Rows, World, run

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks" / "foreign"
SOIL = {
    "reece_c": 50.0,
    "reece_phi": 200.0,
    "unit_weight": 16000.0,
    "exponent": 0.9,
    "cohesion": 300.0,
    "friction_angle": 0.58,
    "shear_x": 0.012,
    "shear_y": 0.015,
}
GRAINS = {"grain_stiffness": 2.2e6, "rim_friction": 0.5}
LAWS = ("linear", "integral", "granular")


def world(law: str, **effects: dict[str, float]) -> World:
    return World(law, 0.1, 0.08, GRAINS if law == "granular" else SOIL, {}, None, 60.0, effects)


def rows(slip=(0.2,), angle=(0.0,), load=(60.0,), travel=0.05, gravity=9.80665) -> Rows:
    grid = [g.ravel() for g in np.meshgrid(slip, np.radians(angle), load, indexing="ij")]
    return Rows(*grid, np.full(len(grid[0]), travel), np.full(len(grid[0]), gravity))


@pytest.mark.parametrize("path", sorted(FOLDER.rglob("*.py")), ids=lambda p: p.name)
def test_worlds_share_no_code_with_the_tool(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
    names += [n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.level == 0]
    foreign = {n for n in names if n.split(".")[0] in ("lunar_mjx", "jax")}
    # Those that call the product's commands, and what these compile and keep.
    modules = ("commands.compiled", "diagnosis.drives.form", "diagnosis.drives.loop", "diagnosis.runs", "logs", "model")
    programs = {f"lunar_mjx.{m}" for m in modules}
    callers = {
        "work.py": {"lunar_mjx.cli"},
        "sweep.py": {"lunar_mjx.commands.compiled"},
        "campaigns.py": {"lunar_mjx.cli", *programs},
    }
    assert foreign == callers.get(path.name, set())


@pytest.mark.parametrize("law", LAWS)
def test_drawbar_pull_and_torque_rise_with_slip(law: str) -> None:
    found = run(world(law), rows(slip=(-0.4, -0.2, 0.0, 0.1, 0.2, 0.35)))
    assert found.reached.all()
    assert np.all(np.diff(found.drawbar_pull) > 0.0)
    assert np.all(np.diff(found.driving_torque) > 0.0)
    assert found.drawbar_pull[0] < 0.0 < found.driving_torque[-1]


@pytest.mark.parametrize("law", LAWS)
def test_side_force_opposes_the_slip_angle_and_is_odd(law: str) -> None:
    found = run(world(law), rows(angle=(-30.0, -10.0, 0.0, 10.0, 30.0)))
    assert np.all(np.diff(found.side_force) > 0.0)
    np.testing.assert_allclose(found.side_force, -found.side_force[::-1], atol=1e-6 * 60.0)
    np.testing.assert_allclose(found.drawbar_pull, found.drawbar_pull[::-1], atol=1e-6 * 60.0)


@pytest.mark.parametrize("law", LAWS)
def test_sinkage_rises_with_load(law: str) -> None:
    found = run(world(law), rows(load=(20.0, 40.0, 80.0)))
    assert np.all(np.diff(found.sinkage) > 0.0)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("angle", [0.0, 20.0])
def test_soil_takes_energy_and_gives_none(law: str, angle: float) -> None:
    at = rows(slip=(-0.5, -0.2, 0.05, 0.2, 0.5, 0.8), angle=(angle,))
    found = run(world(law), at)
    along, across = at.travel * np.cos(at.angle), at.travel * np.sin(at.angle)
    rim = np.where(at.slip >= 0.0, along / (1.0 - at.slip), along * (1.0 + at.slip))
    spent = found.driving_torque * rim / 0.1 - found.drawbar_pull * along + found.side_force * across
    assert np.all(spent > 0.0)


def test_grains_bear_a_wheel_that_stands_as_they_bear_a_plate_pressed_down() -> None:
    """A flat plate pressed down bears f1 + f2 + f3 of three ones, upward (Agarwal et al. 2023)."""
    down = np.array([0.0, 0.0, -1.0])
    np.testing.assert_allclose(granular_stress(down, down), [0.0, 0.0, 0.87504], atol=1e-5)
    blade = granular_stress(np.array([1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    assert blade[0] < 0.0 < blade[2]
    assert np.all(granular_stress(down, np.array([0.0, 0.0, 1.0])) == 0.0)


def test_pressure_of_grains_grows_with_gravity_and_sinkage_of_a_mass_does_not() -> None:
    earth = run(world("granular"), rows(load=(60.0,)))
    moon = run(world("granular"), rows(load=(60.0 * 1.62 / 9.80665,), gravity=1.62))
    np.testing.assert_allclose(moon.sinkage, earth.sinkage, rtol=1e-6)


def test_integral_agrees_with_quadrature_of_its_own_stresses() -> None:
    """The load on the rim is the integral of the stresses at 400 midpoints, too."""
    found = run(world("integral"), rows(slip=(0.3,)))
    entry = np.arccos(1.0 - found.sinkage[0] / 0.1)
    edges = np.linspace(0.0, entry, 401)
    theta = 0.5 * (edges[1:] + edges[:-1])
    front = np.where(theta >= 0.5 * entry, theta, entry - theta)
    depth = 0.1 * (np.cos(front) - np.cos(entry))
    sigma = (50.0 * 300.0 + 16000.0 * 0.08 * 200.0) * (depth / 0.08) ** 0.9
    way = 0.1 * ((entry - theta) - 0.7 * (np.sin(entry) - np.sin(theta)))
    tau = (300.0 + sigma * np.tan(0.58)) * (1.0 - np.exp(-way / 0.012))
    area = 0.1 * 0.08 * np.diff(edges)
    assert np.sum(area * (sigma * np.cos(theta) + tau * np.sin(theta))) == pytest.approx(60.0, rel=1e-3)
    assert np.sum(area * tau) * 0.1 == pytest.approx(found.driving_torque[0], rel=1e-3)


SIGNS = {
    "slip_sinkage": ({"driving": 1.0, "skid": 0.5}, "sinkage", 1),
    "angle_sinkage": ({"lateral": 1.0}, "sinkage", 1),
    "slide_softening": ({"softening": 0.7}, "sinkage", 1),
    "shear_softening": ({"loss": 0.5}, "sinkage", 1),
    "exit_angle": ({"c1": 0.5, "c2": 0.0, "c3": 0.3, "c4": 0.0}, "drawbar_pull", 1),
    "friction_circle": ({"share": 1.0}, "side_force", -1),
    "grousers": ({"height": 0.01, "count": 20.0}, "driving_torque", 1),
    "rolling_resistance": ({"coefficient": 0.05}, "driving_torque", 1),
    "bulldozing": ({"front": 1.0, "side": 1.0, "density": 1600.0}, "drawbar_pull", -1),
    "side_wall": ({"pressure": 1.4, "density": 1600.0}, "side_force", 1),
    "side_entry": ({"kept": 0.3}, "sinkage", 1),
    "curved_envelope": ({"power": 0.6, "pressure": 1000.0}, "driving_torque", -1),
    "hard_layer": ({"modulus": 1e6, "depth": 0.03}, "sinkage", -1),
    "peak_shear": ({"height": 0.4}, "driving_torque", 1),
    "rear_lift": ({"density": 3000.0}, "sinkage", 1),
    "bearing_side_load": ({"arm": 0.1}, "driving_torque", 1),
    "cohesion_lost": ({"ways": 1.0}, "driving_torque", -1),
    "bed_wall": ({"stiffer": 1.0}, "side_force", 1),
    "rate_friction": ({"per_decade": 0.2}, "driving_torque", 1),
    "creep_stiffness": ({"per_decade": 0.3}, "sinkage", -1),
    "gravity_soil": ({"stiffness": 1.0, "cohesion": 0.5}, "sinkage", 1),
    "wheel_radius_error": ({"offset": 0.01}, "driving_torque", 1),
    "soft_tyre": ({"share": 0.1}, "driving_torque", -1),
}


@pytest.mark.parametrize("name", SIGNS)
def test_effects_push_where_the_literature_says(name: str) -> None:
    amounts, quantity, sign = SIGNS[name]
    gravity = 1.62 if name == "gravity_soil" else 9.80665
    at = rows(slip=(0.4,), angle=(20.0,), travel=0.2, gravity=gravity)
    bare = getattr(run(world("integral"), at), quantity)
    there = getattr(run(world("integral", **{name: amounts}), at), quantity)
    assert sign * (there - bare)[0] > 1e-3 * abs(bare[0])


@pytest.mark.parametrize("name", SIGNS)
def test_a_moment_or_side_force_beside_the_stresses_acts_at_the_port_of_both(name: str, monkeypatch) -> None:
    """At one sinkage; the load on the wheel and its pull may be told at the port of the normal stress, these cannot."""
    bare, there = world("integral"), world("integral", **{name: SIGNS[name][0]})
    at, sunk = rows(slip=(0.4,), angle=(20.0,)), np.array([0.02])

    def change() -> np.ndarray:
        return np.abs(np.subtract(*(wheel.forces(w, wheel.settle(w, at), sunk) for w in (there, bare))))[:, 0]

    with monkeypatch.context() as stresses_alone:
        stresses_alone.setattr(wheel, "_more", lambda *given: given[-1])
        in_stress = change().max() > 0.0
    _, _, side, torque = change()
    if not in_stress and max(side, torque) > 0.0:
        assert "wheel_shear" in {**kinds.KNOWN, **kinds.OUTSIDE}[name].ports


def test_skid_shear_counts_the_whole_time_under_a_braked_wheel() -> None:
    at = rows(slip=(-0.6,), angle=(20.0,))
    base = dataclasses.replace(world("integral"), traits={"skid": 0.0})
    there = dataclasses.replace(base, effects={"skid_shear": {"share": 1.0}})
    assert run(there, at).drawbar_pull[0] < run(base, at).drawbar_pull[0]


def test_side_exit_takes_what_contact_behind_the_axle_gives() -> None:
    traits = {"c1": 0.4, "c2": 0.1, "c3": 0.3}
    at = rows(slip=(0.1,), angle=(40.0,))
    base = dataclasses.replace(world("integral"), traits=traits)
    there = dataclasses.replace(base, effects={"side_exit": {"lost": 1.0}})
    assert run(there, at).drawbar_pull[0] < run(base, at).drawbar_pull[0]


def test_every_kind_of_a_set_can_be_drawn_and_changes_the_readings() -> None:
    for number, (group, hidden) in enumerate(sorted(set(cases.plan("report", 80)))):
        case = cases.draw("report", 1, number, group, hidden)
        assert set(case.world.effects) == set(hidden)
        for name in hidden:
            bare = told.without(case.world, name)
            moved = [
                np.abs(bed.readings(bare, r, case.errors)[q] - bed.readings(case.world, r, case.errors)[q]).max()
                for r in case.rows
                for q in case.measured
            ]
            assert max(moved) > 0.0, (case.name, name)


def test_sets_hide_what_they_say() -> None:
    tune = {h for _, hidden in cases.plan("tune", 60) for h in hidden}
    report = {h for _, hidden in cases.plan("report", 600) for h in hidden}
    assert tune <= set(kinds.TUNE_KNOWN + kinds.TUNE_OUTSIDE)
    assert report == set(kinds.REPORT_KNOWN + kinds.REPORT_OUTSIDE)
    assert not set(kinds.TUNE_OUTSIDE) & set(kinds.REPORT_OUTSIDE)
    assert len(kinds.REPORT_KNOWN) >= 15


def test_misfits_have_the_size_they_are_asked_for() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(-2.0, 2.0, size=(400, 4))
    sizes = [np.sqrt(np.mean(Field.draw(rng, 0.05, 4)(x) ** 2)) for _ in range(60)]
    assert np.mean(np.square(sizes)) ** 0.5 == pytest.approx(0.05, rel=0.15)


def test_a_log_is_what_the_schema_asks_for_and_hides_the_truth(tmp_path: Path) -> None:
    case = cases.draw("tune", 5, 0, "single", ("slip_sinkage",))
    bed.write(case, tmp_path / "log")
    bed.write(case, tmp_path / "loud", 1.3)
    about = tomllib.loads((tmp_path / "log" / "log.toml").read_text(encoding="utf-8"))
    loud = tomllib.loads((tmp_path / "loud" / "log.toml").read_text(encoding="utf-8"))
    assert about["format"] == "lunar-mjx-log/1" and about["kind"] == "steady_state"
    for name, entry in about["noise"].items():
        assert loud["noise"][name]["std"] == pytest.approx(1.3 * entry["std"], rel=1e-5)
    assert (tmp_path / "log" / "points.csv").read_bytes() == (tmp_path / "loud" / "points.csv").read_bytes()
    text = (tmp_path / "log" / "log.toml").read_text(encoding="utf-8") + (tmp_path / "log" / "points.csv").read_text(
        "utf-8"
    )
    assert "slip_sinkage" not in text and case.world.law not in text


def test_told_separates_a_large_effect_and_not_a_tiny_one() -> None:
    case = cases.draw("tune", 5, 1, "single", ("rolling_resistance",))
    there = told.separable(case)["rolling_resistance"]
    tiny = dataclasses.replace(case.world, effects={"rolling_resistance": {"coefficient": 1e-5}})
    little = told.separable(dataclasses.replace(case, world=tiny))["rolling_resistance"]
    assert there["sigma"] > 50.0 * little["sigma"]
    assert 0.0 < there["sigma_blind"] <= 1.01 * there["sigma"]
