"""The loop from the command line on a small synthetic wheel table with one hidden effect."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.criticism import WheelBed, audit, wheel_test
from lunar_mjx.diagnosis import build_problem, verbs
from lunar_mjx.diagnosis.tables.port_gains import FIELDS
from lunar_mjx.diagnosis.tables.wheel_form import WheelForm
from lunar_mjx.diagnosis.verdict import Diagnosis, Verdict
from lunar_mjx.effects import catalogue
from lunar_mjx.errors import UserError
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.logs import Noise, write_steady_log

FEW = ("friction_circle", "slip_sinkage")
"""Candidates of these tests: programs with all of them take a minute to compile."""
STD = {"drawbar_pull_N": 0.1, "side_force_N": 0.1, "sinkage_m": 1e-4}
RADIUS, WIDTH, LOADS = 0.0625, 0.05, (8.0, 20.0, 45.0)
"""Several loads, which tell the sinkage exponent from the modulus."""
HIDDEN = 0.4
GUIDE = Path(__file__).resolve().parents[2] / "docs" / "criticism.md"


def write_table(folder, driving: float, seed: int = 0) -> None:
    slip, angle = (a.ravel() for a in np.meshgrid(np.linspace(-0.2, 0.6, 7), [0.0, 15.0, 30.0, 45.0]))
    load = np.resize(LOADS, len(slip))
    bed = WheelBed.of_preset("consistent").with_effect("slip_sinkage", driving=driving, skid=0.0)
    test = wheel_test(slip, np.radians(angle), load, RADIUS, WIDTH)
    result = bed.run(test)
    frame = pd.DataFrame(
        {
            "slip_ratio": slip,
            "slip_angle_deg": angle,
            "normal_load_N": load,
            "drawbar_pull_N": result.drawbar_pull,
            "side_force_N": result.side_force,
            "sinkage_m": result.sinkage,
        }
    )
    rng = np.random.default_rng(seed)
    for column, std in STD.items():
        frame[column] += std * rng.standard_normal(len(frame))
    write_steady_log(
        folder,
        frame,
        wheel={"radius_m": RADIUS, "width_m": WIDTH},
        slip_definition="wheel_frame",
        noise={c: Noise(s, "datasheet") for c, s in STD.items()},
    )


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    write_table(folder / "hidden", HIDDEN)
    write_table(folder / "null", 0.0, 1)
    return folder


@pytest.fixture(autouse=True)
def few(monkeypatch):
    def candidates(run):
        own = [catalogue.get(spec) for spec in run.candidates]
        return {e.name: e for e in (*map(catalogue.get, FEW), *own)}

    for module in (build_problem, verbs):
        monkeypatch.setattr(module, "candidate_effects", candidates)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


def _asked(run, log, folder):
    """A run folder in which `why` has answered; made by whichever test needs it first."""
    if not (folder / "verdict.json").is_file():
        assert run("compare", log, "-o", folder).status == 0
        run("why", folder)
    return folder


def test_the_loop_names_the_hidden_effect_and_the_error_falls(run, logs, work):
    shutil.rmtree(work / "run1", ignore_errors=True)
    found = run("compare", logs / "hidden", "-o", work / "run1")
    assert found.status == 0, found.err
    before = json.loads((work / "run1" / "comparison.json").read_text())
    assert before["solver"] == "ended"
    assert before["refitted"]["held_out"] > 1.5

    why = run("why", work / "run1", "--json")
    assert why.status == Verdict.KNOWN.exit_status
    answer = json.loads(why.out)
    assert (answer["verdict"], answer["effects"], answer["exit_status"]) == ("KNOWN", ["slip_sinkage"], 20)
    first = answer["evidence"][0]
    assert first["status"] == "accepted"
    assert first["probability"] == answer["inclusion"]["slip_sinkage"] > 0.95
    assert sum(answer["probabilities"].values()) == pytest.approx(1.0)
    assert set(answer["discrepancy"]) <= set(FIELDS)
    assert all(0.0 < d["low"] < d["size"] < d["high"] < 0.3 for d in answer["discrepancy"].values())
    value, std = first["values"]["driving"], first["std"]["driving"]
    assert abs(value - HIDDEN) < 5.0 * std < 0.5 * HIDDEN
    assert json.loads((work / "run1" / "verdict.json").read_text()) == answer

    added = run("add", work / "run1", "slip_sinkage", "-o", work / "run2")
    assert added.status == 0, added.err
    after = json.loads((work / "run2" / "comparison.json").read_text())
    # The fit leaves room for a discrepancy of a per cent, which is two sigma of these precise instruments.
    assert after["refitted"]["held_out"] < 0.4 * before["refitted"]["held_out"]
    again = run("why", work / "run2")
    assert again.status == Verdict.NOISE_ONLY.exit_status
    assert again.out.startswith("NOISE_ONLY")

    page = run("report", work / "run1", work / "run2", "-o", work / "report.html")
    assert page.status == 0, page.err
    text = (work / "report.html").read_text()
    assert "slip_sinkage" in text
    for part in (
        "Click a field",
        "averaged in bins",
        "Shapes of missing effects",
        "noise floor",
        "Hypotheses",
        "What remains",
    ):
        assert part in text, part
    assert len(text) < 5e6


def test_nothing_hidden_is_noise(run, logs, work):
    shutil.rmtree(work / "null", ignore_errors=True)
    assert run("compare", logs / "null", "-o", work / "null").status == 0
    assert run("why", work / "null").status == 0


def test_why_can_be_asked_about_one_effect(run, logs, work, monkeypatch):
    null = _asked(run, logs / "null", work / "null")
    about = run("why", null, "--explain", "friction_circle", "--json")
    assert "friction_circle" in json.loads(about.out)["sentence"]
    monkeypatch.setattr(WheelForm, "refit", lambda *_: pytest.fail("a name is refused before anything is fitted"))
    for name, said in (("phlogiston", "is no candidate here; use one of friction_circle"), ("motor", "in the model")):
        wrong = run("why", null, "--explain", name)
        assert wrong.status == 2
        assert f"--explain = '{name}'" in wrong.err and said in wrong.err


def test_a_diagnosis_without_a_fit_answers_for_itself():
    bad = Diagnosis(Verdict.BAD_FIT, (), "it could not be fitted")
    assert verbs.explain(bad, "slip_sinkage") is bad
    with pytest.raises(UserError, match="nothing is known about 'phlogiston'"):
        verbs.explain(Diagnosis(Verdict.NOISE_ONLY, (), "nothing"), "phlogiston")


def test_an_interrupt_leaves_a_usable_folder(run, logs, work, monkeypatch):
    folder = work / "stopped"
    shutil.copytree(_asked(run, logs / "null", work / "null"), folder)

    def stop(*_args, **_kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(WheelForm, "refit", stop)
        with pytest.raises(KeyboardInterrupt):
            verbs.why(folder)
    assert verbs.why(folder).verdict is Verdict.NOISE_ONLY


def test_a_time_limit_ends_the_search_with_what_is_known(run, logs, work):
    folder = work / "short"
    shutil.copytree(_asked(run, logs / "null", work / "null"), folder)
    found = verbs.why(folder, seconds=0.0)
    laws = found.details["search"]["refits"]
    assert laws == len(found.forms)
    assert not found.details["search"]["complete"]
    assert "ended by its time" in found.sentence
    assert json.loads((folder / "verdict.json").read_text())["verdict"] == found.verdict.name


def test_a_solver_that_fails_is_bad_fit(run, logs, work, monkeypatch):
    def fail(*_args, **_kwargs):
        raise EvidenceError("on purpose")

    folder = work / "failing"
    shutil.copytree(_asked(run, logs / "null", work / "null"), folder)
    monkeypatch.setattr(WheelForm, "refit", fail)
    found = verbs.why(folder)
    assert found.verdict is Verdict.BAD_FIT
    assert "on purpose" in found.sentence


@pytest.mark.slow
def test_an_effect_of_ones_own_can_be_proposed(run, logs, work):
    file = work / "my_effects.py"
    example = re.search(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    assert example is not None
    file.write_text(example[1])
    assert run("effect", "test", f"{file}:cable").status == 0
    found = run("compare", logs / "null", "--effects", f"{file}:cable", "-o", work / "own")
    assert found.status == 0, found.err
    why = run("why", work / "own", "--json")
    assert why.status == 0
    assert "cable" in [e["effect"] for e in json.loads(why.out)["evidence"]]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("compare", "nowhere"), "nowhere"),
        (("why", "nowhere"), "run.json"),
        (("add", "nowhere", "slip_sinkage"), "run.json"),
        (("report", "nowhere"), "nowhere"),
        (("compare", "{null}", "--split", "slip_angle=maybe"), "maybe"),
        (("compare", "{null}", "--discrepancy", "sinkage=much"), "much"),
    ],
)
def test_mistakes_are_one_sentence_and_status_2(run, logs, work, arguments, word, monkeypatch):
    monkeypatch.chdir(work)
    found = run(*(str(a).replace("{null}", str(logs / "null")) for a in arguments))
    assert found.status == 2
    assert word in found.err
    assert "Traceback" not in found.err
    assert len(found.err.strip().splitlines()) <= 3


def test_bad_data_is_a_verdict_of_its_own(run, logs, work):
    folder = work / "spoilt"
    shutil.copytree(logs / "null", folder)
    file = next(folder.glob("*.csv"))
    frame = pd.read_csv(file)
    frame.loc[3, "normal_load_N"] = -5.0
    frame.to_csv(file, index=False)
    found = run("compare", folder, "-o", work / "spoilt_run")
    assert found.status == Verdict.BAD_DATA.exit_status
    assert "BAD_DATA" in found.out
    assert "normal_load_N" in found.out


def test_next_names_the_sweep_that_tells_two_effects_apart(run, logs, work):
    folder = _asked(run, logs / "hidden", work / "run1")
    found = run("next", folder, "--between", FEW[0], "--between", FEW[1], "--json")
    assert found.status == 0, found.err
    answer = json.loads(found.out)
    separations = [p["separation"] for p in answer["plans"]]
    assert separations == sorted(separations, reverse=True)
    assert separations[0] > 5.0
    assert separations[0] > 2.0 * separations[-1], "no plan would matter"
    assert set(answer["plans"][0]["pair"]) == set(FEW)
    assert answer["plans"][0]["name"] in answer["sentence"]
    assert json.loads((folder / "next.json").read_text()) == answer


@pytest.mark.slow
def test_an_audit_counts_and_goes_on_where_it_was(run, logs, work):
    _asked(run, logs / "null", work / "null")
    first = audit(work / "null", 1e-3)
    assert [c["truth"] == "nothing" for c in first.cases] == [True, False]
    assert first.cases[0]["outcome"] == "silent, rightly"
    assert first.cases[1]["truth"] in FEW
    assert first.cases[1]["outcome"] not in ("wrongly named", "false alarm")
    second = audit(work / "null", 1e-3)
    assert len(second.cases) == 4 and second.cases[:2] == first.cases
    assert second.rates["false alarms"]["of"] == 2
    assert "of 2" in json.loads((work / "null" / "audit.json").read_text())["sentence"]
