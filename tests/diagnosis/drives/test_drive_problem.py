"""Drives of a whole rover, from an independent generator through the whole diagnosis."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.backends import Hook
from lunar_mjx.diagnosis.attribute import diagnose
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.refit import Settings
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.effects import catalogue
from lunar_mjx.logs import check, read_campaign
from lunar_mjx.logs.findings import is_bad
from lunar_mjx.model import make_model
from tests.diagnosis.drives.drive_campaign import drive_campaign

pytestmark = pytest.mark.slow

FRICTION = 0.3
BASELINE = {
    "motor": {"resistance": (0.05, 2.0), "torque_constant": (0.05, 2.0)},
    "soil": {"shear_modulus_x": (0.3, 2.0), "friction_angle": (0.1, 2.0)},
}
CANDIDATES = ("coulomb_friction", "viscous_friction", "wheel_radius_error")
SETTINGS = Settings(starts=3, draws=500)


def _friction(ctx, state, torque):
    return torque - FRICTION * np.tanh(ctx.joint_speed / 0.03)


def _problem(folder, engine="auto"):
    logs = read_campaign([folder])
    assert not is_bad(check(logs))
    candidates = {n: catalogue.get(n) for n in CANDIDATES}
    return DriveProblem(
        logs, make_model("luvmi_x", terrain="flat", timestep=0.0025), candidates, baseline=BASELINE, engine=engine
    )


@pytest.fixture(scope="module")
def quiet_logs(tmp_path_factory):
    return drive_campaign(tmp_path_factory.mktemp("quiet"))


@pytest.fixture(scope="module")
def rubbing_logs(tmp_path_factory):
    return drive_campaign(tmp_path_factory.mktemp("rubbing"), [Hook("friction", {"torque": _friction})], seed=1)


@pytest.fixture(scope="module")
def quiet(quiet_logs):
    return _problem(quiet_logs)


def test_quotients_agree_with_a_change_of_the_parameter(quiet):
    which = quiet.baseline[:3]
    origin = quiet.origin()
    jacobian = quiet.jacobian(origin, which)
    rows = np.repeat(origin[None], 2, axis=0)
    rows[0, which[1]] += 0.02
    rows[1, which[1]] -= 0.02
    ahead, behind = quiet.predict(rows)
    sigma = quiet.observations.sigma()
    central = (ahead - behind) / 0.04 / sigma
    assert np.linalg.norm(jacobian[:, 1] / sigma - central) < 1e-2 * np.linalg.norm(central)


def test_a_program_without_candidates_predicts_what_one_with_them_at_their_null_does(quiet):
    plain = quiet.predict(quiet.origin()[None])
    assert len(quiet._benches) == 1
    moved = np.repeat(quiet.origin()[None], 2, axis=0)
    moved[1, quiet.candidates["coulomb_friction"][0]] = 1.0
    both = quiet.predict(moved)
    assert len(quiet._benches) == 2
    np.testing.assert_allclose(both[0], plain[0], rtol=1e-9, atol=1e-9)
    assert np.abs((both[1] - both[0]) / quiet.observations.sigma()).max() > 5.0


def test_drives_without_a_hidden_effect_are_noise_only(quiet):
    diagnosis, found = diagnose(quiet, SETTINGS)
    assert diagnosis.verdict is Verdict.NOISE_ONLY, diagnosis.sentence
    assert found.base.fit.rms(found.base.fit.fitted) == pytest.approx(1.0, abs=0.05)


def test_friction_hidden_in_a_drive_is_named_and_sized(rubbing_logs):
    problem = _problem(rubbing_logs)
    diagnosis, found = diagnose(problem, SETTINGS)
    assert diagnosis.verdict is Verdict.KNOWN, diagnosis.sentence
    assert diagnosis.effects == ("coulomb_friction",)
    row = diagnosis.evidence[0]
    assert row.values["torque"] == pytest.approx(FRICTION, rel=0.1)
    assert found.chosen.fit.rms(found.chosen.fit.fitted) < 1.05 < 1.2 < found.base.fit.rms(found.base.fit.fitted)


def test_the_other_engine_gives_the_same_verdicts(quiet_logs, rubbing_logs):
    nothing, _ = diagnose(_problem(quiet_logs, "mjx"), SETTINGS)
    assert nothing.verdict is Verdict.NOISE_ONLY, nothing.sentence
    friction, _ = diagnose(_problem(rubbing_logs, "mjx"), SETTINGS)
    assert friction.verdict is Verdict.KNOWN, friction.sentence
    assert friction.effects == ("coulomb_friction",)
    assert friction.evidence[0].values["torque"] == pytest.approx(FRICTION, rel=0.1)
