"""Drives of a whole rover, from an independent generator through the whole diagnosis."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.backends import Hook
from lunar_mjx.diagnosis.drives.form import DriveForm
from lunar_mjx.diagnosis.drives.instruments import USUAL_ERRORS
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.diagnosis.weighed.conclusion import conclude
from lunar_mjx.effects import catalogue
from lunar_mjx.inference.weighing.search import search
from lunar_mjx.logs import check, read_campaign
from lunar_mjx.logs.findings import is_bad
from lunar_mjx.model import make_model
from tests.diagnosis.drives import drive_campaign as drive_campaign_module
from tests.diagnosis.drives.drive_campaign import drive_campaign

pytestmark = pytest.mark.slow

FRICTION = 0.3
BASELINE = {
    "motor": {"resistance": (0.05, 2.0), "torque_constant": (0.05, 2.0)},
    "soil": {"shear_modulus_x": (0.3, 2.0), "friction_angle": (0.1, 2.0)},
}
CANDIDATES = ("coulomb_friction", "viscous_friction", "wheel_radius_error")


def _friction(ctx, state, torque):
    return torque - FRICTION * np.tanh(ctx.joint_speed / 0.03)


def _problem(folder, engine="auto"):
    logs = read_campaign([folder])
    assert not is_bad(check(logs))
    candidates = {n: catalogue.get(n) for n in CANDIDATES}
    return DriveProblem(
        logs, make_model("luvmi_x", terrain="flat", timestep=0.0025), candidates, baseline=BASELINE, engine=engine
    )


def _found(problem):
    settings = DriveSettings()
    form = DriveForm(problem, settings)
    found = search([form], settings.most_refits, settings.most_terms, settings.window)
    return form, found, conclude(found, settings.sure)


def _rms(form, u):
    return float(np.sqrt(np.mean(form.told(u)[form.observations.in_split("fit")] ** 2)))


def _torque(form, hypothesis):
    (place,) = [i for i in form.candidates["coulomb_friction"] if form.coordinates[i].name == "torque"]
    return float(form.coordinates[place].value(hypothesis.refit.u[place]))


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
    value, jacobian = quiet.jacobian(origin, which)
    np.testing.assert_array_equal(value, quiet.predict(origin[None])[0])
    rows = np.repeat(origin[None], 2, axis=0)
    rows[0, which[1]] += 0.02
    rows[1, which[1]] -= 0.02
    ahead, behind = quiet.predict(rows)
    sigma = quiet.observations.sigma()
    central = (ahead - behind) / 0.04 / sigma
    assert np.linalg.norm(jacobian[:, 1] / sigma - central) < 1e-2 * np.linalg.norm(central)


def test_no_share_of_a_simulation_is_told_as_one_of_the_whole(quiet, monkeypatch):
    """Its last part showed as "100 %, 0 s left" while a fit went on for minutes."""
    told = []
    monkeypatch.setattr(quiet, "progress", lambda what, share: told.append((what, share)))
    row = quiet.origin()
    row[quiet.baseline[0]] += 0.015  # no simulation of other tests
    quiet.predict(row[None])
    assert told and all(what == "simulating" and np.isnan(share) for what, share in told)


def test_a_program_without_candidates_predicts_what_one_with_them_at_their_null_does(quiet):
    plain = quiet.predict(quiet.origin()[None])
    assert quiet._bench_for(quiet.origin()[None]) is quiet.bench
    moved = np.repeat(quiet.origin()[None], 2, axis=0)
    moved[1, quiet.candidates["coulomb_friction"][0]] = 1.0
    both = quiet.predict(moved)
    assert quiet._bench_for(moved) is not quiet.bench
    np.testing.assert_allclose(both[0], plain[0], rtol=1e-9, atol=1e-9)
    assert np.abs((both[1] - both[0]) / quiet.observations.sigma()).max() > 5.0


def test_usual_errors_are_those_of_the_place_where_the_model_stands(quiet):
    """A current's scale is a share of the current that is predicted there, not of that of the model as given."""
    (scale,) = [i for i, c in enumerate(quiet.coordinates) if c.name == "usual motor A: scale"]
    (motor,) = [i for i, c in enumerate(quiet.coordinates) if c.key == "motor.torque_constant"]
    there, more = quiet.origin(), quiet.origin()
    there[motor] = more[motor] = 3.0
    more[scale] = 1.0
    rows = np.concatenate([np.arange(s.start, s.stop) for s in quiet.observations.series if "current" in s.channel])
    changes = []
    for place in (quiet.origin(), there):
        quiet.about(place)
        changes.append((quiet.predict(more[None]) - quiet.predict(there[None]))[0, rows])
        np.testing.assert_allclose(changes[-1], 0.01 * quiet.predict(place[None])[0, rows], atol=1e-12)
    quiet.about(quiet.origin())
    assert np.abs(changes[1] - changes[0]).max() > 0.05 * np.abs(changes[0]).max()


