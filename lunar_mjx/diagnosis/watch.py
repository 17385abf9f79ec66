"""The verb watch: follows a growing log with a fitted model, raises an alarm where something begins, and names it."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.build_problem import known_logs
from lunar_mjx.diagnosis.drives.windows.began import ONSET, began
from lunar_mjx.diagnosis.drives.windows.cut import CUTTING, Cut
from lunar_mjx.diagnosis.drives.windows.following import Follower, Steps
from lunar_mjx.diagnosis.drives.windows.settings import DIFFERENCES
from lunar_mjx.diagnosis.runs import Run, load_run, plain
from lunar_mjx.diagnosis.verdict import Diagnosis, Verdict
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.inference.changes import Change, ChangeDetector, Restlessness
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.logs import Log, check, read_log
from lunar_mjx.logs.findings import is_bad


@dataclasses.dataclass(frozen=True)
class Watching:
    """Pace of a watch over a drive."""

    hours: float = 10.0
    """Driving from one false alarm to the next, at least, h."""
    # Time between two looks at a growing log; time without growth after which it has ended, s.
    every_s: float = 2.0
    idle_s: float = 60.0
    chunk: int = 64
    """Windows of a finished log that are simulated at once."""


WATCHING = Watching()

RECORDINGS = (".mcap", ".bag", ".db3")
"""Endings of recordings that have to be imported before."""


@dataclasses.dataclass(frozen=True)
class Alarm:
    """Moment at which something began in a followed log, with what it is once that is known.

    Attributes:
      number: of the alarm, from 1. onset_s: most probable time, on the log's clock. first_s, last_s: between which it
        lies with 95 %. raised_s: when the log was long enough to tell.
      differences: probability of each difference that may have jumped, most probable first.
      size: words for the size of the most probable one. diagnosis: what began, once enough was driven after it.
    """

    number: int
    onset_s: float
    first_s: float
    last_s: float
    raised_s: float
    differences: dict[str, float]
    size: str
    diagnosis: Diagnosis | None = None

    @property
    def sentence(self) -> str:
        """The alarm, and what began if that is known, in a line."""
        difference, chance = next(iter(self.differences.items()))
        cause = (
            f"{self.raised_s:.1f} s: alarm {self.number}: something began at {self.onset_s:.1f} s (between "
            f"{self.first_s:.1f} and {self.last_s:.1f} s), most probably at {difference} ({chance:.2f}): {self.size}."
        )
        if self.diagnosis is None:
            return cause
        names = ", ".join(self.diagnosis.effects) or self.diagnosis.port or "nothing by name"
        return f"alarm {self.number}, began at {self.onset_s:.1f} s: {self.diagnosis.verdict.label} {names}. " + (
            self.diagnosis.sentence
        )

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "diagnosis"}
        fields["event"] = "alarm" if self.diagnosis is None else "named"
        if self.diagnosis is not None:
            fields["diagnosis"] = self.diagnosis.to_dict()
        return plain({**fields, "sentence": self.sentence})


def watch(
    log: str | Path,
    run: str | Path | Run,
    hours: float = WATCHING.hours,
    once: bool = False,
    out: str | Path | None = None,
    idle_s: float = WATCHING.idle_s,
    progress: Progress = silent,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Alarm]:
    """Alarms of a log, each twice: as it is raised, and with what began once that is known.

    Args:
      log: a log's folder with imposed wheel speeds. run: a comparison of undisturbed drives of the same rover.
      hours: of driving from one false alarm to the next, at least, in the mean.
      once: whether the log has ended; else it is followed until it has not grown for `idle_s`.
      out: folder for what is kept of each alarm; `watch` in the run's folder if None.
      idle_s: s. progress: told what is being done. sleep: how time passes between two looks at a growing log.

    Raises:
      UserError: the log cannot be followed, the run is none of drives with imposed wheel speeds, or its `run.json`
        names what does not exist.
    """
    path = Path(log)
    if path.suffix in RECORDINGS:
        raise bad_input(
            "watch",
            "LOG",
            str(path),
            "is a recording and no log",
            "import it with lunar-mjx log import, and watch that",
        )
    if not 0.0 < hours < math.inf:
        raise bad_input("watch", "--hours", hours, "is no time between false alarms", "give hours above 0")
    run = run if isinstance(run, Run) else load_run(run)
    follower = Follower(run)
    # Both refuse at once what cannot be watched, and not when the first look comes.
    known_logs(run)
    _read(path, follower)
    place = run.folder / "watch" if out is None else Path(out)
    return _Watch(path, run, follower, follower.restlessness(progress), hours, place, progress).alarms(
        once, idle_s, sleep
    )


def _read(path: Path, follower: Follower) -> Log:
    """The log as it is now.

    Raises:
      UserError: it is no drive with imposed wheel speeds, or one of another rover.
    """
    log = read_log(path)
    if not isinstance(log, Log) or log.imposed is None:
        raise UserError(
            f"{path}: its wheel speeds are not imposed, and only such drives are watched; write "
            'imposed = "wheel_speed" in log.toml where the measured wheel speeds are what the wheels did.'
        )
    rover = follower.model.rover
    if Path(log.rover).name != rover.folder.name:
        raise bad_input(path, "rover", log.rover, f"is not the run's, {rover.folder.name}", "watch it with its own run")
    return log


class _Watch:
    """One log that is being followed."""

    def __init__(
        self,
        path: Path,
        run: Run,
        follower: Follower,
        restless: Restlessness,
        hours: float,
        out: Path,
        progress: Progress,
    ):
        self.path, self.run, self.follower, self.restless = path, run, follower, restless
        self.hours, self.out, self.progress = hours, out, progress
        self.detector: ChangeDetector | None = None
        self.seen: list[float] = []  # when each window began
        self.open: list[tuple[Alarm, Change]] = []
        self.count = 0

    def alarms(self, once: bool, idle_s: float, sleep: Callable[[float], None]) -> Iterator[Alarm]:
        """Alarms of the log, each twice: as it is raised, and with what began once that is known."""
        last_end, waited = -math.inf, 0.0
        while True:
            try:
                log = _read(self.path, self.follower)
                # A log that still grows may well look damaged at its end.
                if once and is_bad(findings := check([log])):
                    bad = next(f for f in findings if f.severity == "bad_data")
                    raise UserError(f"{bad.where}: {bad.message}; mend the log before it is watched.")
                end = log.span_s[1]
                windows = self.follower.windows(log)
            except (UserError, ValueError, IndexError):
                # a line that is being written, or a drive that is too short as yet
                if once or waited >= idle_s:
                    raise
            else:
                waited = 0.0 if end > last_end else waited
                last_end = max(last_end, end)
                yield from self._follow(log, windows, end if once else end - CUTTING.levelling_s, once)
                if once or waited >= idle_s:
                    yield from self._name(log, windows, True)
                    return
            sleep(WATCHING.every_s)
            waited += WATCHING.every_s

    def _follow(self, log: Log, found: Cut, until_s: float, once: bool) -> Iterator[Alarm]:
        """Takes the windows that are new and complete."""
        begun = self.seen[-1] if self.seen else -math.inf
        # Windows are cut anew at every look: rounding must not show one twice.
        new = np.flatnonzero((found.start_s > begun + 1e-6) & (found.start_s + found.seconds <= until_s + 1e-6))
        for at in range(0, len(new), WATCHING.chunk):
            part = new[at : at + WATCHING.chunk]
            self.progress("following", float(part[0]) / max(len(found), 1))
            steps = self.follower.steps(found.part(part), log)
            if self.detector is None:
                self.detector = self.follower.detector(steps, self.restless, self.hours)
            for start, step in zip(steps.cut.start_s, steps.steps, strict=True):
                self.seen.append(float(start))
                change = self.detector.see(*step)
                if change is not None:
                    self.count += 1
                    alarm = self._alarm(change, steps)
                    self.open.append((alarm, change))
                    yield alarm
        # Of a finished log alarms are named at its end, when all that followed is known.
        yield from self._name(log, found, False) if not once else ()

    def _alarm(self, change: Change, steps: Steps) -> Alarm:
        length = steps.cut.seconds
        kind = next(iter(change.kinds))
        return Alarm(
            number=self.count,
            onset_s=self.seen[change.onset],
            first_s=self.seen[change.first],
            # Windows are known by their beginning, and what began may have begun anywhere within the last one.
            last_s=self.seen[change.last] + length,
            # A window's slope is known when the accelerometer's mean about its end is complete.
            raised_s=self.seen[change.seen] + length + CUTTING.levelling_s,
            differences={k: p for k, p in change.kinds.items() if p >= 0.01},
            size=self._size(kind, float(change.amount[list(steps.names).index(kind)])),
        )

    def _size(self, kind: str, amount: float) -> str:
        """A jump in the user's words; those of friction and slip are factors."""
        difference = DIFFERENCES[kind]
        value = amount * self.follower.share(kind)
        if kind.startswith("wheel_shear"):
            return f"{difference.words} times {math.exp(value):.2g}"
        return f"{difference.words} {value:+.2g}"

    def _name(self, log: Log, found: Cut, ended: bool) -> Iterator[Alarm]:
        """Names what began wherever enough was driven since, or nothing more will be."""
        waiting = []
        for n, (alarm, change) in enumerate(self.open):
            following = self.open[n + 1][1].first if n + 1 < len(self.open) else len(self.seen)
            if not ended and following == len(self.seen) and len(self.seen) - change.last <= ONSET.most_after:
                waiting.append((alarm, change))
                continue
            numbers = np.searchsorted(found.start_s, np.array(self.seen[:following]) - 1e-6)
            mine = found.part(numbers[numbers < len(found)])
            child = dataclasses.replace(self.run, folder=self.out / f"alarm{alarm.number}")
            self.progress(f"naming alarm {alarm.number}", 0.0)
            diagnosis = began(
                child, self.follower, log, mine, (change.first, change.last), self.restless, self.progress
            )
            yield dataclasses.replace(alarm, diagnosis=_certain(diagnosis))
        self.open = waiting


def _certain(diagnosis: Diagnosis) -> Diagnosis:
    """The diagnosis; where the search names nothing that is undecidable, for the alarm is evidence of something."""
    if diagnosis.verdict is not Verdict.NOISE_ONLY:
        return diagnosis
    sentence = "What began is too small or too short to be told by name."
    return dataclasses.replace(diagnosis, verdict=Verdict.UNDECIDABLE, sentence=sentence)
