"""Measurement logs: reading, checking, writing, templates, and logs recorded from the simulator."""

from lunar_mjx.criticism.log.apply import commands as commands
from lunar_mjx.criticism.log.apply import log_model as log_model
from lunar_mjx.criticism.log.check import check as check
from lunar_mjx.criticism.log.findings import Finding as Finding
from lunar_mjx.criticism.log.importers import import_log as import_log
from lunar_mjx.criticism.log.instruments import Recording as Recording
from lunar_mjx.criticism.log.log import Imu as Imu
from lunar_mjx.criticism.log.log import Log as Log
from lunar_mjx.criticism.log.log import LogTable as LogTable
from lunar_mjx.criticism.log.log import Noise as Noise
from lunar_mjx.criticism.log.log import SteadyLog as SteadyLog
from lunar_mjx.criticism.log.new import new_log as new_log
from lunar_mjx.criticism.log.read import read_campaign as read_campaign
from lunar_mjx.criticism.log.read import read_log as read_log
from lunar_mjx.criticism.log.seal import unseal as unseal
from lunar_mjx.criticism.log.simulate import simulate_log as simulate_log
from lunar_mjx.criticism.log.sysid_series import from_time_series as from_time_series
from lunar_mjx.criticism.log.sysid_series import to_time_series as to_time_series
from lunar_mjx.criticism.log.write import write_log as write_log
from lunar_mjx.criticism.log.write import write_steady_log as write_steady_log
