"""An agent that drives where somebody looks on."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.agents.play import open_agent
from lunar_mjx.cameras import Sun
from lunar_mjx.errors import UserError
from lunar_mjx.viewer.policy_drive import PolicyDrive
from lunar_mjx.viewer.scene import rover_scene


def test_an_environment_without_a_rover_is_refused():
    with pytest.raises(UserError, match="was not trained to drive a rover"):
        PolicyDrive(object(), lambda state, key: None, "point.npz")


@pytest.mark.slow
def test_an_agent_drives_to_its_goal_and_on():
    env, agent, _ = open_agent("scripted", "consistent", {"terrain": "flat", "goal_distance": (3.0, 4.0)})
    drive = PolicyDrive(env, agent, "scripted", seed=3)
    first = drive.readings()
    assert first["time_s"] == 0.0 and 2.5 < first["goal_m"] < 4.5 and len(first["slip"]) == len(env.model.rover.wheels)
    assert rover_scene(drive.model, Sun())["terrain"] == "flat"
    drive.pilot.hold(["back"])  # an onlooker's keys do nothing
    places, notes = [drive.bodies()], set()
    for _ in range(4000):
        drive.advance(0.04)
        places.append(drive.bodies())
        notes.add(drive.note)
        if any("Goal reached" in n for n in notes):
            break
    assert any("Goal reached" in n for n in notes), notes
    chassis = np.array([b[1, :3] for b in places[:-1]])
    steps = np.hypot(*np.diff(chassis[:, :2], axis=0).T)
    assert steps.max() < 0.1  # it moves between the states, and does not jump
    assert drive.time < 1.0 and drive.readings()["goal_m"] > 2.0  # the next episode
    drive.reset()
    assert drive.note == "" and drive.path == 0.0
