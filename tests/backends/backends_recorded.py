"""A rover's model, grounds and recorded drive, for the comparisons."""

from __future__ import annotations

from lunar_mjx.backends.parity import compare as parity
from lunar_mjx.backends.parity.cases import SOFT_LOOP, cases, drive
from lunar_mjx.backends.parity.record import record
from lunar_mjx.model import make_model

DURATION, SAMPLES = 4.0, 6


class Recorded:
    """A model, its grounds, and the reference's drive on each."""

    def __init__(self, rover: str, preset: str, duration: float = DURATION, grounds=None):
        self.model = make_model(rover, "flat", preset)
        self.cases = cases(self.model.rover, grounds)
        self.commands = drive(self.model, duration)
        self.of = {c.name: record(self.model, c, self.commands, SAMPLES) for c in self.cases}

    def judge(self, runner: parity.Runner, kind: str) -> list[parity.Result]:
        """Levels 1 and 2 on all grounds."""
        wanted = parity.tolerances(kind)
        return [
            result
            for case in self.cases
            for samples in (self.of[case.name][0],)
            for result in parity.judge(
                case, samples, runner.step_from(case, samples), wanted, self.model, SOFT_LOOP in kind
            )
        ]
