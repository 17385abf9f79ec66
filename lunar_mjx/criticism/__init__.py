"""Criticism: compare a model with measurements, see where it fails, learn which effect is missing, add it.

Every verb of the loop is a function: `check`, `compare`, `why` (and `explain`), `next_experiment`, `add`, `unknown`,
`report`, `studio`, `improve`, `audit`, and `simulate_log` makes measurements to try them on. Their results are plain
data.
"""

from lunar_mjx.diagnosis.audit import Audit as Audit
from lunar_mjx.diagnosis.audit import audit as audit
from lunar_mjx.diagnosis.formulas.discover import Discovery as Discovery
from lunar_mjx.diagnosis.formulas.discover import discover as unknown  # noqa: F401
from lunar_mjx.diagnosis.next_experiment import NextExperiment as NextExperiment
from lunar_mjx.diagnosis.next_experiment import next_experiment as next_experiment
from lunar_mjx.diagnosis.report import write_report as report  # noqa: F401
from lunar_mjx.diagnosis.runs import Run as Run
from lunar_mjx.diagnosis.runs import load_run as load_run
from lunar_mjx.diagnosis.studio import studio as studio
from lunar_mjx.diagnosis.verbs import BadData as BadData
from lunar_mjx.diagnosis.verbs import add as add
from lunar_mjx.diagnosis.verbs import compare as compare
from lunar_mjx.diagnosis.verbs import explain as explain
from lunar_mjx.diagnosis.verbs import improve as improve
from lunar_mjx.diagnosis.verbs import why as why
from lunar_mjx.diagnosis.verdict import Diagnosis as Diagnosis
from lunar_mjx.diagnosis.verdict import EffectEvidence as EffectEvidence
from lunar_mjx.diagnosis.verdict import Verdict as Verdict
from lunar_mjx.logs import check as check
from lunar_mjx.logs import read_campaign as read_campaign
from lunar_mjx.logs import read_log as read_log
from lunar_mjx.logs import simulate_log as simulate_log
from lunar_mjx.logs import write_log as write_log
from lunar_mjx.wheel_bed.bed import WheelBed as WheelBed
from lunar_mjx.wheel_bed.bed import WheelResult as WheelResult
from lunar_mjx.wheel_bed.bed import WheelTest as WheelTest
from lunar_mjx.wheel_bed.bed import wheel_test as wheel_test
from lunar_mjx.wheel_bed.comparison import Comparison as Comparison
from lunar_mjx.wheel_bed.data_files import load_figures as load_figures
from lunar_mjx.wheel_bed.data_files import replicate_scatter as replicate_scatter
from lunar_mjx.wheel_bed.soil_fit import WheelFit as WheelFit
from lunar_mjx.wheel_bed.soil_fit import fit as fit
from lunar_mjx.wheel_bed.table import SteadyStateTable as SteadyStateTable
from lunar_mjx.wheel_bed.table import average as average
from lunar_mjx.wheel_bed.table import read_table as read_table
