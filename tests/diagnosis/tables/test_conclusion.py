"""Verdicts are the strongest statements that the probabilities of hypotheses allow."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.diagnosis.weighed.conclusion import conclude
from lunar_mjx.inference.evidence import Field
from lunar_mjx.inference.weighing.hypotheses import CALIBRATION, EFFECT, UNLISTED, Term
from lunar_mjx.inference.weighing.search import ModelSearch

EXIT, LUGS, DRAG = (Term(n, EFFECT, -4.0) for n in ("exit_angle", "grousers", "rolling_resistance"))
CELL, SOIL = Term("load", CALIBRATION, -5.0), Term("soil: stiffness", UNLISTED, -5.0)


FORCE = Term("wheel_shear: longitudinal force", UNLISTED, -5.0)


def found(*pairs):
    fields = (Field(SOIL.name, 0.05), Field(FORCE.name, 0.05))
    common = {
        "form": "a",
        "refit": SimpleNamespace(linear=SimpleNamespace(fields=fields)),
        "evidence": SimpleNamespace(tau=np.array([0.2, 0.4])),
    }
    hypotheses = [
        SimpleNamespace(terms=frozenset(t), effects=frozenset(x.name for x in t if x.kind == EFFECT), **common)
        for t, _ in pairs
    ]
    return ModelSearch(tuple(hypotheses), np.array([p for _, p in pairs]), 1, (), True)


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


def test_of_two_ports_that_are_as_sure_the_larger_discrepancy_is_named():
    assert conclude(found(((SOIL, FORCE), 0.98), ((), 0.02)), 0.95).port == "wheel_shear"
    assert conclude(found(((SOIL,), 0.6), ((SOIL, FORCE), 0.38), ((), 0.02)), 0.95).port == "soil"
