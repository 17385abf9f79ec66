"""Gives the log of a case to the tool, as a user would, and sets what it answers beside the sealed answer."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.diagnosis import verbs
from lunar_mjx.diagnosis.runs import SERIES_FILE, Run
from lunar_mjx.diagnosis.verdict import Diagnosis, Verdict
from lunar_mjx.errors import UserError
from lunar_mjx.model import Model, make_model

from . import cases, drive_effects, drives
from .bed import effects as bed_effects
from .bed import logs as bed_logs
from .judge import outcome
from .separable import left_over
from .told import Observed, told, true_values

_95 = 1.959964


@functools.cache
def nominal_model() -> Model:
    """The model that every table is held against: the default preset."""
    return make_model("luvmi_x", terrain="flat")


def ask(logs: Sequence[Path], out: Path, effect: str | None = None) -> tuple[Diagnosis | None, Diagnosis | None, str]:
    """The tool's answer to logs.

    Args:
      logs: their folders. out: the run's folder. effect: asked about by name, if any.

    Returns:
      The diagnosis, the answer about the effect, and the message where the log was refused as a user's mistake.
    """
    try:
        run = verbs.compare(logs, nominal_model(), out)
        found = verbs.why(run)
    except verbs.BadData as bad:
        return bad.diagnosis, None, ""
    except UserError as error:
        return None, None, str(error)
    if effect is None or found.verdict is Verdict.BAD_FIT:
        return found, None, ""
    return found, verbs.explain(found, effect), ""


def table_row(group: str, number: int, seed: int, suggest: bool = False, keep: str | None = None) -> dict[str, Any]:
    """Makes one case on the test bed, asks the tool, opens the seal, and judges.

    Args:
      group, number, seed: of the case. suggest: ask for formulas where the effect is outside the catalogue.
      keep: folder in which log and run stay.
    """
    began = time.monotonic()
    case = cases.make(group, number, seed)
    drawn = time.monotonic()
    place = Path(keep) / case.name if keep else Path(tempfile.mkdtemp(prefix="hidden-"))
    if keep and place.exists():
        shutil.rmtree(place)
    try:
        case.write(place / "log")
        truth = case.truth
        asked = next(iter(truth.effects)) if group == "undecidable" else None
        found, answer, refused = ask([place / "log"], place / "run", asked)
        seconds = time.monotonic() - drawn
        verdict = found.verdict.label if found else "REFUSED"
        row: dict[str, Any] = {
            "case": case.name,
            "kind": "tables",
            "group": group,
            "seed": str(seed),
            "truth": case.answer(),
            "commitment": case.commitment(),
            "separable": case.separable,
            "noise": case.recipe.kind,
            "scale": case.recipe.scale,
            "dirt": case.recipe.dirt,
            "verdict": verdict,
            "sentence": found.sentence if found else refused,
            "named": list(found.effects) if found else [],
        }
        row["explained"] = answer.verdict.label if answer else None
        if found is not None and found.verdict not in (Verdict.BAD_DATA, Verdict.BAD_FIT):
            row |= _physics(case, found, place / "run")
        row |= outcome(row, functools.partial(_twins, truth))
        if suggest and group == "outside" and row["verdict"] == "UNKNOWN":
            row["suggestions"] = _suggestions(place / "run")
        row |= {"seconds": round(seconds, 2), "seconds_drawing": round(drawn - began, 2), "pid": os.getpid()}
        return row
    finally:
        if not keep:
            shutil.rmtree(place, ignore_errors=True)


def drive_row(group: str, number: int, seed: int, folder: str, keep: str | None = None) -> dict[str, Any]:
    """Asks the tool about one campaign that lies on disk, opens the seal, and judges.

    How far two effects can be told apart by a drive is not known beforehand, so a class that holds the truth is right
    whatever its size.

    Args:
      group, number: of the campaign. seed: of the campaign's drawing. folder: where `generate` wrote.
      keep: folder in which the run stays.
    """
    name = f"{group}-{number:03d}"
    began = time.monotonic()
    place = Path(keep) / name if keep else Path(tempfile.mkdtemp(prefix="hidden-"))
    try:
        found, _, refused = ask([Path(folder) / "logs" / name], place)
        seconds = time.monotonic() - began
        sealed = json.loads((Path(folder) / "answers" / f"{name}.json").read_text(encoding="utf-8"))
        answer = sealed["answer"]
        row: dict[str, Any] = {
            "case": name,
            "kind": "drives",
            "group": group,
            "seed": str(seed),
            "truth": answer,
            "commitment": sealed["commitment"],
            "sealed_well": sealed["commitment"] == drives.commitment(answer),
            "noise": answer["recipe"]["kind"],
            "scale": answer["recipe"]["scale"],
            "dirt": answer["recipe"]["dirt"],
            "verdict": found.verdict.label if found else "REFUSED",
            "named": list(found.effects) if found else [],
            "sentence": found.sentence if found else refused,
            "seconds": round(seconds, 2),
        }
        if found is not None and found.verdict not in (Verdict.BAD_DATA, Verdict.BAD_FIT):
            kinds = {**drive_effects.KNOWN, **drive_effects.OUTSIDE}
            row |= {
                "port": found.port,
                "ports": dict(found.ports),
                "parameters": _values(answer["effects"], found),
                "true_ports": sorted({port for n in answer["effects"] for port in kinds[n].ports}),
                "error_before": dict(found.error_before),
                "error_after": dict(found.error_after),
                "undecidable": list(found.undecidable),
            }
        return row | outcome(row, lambda other: 0.0)
    finally:
        if not keep:
            shutil.rmtree(place, ignore_errors=True)


def _twins(truth: bed_logs.Truth, name: str) -> float:
    """Sigma that tell the truth from another effect, by the generator's own physics."""
    return left_over(truth, [name]) if name in bed_effects.KNOWN else float("inf")


