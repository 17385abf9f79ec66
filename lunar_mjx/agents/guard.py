"""The guard against values that are not finite: it names the environment and keeps its last sound state for replay."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.envs.core import Environment, State
from lunar_mjx.errors import UserError, bad_input, require_file
from lunar_mjx.files import replacing
from lunar_mjx.pytree import pytree


class DivergenceError(UserError):
    """A training met a value that is not finite and stopped."""


@pytree
class Guard:
    """What the guard remembers; every leaf has a leading axis of one entry per device.

    Attributes:
      tripped: whether an environment gave a value that is not finite.
      env: its number among the device's environments. iteration: when.
      action: what it was about to do, and `state` the batch state of that one environment before it did.
    """

    tripped: Any
    env: Any
    iteration: Any
    action: Any
    state: State


def start(state: State, action: Any) -> Guard:
    """A guard that has seen nothing, for a batch of environments."""
    zero = jnp.zeros((1,), jnp.int32)
    return Guard(jnp.zeros((1,), bool), zero, zero, action[:1], jax.tree.map(lambda a: a[:1], state))


def watch(guard: Guard, before: State, action: Any, after: State, iteration: Any) -> Guard:
    """Looks at one step of a batch; remembers the first environment that broke, as it was before the step."""
    fine = jnp.isfinite(after.reward) & jnp.isfinite(after.final_obs).all(-1) & jnp.isfinite(after.obs).all(-1)
    # Only what a learner reads: an inner state may hold infinities by design.
    fine = fine & jnp.isfinite(after.final_privileged).all(-1)
    # argmin of booleans is the first false one.
    first = jnp.argmin(fine)
    # The first break is kept: what follows it is its consequence.
    trips = ~jnp.all(fine) & ~guard.tripped[0]

    def keep(old: Any, new: Any) -> Any:
        return jnp.where(trips, jax.lax.dynamic_slice_in_dim(new, first, 1, 0), old)

    return Guard(
        tripped=guard.tripped | trips[None],
        env=jnp.where(trips, first[None].astype(jnp.int32), guard.env),
        iteration=jnp.where(trips, iteration[None], guard.iteration),
        action=keep(guard.action, action),
        state=jax.tree.map(keep, guard.state, before),
    )


def broken(tree: Any) -> Any:
    """Whether any floating-point leaf holds a value that is not finite."""
    leaves = [a for a in jax.tree.leaves(tree) if jnp.issubdtype(a.dtype, jnp.floating)]
    return ~jnp.all(jnp.stack([jnp.isfinite(a).all() for a in leaves]))


def dump(guard: Guard, path: Path | None, envs_per_device: int) -> tuple[int, int]:
    """Writes the remembered state of the first device that tripped; nothing if `path` is None.

    Returns:
      The environment's number in the whole batch, and the iteration.
    """
    # argmax of booleans is the first true one.
    device = int(np.argmax(np.asarray(guard.tripped)))
    one = jax.tree.map(lambda a: np.asarray(a)[device : device + 1], guard)
    number = device * envs_per_device + int(one.env[0])
    if path is not None:
        leaves = {jax.tree_util.keystr(p): a for p, a in jax.tree_util.tree_leaves_with_path(one.state)}
        note = json.dumps({"environment": number, "iteration": int(one.iteration[0])})
        with replacing(path) as part:
            np.savez_compressed(part, note=np.array(note), action=one.action, **leaves)
    return number, int(one.iteration[0])


def replay(env: Environment, path: Path) -> State:
    """Takes the step that broke once more, from a file that `dump` wrote.

    Raises:
      UserError: the file is missing, or of another environment.
    """
    with require_file(path, "the guard's dump").open("rb") as file, np.load(file, allow_pickle=False) as data:
        # Shapes tell what a state of this environment holds, without making one.
        shapes = jax.eval_shape(env.reset, env.params, jax.ShapeDtypeStruct((1, 2), jnp.uint32))
        stored_leaves = []
        for place, leaf in jax.tree_util.tree_leaves_with_path(shapes):
            name = jax.tree_util.keystr(place)
            if name not in data or data[name].shape != leaf.shape:
                raise bad_input(
                    path,
                    name,
                    "missing" if name not in data else data[name].shape,
                    "is not the state of this environment",
                    "make the environment with the settings of the training",
                )
            stored_leaves.append(jnp.asarray(data[name]))
        state = jax.tree.unflatten(jax.tree.structure(shapes), stored_leaves)
        return jax.jit(env.step)(env.params, state, jnp.asarray(data["action"]))
