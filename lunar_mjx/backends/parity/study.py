"""Runs the comparison of a rover on several engines, over all grounds and presets."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Collection, Sequence

from lunar_mjx.backends.base import Observation
from lunar_mjx.backends.native import NativeBackend
from lunar_mjx.backends.parity.cases import RELATIVE, SOFT_LOOP, Case, cases, drive
from lunar_mjx.backends.parity.compare import JaxRunner, Result, Runner, judge, judge_drive, tolerances
from lunar_mjx.backends.parity.record import Noise, Samples, record
from lunar_mjx.backends.pybullet import PyBulletBackend, import_pybullet
from lunar_mjx.dynamics.state import Telemetry
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.model import Model, make_model
from lunar_mjx.report import Reporter
from lunar_mjx.simulate import Commands

ENGINES = ("structured", "mjx", "structured:float32", "mjx:float32", "pybullet", "pybullet:engine")
"""What can be compared with native MuJoCo; `pybullet:engine` bears the wheels by Bullet's own contact."""

DEFAULT_ENGINES = ("structured", "mjx", "structured:float32", "pybullet", "pybullet:engine")


@dataclasses.dataclass
class EngineRun:
    """One engine over all grounds: stages and next states from the samples, and drives, by ground."""

    name: str
    steps: dict[str, tuple[Observation, Observation]]
    drives: dict[str, Telemetry]


@dataclasses.dataclass
class Pair:
    """How far two engines agree.

    Attributes:
      first, second: names. kind: of tolerance. results: of all grounds and levels. judged: whether agreement is
        demanded; with Bullet's own contact the engines differ by nature.
    """

    first: str
    second: str
    kind: str
    results: list[Result]
    judged: bool = True

    @property
    def failed(self) -> list[Result]:
        """Results above their tolerance; none where the pair of backends is shown and not judged."""
        return [r for r in self.results if not r.passed] if self.judged else []


@dataclasses.dataclass
class Study:
    """All pairs of one rover and preset, the reference's drives and its noise floors."""

    model: Model
    grounds: list[Case]
    pairs: list[Pair]
    runs: dict[str, EngineRun]
    noise: dict[str, Noise]

    def floor(self, pair: Pair, ground: str) -> Telemetry:
        """The drives that a pair is held against; see `floor_of`."""
        return floor_of((pair.first, pair.second), pair.kind, self.noise[ground])


def make_runner(engine: str, model: Model) -> Runner:
    """The runner of an engine of `ENGINES`.

    Raises:
      UserError: unknown engine, or PyBullet is not installed.
    """
    if engine not in ENGINES:
        raise bad_input("parity", "engine", engine, "does not exist", f"use some of {', '.join(ENGINES)}")
    name, _, option = engine.partition(":")
    # Options of JAX's engines are precisions, those of PyBullet its kinds of contact.
    if name != "pybullet":
        return JaxRunner(name, model, option or "float64")
    import_pybullet()
    contact = option or "numpy"
    shown = "pybullet" if contact == "numpy" else "pybullet, own contact"
    return Runner(shown, lambda m, n: PyBulletBackend(m, rovers=n, contact=contact), model, rovers=1)


def available(engines: Collection[str]) -> tuple[list[str], str]:
    """The installed ones of some engines, and a sentence on what is left out (empty if nothing is)."""
    try:
        import_pybullet()
    except UserError as missing:
        return [e for e in engines if not e.startswith("pybullet")], str(missing)
    return list(engines), ""


