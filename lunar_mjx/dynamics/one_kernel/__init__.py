"""Many steps of many rovers as one kernel whose state never leaves the chip."""

from lunar_mjx.dynamics.one_kernel.rollout import KernelRollout as KernelRollout
from lunar_mjx.dynamics.one_kernel.scalar_graph import Graph as Graph
from lunar_mjx.dynamics.one_kernel.scalar_graph import UnsupportedError as UnsupportedError