def _physics(case: cases.Case, found: Diagnosis, run: Path) -> dict[str, Any]:
    row = {
        "port": found.port,
        "ports": dict(found.ports),
        "true_ports": _ports(case.truth.effects),
        "error_before": dict(found.error_before),
        "error_after": dict(found.error_after),
        "parameters": _values(case.truth.effects, found),
        "undecidable": list(found.undecidable),
        "floor": None,
        "over_floor": None,
        "told": None,
    }
    if (run / SERIES_FILE).is_file():
        seen, sigma, predicted = _seen(case.truth, run)
        held = ~seen.fitted
        if held.any():
            away = [((seen.value - v) / sigma)[held] for v in (predicted, true_values(case.truth, seen))]
            error, floor = (float(np.sqrt(np.mean(a**2))) for a in away)
            row |= {"floor": floor, "over_floor": error / floor if floor else None}
        if case.truth.effects and case.group != "undecidable":
            # LAPACK may fail on a matrix of hardly felt parameters; that is no answer of the tool's
            with contextlib.suppress(np.linalg.LinAlgError):
                row["told"] = told(case.truth, case.recipe, seen)
    return row


def _seen(truth: bed_logs.Truth, run: Path) -> tuple[Observed, np.ndarray, np.ndarray]:
    """The tool's observations, with its sigma (n,) and the predictions (n,) of its last model."""
    with np.load(run / SERIES_FILE) as data:
        at = data["place"]
        points = dataclasses.replace(truth.points, slip=at[:, 0], angle=np.radians(at[:, 1]), load=at[:, 2])
        channel = np.repeat(data["series_channel"], np.diff([*data["series_start"], len(at)]))
        fitted = data["split"][data["unit"]] == "fit"
        return Observed(channel, points, data["measured"], fitted), data["sigma"], data["predicted"][-1]


def _ports(effects: Mapping[str, Any]) -> list[str]:
    kinds = {**bed_effects.KNOWN, **bed_effects.OUTSIDE}
    return sorted({port for n in effects for port in kinds[n].ports})


def _values(effects: Mapping[str, Mapping[str, float]], found: Diagnosis) -> list[dict[str, Any]]:
    """True and fitted parameters of the effects that were named rightly."""
    rows = []
    for e in found.evidence:
        for name, true in effects.get(e.effect, {}).items() if e.effect in found.effects else ():
            if name in e.values and np.isfinite(e.std.get(name, np.nan)):
                value, std = e.values[name], e.std[name]
                away = abs(value - true)
                rows.append(
                    {
                        "effect": e.effect,
                        "name": name,
                        "truth": true,
                        "value": value,
                        "std": std,
                        "error": away / abs(true),
                        "covered": away <= _95 * std,
                    }
                )
    return rows


def _suggestions(run: Path) -> list[dict[str, Any]]:
    """The tool's first formulas at the port that it named."""
    from lunar_mjx.diagnosis.formulas.discover import discover
    from lunar_mjx.diagnosis.runs import load_run

    loaded: Run = load_run(run)
    try:
        found = discover(loaded)
    except UserError as error:
        return [{"refused": str(error)}]
    return [
        {"port": s.port, "target": s.target, "formula": s.formula, "at_noise": s.at_noise}
        for s in found.suggestions[:3]
    ]
