"""Hooks change the physics at their point, and nothing before it."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.backends import POINTS, Hook, NativeBackend
from lunar_mjx.diagnosis.drives.baseline import ASSUMED, with_nominal_controller
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.model.file import load_model, save_model


@pytest.fixture(scope="module")
def model():
    return make_model("luvmi_x", "slope:5deg")


def _driven(model, hooks=(), steps=150, drive=1.0):
    backend = NativeBackend(model, hooks, rovers=2)
    backend.reset(yaw=[0.0, 1.0])
    control = np.array([drive] * 4 + [0.1, 0.1, 0.0, 0.0] + [0.0] * 4)
    for _ in range(steps):
        backend.step(control)
    return backend


def test_hooks_that_do_nothing_change_nothing(model):
    """Bit for bit, with a hook at every point, returning the value or None."""
    calls = dict.fromkeys(POINTS, 0)

    def watch(point):
        def hook(ctx, state, value):
            calls[point] += 1
            assert ctx.joint_speed.shape == (2, 12) and ctx.wheel_position.shape == (2, 4, 3)
            return value if calls[point] % 2 else None

        return hook

    plain = _driven(model)
    watched = _driven(model, [Hook("watch", {point: watch(point) for point in POINTS})])
    np.testing.assert_array_equal(plain.state().qpos, watched.state().qpos)
    np.testing.assert_array_equal(plain.state().housing_temperature, watched.state().housing_temperature)
    assert calls == {point: 300 if point == "heat" else 150 for point in POINTS}


def _scaled(key, factor):
    def hook(ctx, state, value):
        value[key] = value[key] * factor

    return hook


CHANGES = {
    "command": (lambda c, s, v: 0.5 * v, "joint_speed"),
    "current": (lambda c, s, v: np.clip(v, -0.05, 0.05), "current"),
    "winding": (_scaled("torque_constant", 0.8), "joint_torque"),
    "torque": (lambda c, s, v: v - 0.5 * np.tanh(c.joint_speed / 0.01), "joint_torque"),
    "geometry": (_scaled("radius", 0.98), "sinkage"),
    "contact": (_scaled("rim_speed", 0.9), "wheel_force"),
    "soil": (_scaled("k_phi", 0.5), "sinkage"),
    "normal": (_scaled("load", 0.7), "sinkage"),
    "slip": (_scaled("slip_x", 0.5), "wheel_force"),
    "shear": (_scaled("force", np.array([1.0, 0.5, 1.0])), "wheel_force"),
    "body": (_scaled("force", 1.0), None),
    "heat": (_scaled("winding", 2.0), "winding_temperature"),
}


@pytest.mark.parametrize("point", POINTS)
def test_every_point_acts(model, point):
    function, quantity = CHANGES[point]
    if point == "body":

        def function(ctx, state, value):
            value["force"][:, 2] += -20.0

        quantity = "sinkage"
    plain, changed = _driven(model).observe(), _driven(model, [Hook(point, {point: function})]).observe()
    difference = np.abs(plain[quantity] - changed[quantity])
    assert difference.max() > 1e-3 * np.abs(plain[quantity]).max() or (point == "heat" and difference.max() > 1e-3)


def test_resistance_of_the_winding_point_heats(model):
    """Twice the resistance at the same current: twice the Joule heat."""
    plain = _driven(model, steps=1).observe()
    double = _driven(model, [Hook("double", {"winding": _scaled("resistance", 2.0)})], steps=1).observe()
    np.testing.assert_allclose(double["winding_heat"], 2.0 * plain["winding_heat"], rtol=1e-4)
    assert plain["winding_heat"].max() > 0.1


def test_a_controller_asks_by_the_number_that_it_was_told(model):
    known = with_nominal_controller(model)
    strong = {"torque_constant": tuple(1.05 * k for k in model.parameters["motor"]["torque_constant"])}
    plain, told, knowing = (
        _driven(m, steps=1).observe() for m in (model, known.set("motor", **strong), model.set("motor", **strong))
    )
    np.testing.assert_allclose(told["current"], plain["current"], rtol=1e-9)
    np.testing.assert_allclose(knowing["current"], plain["current"] / 1.05, rtol=1e-9)


def test_what_controllers_reckon_with_is_set_once_and_never_for_an_assumed_motor(tmp_path):
    husky = make_model("husky", "flat")
    known = with_nominal_controller(husky)
    told = known.parameters["joint_control"][ASSUMED]
    assert np.asarray(told) == pytest.approx(78.71 * 0.7 * 0.044)
    save_model(known, tmp_path / "fitted.toml")
    read = load_model(tmp_path / "fitted.toml")
    assert read.parameters["joint_control"][ASSUMED] == pytest.approx(told)
    # a refit has moved the motors since, and what their controllers expect stays
    moved = read.set("motor", torque_constant=tuple(1.1 * k for k in read.parameters["motor"]["torque_constant"]))
    assert with_nominal_controller(moved) is moved
    some = husky.set("joint_control", **{ASSUMED: (1.0, 0.0, 0.0, 1.0)})
    assert with_nominal_controller(some).parameters["joint_control"][ASSUMED] == pytest.approx((1.0, *told[1:3], 1.0))
    warthog = make_model("warthog", "flat")
    assert warthog.rover.assumed and with_nominal_controller(warthog) is warthog


def test_the_cut_off_has_the_last_word(model):
    """A hook on the current cannot drive a motor whose winding is too hot."""
    backend = NativeBackend(model, [Hook("push", {"current": lambda c, s, v: v + 1.0})])
    backend.reset(winding_temperature=430.0)
    backend.step(np.ones(12))
    assert not backend.observe()["current"].any()


def test_hooks_run_in_order_and_own_their_state(model):
    seen = []

    def add(name, amount):
        def hook(ctx, state, value):
            state["sum"] += amount
            seen.append(name)
            return value + amount

        return Hook(name, {"torque": hook}, {"sum": 0.0})

    first, second = add("first", 1.0), add("second", -1.0)
    backend = _driven(model, [first, second], steps=3)
    assert seen == ["first", "second"] * 3
    assert [s["sum"] for s in backend.state().hooks] == [3.0, -3.0]
    backend.reset()
    assert [s["sum"] for s in backend.state().hooks] == [0.0, 0.0]
    assert first.initial == {"sum": 0.0}


def test_payload_may_come_late(model):
    """A payload picked up on the way: the wheels carry it from then on."""

    def pick_up(ctx, state, geometry):
        if ctx.time > 0.5:
            geometry["payload_mass"][:] = 30.0
            geometry["payload_position"][:] = [0.0, 0.0, 0.2]

    backend = NativeBackend(make_model("luvmi_x", "flat"), [Hook("pick up", {"geometry": pick_up})])
    weights = []
    for _ in range(2):
        for _ in range(1500):
            backend.step(np.zeros(12))
        weights.append(backend.observe()["wheel_force"][0, :, 2].sum())
    assert weights == pytest.approx([80.0 * 1.625] * 2, rel=1e-2)


def test_refuses_unknown_points():
    with pytest.raises(UserError, match="hook late: point = 'sensor' does not exist; use one of command, current"):
        Hook("late", {"sensor": lambda c, s, v: v})
