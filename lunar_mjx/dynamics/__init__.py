"""One physics step with the effects at their ports, on interchangeable rigid-body engines."""

from lunar_mjx.dynamics.state import Ambient, Params, State, Telemetry, Temperature
from lunar_mjx.dynamics.system import System, build

__all__ = ["Ambient", "Params", "State", "System", "Telemetry", "Temperature", "build"]
