"""A rover coupled to a bed that answers its wheels: weight, momentum, frames, and a stable exchange of impulses."""

from __future__ import annotations

import dataclasses
import importlib.util
import math

import numpy as np
import pytest

from lunar_mjx.backends.in_sand import plane_of
from lunar_mjx.backends.sand_drive import SandDrive, SandRun, bed_substeps, require_shown, smooth_wheels
from lunar_mjx.errors import UserError
from lunar_mjx.model import Model, make_model
from lunar_mjx.simulate import constant_commands
from lunar_mjx.terrain import flat
from lunar_mjx.wheel_bed.particles.settings import Numerics, Sand
from tests.wheel_bed.particles.spring_bed import SpringBed

HERE = all(importlib.util.find_spec(name) for name in ("newton", "warp"))
needs_extra = pytest.mark.skipif(not HERE, reason="needs newton and warp-lang: pip install 'lunar-mjx[particles]'")
NUMERICS = Numerics(0.025, contact="pic8")


def luvmi(terrain: str = "flat") -> Model:
    return make_model("luvmi_x", terrain, "consistent").replace(gravity=1.625)


def driven(model: Model, seconds: float, bed: type = SpringBed, yaw: float = 0.3, **commands: float) -> SandDrive:
    moves = constant_commands(model, seconds, **commands)
    run = SandRun(model, moves, (0.5, -0.2, yaw), Sand(), NUMERICS, "cpu", make_bed=bed)
    run.run()
    found = run.result()
    assert found is not None and found.whole
    return found


@pytest.fixture(scope="module")
def straight() -> SandDrive:
    return driven(luvmi(), 2.0, drive=2.0)


def test_the_bed_bears_the_weight(straight):
    standing = straight.facts["standing"]
    assert standing["force_over_weight"] == pytest.approx(1.0, abs=0.01)
    force, sinkage = standing["normal_force_N"], standing["sinkage_m"]
    for left, right in (("lf", "rf"), ("lr", "rr")):
        assert force[left] == pytest.approx(force[right], rel=1e-4)
        assert sinkage[left] == pytest.approx(sinkage[right], abs=1e-5)
    # the springs' own law: a force over the stiffness, less what the damper holds still
    assert sinkage["lf"] == pytest.approx(force["lf"] * 1.1 / 2000.0, rel=0.03)


def test_momentum_closes(straight):
    assert straight.facts["momentum_error"] < 1e-8


def test_it_rolls_where_it_is_headed(straight):
    place = straight.seen.position
    way = np.array([place.x[0, -1] - place.x[0, 0], place.y[0, -1] - place.y[0, 0]])
    assert np.arctan2(way[1], way[0]) == pytest.approx(0.3, abs=1e-3)
    assert np.hypot(*way) == pytest.approx(2.0 * 2.0 * 0.1, rel=0.1)
    assert np.abs(straight.seen.slip[0, -1]).max() < 1e-3
    assert straight.facts["disagreement_m_s"] < 0.01


def test_times_and_commands_of_what_is_kept(straight):
    assert straight.seen.time[0] == pytest.approx(0.01 * np.arange(200), abs=1e-9)
    assert straight.commands.values.shape == (200, 12) and straight.commands.interval == pytest.approx(0.01)


def test_a_slope_pulls(straight):
    model = luvmi("slope:10deg")
    parked = driven(model, 0.5, yaw=0.0)
    force = parked.seen.wheel_force
    weight = parked.facts["weight_N"]
    assert parked.facts["standing"]["force_over_weight"] == pytest.approx(1.0, abs=0.02)
    # Drives that stand hold the rover against its weight along the slope.
    along = np.mean(np.sum(np.asarray(force.x)[0], axis=-1)[-20:])
    assert along == pytest.approx(weight * math.sin(math.radians(10.0)), rel=0.03)
    low, high = (
        sum(parked.facts["standing"]["normal_force_N"][c] for c in side) for side in (("lr", "rr"), ("lf", "rf"))
    )
    assert low > high


def test_a_hard_bed_makes_no_rover_chatter():
    """Impulses that lag a step in all but a wheel's own motion must die away, however stiff the ground."""

    class Hard(SpringBed):
        stiffness, damping = 1e6, 1e5

    parked = driven(luvmi(), 0.5, bed=Hard)
    force = np.asarray(parked.seen.wheel_force.z)[0, -25:]
    assert force.std(axis=0).max() < 0.02 * parked.facts["weight_N"]
    assert parked.facts["standing"]["force_over_weight"] == pytest.approx(1.0, abs=0.02)


def test_steps_of_the_bed_follow_the_rim_and_gravity():
    model = luvmi()
    slow, fast = (constant_commands(model, 1.0, drive=w) for w in (0.1, 10.0))
    # 0.06 sqrt(R/g) is 14.9 ms; 0.15 voxels of 25 mm at a rim speed of 1 m/s are 3.75 ms
    assert (bed_substeps(model, slow, NUMERICS), bed_substeps(model, fast, NUMERICS)) == (7, 1)


def test_hills_and_coarse_voxels_are_refused():
    ground = flat()
    heights = np.array(ground.field.heights)
    heights[50, 50] += 0.1
    hill = dataclasses.replace(ground, field=dataclasses.replace(ground.field, heights=heights))
    with pytest.raises(UserError, match=r"is no plane; use flat or slope:5deg"):
        plane_of(hill, 0.0, 0.0)
    wheels = smooth_wheels(luvmi())
    require_shown(wheels, 0.08 / 3.0)
    with pytest.raises(UserError, match=r"--voxel = 0.03 is too coarse"):
        require_shown(wheels, 0.03)


@needs_extra
@pytest.mark.slow
def test_a_rover_in_particles():
    """A rover in sand stands on its four wheels alike, the sand bears its weight, and it drives off and sinks in."""
    from lunar_mjx.wheel_bed.particles.sand_box import open_device

    open_device("cpu")
    model = luvmi()
    moves = constant_commands(model, 0.5, drive=1.0)
    coarse = dataclasses.replace(NUMERICS, voxel=0.04, contact="S2")
    run, again = (SandRun(model, moves, (0.0, 0.0, 0.0), Sand(), coarse, "cpu") for _ in range(2))
    run.run(lambda share: share < 0.4)
    left = run.state()
    run.run(lambda share: share < 0.45)
    # Gone on with, it does the same but for the solver's first guess and the order of sums.
    again.restore(left)
    assert again.bed.particles == run.bed.particles
    again.run(lambda share: again.done < run.done)
    for name in ("engine/qpos", "wheels"):
        assert again.state()[name] == pytest.approx(run.state()[name], abs=0.01 if name == "engine/qpos" else 2.0)
    again.run()
    found = again.result()
    assert found is not None
    standing = found.facts["standing"]
    assert standing["force_over_weight"] == pytest.approx(1.0, abs=0.03)
    sinkage = standing["sinkage_m"]
    for left, right in (("lf", "rf"), ("lr", "rr")):
        assert sinkage[left] > 0.0 and sinkage[left] == pytest.approx(sinkage[right], abs=0.004)
    assert found.seen.position.x[0, -1] > 0.01 and found.facts["momentum_error"] < 1e-6
    assert found.surface[:, 2].min() < -0.01
