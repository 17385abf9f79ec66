"""Criticism: holding models against measurements. So far: single-wheel test beds and their steady-state tables."""

from lunar_mjx.criticism.data_files import load_figures as load_figures
from lunar_mjx.criticism.data_files import replicate_scatter as replicate_scatter
from lunar_mjx.criticism.fit import WheelFit as WheelFit
from lunar_mjx.criticism.fit import fit as fit
from lunar_mjx.criticism.single_wheel import WheelBed as WheelBed
from lunar_mjx.criticism.single_wheel import WheelResult as WheelResult
from lunar_mjx.criticism.single_wheel import WheelTest as WheelTest
from lunar_mjx.criticism.single_wheel import wheel_test as wheel_test
from lunar_mjx.criticism.steady_state import Comparison as Comparison
from lunar_mjx.criticism.steady_state import compare as compare
from lunar_mjx.criticism.table import SteadyStateTable as SteadyStateTable
from lunar_mjx.criticism.table import average as average
from lunar_mjx.criticism.table import read_table as read_table
