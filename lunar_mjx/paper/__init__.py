"""The seed paper's experiments and the checks of plausibility, as functions that return plain data."""

from lunar_mjx.paper.hot_motor import HotMotor, hot_motor
from lunar_mjx.paper.slope import SlopeRun, slope_runs
from lunar_mjx.paper.soft_ground import SoftGround, soft_ground

__all__ = ["HotMotor", "SlopeRun", "SoftGround", "hot_motor", "slope_runs", "soft_ground"]
