"""What the problem of a run is made of: every effect that might be missing, splits, and a bed for its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lunar_mjx.diagnosis.drives.windows.coordinates import SUSPECTS
from lunar_mjx.diagnosis.runs import RUN_FILE, Run
from lunar_mjx.diagnosis.tables.problem import TableProblem, default_units, points
from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import Effect
from lunar_mjx.errors import UserError, bad_input, require_within
from lunar_mjx.logs import Log, SteadyLog
from lunar_mjx.wheel_bed.bed import EARTH_GRAVITY, WheelBed

NO_CANDIDATE = frozenset(
    {
        "parking_brake",
        "payload",
        "tether",
        "hard_surface",
        "soft_ground",
        "surface_type",
        "soil_gradient",
        "boulders",
        "static_boulders",
        "engine_friction",
        "joint_limits",
        "chassis_contact",
        "encoder_quantisation",
        "motor_power",
        "electronics",
        "solar_panels",
        "battery",
        "chassis_node",
    }
)
"""Effects that are an arrangement of the test which its user knows, an engine's substitute for physics, or without a
derivative: they are never proposed as missing."""

FINER_FORMS = frozenset({"slide_softening", "side_entry", "side_exit", "shear_softening", "skid_shear", "side_wall"})
"""Finer forms of slip_sinkage, angle_sinkage, bulldozing: only a bed that imposes slip and slip angle, against a model
that integrates the stress, can tell them from these; elsewhere they would only be their twins."""


def candidate_effects(run: Run) -> dict[str, Effect]:
    """Every effect that may be proposed: the catalogue's, and the user's own."""
    candidates = {n: e for n, e in catalogue.CATALOGUE.items() if n not in NO_CANDIDATE}
    for spec in run.candidates:
        effect = catalogue.get(spec)
        candidates[effect.name] = effect
    return candidates


def known_logs(run: Run) -> list[Log] | list[SteadyLog]:
    """The logs of a run that was read back, once what its `run.json` says of logs and effects is found among them.

    Raises:
      UserError: a split or known error of what the logs do not hold, or an added effect that does not exist.
    """
    path, logs = run.folder / RUN_FILE, run.checked[0]
    require_splits(run.splits, logs, path, "splits")
    require_discrepancy(run.discrepancy, logs, f"{path}: discrepancy")
    # What `add` may have added: effects, the user's own too, and what logs with imposed wheel speeds have instead.
    known = {*candidate_effects(run), *catalogue.CATALOGUE, *run.model.effect_names, *(s.name for s in SUSPECTS)}
    for name in run.added:
        if name not in known:
            raise bad_input(path, "added", name, "is no effect", "correct its name, or compare anew")
    return logs


def require_splits(
    splits: Mapping[str, str], logs: Sequence[Any], source: str | Path = "compare", field: str = "--split"
) -> None:
    """Raises `UserError` for a split of a log, or group of points, that is not there."""
    if not splits:
        return
    names = [log.name for log in logs if isinstance(log, Log)]
    # Tables are split by groups of points, which have names of their own.
    names += [n for log in logs if not isinstance(log, Log) for n in default_units(points(log)[0])[1]]
    for name, split in splits.items():
        if name not in names:
            known = ", ".join(dict.fromkeys(names))
            raise bad_input(source, field, f"{name}={split}", "names nothing of these logs", f"use one of {known}")


MOST_DISCREPANCY = 1e9
"""SI: beyond every channel's range, and its square is a number."""


def require_discrepancy(discrepancy: Mapping[str, float], logs: Sequence[Any], source: str = "--discrepancy") -> None:
    """Raises `UserError` for a known error of the model that is negative, or of a quantity that no table holds.

    Channels of drives are looked up where drives are compared: their names may hold `*`.
    """
    known = dict.fromkeys(q for log in logs if isinstance(log, SteadyLog) for q in log.table.measured)
    for name, size in discrepancy.items():
        if known and name not in known:
            raise bad_input(source, "quantity", name, "was not measured", f"use one of {', '.join(known)}")
        require_within(source, name, size, 0.0, MOST_DISCREPANCY)


def candidates_of(run: Run, only: Sequence[str] | None = None) -> dict[str, Effect]:
    """Candidates of a run's drives by name: those asked for, else all that drives could show.

    Raises:
      UserError: a candidate that does not exist.
    """
    known = candidate_effects(run)
    if only is None:
        return {n: e for n, e in known.items() if n not in FINER_FORMS}
    for name in only:
        if name not in known:
            raise UserError(f"effect {name!r} is no candidate here; use one of {', '.join(known)}.")
    return {n: known[n] for n in only}


def table_problem(run: Run, logs: Sequence[SteadyLog], candidates: Mapping[str, Effect]) -> TableProblem:
    """The problem of steady-state tables: the model's wheel under the test bed's gravity."""
    # Beds that state no gravity stand on Earth. One bed stands for all tables, so it has one gravity.
    gravities = {float(log.gravity_m_s2 or EARTH_GRAVITY) for log in logs}
    if len(gravities) > 1:
        raise UserError(f"{logs[0].folder}: tables of different gravity do not go into one run; compare them apart.")
    bed = WheelBed.of_first_wheel(run.model, gravities.pop())
    return TableProblem(logs, bed, candidates, run.splits, extra_sigma=run.discrepancy)
