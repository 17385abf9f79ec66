"""A contact law against tables: derivatives, fields that follow their ports, and speeds that differ."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.diagnosis import build_problem
from lunar_mjx.diagnosis.runs import Run
from lunar_mjx.diagnosis.tables.loop import build_tables, contact_laws, with_law
from lunar_mjx.diagnosis.tables.port_gains import ADDED, FIELDS, GAINS
from lunar_mjx.diagnosis.tables.settings import TableSettings
from lunar_mjx.diagnosis.tables.wheel_program import ABSCISSAE
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.diagnosis.weighed.conclusion import conclude
from lunar_mjx.effects import catalogue
from lunar_mjx.errors import UserError
from lunar_mjx.inference.weighing.hypotheses import UNLISTED
from lunar_mjx.inference.weighing.search import search
from lunar_mjx.logs import Noise, read_campaign, write_steady_log
from lunar_mjx.model import make_model
from lunar_mjx.wheel_bed.bed import WheelBed, wheel_test

RADIUS, WIDTH = 0.15, 0.1
STD = {"drawbar_pull_N": 0.3, "side_force_N": 0.3, "driving_torque_Nm": 0.05, "sinkage_m": 4e-4}


def write(folder, change=None, speeds=(0.05,), seed=0):
    """A table of the closed form; `change(frame)` spoils it, every speed repeats it."""
    slip, angle, load = (
        a.ravel() for a in np.meshgrid(np.linspace(-0.1, 0.6, 6), [0.0, 15.0, 30.0], [40.0, 80.0], indexing="ij")
    )
    result = WheelBed.of_preset("consistent").run(wheel_test(slip, np.radians(angle), load, RADIUS, WIDTH))
    one = pd.DataFrame(
        {
            "slip_ratio": slip,
            "slip_angle_deg": angle,
            "normal_load_N": load,
            "drawbar_pull_N": result.drawbar_pull,
            "side_force_N": result.side_force,
            "driving_torque_Nm": result.driving_torque,
            "sinkage_m": result.sinkage,
        }
    )
    frame = pd.concat([one.assign(travel_speed_m_s=s) for s in speeds], ignore_index=True)
    frame = frame if change is None else change(frame)
    rng = np.random.default_rng(seed)
    for column, std in STD.items():
        frame[column] += std * rng.standard_normal(len(frame))
    return write_steady_log(
        folder,
        frame,
        wheel={"radius_m": RADIUS, "width_m": WIDTH},
        slip_definition="wheel_frame",
        noise={c: Noise(s, "datasheet") for c, s in STD.items()},
    )


@pytest.fixture(autouse=True)
def few(monkeypatch):
    only = {n: catalogue.get(n) for n in ("slip_sinkage", "rolling_resistance")}
    monkeypatch.setattr(build_problem, "candidate_effects", lambda run: only)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tables")


def tables(folder, name, **how):
    path = folder / name
    if not path.exists():
        write(path, **how)
    run = Run(folder / "run", (path,), make_model("luvmi_x", terrain="flat", preset="consistent"))
    return build_tables(run, read_campaign([path]), rivals=False)


def weigh(problem):
    s = problem.settings
    return search(problem.forms, s.most_refits, s.most_terms, s.window)


def test_derivatives_by_coordinates_and_load_agree_with_differences(folder):
    form = tables(folder, "plain").own
    u = np.zeros(len(form.coordinates))
    value, slope = form.predict(u)
    step = 1e-5
    for i in form.baseline:
        up, down = u.copy(), u.copy()
        up[i] += step
        down[i] -= step
        numeric = (form.predict(up)[0] - form.predict(down)[0]) / (2.0 * step)
        np.testing.assert_allclose(slope[:, i], numeric, rtol=1e-4, atol=1e-4 * np.abs(numeric).max() + 1e-9)
    test = form.data.imposed.test
    more = dataclasses.replace(test, normal_load=np.asarray(test.normal_load) * (1.0 + step))
    moved, _ = form.program(u, form.data.imposed._replace(test=more))
    numeric = (moved[form.data.quantity, form.data.point] - value) / step
    column = slope[:, len(u) + len(GAINS) + ABSCISSAE.index("load scale")]
    np.testing.assert_allclose(column, numeric, rtol=1e-3, atol=1e-3 * np.abs(numeric).max())


def test_a_gain_on_the_side_force_moves_the_side_force_alone(folder):
    form = tables(folder, "plain").own
    value, slope = form.predict(np.zeros(len(form.coordinates)))
    number = next(i for i, g in enumerate(GAINS) if g.field == "wheel_shear: lateral force")
    column = slope[:, len(form.coordinates) + number]
    aside = form.data.quantity == 1
    np.testing.assert_allclose(column[aside], value[aside], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(column[~aside], 0.0, atol=1e-12)


def test_a_force_that_a_law_lacks_is_unlisted_and_no_usual_discrepancy(folder):
    form = tables(folder, "plain").own
    linear, _, _ = form.linearise(np.zeros(len(form.coordinates)))
    assert set(linear.added) == {g.field for g in GAINS if g.kind == ADDED}
    added = np.concatenate(list(linear.added.values()))
    assert not set(added) & set(linear.always)
    field = "wheel_shear: driving moment"
    unlisted = frozenset(t for t in form.terms if t.kind == UNLISTED and t.name == field)
    _, _, places = linear.evidence(unlisted)
    assert set(linear.added[field]) <= set(places)
    assert not set(added) & set(linear.evidence(frozenset())[2])


def test_forms_of_one_law_have_the_same_candidates(folder, monkeypatch):
    more = {n: catalogue.get(n) for n in ("side_wall", "skid_shear", "shear_softening", "slip_sinkage")}
    monkeypatch.setattr(build_problem, "candidate_effects", lambda run: more)
    tables(folder, "plain")
    path = folder / "plain"
    run = Run(folder / "run", (path,), make_model("luvmi_x", terrain="flat", preset="consistent"))
    problem = build_tables(run, read_campaign([path]))
    closed, integral = (set(problem.form(n).candidates) for n in ("closed form", "stress_integral"))
    assert closed == integral == set(more)


def test_a_refit_arrives_from_the_model_as_given_and_from_afar(folder):
    form = tables(folder, "plain").own
    far = np.zeros(len(form.coordinates))
    far[form.baseline] = np.clip(1.5, *form._bounds(form.baseline))
    found = [form.refit(frozenset(), None, start) for start in (None, far)]
    values = [r.linear.evidence(frozenset())[0] for r in found]
    assert values[0] == pytest.approx(values[1], abs=0.5)


def test_alone_a_model_predicts_best_without_what_it_leaves_to_instruments(folder):
    form = tables(folder, "plain").own
    refit = form.refit(frozenset(), None, None)
    alone = form.alone(refit)
    fit = form.observations.in_split("fit")
    left, least = (float(np.sum(form.residual(u)[fit] ** 2)) for u in (refit.u, alone))
    assert least < left and least == pytest.approx(fit.sum(), rel=0.2)
    # along no coordinate is there anything better
    for i in form.baseline:
        for step in (-0.05, 0.05):
            beside = alone.copy()
            beside[i] += step
            prior = (beside[i] ** 2 - alone[i] ** 2) / form.coordinates[i].prior ** 2
            low, high = form.coordinates[i].bounds()
            if low <= beside[i] <= high:
                assert np.sum(form.residual(beside)[fit] ** 2) + prior > least - 0.1


def test_chunks_of_points_make_no_difference(folder):
    form = tables(folder, "plain").own
    u = np.zeros(len(form.coordinates))
    whole, _ = form.program(u, form.data.imposed)
    part = form.data.imposed._replace(
        test=type(form.data.imposed.test)(
            **{
                f.name: np.asarray(getattr(form.data.imposed.test, f.name))[:5]
                for f in dataclasses.fields(form.data.imposed.test)
            }
        ),
        slip=form.data.imposed.slip[:5],
        lever=form.data.imposed.lever[:5],
        mean_load=form.data.imposed.mean_load[:5],
        gravity=form.data.imposed.gravity[:5],
    )
    np.testing.assert_allclose(form.program(u, part)[0], whole[:, :5], rtol=1e-12)


def test_nothing_hidden_and_a_load_cell_off_are_quiet(folder):
    assert conclude(weigh(tables(folder, "plain")), 0.95).verdict is Verdict.NOISE_ONLY

    def off(frame):
        return frame.assign(drawbar_pull_N=1.03 * frame["drawbar_pull_N"])

    assert conclude(weigh(tables(folder, "cell", change=off, seed=1)), 0.95).verdict is Verdict.NOISE_ONLY


def test_shear_that_depends_on_the_rate_is_unlisted_and_not_noise(folder):
    def rate(frame):
        fast = frame["travel_speed_m_s"] > 0.1
        factor = np.where(fast, 1.3, 1.0)
        return frame.assign(
            drawbar_pull_N=frame["drawbar_pull_N"] + (factor - 1.0) * frame["driving_torque_Nm"] / RADIUS,
            driving_torque_Nm=factor * frame["driving_torque_Nm"],
            side_force_N=factor * frame["side_force_N"],
        )

    problem = tables(folder, "rate", change=rate, speeds=(0.02, 0.2), seed=2)
    assert len(problem.own.data.imposed.slip) == 72, "runs at different speeds were pooled"
    said = conclude(weigh(problem), 0.95)
    assert said.verdict is Verdict.UNKNOWN
    assert said.port in ("soil", "wheel_shear")
    assert said.place is not None and said.place.endswith("with speed")


def test_an_effect_is_named_and_what_remains_is_told_by_port(folder):
    def resist(frame):
        return frame.assign(driving_torque_Nm=frame["driving_torque_Nm"] + 0.06 * RADIUS * frame["normal_load_N"])

    found = weigh(tables(folder, "resist", change=resist, seed=3))
    said = conclude(found, 0.95)
    assert (said.verdict, said.effects) == (Verdict.KNOWN, ("rolling_resistance",))
    assert len(found.best.evidence.tau) == len(FIELDS)
    assert (found.best.evidence.tau < 0.1).all()


def test_the_law_of_an_effect_is_inexact_where_it_acts(folder):
    form = tables(folder, "plain").own
    u = np.zeros(len(form.coordinates))
    assert not form.linearise(u)[0].inexact
    place = next(i for i, c in enumerate(form.coordinates) if c.key == "rolling_resistance.coefficient")
    u[place] = 1.0
    linear, columns, _ = form.linearise(u)
    (own,) = linear.inexact.values()
    named = form.listed(frozenset({"rolling_resistance"}))
    assert set(own) <= set(linear.evidence(named)[2])
    # neither where it is not, nor beside another alone
    for others in (frozenset(), form.listed(frozenset({"slip_sinkage"}))):
        assert not set(own) & set(linear.evidence(others)[2])
    # a couple about the axle can be wrong in the driving torque alone
    torque = form.data.quantity == 2
    assert np.abs(columns[torque][:, own]).max() > 0.0
    np.testing.assert_allclose(columns[~torque][:, own], 0.0, atol=1e-9)


def test_the_law_of_an_effect_that_was_added_is_inexact_too(folder):
    model = make_model("luvmi_x", terrain="flat", preset="consistent").add("rolling_resistance", coefficient=0.05)
    tables(folder, "plain")
    run = Run(folder / "run", (folder / "plain",), model)
    form = build_tables(run, run.campaign(), rivals=False).own
    linear, _, _ = form.linearise(np.zeros(len(form.coordinates)))
    assert set(linear.inexact) == {"rolling_resistance"}
    assert set(linear.inexact["rolling_resistance"]) <= set(linear.evidence(frozenset())[2])


def test_an_effect_whose_law_is_uneven_has_more_evidence_where_laws_may_be_inexact(folder, monkeypatch):
    def resist(frame):
        # half as strong at the strongest slip
        share = 1.0 - 0.5 * (frame["slip_ratio"] + 0.1) / 0.7
        return frame.assign(
            driving_torque_Nm=frame["driving_torque_Nm"] + 0.25 * share * RADIUS * frame["normal_load_N"]
        )

    form = tables(folder, "uneven", change=resist, seed=6).own
    named = form.listed(frozenset({"rolling_resistance"}))
    value = form.refit(frozenset({"rolling_resistance"}), None, None).linear.evidence(named)[0]
    monkeypatch.setattr(form, "settings", dataclasses.replace(form.settings, effect_discrepancy=0.0))
    exact = form.refit(frozenset({"rolling_resistance"}), None, None).linear.evidence(named)[0]
    assert value > exact + 1.0


def test_rival_laws_take_the_place_of_the_models_own():
    model = make_model("luvmi_x", terrain="flat", preset="consistent")
    laws = contact_laws(model, TableSettings().laws)
    assert list(laws) == ["closed form", "stress_integral", "granular_resistance"]
    assert "stress_integral" in laws["stress_integral"].effect_names
    assert not {"pressure_sinkage", "closed_form_shear"} & set(laws["stress_integral"].effect_names)
    assert list(contact_laws(with_law(model, "stress_integral"), ())) == ["stress_integral"]


def test_tables_of_several_gravities_share_a_run(folder):
    write(folder / "earth", seed=4)
    write(folder / "moon", seed=4)
    path = folder / "moon" / "log.toml"
    path.write_text("gravity_m_s2 = 1.62\n" + path.read_text().replace("gravity_m_s2 = 9.80665\n", ""))
    run = Run(folder / "run", (folder / "earth", folder / "moon"), make_model("luvmi_x", terrain="flat"))
    form = build_tables(run, run.campaign(), rivals=False).own
    value, _ = form.predict(np.zeros(len(form.coordinates)))
    half = len(form.data.imposed.slip) // 2
    assert set(form.data.imposed.gravity[:half]) != set(form.data.imposed.gravity[half:])
    first, second = value[form.data.point < half], value[form.data.point >= half]
    assert np.isfinite(value).all() and len(first) == len(second)


def test_settings_are_given_by_name():
    changed = TableSettings.of({"effect_odds": "0.5", "laws": "stress_integral", "most_terms": 3})
    assert (changed.effect_odds, changed.laws, changed.most_terms) == (0.5, ("stress_integral",), 3)
    for name, value in (("odds", "1"), ("most_terms", "2.5"), ("effect_odds", "many")):
        with pytest.raises(UserError, match=name):
            TableSettings.of({name: value})


def test_a_model_that_an_effect_was_added_to_shares_its_program(folder):
    path = folder / "plain"
    if not path.exists():
        write(path)
    model = make_model("luvmi_x", terrain="flat", preset="consistent")
    grown = model.add("rolling_resistance", "add", coefficient=0.05)
    first, second = (
        build_tables(Run(folder / "run", (path,), m), Run(folder / "run", (path,), m).campaign(), rivals=False).own
        for m in (model, grown)
    )
    assert first.program._run is second.program._run
    u, v = np.zeros(len(first.coordinates)), np.zeros(len(second.coordinates))
    place = next(i for i, c in enumerate(first.coordinates) if c.key == "rolling_resistance.coefficient")
    u[place] = 0.05 / first.coordinates[place].scale
    np.testing.assert_allclose(first.predict(u)[0], second.predict(v)[0], rtol=1e-9, atol=1e-12)


def test_the_moment_errs_with_the_shear_stress_and_little_beyond(folder):
    form = tables(folder, "plain").own
    linear, _, _ = form.linearise(np.zeros(len(form.coordinates)))
    usual = {f.name: f.usual for f in linear.fields}
    assert usual["wheel_shear: driving moment"] == pytest.approx(0.2 * usual["wheel_shear: longitudinal force"])
    assert len(set(usual.values())) == 2


def test_effects_on_sensors_of_drives_are_not_used_and_that_is_said(folder):
    assert not tables(folder, "plain").unused
    path = folder / "plain"
    model = make_model("luvmi_x", terrain="flat", preset="consistent").add("channel_scale")
    problem = build_tables(Run(folder / "run", (path,), model), read_campaign([path]), only=())
    assert "channel_scale" in problem.unused and "calibration" in problem.unused
