"""The structured engine against native MuJoCo (float64, Euler with implicit damping), one step from random states."""

import jax
import mujoco
import numpy as np
import pytest
import structured_models as made
from structured_reference import Reference

from lunar_mjx.dynamics.structured.engine import StructuredEngine
from lunar_mjx.dynamics.structured.suitability import UnsuitableError
from lunar_mjx.rover import load_rover

OPEN = ("luvmi_x", "three_legs", "six_legs", "mixed")


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def _rover(name, folder):
    if name in ("luvmi_x", "viper"):
        return load_rover(name)
    return {
        "three_legs": lambda: made.spider(folder, 3, links=3),
        "six_legs": lambda: made.spider(folder, 6, links=1, seed=3),
        "mixed": lambda: made.mixed(folder),
        "lower": lambda: made.fourbar(folder, "lower", damping=0.0),
        "coupler": lambda: made.fourbar(folder, "coupler", damping=0.0),
        "upper": lambda: made.fourbar(folder, "upper", damping=0.0),
    }[name]()


def _relative(a, b):
    return np.abs(a - b).max() / max(np.abs(b).max(), 1.0)


LOOPED = ("viper", "lower", "coupler", "upper")


@pytest.mark.parametrize("name", OPEN)
def test_open_chains_equal_native_mujoco(name, tmp_path):
    _assert_equals_native(_rover(name, tmp_path), 100)


@pytest.mark.slow
@pytest.mark.parametrize("name", OPEN)
def test_open_chains_equal_native_mujoco_from_a_thousand_states(name, tmp_path):
    _assert_equals_native(_rover(name, tmp_path), 1000)


def _assert_equals_native(rover, states):
    """Poses, joints and velocities after one step, and where the wheels were."""
    reference = Reference(rover)
    qpos, qvel, forces = reference.random(states)
    seen, (new_qpos, new_qvel) = reference.step(qpos, qvel, forces)
    new_qpos, new_qvel = np.asarray(new_qpos), np.asarray(new_qvel)
    wheels = np.stack([np.asarray(c) for c in seen.wheel_position], axis=-1)
    for i in range(states):
        q, v, places = reference.native(qpos[i], qvel[i], {k: f[i] for k, f in forces.items()})
        assert _relative(new_qpos[i, :7], q[:7]) < 1e-12  # position and orientation
        assert _relative(new_qpos[i], q) < 1e-12
        assert _relative(new_qvel[i], v) < 1e-12
        assert _relative(wheels[i], places) < 1e-12


@pytest.mark.parametrize("name", LOOPED)
def test_loops_equal_the_rigid_loop(name, tmp_path):
    _assert_equals_rigid_loop(_rover(name, tmp_path), 20)


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPED)
def test_loops_equal_the_rigid_loop_from_a_thousand_states(name, tmp_path):
    _assert_equals_rigid_loop(_rover(name, tmp_path), 1000)


def _assert_equals_rigid_loop(rover, states):
    """Accelerations of the base and the independent joints, with implicit damping within the loop."""
    reference = Reference(rover)
    reference.model.opt.jacobian = 0
    dt = reference.timestep
    qpos, qvel, forces = reference.random(states)
    # short of the dead points of the general loops
    qpos[:, 7:] = np.clip(qpos[:, 7:], -0.15, 0.15)
    qpos, qvel = reference.closed(qpos, qvel)
    new_qvel = np.asarray(reference.step(qpos, qvel, forces)[1][1])
    free = np.r_[
        :6,
        [
            link.dof[i]
            for g in reference.engine.structure.groups
            for link in (g.links[k] for k in g.free)
            for i in range(g.count)
        ],
    ]
    for i in range(states):
        exact = reference.hard_loop(qpos[i], qvel[i], {k: f[i] for k, f in forces.items()})
        found = (new_qvel[i] - qvel[i]) / dt
        assert np.abs(found - exact)[free].max() < 1e-6 * np.abs(exact).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["viper", "lower"])
def test_native_mujoco_tends_to_the_engine_as_its_loops_stiffen(name, tmp_path):
    """MuJoCo's soft loop, at twice its own time step, against ours over 10 ms: the gap closes with the time step."""
    gaps = []
    for dt in (1e-3, 2.5e-4, 6.25e-5):
        reference = Reference(_rover(name, tmp_path), dt)
        m = reference.model
        m.eq_solref[:] = (2 * dt, 1.0)
        m.eq_solimp[:, :2] = 0.9999
        m.opt.iterations, m.opt.ls_iterations, m.opt.tolerance = 100, 50, 0.0
        qpos, qvel, forces = reference.random(1)
        forces = {k: 0.1 * f for k, f in forces.items()}
        qpos, qvel = reference.closed(qpos * [1, 1, 1, 1, 1, 1, 1, *[0.5] * (m.nq - 7)], 0.3 * qvel)
        step = jax.jit(reference.step)
        q, v = qpos, qvel
        d = reference.data
        d.qpos[:], d.qvel[:] = qpos[0], qvel[0]
        for _ in range(round(0.01 / dt)):
            _, (q, v) = step(q, v, forces)
            reference.native(d.qpos.copy(), d.qvel.copy(), {k: f[0] for k, f in forces.items()})
        gaps.append(np.abs(np.asarray(q[0]) - d.qpos).max())
    assert gaps[1] < 0.6 * gaps[0] and gaps[2] < 0.6 * gaps[1]
    assert gaps[2] < 1e-4