def test_drives_without_a_hidden_effect_are_noise_only(quiet):
    form, found, said = _found(quiet)
    assert said.verdict is Verdict.NOISE_ONLY, said.sentence
    assert _rms(form, found.base(form.name).refit.u) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("engine", ["auto", "mjx"])
def test_friction_hidden_in_a_drive_is_named_and_sized(rubbing_logs, engine):
    form, found, said = _found(_problem(rubbing_logs, engine))
    assert said.verdict is Verdict.KNOWN, said.sentence
    assert said.effects == ("coulomb_friction",)
    assert _torque(form, found.best) == pytest.approx(FRICTION, rel=0.1)
    assert _rms(form, found.best.refit.u) < 1.05
    # Unknown inputs at the joint could do what friction does; the model itself cannot.
    assert _rms(form, form.alone(found.base(form.name).refit)) > 1.2


def test_a_usual_error_of_a_clock_is_what_a_late_stamp_does(tmp_path):
    """Wheels are read at every second simulated sample: from reading to reading they have reached their commands."""
    logs = read_campaign([drive_campaign(tmp_path, encoders_every=2)])
    candidates = {"clock_offset": catalogue.get("clock_offset")}
    problem = DriveProblem(logs, make_model("luvmi_x", terrain="flat", timestep=0.0025), candidates, baseline=BASELINE)
    names = [c.name for c in problem.coordinates]
    late, usual = names.index("joint"), names.index("usual clock joint: late")
    rows = np.repeat(problem.origin()[None], 3, axis=0)
    rows[1, late], rows[2, usual] = 1e-3 / problem.coordinates[late].scale, 1.0
    plain, stamped, erring = problem.predict(rows)
    joints = np.concatenate([np.arange(s.start, s.stop) for s in problem.observations.series if "speed" in s.channel])
    change, wanted = (erring - plain)[joints], (stamped - plain)[joints] * USUAL_ERRORS.usual_clock_s / 1e-3
    assert np.abs(wanted).max() > 0.01
    # a shift by a millisecond is the derivative but for its square
    np.testing.assert_allclose(change, wanted, atol=0.03 * float(np.abs(wanted).max()))


def test_a_jump_of_the_command_is_no_slope_of_a_current(tmp_path, monkeypatch):
    jump = 1.5
    monkeypatch.setattr(drive_campaign_module, "PROFILES", (lambda t: 0.0 if t < jump else 2.0,))
    logs = read_campaign([drive_campaign(tmp_path)])
    problem = DriveProblem(logs, make_model("luvmi_x", terrain="flat", timestep=0.0025), {}, baseline=BASELINE)
    predicted, interval = problem.predict(problem.origin()[None])[0], 0.1
    seen = 0
    for s in problem.observations.series:
        if "drive_current" in s.channel:
            current, rate = predicted[s.start : s.stop], problem.rate[s.start : s.stop]
            step = int(np.argmax(np.abs(np.diff(current))))
            assert np.abs(np.diff(current)[step]) > 0.5, "the current jumps"
            # of the last reading before it; the peak behind it falls on its other side as fast as it rose
            assert np.abs(rate[step]) * interval < 0.01 * np.abs(np.diff(current)[step])
            seen += 1
    assert seen == 4
