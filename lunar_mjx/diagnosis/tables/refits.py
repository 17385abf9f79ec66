"""Refits of wheel tables with one effect each: the error that every candidate would leave, for the studio."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from lunar_mjx.diagnosis.folder.refits import write_refits
from lunar_mjx.diagnosis.runs import HYPOTHESES_FILE, Run
from lunar_mjx.diagnosis.tables.loop import Progress, build_tables
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.logs import SteadyLog


def refit_each(run: Run, logs: Sequence[SteadyLog], sets: Sequence[Sequence[str]], progress: Progress) -> None:
    """Refits a run's model with each set of effects in turn, and writes `refits.npz`.

    A set that the search of `why` has refitted begins where that ended; one whose solver fails is left out.

    Args:
      run: with its model. logs: its tables.
      sets: names of catalogue effects that are refitted together. Names that are no candidates are skipped.
      progress: told of every refit.
    """
    problem = build_tables(run, logs, rivals=False)
    form = problem.own
    known = run.load(HYPOTHESES_FILE) or {}
    refits = {}
    with threadpool_limits(1, "blas"):
        base = form.refit(frozenset(), None, None)
        for number, wanted in enumerate(sets):
            names = frozenset(wanted)
            if not names or not names <= set(form.candidates):
                continue
            progress("refitting with " + ", ".join(sorted(names)), number / len(sets))
            kept = (known.get(" + ".join([form.name, *sorted(names)])) or {}).get("u")
            start = None if kept is None else np.array([float(kept.get(c.key, 0.0)) for c in form.coordinates])
            try:
                refit = form.refit(names, base if start is None else None, start)
            except EvidenceError:
                continue
            alone = form.alone(refit)
            refits[tuple(sorted(names))] = (form.residual(alone), form.predicted(alone))
    write_refits(run.folder, refits)
