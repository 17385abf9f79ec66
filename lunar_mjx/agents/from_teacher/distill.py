"""Distillation (DAgger, Ross et al. 2011, arXiv 1011.0686): a student imitates a teacher where the student drives.

The teacher is a trained policy. It reads the environment's privileged numbers, which must be its own observations; the
student reads the others, a picture among them if there is one. At first the teacher drives, later the student, and the
teacher says at every step what it would have done.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import optax

from lunar_mjx._quiet import without_warp_notices
from lunar_mjx.agents.networks import make_actor
from lunar_mjx.agents.policy import Policy, load_policy, shipped_policy, taught_in
from lunar_mjx.agents.td3 import polyak
from lunar_mjx.envs import NavigationEnv
from lunar_mjx.errors import bad_input, require_within
from lunar_mjx.pytree import pytree

with without_warp_notices():
    from brax.training.gradients import gradient_update_fn


@dataclasses.dataclass(frozen=True)
class DistillConfig:
    """Settings of distillation.

    Attributes:
      teacher: path of its policy, or name of one that ships (`luvmi_x`, `luvmi_x/ladder-3`).
      actor_layers: widths of the student's hidden layers. activation, layer_norm: of them.
      actor_last_scale: of the last layer at the start.
      filters: of the convolutions on the student's picture.
      rate: learning rate. max_gradient: norm to which gradients are cut.
      tau: share of the new parameters in their running mean, per update; the mean is the policy that is kept.
      teacher_steps: steps of every environment over which the teacher hands the driving over, one environment after
        the other; the student drives from the beginning if 0.
      unroll: steps of every environment between updates.
      minibatches: of environments, per pass. passes: over the data of an unroll.
    """

    UNUSED: ClassVar[tuple[str, ...]] = ("batch", "updates", "buffer_steps", "random_steps", "noise")
    """Fields of `TrainConfig` that say nothing here: nothing is replayed, and the student explores by its mistakes."""

    teacher: str = ""
    actor_layers: tuple[int, ...] = (256, 128)
    activation: str = "relu"
    layer_norm: bool = False
    actor_last_scale: float = 1.0
    filters: tuple[int, ...] = (16, 32, 32)
    rate: float = 5e-4
    max_gradient: float = 1.0
    tau: float = 0.002
    teacher_steps: int = 1_000
    unroll: int = 8
    minibatches: int = 4
    passes: int = 1

    def __post_init__(self) -> None:
        for name in ("unroll", "minibatches", "passes"):
            if getattr(self, name) < 1:
                raise bad_input("DistillConfig", name, getattr(self, name), "is below 1", "give at least 1")
        for name in ("actor_last_scale", "rate", "max_gradient"):
            require_within("DistillConfig", name, getattr(self, name), 0.0, above=True)
        require_within("DistillConfig", "tau", self.tau, 0.0, 1.0, above=True)
        require_within("DistillConfig", "teacher_steps", self.teacher_steps, 0)
        for name in ("actor_layers", "filters"):
            for width in getattr(self, name):
                require_within("DistillConfig", name, width, 1.0, 1e5)


@pytree
class DistillState:
    """Parameters of the student, their running mean, and their optimiser."""

    actor: Any
    mean: Any
    optimiser: Any


@pytree
class Lesson:
    """What was seen and what the teacher would have done; leading axes `env`, `time`, or `env` for one step.

    Attributes:
      obs: of the student, normalised. action: of the teacher.
    """

    obs: Any
    action: Any


class Distill:
    """The algorithm for an environment whose privileged numbers are what the teacher sees.

    Args:
      config: settings. env: the environment.

    Raises:
      UserError: no such teacher, or one of another rover, other actions or other observations.
    """

    def __init__(self, config: DistillConfig, env: Any):
        c = self.config = config
        self.teacher = open_teacher(c.teacher)
        check_teacher(c.teacher, self.teacher, env)
        picture = getattr(env, "picture", None)
        # What a policy's file says of its network beyond layers.
        self.eye = {} if picture is None else {"picture": list(picture), "filters": list(c.filters)}
        self.actor = make_actor(
            env.observation_size,
            env.action_size,
            c.actor_layers,
            c.activation,
            c.layer_norm,
            c.actor_last_scale,
            **self.eye,
        )
        self.optimiser = optax.chain(optax.clip_by_global_norm(c.max_gradient), optax.adam(c.rate))

    def init(self, key: Any) -> DistillState:
        """Network and optimiser before the first update, drawn from a key of `jax.random`."""
        actor = self.actor.init(key)
        # A copy: a state is donated to the next epoch, and one buffer may be given away once only.
        return DistillState(actor, jax.tree.map(jnp.copy, actor), self.optimiser.init(actor))

    def policy(self, state: DistillState) -> Any:
        """Parameters of the student: their mean over the last updates, which the noise of single ones is not in."""
        return state.mean

    def act(self, actor: Any, obs: Any) -> Any:
        """Actions of the student, (env, action)."""
        return self.actor.apply(actor, obs)

    def teacher_share(self, iterations: Any) -> Any:
        """Share of the environments that the teacher drives after so many steps of each."""
        return jnp.maximum(0.0, 1.0 - iterations / max(1, self.config.teacher_steps)) * (self.config.teacher_steps > 0)

    def drive(self, state: DistillState, obs: Any, privileged: Any, iterations: Any) -> tuple[Any, Lesson]:
        """Actions to be taken, (env, action), and the lesson of the step.

        Args:
          state: of the student. obs: its own, normalised. privileged: what the teacher sees, as the environment gives
            it. iterations: steps of every environment so far.
        """
        # In every state, whoever drove there: what to do after own mistakes is the lesson (DAgger).
        taught = self.teacher.act(privileged).astype(obs.dtype)
        rank = (jnp.arange(obs.shape[0]) + 0.5) / obs.shape[0]
        # Whole environments and not single steps: a teacher that takes over now and then hides where mistakes lead.
        driven = (rank < self.teacher_share(iterations))[:, None]
        return jnp.where(driven, taught, self.act(state.actor, obs)), Lesson(obs, taught)

    def loss(self, actor: Any, lesson: Lesson) -> Any:
        """Mean squared difference between the student's and the teacher's actions."""
        return jnp.mean((self.act(actor, lesson.obs) - lesson.action) ** 2)

    def update(
        self, state: DistillState, lessons: Lesson, key: Any, axis: str | None = None
    ) -> tuple[DistillState, dict]:
        """All passes over lessons (env, time, ...).

        Args:
          state: before. lessons: of an unroll. key: of minibatches.
          axis: mesh axis over which gradients are averaged, if any.

        Returns:
          The state after, and losses by name.
        """
        c = self.config
        learn = gradient_update_fn(self.loss, self.optimiser, axis)

        def minibatch(state: DistillState, part: Lesson) -> tuple[DistillState, Any]:
            loss, actor, optimiser = learn(state.actor, part, optimizer_state=state.optimiser)
            return DistillState(actor, polyak(state.mean, actor, c.tau), optimiser), loss

        def once(state: DistillState, key: Any) -> tuple[DistillState, Any]:
            order = jax.random.permutation(key, lessons.action.shape[0]).reshape(c.minibatches, -1)
            # Each minibatch is gathered when it is due: pictures of a whole unroll need not be there twice.
            return jax.lax.scan(lambda s, rows: minibatch(s, jax.tree.map(lambda a: a[rows], lessons)), state, order)

        state, losses = jax.lax.scan(once, state, jax.random.split(key, c.passes))
        return state, {"imitation_loss": jnp.mean(losses)}


def open_teacher(name: str) -> Policy:
    """The teacher's policy.

    Args:
      name: path of a policy, or name of one that ships.

    Raises:
      UserError: there is none.
    """
    path = Path(name) if name.endswith(".npz") else shipped_policy(name) if name else None
    if path is None:
        remedy = "give a policy.npz, a rover that ships one, or luvmi_x/ladder-3"
        raise bad_input("distill", "teacher", name, "is no policy", remedy)
    return load_policy(path)


DRIVING = ("action", "four_wheel_steering", "top_speed", "load_share", "decimation")
"""Settings of the navigation task that say what an action does."""


def check_teacher(name: str, teacher: Policy, env: Any) -> None:
    """Raises `UserError` for a teacher whose actions or observations are not those of the environment."""
    source = f"distill: teacher {name}"
    if isinstance(env, NavigationEnv) and teacher.environment.get("name") == "navigation":
        task, rover = taught_in(teacher, source)
        if rover is not None and rover != env.model.rover.name:
            problem = f"is not the {env.model.rover.name} that is to learn"
            raise bad_input(source, "rover", rover, problem, f"give a teacher of {env.model.rover.name}")
        # An action of as many numbers may mean other speeds, which a student would copy without a word.
        for field in DRIVING:
            theirs, ours = getattr(task, field), getattr(env.config, field)
            if theirs != ours:
                remedy = f"give the training's options {field} = {theirs!r}"
                raise bad_input(source, field, theirs, f"differs from the environment's {ours!r}", remedy)
        if tuple(env.config.privileged) != tuple(task.observations):
            remedy = f"give the training's options privileged = {list(task.observations)}"
            raise bad_input("distill", "privileged", env.config.privileged, "is not what the teacher sees", remedy)
    for field, theirs, ours in (
        ("actions", teacher.network["actions"], env.action_size),
        ("observations", teacher.network["obs"], env.privileged_size),
    ):
        if theirs != ours:
            remedy = "give a teacher that was trained in such an environment"
            raise bad_input(source, field, theirs, f"are not the environment's {ours}", remedy)