def test_free_flight_keeps_momentum_and_energy(tmp_path):
    """Without springs, dampers or forces: momentum exact to the integrator's order, energy too."""
    drifts = []
    rover = made.fourbar(tmp_path, "lower", damping=0.0)
    text = rover.mjcf.read_text().replace('stiffness="80"', "").replace('stiffness="20"', "")
    rover.mjcf.write_text(text)
    reference = Reference(rover)
    m, d = reference.model, reference.data
    m.opt.gravity[:] = 0.0
    qpos, qvel, _ = reference.random(1, seed=2)
    qpos, qvel = (a[0] for a in reference.closed(qpos, 0.5 * qvel))
    start = _momentum(m, d, qpos, qvel)
    for dt in (2e-4, 1e-4):
        q, v = reference.fly(dt, round(0.1 / dt), qpos, qvel)
        end = _momentum(m, d, np.asarray(q), np.asarray(v))
        fallen = np.array([0.0, 0.0, -m.body_subtreemass[0] * 1.625 * 0.1])
        assert np.abs(end["linear"] - start["linear"] - fallen).max() < 1e-2 * np.abs(start["linear"]).max()
        assert np.abs(end["spin"] - start["spin"]).max() < 1e-2 * np.abs(start["spin"]).max()
        drop = m.body_subtreemass[0] * 1.625 * (end["com"][2] - start["com"][2])
        drifts.append(abs(end["energy"] - start["energy"] + drop) / start["energy"])
    assert drifts[1] < 0.7 * drifts[0] and drifts[1] < 1e-3


def _momentum(m, d, q, v):
    """Linear momentum, angular momentum about the centre of mass, kinetic energy with the rotors' inertia."""
    d.qpos[:], d.qvel[:] = q, v
    mujoco.mj_forward(m, d)
    mujoco.mj_subtreeVel(m, d)
    mass = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, mass)
    return {
        "linear": m.body_subtreemass[0] * d.subtree_linvel[0],
        "spin": d.subtree_angmom[0].copy(),
        "energy": 0.5 * d.qvel @ mass @ d.qvel,
        "com": d.subtree_com[0].copy(),
    }


REFUSED = {
    'axis="0 1 0" type="slide"': "slide or ball joint",
    'axis="0 1 0" frictionloss="0.1"': "frictionloss",
    'axis="0 1 0" limited="true" range="-1 1"': None,
}


@pytest.mark.parametrize(("joint", "message"), REFUSED.items())
def test_refuses_joints_it_cannot_honour(joint, message, tmp_path):
    rover = made.spider(tmp_path, 3, links=1)
    text = rover.mjcf.read_text()
    first = text.index('axis="', text.index("l0_drive"))
    rover.mjcf.write_text(text[:first] + joint + text[text.index('"', first + 6) + 1 :])
    if message is None:
        StructuredEngine(rover)  # limits are off by their flag
        return
    with pytest.raises(UnsuitableError, match=message):
        StructuredEngine(rover)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<flag contact="disable"', '<flag gravity="disable" contact="disable"', "mjDSBL_GRAVITY"),
        ('integrator="Euler"', 'integrator="implicitfast"', "integrator"),
        ('integrator="Euler"', 'integrator="Euler" density="1.2"', "fluid"),
        ('<body name="mast"', '<body name="mast" gravcomp="1"', "gravcomp"),
        ("</worldbody>", '</worldbody><equality><weld body1="mast" body2="l0_wheel"/></equality>', "neither connect"),
        ("</worldbody>", '</worldbody><actuator><position joint="l0_drive"/></actuator>', "biastype"),
        ("</worldbody>", '</worldbody><tendon><fixed><joint joint="l0_drive" coef="1"/></fixed></tendon>', "tendons"),
        (
            "</worldbody>",
            '</worldbody><equality><connect body1="l0_wheel" body2="l1_wheel" anchor="0 0 0"/></equality>',
            "1 \\+ 1",
        ),
    ],
)
def test_refuses_models_it_cannot_honour(old, new, message, tmp_path):
    rover = made.spider(tmp_path, 3, links=1)
    rover.mjcf.write_text(rover.mjcf.read_text().replace(old, new, 1))
    with pytest.raises(UnsuitableError, match=message):
        StructuredEngine(rover)
