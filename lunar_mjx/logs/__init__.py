"""Measurement logs: reading, checking, writing, templates, and logs recorded from the simulator."""

from lunar_mjx.logs.apply import commands as commands
from lunar_mjx.logs.apply import log_model as log_model
from lunar_mjx.logs.checks.gate import check as check
from lunar_mjx.logs.findings import Finding as Finding
from lunar_mjx.logs.log import Imu as Imu
from lunar_mjx.logs.log import Log as Log
from lunar_mjx.logs.log import LogTable as LogTable
from lunar_mjx.logs.log import Noise as Noise
from lunar_mjx.logs.log import SteadyLog as SteadyLog
from lunar_mjx.logs.readers.folder import read_campaign as read_campaign
from lunar_mjx.logs.readers.folder import read_log as read_log
from lunar_mjx.logs.readers.import_log import import_drives as import_drives
from lunar_mjx.logs.readers.import_log import import_log as import_log
from lunar_mjx.logs.readers.sysid_series import from_time_series as from_time_series
from lunar_mjx.logs.readers.sysid_series import to_time_series as to_time_series
from lunar_mjx.logs.recorder.instruments import Recording as Recording
from lunar_mjx.logs.recorder.simulate import simulate_log as simulate_log
from lunar_mjx.logs.seal import unseal as unseal
from lunar_mjx.logs.template import new_log as new_log
from lunar_mjx.logs.write import write_log as write_log
from lunar_mjx.logs.write import write_steady_log as write_steady_log
