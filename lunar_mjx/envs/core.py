"""What every environment here is: pure functions over a whole batch, and one pytree of state."""

from __future__ import annotations

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Bool, Float, Int

from lunar_mjx.pytree import AnyArray, pytree

PER_STEP = ("reward_", "curriculum_")
"""What the names of metrics begin with that say something in every step: parts of the step's reward, and where rovers
stand in a curriculum."""


@pytree
class State:
    """One step of a batch of environments; every leaf has the leading axis `env`.

    Environments reset themselves: where an episode ended, `obs` is the first observation of the next episode and
    `final_obs` the last of the one that ended. Elsewhere the two are equal, so that `final_obs` is always the true
    successor of the observation acted on.

    Attributes:
      obs: what the policy sees next.
      privileged: what only a critic may see next (asymmetric observations); of width 0 if there is nothing.
      reward: of the step.
      terminated: the task ended: nothing follows, no value is left.
      truncated: the episode was cut off although the task goes on: the value of `final_obs` still counts.
      final_obs, final_privileged: the true successors, before any reset.
      metrics: numbers for logs, by name: `episode_return`, `episode_length`, `success` and others of the episode, which
        mean something only where `done`; and those of `PER_STEP`.
      info: what scripted agents and viewers read.
      inner: the environment's own state.
    """

    obs: Float[AnyArray, "env obs"]
    privileged: Float[AnyArray, "env privileged"]
    reward: Float[AnyArray, "env"]
    terminated: Bool[AnyArray, "env"]
    truncated: Bool[AnyArray, "env"]
    final_obs: Float[AnyArray, "env obs"]
    final_privileged: Float[AnyArray, "env privileged"]
    metrics: dict[str, Any]
    info: dict[str, Any]
    inner: Any

    @property
    def done(self) -> Any:
        """(env,) whether the episode ended, for either reason."""
        return self.terminated | self.truncated


class Environment(Protocol):
    """A batch of environments as pure functions; actions lie in [-1, 1].

    Attributes:
      params: everything shared by the batch (terrain, tables, physical parameters), as a pytree of arrays.
      observation_size, privileged_size, action_size: widths.
      control_interval: s of simulated time per step.
      episode_steps: most steps of an episode.
    """

    params: Any
    observation_size: int
    privileged_size: int
    action_size: int
    control_interval: float
    episode_steps: int

    def reset(self, params: Any, keys: Array) -> State:
        """Begins an episode in every environment; `keys` (env, 2) are raw random keys, one each."""
        ...

    def step(self, params: Any, state: State, action: Array) -> State:
        """Acts in every environment, `action` (env, action), and resets those whose episode ended."""
        ...


def split_keys(key: Array, count: int) -> Int[Array, "env 2"]:
    """Raw random keys, one for each of `count` environments."""
    return jax.random.split(key, count)


def where(condition: Bool[Array, "env"], new: Any, old: Any) -> Any:
    """Takes whole environments from `new` where the condition holds, from `old` elsewhere."""

    def choose(a: Any, b: Any) -> Any:
        # The condition is stretched over the trailing axes, whatever each leaf's width.
        return jnp.where(condition.reshape(-1, *([1] * (jnp.ndim(a) - 1))), a, b)

    return jax.tree.map(choose, new, old)


_WIDEST = 32
"""Numbers per environment up to which an array counts as narrow: 32 floats are one cache line of 128 bytes."""


def _narrow(array: Any) -> bool:
    return jnp.ndim(array) == 2 and array.shape[1] <= _WIDEST


def side_by_side(tree: Any, wanted: bool | None = None) -> Any:
    """The arrays of a tree, those of shape (env, n) with neighbouring environments side by side in a GPU's memory.

    Shapes and values stay what they are. The physics wants this order inside, so that a loop over steps whose state
    has it needs no transposing on the way in and out, and every kernel reads and writes whole cache lines. Wide arrays
    (height scans, and observations that hold them) keep the usual order: the scan's points lie together anyway.

    Args:
      tree: a pytree of arrays. wanted: whether to ask for it; only on GPUs if None.
    """
    # Only a GPU reads the memory of neighbouring environments together.
    if not (jax.default_backend() == "gpu" if wanted is None else wanted):
        return tree
    columns = Layout(major_to_minor=(1, 0))
    return jax.tree.map(lambda a: with_layout_constraint(a, columns) if _narrow(a) else a, tree)
