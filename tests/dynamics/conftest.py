"""Compiled systems shared by the tests of the dynamics: one compilation for each rover, preset and rate."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics import Params, State, System, Telemetry, build
from lunar_mjx.model import make_model
from lunar_mjx.terrain import Terrain, inclined, stack

ROVERS, COMMANDS = 6, 10


class Bench:
    """A system whose batched rollout is compiled once; the terrain varies from rover to rover."""

    def __init__(self, system: System):
        self.system = system
        self.model = system.model
        self.drives = len(self.model.rover.wheels)
        self._runs = {}

        def reset(ground, x, y, yaw):
            return system.reset(dataclasses.replace(system.params, terrain=ground), x, y, yaw)

        self._reset = jax.jit(reset)

    def control(self, drive: float = 0.0, steer: float = 0.0, suspension: float = 0.0) -> np.ndarray:
        """One control vector; `steer` goes to the front wheels."""
        values = []
        for group in self.model.rover.groups:
            for wheel, _ in zip(self.model.rover.wheels, group.joints, strict=True):
                front = wheel.corner in ("lf", "rf")
                values.append({"drive": drive, "steer": steer if front else 0.0, "suspension": suspension}[group.name])
        return np.array(values)

    def drive(
        self,
        terrains: list[Terrain],
        states: State,
        controls: np.ndarray,
        every: int,
        brake: bool = False,
        gravity: float | None = None,
    ) -> tuple[State, Telemetry]:
        """Runs a batch, one terrain per rover, from batched states; controls (time, joint) or (rover, time, joint).

        The batch is padded and the time cut into pieces of one shape, so that everything runs one compiled function.
        """
        n = len(terrains)
        controls = np.broadcast_to(controls, (n, *controls.shape[-2:]))
        assert n <= ROVERS and controls.shape[1] % COMMANDS == 0
        spare = [n - 1] * (ROVERS - n)
        rows = np.array([*range(n), *spare])
        ground = jax.tree.map(jnp.asarray, stack([*terrains, *([terrains[-1]] * len(spare))]))
        states = jax.tree.map(lambda a: a[rows], states)
        run = self._runs.setdefault(every, self._compile(every))
        settings = jnp.asarray(float(brake)), jnp.asarray(self.model.gravity if gravity is None else gravity)
        pieces = []
        for piece in np.split(controls[rows], controls.shape[1] // COMMANDS, axis=1):
            states, seen = run(ground, states, jnp.asarray(piece), *settings)
            pieces.append(jax.device_get(seen))
        whole = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1)[:n], *pieces)
        return jax.tree.map(lambda a: np.asarray(a)[:n], states), whole

    def _compile(self, every: int):
        each = Params(gravity=None, ambient=None, effects=None, terrain=0)

        @jax.jit
        def run(ground, state, controls, engaged, gravity):
            effects = self.system.params.effects
            effects = {**effects, "parking_brake": {**effects["parking_brake"], "engaged": engaged}}
            params = dataclasses.replace(self.system.params, gravity=gravity, terrain=ground, effects=effects)
            return self.system.rollout_batch(params, state, controls, every, each, one_body=True)

        return run

    def stand(self, terrains: list[Terrain], x=0.0, y=0.0, yaw=0.0) -> State:
        """Rovers at rest, one on each terrain."""
        x, y, yaw = (np.broadcast_to(v, (len(terrains),)) for v in (x, y, yaw))
        states = [
            self._reset(jax.tree.map(jnp.asarray, t), *(jnp.asarray(v[i], float) for v in (x, y, yaw)))
            for i, t in enumerate(terrains)
        ]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


@functools.cache
def bench(rover: str, preset: str = "field", dt: float = 0.002) -> Bench:
    """The bench for a rover, with a parking brake; cached, since each costs a compilation."""
    model = make_model(rover, "flat", preset, timestep=dt).add("parking_brake", engaged=0.0)
    return Bench(build(model))


@pytest.fixture(params=["luvmi_x", "viper"])
def rover(request: pytest.FixtureRequest) -> str:
    return request.param


def plane(degrees: float, direction_deg: float = 0.0) -> Terrain:
    """A plane that rises by `degrees` toward `direction_deg`, on the grid that every plane of these tests shares.

    One name for all of them: it is part of the compiled structure, and each slope would else be a program of its own.
    """
    return dataclasses.replace(inclined(np.deg2rad(degrees), 200.0, np.deg2rad(direction_deg)), name="plane")
