"""The command layer: Ackermann, crab, point turn and skid steer, and the limits."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics import build
from lunar_mjx.errors import UserError
from lunar_mjx.manoeuvres.cmd_vel import CmdVel, cmd_vel_commands
from lunar_mjx.model import make_model

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rocker():
    return CmdVel(make_model("rocker_bogie", "flat"))


def _told(layer: CmdVel, *motion: float) -> tuple[np.ndarray, np.ndarray]:
    """Rim speeds, m/s, and steering angles, rad, by wheel (0 where it does not steer)."""
    control = np.asarray(layer(*motion))
    angle = np.where(layer._steered, control[layer._steer], 0.0)
    return control[layer._drive] * layer.radius, angle


def test_ackermann_axles_meet_in_one_point(rocker: CmdVel) -> None:
    """Every wheel rolls about the centre of the turn, at its own distance times the yaw rate."""
    v, w = 0.03, 0.02
    speed, angle = _told(rocker, v, 0.0, w)
    center = np.array([0.0, v / w])
    arm = rocker.position - center
    heading = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    np.testing.assert_allclose(np.sum(arm * heading, axis=-1), 0.0, atol=1e-6)
    np.testing.assert_allclose(speed, w * np.linalg.norm(arm, axis=-1), rtol=1e-5)
    assert angle[0] > 0.0 > angle[4] and angle[0] > angle[1]


def test_point_turn_stays_on_the_spot(rocker: CmdVel) -> None:
    speed, angle = _told(rocker, 0.0, 0.0, 0.03)
    velocity = speed[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    np.testing.assert_allclose(
        velocity, 0.03 * np.stack([-rocker.position[:, 1], rocker.position[:, 0]], -1), atol=1e-7
    )


def test_crab_where_all_wheels_steer() -> None:
    layer = CmdVel(make_model("luvmi_x", "flat"))
    speed, angle = _told(layer, 0.1, 0.04, 0.0)
    np.testing.assert_allclose(angle, np.arctan2(0.04, 0.1), rtol=1e-5)
    np.testing.assert_allclose(speed, np.hypot(0.1, 0.04), rtol=1e-5)
    _, back = _told(layer, -0.1, 0.04, 0.0)
    np.testing.assert_allclose(back, -np.arctan2(0.04, 0.1), rtol=1e-5)


def test_a_rover_with_fixed_wheels_does_not_crab(rocker: CmdVel) -> None:
    np.testing.assert_array_equal(rocker(0.03, 0.02, 0.0), rocker(0.03, 0.0, 0.0))


def test_skid_steer() -> None:
    """Without steering: each side at v -+ omega y."""
    layer = CmdVel(make_model("husky", "flat"))
    speed, angle = _told(layer, 0.3, 0.0, 0.5)
    np.testing.assert_allclose(speed, 0.3 - 0.5 * layer.position[:, 1], rtol=1e-5)
    assert not angle.any()


def test_limits() -> None:
    """No angle beyond its limit, no wheel beyond its speed; a curve that is too tight becomes the tightest one."""
    layer = CmdVel(make_model("viper", "flat"), wheel_limit=0.2)
    for motion in np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3)):
        speed, angle = _told(layer, *motion)
        assert (np.abs(angle) <= layer.steer_limit + 1e-6).all()
        assert np.abs(speed).max() <= 0.2 * (1.0 + 1e-5)
    speed, angle = _told(layer, 0.05, 0.0, 1.0)
    assert np.abs(angle).max() == pytest.approx(layer.steer_limit[0], rel=1e-4)
    # still a turn about one point: the inner and outer wheels' axles meet on the chassis' own axle
    assert np.ptp(layer.position[:, 1] + layer.position[:, 0] / np.tan(angle)) < 1e-4


def test_default_limit_is_the_back_emf() -> None:
    """48 V over K N = 0.0716 x 1526 turn the wheels at 0.44 rad/s: 5.5 cm/s, the pace of the Mars rovers."""
    assert CmdVel(make_model("rocker_bogie", "flat")).wheel_limit == pytest.approx(48 / (0.0716 * 1526) * 0.125)


def test_other_control_modes_and_texts_are_refused() -> None:
    model = make_model("viper", "flat")
    with pytest.raises(UserError, match=r"control\.drive\.mode = 'torque' is another mode; use velocity"):
        CmdVel(model.replace(modes={"drive": "torque"}))
    with pytest.raises(UserError, match="wheel_limit = 0"):
        CmdVel(model, wheel_limit=0.0)
    with pytest.raises(UserError, match="is not three numbers; write v_x,v_y,yaw_rate"):
        cmd_vel_commands(model, "0.1,0", 1.0)


def test_the_rover_does_what_is_asked(rocker: CmdVel) -> None:
    """Driven on hard ground: forward, a curve to the left and a turn on the spot, within 10 % of speed and yaw rate."""
    model = make_model("rocker_bogie", "flat").add("hard_surface")
    system = build(model)
    wanted = np.array([(0.04, 0.0, 0.0), (0.03, 0.0, 0.03), (0.0, 0.0, 0.05)])
    steer = np.stack([np.asarray(rocker(*w)) for w in wanted])
    turned = steer.copy()
    turned[:, rocker._drive] = 0.0  # the wheels turn first
    controls = jnp.asarray(
        np.concatenate([np.tile(turned[:, None], (1, 40, 1)), np.tile(steer[:, None], (1, 80, 1))], 1)
    )
    start = jax.jit(jax.vmap(lambda _: system.reset(system.params)))(jnp.arange(3))
    _, seen = jax.device_get(
        jax.jit(lambda s: system.rollout_batch(system.params, s, controls, 50, one_body=True))(start)
    )
    late = slice(-40, None)
    speed = np.hypot(seen.velocity.x, seen.velocity.y)[:, late].mean(1)
    yaw = seen.angular_velocity.z[:, late].mean(1)
    np.testing.assert_allclose(speed[:2], wanted[:2, 0], rtol=0.1)
    assert speed[2] < 0.004
    np.testing.assert_allclose(yaw[1:], wanted[1:, 2], rtol=0.1)
    assert abs(yaw[0]) < 1e-3
