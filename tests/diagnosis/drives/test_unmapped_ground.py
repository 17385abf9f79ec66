"""Ground that nobody mapped: its modes, and a drive over a rough ground that its log calls flat."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import interpn

from lunar_mjx.diagnosis.drives.baseline import BASELINE, baseline_coordinates
from lunar_mjx.diagnosis.drives.form import DriveForm
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.drives.simulation import log_run
from lunar_mjx.diagnosis.drives.simulation.unmapped_ground import POSE as POSE_CHANNELS
from lunar_mjx.diagnosis.drives.simulation.unmapped_ground import UNMAPPED_GRID, unmapped_ground
from lunar_mjx.diagnosis.fitted_model import fitted_model
from lunar_mjx.logs import read_campaign
from lunar_mjx.manoeuvres.manoeuvre import wheel_places
from lunar_mjx.model import make_model
from lunar_mjx.terrain.heightfield import HeightField
from tests.diagnosis.drives.drive_campaign import SIGMA, STEP, drive_campaign


class _Drive:
    """A log of a straight drive of 2 m."""

    def __init__(self, *channels: str):
        time = np.arange(0.0, 8.0, 0.1)
        values = {"position_x_m": 0.25 * time, "position_y_m": 0.0 * time, "yaw_deg": 0.0 * time}
        self._samples = {c: (time, values.get(c, 0.0 * time)) for c in channels}

    def channel(self, name):
        return self._samples.get(name)


POSE = ("position_x_m", "position_y_m", "yaw_deg", "pitch_deg")


@pytest.fixture(scope="module")
def model():
    return make_model("luvmi_x", terrain="flat", timestep=STEP)


def test_modes_have_a_variance_of_one_below_the_wheels_and_lie_on_the_stated_plane(model):
    sloped = make_model("luvmi_x", terrain="slope:10deg", timestep=STEP)
    ground = unmapped_ground(_Drive(*POSE), sloped)
    assert ground is not None and 3 <= len(ground.modes) <= UNMAPPED_GRID.modes
    x = float(ground.field.x0) + float(ground.field.cell) * np.arange(UNMAPPED_GRID.nodes)
    assert np.allclose(ground.field.heights, np.tan(np.radians(10.0)) * x[None], atol=1e-4)
    variance = np.sum(ground.modes**2, axis=0)
    x, side = np.linspace(0.2, 1.8, 9), next(iter(wheel_places(model.rover).values()))[1]
    on_the_way = _at(ground.field, variance, x, side + 0.0 * x)
    assert np.all((on_the_way > 0.6) & (on_the_way < 1.3))


@pytest.mark.parametrize("missing", ["position_x_m", "position_y_m", "yaw_deg", "pitch_deg"])
def test_a_log_that_does_not_tell_where_the_rover_drove_and_lay_has_none(model, missing):
    assert unmapped_ground(_Drive(*(c for c in POSE if c != missing)), model) is None


def test_a_map_is_taken_at_its_word(model):
    field = model.terrain.field
    bumpy = np.array(field.heights, float)
    bumpy[1, 1] += 0.05
    mapped = SimpleNamespace(
        rover=model.rover, terrain=dataclasses.replace(model.terrain, field=dataclasses.replace(field, heights=bumpy))
    )
    assert unmapped_ground(_Drive(*POSE), mapped) is None


def test_choices_of_how_contact_moves_are_fitted():
    for preset, normal in (("consistent", "pressure_sinkage"), ("field", "stress_integral")):
        own = {c.key for c in baseline_coordinates(make_model("luvmi_x", preset=preset), BASELINE)}
        assert {f"{normal}.damping", *(f"shear_state.{p}" for p in ("damping_time", "relaxation", "creep"))} <= own


def test_what_is_nothing_in_a_model_as_it_comes_begins_there():
    (creep,) = (c for c in baseline_coordinates(make_model("luvmi_x"), BASELINE) if c.name == "creep")
    assert (creep.value(0.0), creep.bounds()[0], creep.log, creep.unit) == (0.0, 0.0, False, "m/s")
    fitted = make_model("luvmi_x").set("shear_state", creep=0.03)
    (creep,) = (c for c in baseline_coordinates(fitted, BASELINE) if c.name == "creep")
    assert creep.value(0.0) == 0.03 and creep.value(creep.bounds()[0]) == 0.0
    assert not any(c.name == "creep" for c in baseline_coordinates(fitted, {}))


def test_a_fit_that_ends_at_a_bound_is_a_model_all_the_same():
    """Down from 0.0034039 m/s the bound of zero comes out as -4e-19."""
    begun = make_model("luvmi_x").set("shear_state", creep=0.0034039)
    (creep,) = (c for c in baseline_coordinates(begun, BASELINE) if c.name == "creep")
    at = creep.bounds()[0]
    assert creep.value(at) < 0.0
    assert fitted_model([creep], np.array([at]), [0], begun).parameters["shear_state"]["creep"] == 0.0


def _at(field: HeightField, heights: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Heights on a field's grid at places."""
    rows, cols = (np.arange(n) for n in heights.shape)
    at = ((y - float(field.y0)) / float(field.cell), (x - float(field.x0)) / float(field.cell))
    return interpn((rows, cols), np.asarray(heights, float), np.column_stack(at))


def _waves() -> HeightField:
    steps = 0.05 * np.arange(121)
    x, y = np.meshgrid(steps - 2.0, steps - 3.0)
    heights = 0.012 * np.sin(2.0 * np.pi * x / 1.1 + 0.5) + 0.006 * np.sin(2.0 * np.pi * (x + y) / 1.7)
    return HeightField(heights, np.asarray(-2.0), np.asarray(-3.0), np.asarray(0.05))


def _form(folder, model) -> DriveForm:
    return DriveForm(DriveProblem(read_campaign([folder]), model, {}), DriveSettings())


def _pose_error(form: DriveForm, u: np.ndarray) -> float:
    """Largest root mean square error of height, roll or pitch in one log, in stated standard deviations of the noise.

    Up to a constant: how deep the rover stands in soil that yields is not the ground's.
    """
    found, off = 0.0, form.observations.value - form.predicted(u)
    for s in form.observations.series:
        if s.channel in POSE_CHANNELS:
            found = max(found, float(np.std(off[s.start : s.stop])) / SIGMA[s.channel.partition("_")[0]])
    return found


@pytest.mark.slow
def test_waves_under_a_drive_are_found_though_its_log_calls_them_flat(model, tmp_path, monkeypatch):
    logs = drive_campaign(tmp_path, ground=_waves())
    form = _form(logs, model)
    u = form.refit(frozenset(), None, None).u
    assert _pose_error(form, u) < 1.5
    assert len(form.ground)
    monkeypatch.setattr(log_run, "unmapped_ground", lambda log, model: None)
    level = _form(logs, model)
    assert not len(level.ground)
    assert _pose_error(level, level.refit(frozenset(), None, None).u) > 3.0
