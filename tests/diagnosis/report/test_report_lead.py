"""What the report says first: a badge, a plain sentence and the next command, for every verdict."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from small_run import complete, write_run

from lunar_mjx.diagnosis.report import figures, tables
from lunar_mjx.diagnosis.report.lead import lead
from lunar_mjx.diagnosis.report.read import Result
from lunar_mjx.diagnosis.report.steps import Error
from lunar_mjx.diagnosis.report.write import _audit_line, _verdict, write_report
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.diagnosis.weighed.answer import parameter_table
from lunar_mjx.errors import UserError
from lunar_mjx.inference.coordinates import FACTOR_UNIT, NUISANCE, Coordinate


def result(name: str, verdict: dict | None, comparison: dict | None = None, **run) -> Result:
    return Result(name, run, comparison, verdict, None, None, None, None, {})


@pytest.mark.parametrize("verdict", Verdict)
def test_every_verdict_has_a_sentence_and_says_what_to_do_next(verdict: Verdict):
    judge = result("run1", {"verdict": verdict.label, "effects": ["slip_sinkage"], "port": "soil"}, logs=["mine"])
    found = lead([judge], judge)
    assert found.badge and found.badge != verdict.label and found.sentence.endswith(".") and found.next
    assert found.tone in ("good", "open", "bad")


def test_a_search_that_was_cut_short_is_to_be_asked_again():
    verdict = {"verdict": "UNDECIDABLE", "details": {"search": {"complete": False}}}
    judge = result("run1", verdict)
    assert lead([judge], judge).next[0].startswith("lunar-mjx why run1 ")
    judge = result("run1", {**verdict, "details": {"search": {"complete": True}}})
    assert lead([judge], judge).next[0].startswith("lunar-mjx next run1 ")


REFUSED = ("BAD_DATA", "BAD_FIT")


@pytest.mark.parametrize("verdict", [*REFUSED, "KNOWN", "UNKNOWN"])
def test_an_audit_is_asked_for_where_there_is_something_to_audit(verdict):
    said = _audit_line(result("run1", {"verdict": verdict}))
    assert said.endswith(".") and ("--audit" in said) == (verdict not in REFUSED)


def test_probabilities_claim_no_more_digits_than_they_have():
    listed = {"slip_sinkage": 0.997, "grousers": 0.0025, "side_wall": 4e-4, "toe": 1e-9}
    table = tables.hypotheses(result("run1", {"probabilities": listed}))[0]
    assert table.rows == [["slip_sinkage", "99.7 %"], ["grousers", "0.25 %"], ["2 others together", "less than 0.1 %"]]


def test_what_was_named_is_added_by_the_command_that_follows():
    judge = result("run1", {"verdict": "KNOWN", "effects": ["slip_sinkage"]})
    found = lead([judge], judge)
    assert "slip sinkage" in found.sentence
    assert found.next == ["lunar-mjx add run1 slip_sinkage -o with_slip_sinkage", "lunar-mjx why with_slip_sinkage"]


def test_what_is_unlisted_is_sought_under_the_better_contact_law(run):
    """The verdict says "the contact law explains these data better: add it"; so do the steps, before a formula."""
    forms = {"closed form": 1e-9, "stress_integral": 1.0}
    judge = result("run1", {"verdict": "UNKNOWN", "port": "wheel_normal", "forms": forms})
    steps = [s.partition("  ")[0] for s in lead([judge], judge).next]
    assert steps == [
        "lunar-mjx add run1 stress_integral -o with_stress_integral",
        "lunar-mjx why with_stress_integral",
        "lunar-mjx unknown with_stress_integral",
    ]
    alone = result("run1", {"verdict": "UNKNOWN", "port": "soil"})
    assert [s.partition("  ")[0] for s in lead([alone], alone).next] == ["lunar-mjx unknown run1"]


def test_a_contact_law_that_was_taken_back_is_told_of_and_not_proposed():
    refused = [{"law": "stress_integral", "run": "run1", "sentence": "stress_integral was taken back."}]
    verdict = {"verdict": "KNOWN", "sentence": "side_wall is missing.", "effects": ["side_wall"]}
    verdict |= {"forms": {"closed form": 1e-9, "stress_integral": 1.0}, "details": {"taken_back": refused}}
    judge = result("run1", verdict)
    assert lead([judge], judge).next[0].split()[3] == "side_wall"
    assert "stress_integral was taken back." in _verdict(judge, [])


def test_several_are_added_one_by_one_and_a_better_contact_law_first(run):
    forms = {"closed form": 1e-9, "stress_integral": 1.0}
    judge = result("run1", {"verdict": "MULTIPLE", "effects": ["side_wall", "bulldozing"], "forms": forms})
    steps = lead([judge], judge).next
    added = [s.split()[3] for s in steps[:-1]]
    assert added == ["stress_integral", "side_wall", "bulldozing"]
    assert steps[-1] == "lunar-mjx why with_bulldozing"
    for step in steps:  # each is a command that exists and takes these arguments
        answer = run(*step.split()[1:])
        assert "unexpected extra argument" not in answer.out + answer.err
    judge = result("run1", {"verdict": "KNOWN", "effects": ["side_wall"], "forms": {"stress_integral": 0.6}})
    assert lead([judge], judge).next[0].split()[3] == "side_wall"


def placed(verdict: dict | None, **run) -> Result:
    return Result("my run", run, None, verdict, None, None, None, None, {}, Path("runs/my run"))


@pytest.mark.parametrize("verdict", [None, *Verdict])
def test_commands_name_the_folder_as_it_was_given_and_as_a_shell_takes_it(verdict: Verdict | None):
    told = verdict and {"verdict": verdict.label, "effects": ["slip_sinkage", "grousers"], "port": "soil"}
    judge = placed(told, logs=["logs/my log"])
    commands = [shlex.split(s[s.index("lunar-mjx") :]) for s in lead([judge], judge).next if "lunar-mjx" in s]
    assert commands or verdict is Verdict.BAD_FIT
    for words in commands:
        assert any(w.startswith(("runs/my run", "runs/with_")) or w == "logs/my log" for w in words), words
    if verdict is Verdict.MULTIPLE:
        assert commands[1] == ["lunar-mjx", "add", "runs/with_slip_sinkage", "grousers", "-o", "runs/with_grousers"]


def test_an_own_effect_is_added_with_its_file_and_an_instrument_not_at_all():
    named = {"verdict": "MULTIPLE", "effects": ["cable", "calibration: sinkage_m"]}
    judge = placed(named, candidates=["my effects.py:cable"])
    add, recalibrate, ask = lead([judge], judge).next
    assert shlex.split(add)[3:] == ["my effects.py:cable", "-o", "runs/with_cable"]
    assert recalibrate == "Recalibrate sinkage_m: it errs by more than is usual."
    assert ask == "lunar-mjx why runs/with_cable"
    judge = placed({"verdict": "KNOWN", "effects": ["calibration: sinkage_m"]})
    assert lead([judge], judge).next == [recalibrate]


def test_no_model_is_called_fitted_that_is_not(tmp_path):
    """`model.toml` of a run is what was compared; `fitted.toml`, where there is one, what the fit made of it."""
    judge = dataclasses.replace(placed({"verdict": "NOISE_ONLY"}), folder=tmp_path / "run1")
    use = lead([judge], judge).next[0]
    assert "model.toml" in use and "fitted model" not in use and "comparison.json" in use
    (tmp_path / "run1").mkdir()
    (tmp_path / "run1" / "fitted.toml").touch()
    use = lead([judge], judge).next[0]
    assert use == f"Use the fitted model: lunar-mjx simulate --model {tmp_path / 'run1' / 'fitted.toml'}"


def test_a_run_that_was_not_diagnosed_asks_for_it():
    judge = result("run1", {"verdict": "KNOWN", "effects": ["grousers"]})
    last = result("run2", None, added=["grousers"])
    found = lead([judge, last], judge)
    assert found.next == lead([last], last).next == ["lunar-mjx why run2"]
    # the page leads with the model as it now is, not with a finding that came before it was mended
    assert found.badge == "not diagnosed" and "now has grousers" in found.sentence and "run1" in found.sentence


class Named:
    """A step as the figure reads it."""

    def __init__(self, short: str):
        self.short = short


def test_labels_of_the_waterfall_stand_in_places_of_their_own():
    steps = [Named("as given"), Named("refitted"), Named("+ slip_sinkage<br>(proposed)")]
    errors = [Error(v, 0.9 * v, 1.2 * v, 10, 5) for v in (12.8, 8.4, 1.2)]
    figure = figures.waterfall(steps, errors, [None] * 3, "held-out")
    bars = figure.data[0]
    assert list(bars.x) == [12.8, 8.4, 1.2] and len(set(bars.y)) == 3
    notes = [a for a in figure.layout.annotations if "sigma" in a.text]
    assert [a.y for a in notes] == list(bars.y)
    assert all(a.xref == "paper" and a.x > 1.0 for a in notes)  # beyond every mark


def test_a_common_factor_is_shown_in_the_unit_of_what_it_multiplies(tmp_path):
    from lunar_mjx.model import make_model
    from lunar_mjx.model.file import save_model

    model = make_model("viper", "flat", "consistent")
    save_model(model, tmp_path / "model.toml")
    fitted = {
        "motor": {
            "value": {"gear_ratio": 1.1},
            "std": {"gear_ratio": 0.01},
            "given": {"gear_ratio": 1.0},
            "unit": {"gear_ratio": "factor"},
        }
    }
    run = Result("run1", {}, {"parameters": fitted}, None, None, None, None, None, {}, tmp_path)
    (table,) = tables.parameters(run, dataclasses.replace(run))
    own = np.unique(np.asarray(model.parameters["motor"]["gear_ratio"], float))
    assert len(table.rows) == len(own) > 1
    shown = sorted(float(row[2]) for row in table.rows)
    np.testing.assert_allclose(shown, own, rtol=5e-3)
    after = sorted(float(row[4].split(" ")[0]) for row in table.rows)
    np.testing.assert_allclose(after, 1.1 * own, rtol=5e-3)
    assert not any("factor" in cell for row in table.rows for cell in row)


@pytest.mark.parametrize(
    ("comparison", "splits", "words"),
    [
        ({}, {}, "default rule"),
        ({"log_splits": {"a": "fit", "b": "test"}}, {}, "Stated by the logs"),
        ({"log_splits": {"a": "fit"}}, {"b": "select"}, "--split: b"),
    ],
)
def test_who_decided_the_splits_is_said(comparison: dict, splits: dict, words: str):
    said = tables._who_split(result("run1", None, comparison, splits=splits), ["a", "b"])
    assert words in said
    assert ("no log states a split" in said) == (not comparison and not splits)


@pytest.mark.parametrize(
    ("value", "std", "words"),
    [
        (2e5, 6e4, "(2.00 ± 0.6)e+05"),
        (1.09, 0.12, "1.09 ± 0.12"),
        (2e5, None, "2.00e+05"),
        (2.5e-5, 4e-7, "(2.50 ± 0.04)e-05"),
    ],
)
def test_a_value_and_its_deviation_share_their_power_of_ten(value: float, std: float | None, words: str):
    assert tables.plus_minus(value, std) == words


def test_what_was_held_against_no_measurement_is_not_told():
    def told(**held) -> list[str]:
        blocks = tables.hypotheses(result("run1", {"details": {"held_out": held}}))
        return [line for block in blocks for line in block.paragraphs]

    assert told(manoeuvres=1, gain=0.0, se=0.0) == []
    (one,) = told(manoeuvres=1, gain=4.0, se=0.0)
    assert "On 1 group that" in one and "±" not in one  # one group has no scatter
    (three,) = told(manoeuvres=3, gain=4.0, se=2.0)
    assert "On 3 groups that" in three and "4 ± 2" in three


def test_parameters_that_no_fit_moved_stand_in_one_line():
    given = {"n": 1.0, "stiffness": 2e5}
    moved = {"value": {"n": 0.9, "stiffness": 2e5 * (1.0 + 1e-15)}, "std": {"n": 0.1, "stiffness": 6e4}, "given": given}
    run = result("run1", None, {"parameters": {"soil": moved}})
    table, unmoved = tables.parameters(run, run)
    assert table.header == ["parameter", "unit", "as given", "refitted"]  # of a run that proposes nothing
    assert [row[0] for row in table.rows] == ["soil.n"]
    assert "soil.stiffness" in unmoved.paragraphs[0] and "soil.n" not in unmoved.paragraphs[0]


def test_rows_of_the_waterfall_fit_a_phone():
    steps = [Named("as given"), Named("+ stress_integral, side_wall, side_entry, shear_softening, skid_shear")]
    bars = figures.waterfall(steps, [Error(v, v, v, 10, 5) for v in (25.0, 10.8)], [None] * 2, "held-out").data[0]
    assert max(len(line) for name in bars.y for line in name.split("<br>")) <= figures._NAME_WIDTH
    assert "skid_shear" in bars.y[1]


def test_a_factor_on_the_models_own_values_is_recorded_as_such():
    known = dataclasses.replace(Coordinate("soil", "n", 1.0, 0.1, 0.5, 2.0), unit="1")
    coordinates = (known, dataclasses.replace(known, name="cohesion", factor=True))
    form = SimpleNamespace(coordinates=coordinates, discrepancy=(), ground=())
    table = parameter_table(cast(Any, form), np.zeros(2), np.eye(2), np.arange(2))
    assert table["soil"]["unit"] == {"n": "1", "cohesion": FACTOR_UNIT}


def test_amounts_of_ground_and_discrepancy_are_no_parameters():
    coordinates = tuple(Coordinate("soil", name, 1.0, 0.1, 0.5, 2.0) for name in ("n", "cohesion", "k_phi"))
    form = SimpleNamespace(coordinates=coordinates, discrepancy=np.array([2]), ground=np.array([1]))
    table = parameter_table(cast(Any, form), np.zeros(3), np.eye(4), np.arange(4))
    assert list(table["soil"]["value"]) == ["n"]


def test_starts_and_instruments_have_a_table_of_their_own():
    fitted = {name: {"value": {"x": 0.2}, "std": {"x": 0.1}, "given": {"x": 0.0}} for name in ("drag", NUISANCE)}
    run = result("run1", None, {"parameters": fitted})
    own, instruments = tables.parameters(run, run)
    assert [row[0] for row in own.rows] == ["drag.x"] and not own.folded
    assert [row[0] for row in instruments.rows] == [f"{NUISANCE}.x"] and instruments.folded


def test_a_campaign_of_many_drives_makes_no_paragraph_of_the_title(tmp_path):
    folder = complete(write_run(tmp_path / "run", table=False))
    run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    run["logs"] = [str(tmp_path / f"drive_{k}") for k in range(9)]
    (folder / "run.json").write_text(json.dumps(run), encoding="utf-8")
    page = write_report([folder], tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<h1>Criticism of a model: drive_0, drive_1, drive_2, drive_3 and 5 more</h1>" in page


@pytest.mark.parametrize("name", ["comparison.json", "series.npz", "model.toml"])
def test_a_run_that_was_copied_in_part_is_refused_in_a_sentence(name, tmp_path):
    """A file is missing or torn: the report said nothing of it, and left out what stands there."""
    folder = complete(write_run(tmp_path / "run", table=False))
    (folder / "model.toml").write_text('preset = "consistent"', encoding="utf-8")
    write_report([folder], tmp_path / "report.html")
    content = (folder / name).read_bytes()
    (folder / name).unlink()
    with pytest.raises(UserError, match=rf"{name}: is missing beside .*; copy the whole folder of the run, or make it"):
        write_report([folder], tmp_path / "report.html")
    (folder / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match=rf"{name}: is damaged \(.*lunar-mjx compare"):
        write_report([folder], tmp_path / "report.html")
