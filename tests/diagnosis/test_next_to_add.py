"""What `improve` adds: what is more probable than not where something is missing, and the most probable law with it."""

from __future__ import annotations

import pytest

from lunar_mjx.diagnosis import verbs
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
    assert _next_to_add(said, run) == added


@pytest.mark.parametrize(
    ("verdict", "added"),
    [
        (Verdict.KNOWN, ["side_wall", "exit_angle"]),
        (Verdict.UNKNOWN, ["side_wall", "exit_angle"]),
        (Verdict.KNOWN_CLASS, []),
        (Verdict.UNDECIDABLE, []),
    ],
)
def test_where_something_is_missing_every_effect_more_probable_than_not_is_added(tmp_path, verdict, added):
    model = make_model("luvmi_x", terrain="flat", preset="consistent")
    probable = {
        "side_wall": 0.99,
        "exit_angle": 0.6,
        "grousers": 0.4,
        "unlisted at wheel_normal: resistance": 0.9,
        "unlisted at motor_torque": 0.8,
        "calibration: slip": 0.8,
        "calibration.pitch": 0.7,
    }
    said = Diagnosis(verdict, ("side_wall", "exit_angle"), "", inclusion=probable)
    assert _next_to_add(said, Run(tmp_path, (), model)) == added


def test_what_held_out_drives_have_taken_back_is_not_added(tmp_path):
    model = make_model("luvmi_x", terrain="flat", preset="consistent")
    said = Diagnosis(Verdict.UNKNOWN, (), "", inclusion={"side_wall": 0.99})
    assert _next_to_add(said, Run(tmp_path, (), model)) == []


def test_what_a_model_has_is_not_added_again(tmp_path):
    model = make_model("luvmi_x", terrain="flat", preset="consistent").add("side_wall", "add")
    said = Diagnosis(Verdict.KNOWN, ("side_wall",), "", inclusion={"side_wall": 0.99, "exit_angle": 0.6})
    assert _next_to_add(said, Run(tmp_path, (), model)) == ["exit_angle"]


@pytest.mark.parametrize(("beside", "kept"), [((), []), (("side_wall",), [["side_wall"]])])
def test_a_law_with_which_the_model_itself_fits_worse_is_taken_back(tmp_path, monkeypatch, beside, kept):
    """Its folder is no run any more, and what was to be added beside it is added without it."""
    model = make_model("luvmi_x", terrain="flat", preset="consistent")
    error = {(): 4.0, ("granular_resistance", *beside): 8.0, ("side_wall",): 3.0}
    added = []

    def compared(names, folder):
        run = Run(folder, (), model)
        run.folder.mkdir(exist_ok=True)
        (run.folder / "error").write_text(str(error[tuple(names)]))
        return run

    def add(run, logs, names, out, progress, values):
        added.append(list(names))
        return compared(names, out)

    def why(run, progress):
        first = run.folder.name == "run1"
        forms = {"closed form": 0.02, "granular_resistance": 0.98} if first else {}
        return Diagnosis(
            Verdict.KNOWN if first and beside else Verdict.NOISE_ONLY, beside if first else (), "", forms=forms
        )

    monkeypatch.setattr(verbs, "compare", lambda logs, model, out, *rest: compared((), out))
    monkeypatch.setattr(verbs, "why", why)
    monkeypatch.setattr(verbs, "_add", add)
    monkeypatch.setattr(verbs, "gate", lambda run: [])
    monkeypatch.setattr(verbs, "_fitted_error", lambda run: float((run.folder / "error").read_text()))
    monkeypatch.setattr(verbs.windows, "imposed", lambda campaign: False)
    _, runs = verbs.improve([], model, tmp_path)
    assert added == [["granular_resistance", *beside], *kept]
    assert [r.folder.name for r in runs] == [f"run{k + 1}" for k in range(1 + len(kept))]
    assert {p.name for p in tmp_path.iterdir()} == {r.folder.name for r in runs} | (
        set() if beside else {"taken_back1"}
    )
    assert all(verbs._fitted_error(r) <= 4.0 for r in runs)
