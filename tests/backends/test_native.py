"""The native backend: batches, state, channels, effects that it lacks."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.backends import Hook, NativeBackend
from lunar_mjx.backends.native import native_model
from lunar_mjx.backends.physics import SUPPORTED, Ground
from lunar_mjx.effects import Parameter, effect
from lunar_mjx.effects.presets import PRESETS
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.simulate import Commands, constant_commands
from lunar_mjx.terrain import load_terrain, nearest_rock, sample


@pytest.fixture(scope="module")
def model():
    return make_model("luvmi_x", "flat")


def _control(model, speed=1.0):
    return np.array([speed if g.name == "drive" else 0.0 for g in model.rover.groups for _ in g.joints])


def test_supports_every_preset():
    assert set().union(*PRESETS.values()) <= set(SUPPORTED)


def test_refuses_effects_that_it_lacks(model):
    @effect("body_wrench", force=Parameter(1.0, 0.0, (0.0, 10.0), "N", "pull of a tether", "test"))
    def tether(ctx, p, x, wrench):
        """A pull."""
        return wrench

    with pytest.raises(UserError, match="native: effects = tether are not among those that this backend implements"):
        NativeBackend(model.add(tether))


def test_ground_equals_the_sampler():
    """NumPy's bilinear heights and boulder look-up against the JAX ones, edges and outside included."""
    terrain = load_terrain("lunar_plain")
    ground = Ground(terrain)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-130.0, 130.0, (2, 4000)).astype(np.float32)
    z, slope_x, slope_y, inside = ground.field.value(x.astype(float), y.astype(float))
    expected = sample(terrain.field, x, y)
    assert 0 < inside.sum() < len(inside)
    away = np.abs((x - ground.field.x0) / ground.field.cell % 1.0 - 0.5) < 0.49
    away &= np.abs((y - ground.field.y0) / ground.field.cell % 1.0 - 0.5) < 0.49
    for found, wanted, atol in zip((z, slope_x, slope_y), expected, (1e-4, 3e-3, 3e-3), strict=True):
        np.testing.assert_allclose(found[away], np.asarray(wanted)[away], atol=atol)
    center, radius = ground.rock(x.astype(float), y.astype(float))
    wanted = [np.asarray(v) for v in nearest_rock(terrain.rocks, x, y)]
    assert (radius > 0).any()
    np.testing.assert_array_equal(np.column_stack([center, radius]), np.stack(wanted, -1).astype(float))


def test_rovers_of_a_batch_are_independent(model):
    """Three rovers at once move as each would alone, bit for bit, on two threads as on one."""
    control = np.stack([_control(model, v) for v in (0.5, 1.0, -0.7)])
    many = NativeBackend(model, rovers=3, threads=2)
    many.reset(x=[0.0, 1.0, 2.0], yaw=[0.0, 1.0, 2.0])
    for _ in range(60):
        many.step(control)
    for i in range(3):
        one = NativeBackend(model)
        one.reset(x=float(i), yaw=float(i))
        for _ in range(60):
            one.step(control[i])
        np.testing.assert_array_equal(one.state().qpos[0], many.state().qpos[i])
        np.testing.assert_array_equal(one.state().winding_temperature[0], many.state().winding_temperature[i])


def test_set_state_continues_bit_for_bit(model):
    hook = Hook("memory", {"torque": _worn}, {"turns": 0.0})
    backend = NativeBackend(model, [hook])
    for _ in range(40):
        backend.step(_control(model))
    kept = backend.state()
    stages = backend.stages(_control(model))
    assert set(stages) == {"wheel poses", "slip", "sinkage", "soil wrench", "motor torque", "heat", "acceleration"}
    ends = []
    for _ in range(2):
        backend.set_state(kept)
        for _ in range(30):
            backend.step(_control(model))
        ends.append(backend.state())
    np.testing.assert_array_equal(ends[0].qpos, ends[1].qpos)
    assert ends[0].hooks[0]["turns"] == ends[1].hooks[0]["turns"] > kept.hooks[0]["turns"] > 0.0


def _worn(ctx, state, torque):
    state["turns"] = state["turns"] + float(np.abs(ctx.joint_speed).sum()) * ctx.dt
    return torque * (1.0 - 1e-3 * state["turns"])


