"""The particle bed without its extra: wheel, box, time, plan, results and the log; nothing is simulated."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.logs import check, read_log
from lunar_mjx.logs.recorder.particle_bed import write_particle_log
from lunar_mjx.wheel_bed.data_files import load_figures
from lunar_mjx.wheel_bed.particles import campaign
from lunar_mjx.wheel_bed.particles.mesh import rim, volume, wheel_mesh
from lunar_mjx.wheel_bed.particles.points import points_of_table
from lunar_mjx.wheel_bed.particles.results import VARIANTS, numerical_error, steady, variant_numerics
from lunar_mjx.wheel_bed.particles.settings import Numerics, ParticleWheel, Point, Sand, layout
from tests.wheel_bed.particles.fakes import NUMERICS, POINT, RUN, SAND, WHEEL, fake_result, series


class TestMesh:
    def test_a_smooth_wheel_is_a_cylinder(self):
        assert volume(*wheel_mesh(WHEEL)) == pytest.approx(math.pi * 0.1**2 * 0.1, rel=1e-3)

    def test_grousers_add_their_volume(self):
        wheel = ParticleWheel(0.1, 0.1, grouser_count=12, grouser_height=0.02)
        ring = math.pi * (0.12**2 - 0.1**2) * 0.1
        assert volume(*wheel_mesh(wheel)) == pytest.approx(math.pi * 0.1**2 * 0.1 + 0.25 * ring, rel=0.02)
        assert np.linalg.norm(rim(wheel), axis=1).max() == pytest.approx(0.12)

    @pytest.mark.parametrize("wheel", [WHEEL, ParticleWheel(0.1, 0.05, 8, 0.01)])
    def test_the_surface_is_closed(self, wheel):
        faces = wheel_mesh(wheel)[1]
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        there, back = {tuple(e) for e in edges.tolist()}, {(b, a) for a, b in edges.tolist()}
        assert len(there) == len(edges) and there == back


class TestScales:
    def test_gravity_changes_times_and_no_lengths(self):
        moon = dataclasses.replace(RUN, gravity=1.625)
        assert moon.steps == RUN.steps and layout([moon]) == layout([RUN])
        assert moon.time_step / RUN.time_step == pytest.approx(math.sqrt(9.81 / 1.625))

    def test_the_wheel_stays_inside_its_sand(self):
        for slip, travel in ((-0.5, 1.0), (0.9, 0.1)):
            run = dataclasses.replace(RUN, point=Point(slip, 0.0, 50.0, 1.0, travel))
            box = layout([run])
            way = run.speed * travel * (run.drive_time + run.ramp_time)
            assert box.start + way + WHEEL.radius < box.size[0]

    def test_a_slow_wheel_still_travels_its_radii(self):
        run = dataclasses.replace(RUN, point=Point(0.9, 0.0, 50.0, 1.0, 0.1))
        assert run.speed * 0.1 * run.drive_time == pytest.approx(NUMERICS.least_travel * WHEEL.radius)

    def test_plane_strain_strength(self):
        sand = Sand(friction_angle=30.0, cohesion=100.0)
        assert sand.friction == pytest.approx(0.5) and sand.strength == pytest.approx(100.0 * math.cos(math.pi / 6))


class TestMistakes:
    @pytest.mark.parametrize(
        ("make", "words"),
        [
            (lambda: ParticleWheel(-0.1, 0.1), "radius = -0.1"),
            (lambda: ParticleWheel(0.1, 0.1, 8), "grouser_count = 8 and grouser_height do not agree"),
            (lambda: Sand(friction_angle=80.0), "friction_angle = 80"),
            (lambda: Point(0.99, 0.0, 50.0, 1.0, 0.01), "slip_ratio = 0.99"),
            (lambda: Point(0.1, 0.0, 0.0, 1.0, 0.9), "normal_load_N = 0"),
            (lambda: Numerics(0.01, contact="Q9"), "contact = 'Q9'"),
            (lambda: layout([dataclasses.replace(RUN, numerics=Numerics(0.05))]), "too coarse"),
            (
                lambda: layout([dataclasses.replace(RUN, wheel=ParticleWheel(0.1, 0.1, 8, 0.005))]),
                "coarser than the grousers' height",
            ),
            (lambda: campaign.plan(WHEEL, SAND, 9.81, [POINT], NUMERICS, controls=2), "--controls = 2"),
        ],
    )
    def test_is_told_in_one_sentence(self, make, words):
        with pytest.raises(UserError) as told:
            make()
        assert words in str(told.value) and "\n" not in str(told.value)

    def test_a_broken_line_of_results_is_named(self, tmp_path):
        (tmp_path / campaign.RUNS_FILE).write_text('{"key": 1}\nrubbish\n{"key": 2}\n')
        with pytest.raises(UserError, match="line 2"):
            campaign.read_results(tmp_path)

    def test_a_last_line_that_was_cut_off_is_left_out(self, tmp_path):
        (tmp_path / campaign.RUNS_FILE).write_text('{"key": 1}\n{"ke')
        assert campaign.read_results(tmp_path) == [{"key": 1}]


class TestPlan:
    def test_the_measured_wheel_keeps_its_points(self):
        table = load_figures()
        points = points_of_table(table)
        assert len(points) == len(table)
        for p, rim_speed, travel in zip(
            points, table.test["rim_speed_m_s"], table.test["travel_speed_m_s"], strict=True
        ):
            assert max(p.rim, p.travel) == pytest.approx(1.0)
            assert p.rim * travel == pytest.approx(p.travel * rim_speed)

    def test_each_variant_changes_one_thing(self):
        for variant in VARIANTS:
            changed = dataclasses.replace(RUN, numerics=variant_numerics(NUMERICS, variant))
            same = {
                "voxel": changed.numerics.voxel == NUMERICS.voxel,
                "step": changed.time_step == pytest.approx(RUN.time_step),
                "contact": changed.numerics.contact == NUMERICS.contact,
                "jitter": changed.numerics.seed == NUMERICS.seed,
            }
            assert [name for name, kept in same.items() if not kept] == [variant]

    def test_control_runs_come_after_the_table(self):
        points = [dataclasses.replace(POINT, load=w) for w in (20.0, 40.0, 60.0)]
        runs = campaign.plan(WHEEL, SAND, 9.81, points, NUMERICS, controls=2)
        assert [r.variant for r in runs] == ["table"] * 3 + [v for v in VARIANTS for _ in range(2)]
        assert len({r.key for r in runs}) == len(runs)

    def test_a_plan_survives_as_plain_data(self):
        runs = campaign.plan(WHEEL, SAND, 9.81, [POINT], NUMERICS, controls=1)
        data = json.loads(json.dumps([{**r.inputs(), "variant": r.variant} for r in runs]))
        assert [r.key for r in campaign.read_plan(data)] == [r.key for r in runs]

    def test_batches_hold_what_fits_and_what_is_alike(self):
        points = [dataclasses.replace(POINT, load=w) for w in (20.0, 40.0, 60.0)] + [Point(0.9, 0.0, 50.0, 1.0, 0.1)]
        runs = campaign.plan(WHEEL, SAND, 9.81, points, NUMERICS, controls=0)
        one = layout(runs[:1]).particles
        assert [len(b) for b in campaign.batches(runs, 2 * one)] == [2, 1, 1]
        assert [len(b) for b in campaign.batches(runs, 1)] == [1] * 4
        on_moon = dataclasses.replace(runs[0], gravity=1.625)
        assert [len(b) for b in campaign.batches([runs[0], on_moon], 10 * one)] == [1, 1]


class TestResults:
    def test_steady_values_are_means_of_the_end(self):
        found = steady(RUN, series(RUN))
        means = {"drawbar_pull": 3.0, "side_force": 0.0, "driving_torque": 1.0, "sinkage": 0.02}
        assert found["values"] == pytest.approx(means)
        assert found["usable"] and found["error"]["drawbar_pull"] == 0.0

    @pytest.mark.parametrize("wrong", [{"vertical_force": 40.0}, {"sinkage": 0.11}, {"drawbar_pull": math.nan}])
    def test_what_is_not_settled_is_no_point(self, wrong):
        assert not steady(RUN, series(RUN, **wrong))["usable"]

    def test_errors_by_cause(self):
        runs = campaign.plan(WHEEL, SAND, 9.81, [POINT], NUMERICS, controls=1)
        away = {"table": 5.0, "voxel": 5.3, "step": 4.9, "contact": 5.2, "jitter": 5.1}
        error = numerical_error([fake_result(r, drawbar_pull=away[r.variant]) for r in runs])["drawbar_pull"]
        # a voxel half as large again errs by half as much again; a halved step halves its error
        assert error["voxel"] == pytest.approx(2.0 * 0.3) and error["step"] == pytest.approx(2.0 * 0.1)
        assert error["contact"] == pytest.approx(0.2) and error["jitter"] == pytest.approx(0.1 / math.sqrt(2.0))
        assert error["total"] == pytest.approx(math.sqrt(0.6**2 + 0.2**2 + 0.2**2 + 0.005))

    def test_what_has_not_come_to_rest_is_an_error(self):
        result = fake_result(RUN) | {"drift": dict.fromkeys(fake_result(RUN)["values"], 0.3)}
        error = numerical_error([result])["side_force"]
        assert error["drift"] == pytest.approx(0.3) == error["total"]

    def test_the_log_is_read_back_with_its_noise(self, tmp_path):
        points = [Point(s, a, 50.0, 1.0, 1.0 - s) for s in (0.1, 0.3) for a in (0.0, 20.0)]
        runs = campaign.plan(WHEEL, SAND, 1.625, points, NUMERICS, controls=1)
        # side force and sinkage as a wheel that slides would show them, so that the gate has nothing to find
        results = [
            fake_result(
                r,
                drawbar_pull=5.0 + r.point.slip_ratio + 0.1 * len(r.variant),
                side_force=0.5 * r.point.slip_angle + r.point.slip_ratio,
                driving_torque=2.0 + r.point.slip_ratio + 0.01 * r.point.slip_angle,
                sinkage=0.01 + 0.01 * r.point.slip_ratio + 1e-4 * r.point.slip_angle + 1e-4 * len(r.variant),
            )
            for r in runs
        ]
        for _ in range(2):  # the second takes the place of the first
            log = read_log(write_particle_log(tmp_path, results, "wheel_frame"))
        assert len(log.table) == 4 and log.gravity_m_s2 == 1.625 and log.wheel["radius_m"] == 0.1
        assert log.noise["drawbar_pull_N"].std == pytest.approx(numerical_error(results)["drawbar_pull"]["total"])
        assert [f for f in check([log]) if f.severity == "bad_data" and f.kind != "noise"] == []

    def test_no_log_of_runs_that_did_not_settle(self, tmp_path):
        with pytest.raises(UserError, match="none of 1 runs is usable"):
            write_particle_log(tmp_path, [fake_result(RUN, usable=False)], "wheel_frame")


class TestResume:
    def test_what_is_kept_is_not_computed_again(self, tmp_path, monkeypatch):
        runs = campaign.plan(WHEEL, SAND, 9.81, [POINT], NUMERICS, controls=1)
        (tmp_path / campaign.RUNS_FILE).write_text(json.dumps(fake_result(runs[0])) + "\n")
        seen = []

        class Boxes:
            def __init__(self, batch, device):
                self.batch = batch
                seen.extend(r.variant for r in batch)

            def run(self, going_on):
                return [series(r) for r in self.batch] if going_on(1.0) else None

        monkeypatch.setattr(campaign, "open_device", lambda device: "cpu")
        monkeypatch.setattr(campaign, "SandBoxes", Boxes)
        told = []
        done = campaign.compute(runs, tmp_path, progress=lambda what, share: told.append(share))
        assert seen == ["voxel", "step", "contact", "jitter"] and done.left == 0
        assert told == sorted(told) and told[-1] == pytest.approx(1.0)
        assert not campaign.missing(runs, tmp_path)
        assert campaign.compute(runs, tmp_path).results == campaign.read_results(tmp_path)

    def test_time_that_is_up_loses_nothing(self, tmp_path, monkeypatch):
        monkeypatch.setattr(campaign, "open_device", lambda device: "cpu")
        done = campaign.compute([RUN], tmp_path, seconds=0.0)
        assert done.stopped == "time limit" and done.left == 1 and done.results == []
