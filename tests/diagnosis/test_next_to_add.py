"""What `improve` adds: what is more probable than not where something is missing, and the most probable law with it."""

from __future__ import annotations

import pytest
import typer

from lunar_mjx.commands.diagnosis import _finish, _print_steps
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


class Loop:
    """`improve` with its verbs replaced: what a model's own error is, and what is said of each run.

    Attributes:
      error: sigma in the fitted measurements, by the effects added to the first run's model, in their order.
      said: verdict on the runs in turn; NOISE_ONLY behind the last.
      added: what was added, in turn.
    """

    def __init__(self, monkeypatch, error, said):
        self.error, self.said, self.added = error, said, []
        self.model = make_model("luvmi_x", terrain="flat", preset="consistent")
        monkeypatch.setattr(verbs, "compare", lambda logs, model, out, *rest: self.compared((), out))
        monkeypatch.setattr(verbs, "why", self.why)
        monkeypatch.setattr(verbs, "_add", self.add)
        monkeypatch.setattr(verbs, "gate", lambda run: [])
        monkeypatch.setattr(verbs.windows, "imposed", lambda campaign: False)

    def compared(self, added, folder):
        run = Run(folder, (), self.model, added=tuple(added))
        run.folder.mkdir(exist_ok=True)
        run.save("comparison.json", {"as_given": {}, "refitted": {"fit": self.error[tuple(added)]}, "by_channel": []})
        return run

    def add(self, run, logs, names, out, progress, values):
        self.added.append(list(names))
        return self.compared((*run.added, *names), out)

    def why(self, run, progress):
        place = int(run.folder.name.removeprefix("run")) - 1
        said = self.said[place] if place < len(self.said) else Diagnosis(Verdict.NOISE_ONLY, (), "")
        run.save("verdict.json", said.to_dict())
        return said


GRANULAR = {"closed form": 0.02, "granular_resistance": 0.98}


@pytest.mark.parametrize(("beside", "kept"), [((), []), (("side_wall",), [["side_wall"]])])
def test_a_law_with_which_the_model_itself_fits_worse_is_taken_back(tmp_path, monkeypatch, beside, kept):
    """Its folder is no run any more, and what was to be added beside it is added without it."""
    said = Diagnosis(Verdict.KNOWN if beside else Verdict.NOISE_ONLY, beside, "", forms=GRANULAR)
    loop = Loop(monkeypatch, {(): 4.0, ("granular_resistance", *beside): 8.0, ("side_wall",): 3.0}, [said])
    _, runs = verbs.improve([], loop.model, tmp_path)
    assert loop.added == [["granular_resistance", *beside], *kept]
    assert [r.folder.name for r in runs] == [f"run{k + 1}" for k in range(1 + len(kept))]
    assert {p.name for p in tmp_path.iterdir()} == {r.folder.name for r in runs} | (
        set() if beside else {"taken_back1"}
    )
    assert all(verbs._fitted_error(r) <= 4.0 for r in runs)


def test_a_law_that_was_taken_back_is_not_tried_again_and_told_of(tmp_path, monkeypatch, capsys):
    """Every verdict tells of it; so do, where they are printed, the step in which it was tried and the last verdict."""
    said = [Diagnosis(Verdict.KNOWN, (n,), "", forms=GRANULAR) for n in ("side_wall", "bulldozing")]
    said.append(Diagnosis(Verdict.NOISE_ONLY, (), "", forms=GRANULAR, probabilities={"nothing": 1.0}))
    law = "granular_resistance"
    error = {(): 4.0, (law, "side_wall"): 8.0, ("side_wall",): 3.0, ("side_wall", "bulldozing"): 2.0}
    loop = Loop(monkeypatch, error, said)
    last, runs = verbs.improve([], loop.model, tmp_path)
    assert loop.added == [[law, "side_wall"], ["side_wall"], ["bulldozing"]]
    (refused,) = last.details["taken_back"]
    assert refused == {
        "law": law,
        "beside": ["side_wall"],
        "run": "run1",
        "before": 4.0,
        "after": 8.0,
        "sentence": "granular_resistance was taken back: in place of the contact law of run1 and with side_wall the "
        "model itself fits worse, 8 sigma in the fitted measurements where it had 4.",
    }
    assert all(run.load("verdict.json")["details"]["taken_back"] == [refused] for run in runs)
    _print_steps(runs)
    steps = " ".join(capsys.readouterr().out.split())
    assert steps.count(refused["sentence"]) == 1 and steps.index(refused["sentence"]) < steps.index("run2:")
    with pytest.raises(typer.Exit):
        _finish(last, as_json=False)
    assert refused["sentence"] in " ".join(capsys.readouterr().out.split())


def test_what_belongs_to_a_law_that_was_taken_back_is_not_added_without_it(tmp_path, monkeypatch):
    """Of rounds to come, too: a part of another contact law is no addition to the one that stays."""
    said = [
        Diagnosis(Verdict.KNOWN, ("side_wall",), "", forms=GRANULAR),
        Diagnosis(Verdict.KNOWN, ("engine_friction",), "", forms=GRANULAR),
    ]
    error = {(): 4.0, ("granular_resistance", "side_wall"): 8.0, ("side_wall",): 3.0}
    loop = Loop(monkeypatch, error, said)
    verbs.improve([], loop.model, tmp_path)
    assert loop.added[1:] == [["side_wall"]]
