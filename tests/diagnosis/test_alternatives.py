"""Another form of part of the model, for drives: refitted in its place, and said to do better where it does."""

from __future__ import annotations

import pytest

from lunar_mjx.diagnosis import alternatives as module
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.refit import Candidate
from lunar_mjx.diagnosis.runs import Run
from lunar_mjx.effects import catalogue
from lunar_mjx.inference.fitting import fit
from lunar_mjx.inference.held_out import noise_test
from lunar_mjx.logs import read_campaign
from lunar_mjx.model import make_model
from tests.diagnosis.drives.drive_campaign import STEP, drive_campaign

pytestmark = pytest.mark.slow

BASELINE = {"motor": {"resistance": (0.05, 2.0), "torque_constant": (0.05, 2.0)}}
FORM = "stress_integral"


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Drives of a rover whose wheels obey another form of contact."""
    return read_campaign([drive_campaign(tmp_path_factory.mktemp("drives"), noise=0.2, forms=[FORM])])


@pytest.fixture(scope="module")
def chosen(logs):
    model = make_model("luvmi_x", terrain="flat", timestep=STEP)
    problem = DriveProblem(logs, model, {}, baseline=BASELINE)
    base = fit(problem, problem.free(), starts=1, certify=False)
    return problem, Candidate((), base, noise_test(problem, base), 0.0, 0.0)


def test_the_form_that_drives_were_made_with_does_better_in_place_of_the_models(logs, chosen, tmp_path, monkeypatch):
    problem, base = chosen
    monkeypatch.setattr(module, "candidate_effects", lambda run: {FORM: catalogue.get(FORM)})
    run = Run(tmp_path, (), problem.model)
    said = []
    (found,) = module.alternatives(run, logs, problem, base, lambda what, share: said.append(what))
    assert found.effect == FORM
    assert set(found.replaces) == {"pressure_sinkage", "closed_form_shear"}
    assert found.chi2_before == base.fit.chi2
    assert found.helps
    assert found.chi2 < 1.1 * base.fit.fitted.sum() < base.fit.chi2
    assert f"refitting with {FORM} instead" in said
