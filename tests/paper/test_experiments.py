"""The seed paper's Figs. 3 and 5 and the slope check: what they must show."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.paper import hot_motor, slope_runs, soft_ground


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "consistent"])
def test_hot_motor_loses_torque_and_cuts_off_at_150_degC(preset: str) -> None:
    """Fig. 3: torque starts at the 15 N m asked for, falls as the winding heats, and drops to zero at 150 degC."""
    run = hot_motor(preset, duration=7.0)
    before = run.time < run.cutoff_time
    assert run.torque[0] == pytest.approx(15.0, rel=1e-4)
    assert (np.diff(run.torque[before]) < 0).all()
    assert run.winding[before].max() < 150.0 <= run.winding.max() + 1.0
    # eq. 7 at 150 degC: K = K_0 (1 - 0.0012 * 125)
    assert run.torque[before][-1] == pytest.approx(15.0 * (1 - 0.0012 * 125), rel=5e-3)
    assert run.torque[np.searchsorted(run.time, run.cutoff_time)] == 0.0
    if preset == "paper":
        assert (run.torque[~before] == 0.0).all()
        assert np.ptp(run.housing) < 1e-6  # flaw 1: the stator never warms
    else:
        assert run.housing[-1] > run.housing[0] + 1.0


@pytest.mark.slow
def test_soft_ground_deviates_and_mirrors() -> None:
    """Fig. 5: straight on hard ground; on soil softer to one side toward that side, and mirrored for the other."""
    ends = {(r.ground, r.side): (r.x[-1] - r.x[0], r.y[-1] - r.y[0]) for r in soft_ground("consistent", 4.0)}
    assert abs(ends["hard", 1][1]) < 1e-5 and abs(ends["hard", -1][1]) < 1e-5
    assert ends["soft", 1][1] > 0.02
    assert ends["soft", -1][1] == pytest.approx(-ends["soft", 1][1], rel=1e-5)
    assert ends["soft", -1][0] == pytest.approx(ends["soft", 1][0], rel=1e-7)
    assert 1.0 < ends["soft", 1][0] < ends["hard", 1][0]


@pytest.mark.slow
def test_viper_stalls_near_the_plausible_slope() -> None:
    """40 % slip comes near the 15.1 degrees that one wheel's drawbar pull allows; 25 degrees are too steep."""
    flat, at, steep = slope_runs([0.0, 15.1, 25.0], duration=10.0, average=3.0)
    assert 0.0 < flat.slip < 0.12
    assert 0.30 < at.slip < 0.50
    assert steep.slip > 0.95
    assert flat.speed > at.speed > steep.speed
