"""The PyBullet backend; without PyBullet only its absence is tested."""

from __future__ import annotations

import builtins
import dataclasses
import importlib.util

import numpy as np
import pytest
from backends_recorded import Recorded

from lunar_mjx.backends import Hook, NativeBackend
from lunar_mjx.backends.parity import compare as parity
from lunar_mjx.backends.parity.study import available, make_runner
from lunar_mjx.backends.pybullet import PyBulletBackend, import_pybullet, urdf_of
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model

installed = pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="the extra pybullet is not there")


@pytest.fixture
def absent(monkeypatch):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "pybullet":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.delitem(__import__("sys").modules, "pybullet", raising=False)
    monkeypatch.setattr(builtins, "__import__", refuse)


def test_absence_is_one_sentence(absent):
    with pytest.raises(
        UserError, match=r"pybullet: the module is not installed; install the extra lunar-mjx\[pybullet"
    ):
        import_pybullet()
    used, note = available(["structured", "pybullet"])
    assert used == ["structured"] and "not installed" in note


def _failed(results):
    return [f"{r.case} {r.level} {r.stage} {r.quantity} {r.where}: {r.error:.3g}" for r in results if not r.passed]


@installed
def test_agrees_with_native(luvmi):
    """Stages, steps and a drive on flat soil, rock on a slope, and a crater."""
    runner = make_runner("pybullet", luvmi.model)
    assert not _failed(luvmi.judge(runner, "pybullet"))
    case = luvmi.cases[0]
    _, run, perturbed = luvmi.of[case.name]
    noise = perturbed.floor(single=True, soft_loop=False)
    wanted = parity.tolerances("pybullet", drive=True)
    drive = runner.drive(case, luvmi.commands)
    assert not _failed(parity.judge_drive(case, run, noise, drive, wanted, luvmi.model))


@installed
def test_loops_agree_with_native():
    """VIPER's four-bars: Bullet's pins against MuJoCo's compliant constraint."""
    viper = Recorded("viper", "consistent", 2.0, ("flat, soft",))
    runner = make_runner("pybullet", viper.model)
    assert not _failed(viper.judge(runner, "pybullet, soft loop"))
    case = viper.cases[0]
    drive = runner.drive(case, viper.commands)
    _, run, _ = viper.of[case.name]
    assert np.abs(drive.position.x - run.position.x).max() < 1e-5
    assert run.position.x[0, -1] > 0.05


@installed
def test_rotors_count(luvmi):
    """Without what the backend adds for the rotors the acceleration would be another one altogether."""
    case = luvmi.cases[0]
    samples = luvmi.of[case.name][0]
    still = luvmi.model.replace(terrain=case.terrain)
    backend = PyBulletBackend(still, rovers=len(samples.control))
    for world in backend._worlds:
        world._inertia = 0.0 * world._inertia
    backend.set_state(samples.state)
    backend.step(samples.control)
    acceleration = (backend.state().qvel - samples.state.qvel) / still.timestep
    assert np.abs(acceleration - samples.stages["acceleration"]).max() > 1.0


@installed
def test_planted_fault_is_told(luvmi):
    def flip(ctx, state, value):
        value["force"][..., 1] *= -1.0

    case = luvmi.cases[0]
    samples = luvmi.of[case.name][0]
    runner = parity.Runner("pybullet", lambda m, n: PyBulletBackend(m, [Hook("flip", {"shear": flip})], n), luvmi.model)
    results = parity.judge(case, samples, runner.step_from(case, samples), parity.tolerances("pybullet"), luvmi.model)
    first = parity.first_failure(results)
    assert first is not None and first.stage == "soil wrench"


@installed
@pytest.mark.parametrize(("rover", "preset"), [("luvmi_x", "paper"), ("luvmi_x", "consistent"), ("viper", "paper")])
def test_own_contact_bears_the_rover(rover, preset):
    """On rock, and everywhere in the paper's preset, the wheels stand on Bullet's height field."""
    model = make_model(rover, "flat", preset)
    if preset == "consistent":
        model = model.add("hard_surface")
    backend = PyBulletBackend(model, contact="engine")
    for _ in range(400):
        backend.step(np.zeros(len(model.rover.joints)))
    seen = backend.observe()
    assert seen["wheel_force"][0, :, 2].sum() == pytest.approx(model.rover.mass * model.gravity, rel=0.02)
    # Bullet shares the load between several points of contact, each as stiff as the whole: sinkage is a part of F/k
    normal = "penalty_contact" if preset == "paper" else "hard_ground"
    whole = model.rover.mass * model.gravity / 4.0 / model.parameters[normal]["stiffness"]
    assert 0.1 * whole < seen["sinkage"][0].mean() < 1.1 * whole
    assert abs(backend.state().qpos[0, 0]) < 2e-3


@installed
def test_own_contact_drives():
    model = make_model("luvmi_x", "slope:5deg", "paper")
    backend = PyBulletBackend(model, contact="engine")
    control = np.array([1.0] * 4 + [0.0] * 8)
    for _ in range(1000):
        backend.step(control)
    assert 0.1 < backend.state().qpos[0, 0] < 0.21
    backend.close()


@installed
def test_refuses_what_it_cannot(tmp_path):
    model = make_model("luvmi_x", "flat")
    with pytest.raises(UserError, match="pybullet: effects = 'payload' cannot change a loaded URDF"):
        PyBulletBackend(model.add("payload", mass=3.0))
    with pytest.raises(UserError, match="pybullet: contact = 'magic' does not exist; use one of numpy, engine"):
        PyBulletBackend(model, contact="magic")
    (tmp_path / "rover.toml").write_text((model.rover.folder / "rover.toml").read_text())
    with pytest.raises(UserError, match=r"luvmi_x\.urdf' is not there, and PyBullet loads URDF only"):
        urdf_of(dataclasses.replace(model.rover, folder=tmp_path))


TARGETS = {"position": 0.6, "velocity": 1.0, "torque": 4.0, "current": 0.2}
"""Targets of the drive motors by control mode: rad, rad/s, N m, A."""


@installed
@pytest.mark.parametrize("mode", TARGETS)
def test_control_modes_agree_with_native(mode):
    """Half a second of driving in each of the four control modes, from rest on soft ground."""
    model = make_model("luvmi_x", "flat")
    model = model.replace(modes=model.modes | {"drive": mode}, gains=model.gains | {"drive": (40.0, 20.0)})
    drives = np.array([group.name == "drive" for group in model.rover.groups for _ in group.joints])
    seen = []
    for backend in (NativeBackend(model), PyBulletBackend(model)):
        for _ in range(250):
            backend.step(TARGETS[mode] * drives)
        seen.append((backend.observe(), backend.state()))
        backend.close()
    (a, at), (b, bt) = seen
    np.testing.assert_allclose(bt.qpos, at.qpos, atol=1e-6)
    np.testing.assert_allclose(b["joint_torque"], a["joint_torque"], atol=1e-3)
    assert at.qpos[0, 0] > 0.01
    if mode == "current":
        np.testing.assert_allclose(a["current"][0, drives], TARGETS[mode], rtol=1e-12)
    if mode == "torque":  # but for what a warm winding's magnet has lost
        np.testing.assert_allclose(a["joint_torque"][0, drives], TARGETS[mode], rtol=0.01)