def run_study(
    rover: str,
    preset: str,
    engines: Sequence[str] = DEFAULT_ENGINES,
    duration: float = 5.0,
    samples: int = 16,
    grounds: Collection[str] | None = None,
    report: Reporter = lambda what, done: None,
) -> Study:
    """Compares engines with native MuJoCo, and the structured engine with MJX, on one rover and preset.

    Args:
      rover: name or folder. preset: "consistent", "field" or "paper".
      engines: some of `ENGINES`. duration: of the drives, s. samples: states per ground for levels 1 and 2.
      grounds: names of the grounds, all if None.
      report: told of the progress.

    Raises:
      UserError: an unknown engine, preset, rover or ground.
    """
    model = make_model(rover, "flat", preset)
    known = cases(model.rover)
    wrong = set(grounds or ()) - {c.name for c in known}
    if wrong:
        raise bad_input(
            "parity", "ground", sorted(wrong)[0], "does not exist", f"use some of {'; '.join(c.name for c in known)}"
        )
    used = [c for c in known if grounds is None or c.name in grounds]
    runners = [make_runner(e, model) for e in engines]
    commands = drive(model, duration)
    parts = len(used) * (2 + 3 * len(runners))  # a drive takes about as long as the samples of two grounds
    recorded = {}
    for i, case in enumerate(used):
        report(f"{preset}: native, {case.name}", 2 * i / parts)
        recorded[case.name] = record(model, case, commands, samples)
    reference = EngineRun(
        NativeBackend.name,
        {k: (r[0].stages, r[0].after) for k, r in recorded.items()},
        {k: r[1] for k, r in recorded.items()},
    )
    of = {k: r[0] for k, r in recorded.items()}
    runs = {reference.name: reference}
    for i, runner in enumerate(runners):
        first = len(used) * (2 + 3 * i)
        runs[runner.name] = _run(
            runner,
            used,
            of,
            commands,
            lambda what, done, first=first: report(f"{preset}: {what}", (first + 3 * len(used) * done) / parts),
        )
    noise = {k: r[2] for k, r in recorded.items()}
    pairs = [_pair(model, used, reference, runs[r.name], of, noise) for r in runners]
    # Against each other, too: they share the effects, so that what differs is rigid-body dynamics alone.
    if "structured" in runs and "mjx" in runs:
        pairs.append(_pair(model, used, runs["structured"], runs["mjx"], of, noise))
    return Study(model, used, pairs, runs, noise)


def _run(runner: Runner, used: list[Case], of: dict[str, Samples], commands: Commands, report: Reporter) -> EngineRun:
    """One engine over all grounds; what it holds is freed before the next."""
    steps, drives = {}, {}
    with contextlib.closing(runner):
        for i, case in enumerate(used):
            report(f"{runner.name}, states on {case.name}", i / (3 * len(used)))
            steps[case.name] = runner.step_from(case, of[case.name])
        # All grounds in one batch where the engine can: one program in place of one a ground.
        if isinstance(runner, JaxRunner):
            report(f"{runner.name}, drives", 1 / 3)
            drives = dict(zip((c.name for c in used), runner.drives(used, commands), strict=True))
        else:
            for i, case in enumerate(used):
                report(f"{runner.name}, drive on {case.name}", (1 + 2 * i / len(used)) / 3)
                drives[case.name] = runner.drive(case, commands)
    return EngineRun(runner.name, steps, drives)


def kind_of(names: tuple[str, str], model: Model) -> str:
    """What separates two engines: keys of their tolerance, comma-separated."""
    kinds = ["float64"]
    for name in names:
        if name.endswith("float32"):
            kinds.append("float32")
        if name.startswith("pybullet"):
            kinds.append("pybullet")
    # The coarser of two engines decides.
    rounding = max(kinds, key=lambda k: RELATIVE[k])
    exact = [name.startswith(("structured", "pybullet")) for name in names]
    # Two engines with loops of one kind must agree as if there were none.
    return f"{rounding}, {SOFT_LOOP}" if model.rover.loops and exact[0] != exact[1] else rounding


def floor_of(names: tuple[str, str], kind: str, noise: Noise) -> Telemetry:
    """The reference and its drives perturbed as the engines are: by float64's errors, and by float32's.

    Those of float32 count for PyBullet as well: it integrates about the chassis' centre of mass, not its frame, which
    differs by up to 6e-10 m a step, far beyond float64.
    """
    single = any(name.endswith("float32") or name.startswith("pybullet") for name in names)
    return noise.floor(single, SOFT_LOOP in kind)


def _pair(
    model: Model, used: list[Case], a: EngineRun, b: EngineRun, of: dict[str, Samples], noise: dict[str, Noise]
) -> Pair:
    kind = kind_of((a.name, b.name), model)
    results = []
    for case in used:
        samples = dataclasses.replace(of[case.name], stages=a.steps[case.name][0], after=a.steps[case.name][1])
        results += judge(case, samples, b.steps[case.name], tolerances(kind), model, SOFT_LOOP in kind)
        floor = floor_of((a.name, b.name), kind, noise[case.name])
        results += judge_drive(
            case, a.drives[case.name], floor, b.drives[case.name], tolerances(kind, drive=True), model
        )
    return Pair(a.name, b.name, kind, results, judged="own contact" not in b.name)