def test_run_gives_log_channels(model):
    backend = NativeBackend(model, rovers=2)
    commands = constant_commands(model, 1.0, drive=1.0)
    backend.reset(x=[0.0, 3.0])
    seen = backend.run(commands)
    tables = [backend.channels(seen, commands, i) for i in range(2)]
    assert list(tables[0]["time_s"]) == pytest.approx(np.arange(20) * 0.05)
    for table, start in zip(tables, (0.0, 3.0), strict=True):
        assert table["position_x_m"].iloc[-1] > start + 0.02
        assert table["winding_lf_drive_temperature_degC"].iloc[-1] > 25.0
        assert not table.isna().any(axis=None)
        assert table["accelerometer_z_m_s2"].iloc[-3] == pytest.approx(1.625, abs=0.2)
        speed = np.hypot(table["body_velocity_x_m_s"], table["body_velocity_y_m_s"]).iloc[-1]
        assert speed == pytest.approx(
            np.hypot(table["world_velocity_x_m_s"], table["world_velocity_y_m_s"]).iloc[-1], rel=1e-3
        )
    assert set(tables[0]) >= {"command_lf_drive_speed_rad_s", "wheel_rr_slip_angle_deg", "gyro_z_rad_s"}


def test_channels_are_those_of_the_simulator(model):
    """The same names as `lunar_mjx.simulate` writes, and the same numbers for the same telemetry."""
    import jax

    from lunar_mjx.dynamics import build
    from lunar_mjx.simulate import channels

    backend = NativeBackend(model)
    backend.reset(yaw=0.7)
    commands = constant_commands(model, 0.5, drive=1.0)
    seen = backend.run(commands)
    ours = backend.channels(seen, commands)
    one = jax.tree.map(lambda a: a[0], seen)
    theirs = channels(build(model), one, commands)
    assert list(ours) == list(theirs)
    inner = slice(1, -1)  # the quotient of velocities is one-sided at the ends
    np.testing.assert_allclose(ours.to_numpy()[inner], theirs.to_numpy()[inner], rtol=1e-6, atol=1e-9)


def test_run_says_when_it_diverged(model):
    def blow(ctx, state, body):
        body["force"] += 1e300 if ctx.time > 0.1 else 0.0

    backend = NativeBackend(model, [Hook("blow", {"body": blow})])
    with pytest.raises(UserError, match=r"native: time, s = 0\.\d+ is where the simulation diverged"):
        backend.run(constant_commands(model, 1.0))


@pytest.mark.parametrize(
    ("commands", "message"),
    [
        (Commands(np.zeros((3, 5)), 0.05), r"control = \(5,\) has another shape"),
        (Commands(np.zeros((3, 12)), 0.0511), "is no whole number of time steps"),
    ],
)
def test_refuses_commands_of_another_shape_or_rate(model, commands, message):
    with pytest.raises(UserError, match=message):
        NativeBackend(model).run(commands)


def test_payload_rests_on_the_wheels(model):
    """Standing still, the wheels carry rover and payload, shared as its place asks."""
    loads = {}
    for name, x in (("front", 0.2), ("rear", -0.2)):
        backend = NativeBackend(model.add("payload", mass=20.0, x=x, y=0.0, z=0.1))
        for _ in range(2000):
            backend.step(np.zeros(12))
        loads[name] = backend.observe()["wheel_force"][0, :, 2]
        assert loads[name].sum() == pytest.approx(70.0 * 1.625, rel=2e-3)
    np.testing.assert_allclose(loads["front"][:2].sum() - loads["rear"][:2].sum(), 20.0 * 1.625 * 0.4 / 0.74, rtol=0.05)


def test_rotors_are_part_of_the_inertia(model):
    light = native_model(model.set("motor", rotor_inertia=0.0))
    heavy = native_model(model)
    drive = heavy.joint("lf_drive").dofadr[0]
    assert light.dof_armature[drive] == 0.0
    assert heavy.dof_armature[drive] == pytest.approx(9e-7 * 243.0**2)


def test_ambient_follows_the_sun(model):
    warm = model.replace(ambient=(400.0, 100.0, 0.0, 1000.0), timestep=0.002)
    backend = NativeBackend(warm)
    assert backend.state().winding_temperature[0, 0] == pytest.approx(400.0)
    assert backend.numbers.ambient_temperature(500.0) == pytest.approx(100.0)
    assert backend.numbers.ambient_temperature(100.0) == pytest.approx(100.0 + 300.0 * np.cos(0.2 * np.pi) ** 0.25)
