"""Verdicts are the strongest statements that the probabilities of hypotheses allow."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.diagnosis.weighed.conclusion import conclude
from lunar_mjx.inference.weighing.hypotheses import CALIBRATION, EFFECT, UNLISTED, Term
from lunar_mjx.inference.weighing.search import ModelSearch

EXIT, LUGS, DRAG = (Term(n, EFFECT, -4.0) for n in ("exit_angle", "grousers", "rolling_resistance"))
CELL, SOIL = Term("load", CALIBRATION, -5.0), Term("soil: stiffness", UNLISTED, -5.0)


def found(*pairs):
    hypotheses = [
        SimpleNamespace(form="a", terms=frozenset(t), effects=frozenset(x.name for x in t if x.kind == EFFECT))
        for t, _ in pairs
    ]
    return ModelSearch(tuple(hypotheses), np.array([p for _, p in pairs]), 1, (), True)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("pairs", "verdict", "effects", "further", "unlisted"),
    [
        ([((EXIT,), 0.97), ((), 0.03)], Verdict.KNOWN, ("exit_angle",), (), False),
        (
            [((EXIT, LUGS), 0.6), ((EXIT, CELL), 0.37), ((EXIT,), 0.03)],
            Verdict.KNOWN,
            ("exit_angle",),
            ("grousers", "calibration: load"),
            False,
        ),
        ([((EXIT, LUGS), 0.6), ((EXIT,), 0.4)], Verdict.KNOWN, ("exit_angle",), (), False),
        ([((EXIT, LUGS), 0.6), ((EXIT, SOIL), 0.4)], Verdict.KNOWN, ("exit_angle",), ("grousers",), True),
        (
            [((LUGS,), 0.6), ((DRAG,), 0.38), ((), 0.02)],
            Verdict.KNOWN_CLASS,
            ("grousers", "rolling_resistance"),
            (),
            False,
        ),
        ([((SOIL,), 0.96), ((), 0.04)], Verdict.UNKNOWN, (), (), True),
        # beside what no hypothesis describes an effect helps; it is not known
        ([((EXIT, SOIL), 0.96), ((EXIT,), 0.04)], Verdict.UNKNOWN, ("exit_angle",), (), True),
        ([((), 0.96), ((CELL,), 0.04)], Verdict.NOISE_ONLY, (), (), False),
        ([((), 0.5), ((LUGS,), 0.5)], Verdict.UNDECIDABLE, (), (), False),
    ],
)
def test_the_strongest_sure_statement(pairs, verdict, effects, further, unlisted):
    said = conclude(found(*pairs), 0.95)
    assert (said.verdict, said.effects, said.further, said.unlisted) == (verdict, effects, further, unlisted)
    assert all(name in said.sentence for name in (*effects, *further))
