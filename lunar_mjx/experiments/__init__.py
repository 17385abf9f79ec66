"""The seed paper's experiments and the checks of plausibility, as functions that return plain data."""

from lunar_mjx.experiments.hot_motor import HotMotor, hot_motor
from lunar_mjx.experiments.slope import SlopeRun, slope_runs
from lunar_mjx.experiments.soft_ground import SoftGround, soft_ground

__all__ = ["HotMotor", "SlopeRun", "SoftGround", "hot_motor", "slope_runs", "soft_ground"]
