"""What `improve` adds: all that is named, and the most probable contact law with it; a law alone where it is sure."""

from __future__ import annotations

import pytest

from lunar_mjx.diagnosis.runs import Run
from lunar_mjx.diagnosis.verbs import _next_to_add
from lunar_mjx.diagnosis.verdict import Diagnosis, Verdict
from lunar_mjx.model import make_model


@pytest.mark.parametrize(
    ("verdict", "effects", "share", "added"),
    [
        (Verdict.KNOWN, ("side_wall",), 0.6, ["stress_integral", "side_wall"]),
        (Verdict.KNOWN, ("side_wall",), 0.4, ["side_wall"]),
        (Verdict.NOISE_ONLY, (), 0.6, []),
        (Verdict.UNDECIDABLE, ("side_wall",), 0.6, []),
        (Verdict.NOISE_ONLY, (), 0.97, ["stress_integral"]),
    ],
)
def test_a_model_that_grows_is_made_of_the_most_probable_law(tmp_path, verdict, effects, share, added):
    model = make_model("luvmi_x", terrain="flat", preset="consistent")
    run = Run(tmp_path, (), model)
    said = Diagnosis(verdict, effects, "", forms={"closed form": 1.0 - share, "stress_integral": share})
    assert _next_to_add(said, run, keep_going=False) == added
