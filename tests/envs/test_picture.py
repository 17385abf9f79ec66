"""The pictures of an episode as it goes on."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from lunar_mjx.envs.picture import Picture
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain import flat


def test_wheel_tracks_grow_while_the_rover_drives(opengl: None) -> None:
    """A picture of a rover that came along a way differs from one of a rover set down: two dark lines lie behind it."""
    rover = load_rover("viper")
    env: Any = SimpleNamespace(
        model=SimpleNamespace(rover=rover, gravity=1.62, effect_names=()),
        control_interval=0.1,
        params=SimpleNamespace(system=SimpleNamespace(terrain=flat(60.0))),
        config=SimpleNamespace(goal_radius=1.0),
    )

    def state(x: float) -> Any:
        qpos = rover.compile().qpos0.copy()
        qpos[:3] = x, 0.0, rover.standing_height
        return SimpleNamespace(inner=SimpleNamespace(physics=SimpleNamespace(qpos=qpos[None]), goal=[[8.0, 0.0]]))

    driven, placed = Picture(env, "camera"), Picture(env, "camera")
    for drawn in (driven, placed):
        drawn.begin(state(0.0))
    for n, x in enumerate(np.linspace(0.1, 3.0, 30)):
        driven.add(state(float(x)), done=False)
        if x > 1.4 and n % 5 == 0:  # pictures between take up the steps since the one before
            driven.frame()
    placed.add(state(3.0), done=False)
    placed._wheels, placed._poses = None, [placed._qpos]
    trodden, plain = driven.frame().astype(float), placed.frame().astype(float)
    for drawn in (driven, placed):
        drawn.close()
    darker = trodden.sum(axis=-1) < 0.92 * plain.sum(axis=-1)
    assert 0.01 < darker.mean() < 0.2
    columns = np.nonzero(darker[-40:].sum(axis=0) > 4)[0]
    assert len(columns) > 10 and np.diff(columns).max() > 20
