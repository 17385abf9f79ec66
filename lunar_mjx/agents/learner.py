"""One epoch of training as a pure function: act, store, learn, many times over, on one or many devices.

The whole state of a training is one pytree. Every device runs its own share of the environments and of each batch;
parameters are the same everywhere, because gradients and observation statistics are averaged over the mesh.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec

from lunar_mjx._quiet import without_warp_notices
from lunar_mjx.agents import guard
from lunar_mjx.agents.ddpg import DDPG, DDPGConfig
from lunar_mjx.agents.from_brax.ppo import PPO, PPOConfig, Rollout
from lunar_mjx.agents.from_brax.sac import SAC, SACConfig
from lunar_mjx.agents.from_teacher.distill import Distill, DistillConfig, Lesson
from lunar_mjx.agents.networks import normalised
from lunar_mjx.agents.replay import Batch, ReplayBuffer, ReplayState, Transition
from lunar_mjx.agents.td3 import TD3, TD3Config
from lunar_mjx.envs.core import PER_STEP, Environment, State
from lunar_mjx.errors import bad_input, require_within
from lunar_mjx.pytree import pytree, tree_of

with without_warp_notices():
    from brax.training.acme import running_statistics

AXIS = "device"
EPISODE = ("episode_return", "episode_length", "success")
"""Metrics that every environment gives for episodes that ended."""
LARGEST_COUNT = 2**31 - 1
"""1; places in a buffer and steps are counted in 32 bits."""
AGENTS: dict[type, Any] = {TD3Config: TD3, DDPGConfig: DDPG, SACConfig: SAC, PPOConfig: PPO}
"""Algorithms by the class of their settings; beside them `Distill`, which looks at its environment itself."""
ON_POLICY = PPOConfig | DistillConfig
"""Settings of algorithms that learn from each unroll once, without a buffer."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How an agent is trained; the algorithm's own settings are in `algorithm`.

    Attributes:
      algorithm: settings of the algorithm, whose class also chooses it.
      envs: environments, over all devices.
      batch: transitions per update, over all devices.
      updates: updates per step of all environments.
      buffer_steps: steps kept per environment.
      random_steps: steps of each environment with random actions before the policy acts and learns.
      noise: least and greatest deviation of the exploration noise, spread evenly over the environments (PQL's mixed
        exploration); equal for one deviation.
      normalise: normalise observations by their running mean and deviation.
      epoch_steps: steps of each environment per jitted epoch.
      episodes: report every episode that ends, for curves by episode; only for few environments.
      precision: of matrix products: "highest" is float32; "default" lets recent GPUs round to TF32.
    """

    algorithm: TD3Config | DDPGConfig | SACConfig | PPOConfig | DistillConfig
    envs: int = 1
    batch: int = 256
    updates: int = 1
    buffer_steps: int = 1_000_000
    random_steps: int = 100
    noise: tuple[float, float] = (0.3, 0.3)
    normalise: bool = False
    epoch_steps: int = 1000
    episodes: bool = True
    precision: str = "highest"

    def __post_init__(self) -> None:
        for name in ("envs", "batch", "updates", "buffer_steps", "epoch_steps"):
            if getattr(self, name) < 1:
                raise bad_input("TrainConfig", name, getattr(self, name), "is below 1", "give at least 1")
            require_within("TrainConfig", name, getattr(self, name), 1, LARGEST_COUNT)
        for value in self.noise:
            require_within("TrainConfig", "noise", value, 0.0)
        if self.precision not in ("highest", "high", "default"):
            raise bad_input("TrainConfig", "precision", self.precision, "does not exist", "use highest or default")
        if not 0.0 <= self.noise[0] <= self.noise[1]:
            raise bad_input("TrainConfig", "noise", self.noise, "is no range of deviations", "give (least, greatest)")
        if not isinstance(self.algorithm, ON_POLICY) and self.random_steps < self.algorithm.n_step:
            raise bad_input(
                "TrainConfig",
                "random_steps",
                self.random_steps,
                f"is below n_step = {self.algorithm.n_step}",
                "raise it",
            )


@pytree
class TrainState:
    """Everything that a training needs to go on; `iterations` counts steps of every environment.

    Of one copy on every device: agent, statistics, iterations. Of one share on every device: the rest. PPO and
    distillation have neither buffer nor noise.
    """

    agent: Any
    statistics: Any
    iterations: Any
    env: State
    buffer: ReplayState | None
    noise: Any
    key: Any
    guard: guard.Guard


def least_memory(env: Environment, config: TrainConfig) -> int:
    """Bytes that a training takes at least, over all devices: environments, buffer and one batch, in single precision.

    What else a state holds, the networks and what a program needs while it runs come on top.
    """
    seen = 2 * (env.observation_size + env.privileged_size)  # of a step and of its successor
    # Action and reward are numbers, the two ends of an episode truth values of one byte.
    transition = 4 * (seen + env.action_size + 1) + 2
    if isinstance(config.algorithm, ON_POLICY):
        return config.envs * 4 * seen * (1 + config.algorithm.unroll)
    return config.envs * (4 * seen + config.buffer_steps * transition) + config.batch * transition


def require_memory(env: Environment, config: TrainConfig, devices: Sequence[Any]) -> None:
    """Raises `UserError` for a training that cannot fit into the memory of its devices, before anything compiles."""
    mine = [d for d in devices if d.process_index == jax.process_index()]
    limits: list[Any] = [(d.memory_stats() or {}).get("bytes_limit") for d in mine]
    if None not in limits:
        there = sum(limits)
    elif hasattr(os, "sysconf"):  # devices of a host share its memory
        there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    else:
        return
    needed = least_memory(env, config) * len(mine) / len(devices)
    if needed > there:
        raise bad_input(
            "TrainConfig",
            "envs, buffer_steps, batch",
            f"{config.envs}, {config.buffer_steps}, {config.batch}",
            f"take {needed / 1e9:.0f} GB at least, and there are {there / 1e9:.0f}",
            "keep fewer steps, or lower the number of environments",
        )


class Learner:
    """Training of one algorithm in one environment over a mesh of devices.

    Args:
      env: the environment.
      config: how to train.
      mesh: devices along the axis `AXIS`; all devices of all processes if None.

    Raises:
      UserError: more than the devices' memory holds, environments or batch that do not divide among them, or for PPO
        and distillation environments among minibatches or an epoch among unrolls; a teacher that does not fit.
    """

    def __init__(self, env: Environment, config: TrainConfig, mesh: Mesh | None = None):
        self.env, self.config = env, config
        self.mesh = mesh or jax.make_mesh((jax.device_count(),), (AXIS,))
        self.devices = self.mesh.size
        for name in ("envs", "batch"):
            if getattr(config, name) % self.devices:
                raise bad_input(
                    "TrainConfig",
                    name,
                    getattr(config, name),
                    f"does not divide among {self.devices} devices",
                    "give a multiple",
                )
        require_memory(env, config, list(self.mesh.devices.flat))
        algorithm = config.algorithm
        self.agent: Any
        if isinstance(algorithm, DistillConfig):
            self.agent = Distill(algorithm, env)
        else:
            sizes = env.observation_size, env.privileged_size, env.action_size
            self.agent = AGENTS[type(algorithm)](algorithm, *sizes)
        shared, own = Spec(), Spec(AXIS)
        self.buffer, buffer = None, None
        if isinstance(algorithm, ON_POLICY):
            if config.epoch_steps % algorithm.unroll:
                problem = f"is no multiple of unroll = {algorithm.unroll}"
                raise bad_input("TrainConfig", "epoch_steps", config.epoch_steps, problem, "give one")
            if config.envs // self.devices % algorithm.minibatches:
                problem = f"does not divide among {self.devices} devices of {algorithm.minibatches} minibatches"
                raise bad_input("TrainConfig", "envs", config.envs, problem, "give a multiple")
        else:
            self.buffer = ReplayBuffer(config.buffer_steps, algorithm.n_step, algorithm.gamma)
            buffer = tree_of(ReplayState, storage=own, head=shared, filled=shared)
        self.specs = tree_of(
            TrainState,
            agent=shared,
            statistics=shared,
            iterations=shared,
            env=own,
            buffer=buffer,
            noise=own,
            key=own,
            guard=own,
        )
        self._init = self._over_devices(self._init_share, (shared, shared), self.specs)
        reports = (shared, own) if config.episodes else (shared, shared)
        self._epoch = self._over_devices(self._epoch_share, (shared, self.specs), (self.specs, reports), donate=(1,))

    def _over_devices(self, function: Any, ins: Any, outs: Any, donate: tuple[int, ...] = ()) -> Any:
        # Each device runs its own environments; only gradients and statistics cross between them.
        mapped = jax.shard_map(function, mesh=self.mesh, in_specs=ins, out_specs=outs, check_vma=False)
        # The state is donated: a buffer of millions of transitions exists once.
        return jax.jit(mapped, donate_argnums=donate)

    def init(self, seed: int) -> TrainState:
        """The state before the first step."""
        with jax.default_matmul_precision(self.config.precision):
            return self._init(self.env.params, jax.random.PRNGKey(seed))

    def epoch(self, env_params: Any, state: TrainState) -> tuple[TrainState, Any]:
        """Runs `epoch_steps` steps of every environment, and their updates; `state` is used up.

        Returns:
          The state after, and a pair: numbers of the epoch by name, and per step and environment (or nothing) whether
          an episode ended, its return, length and success.
        """
        with jax.default_matmul_precision(self.config.precision):
            return self._epoch(env_params, state)

    def compile(self) -> None:
        """Compiles ahead what `init` and `epoch` run; several learners may do so in threads at once."""
        with jax.default_matmul_precision(self.config.precision):
            state = self.abstract()
            key = jax.random.PRNGKey(0)
            params = self.env.params
            begin, epoch = self._init.lower(params, key), self._epoch.lower(params, state)
            self._init, self._epoch = begin.compile(), epoch.compile()

    def shardings(self, state: Any) -> Any:
        """Where every leaf of a state like `state` lives."""
        prefix = jax.tree.map(lambda s: NamedSharding(self.mesh, s), self.specs, is_leaf=lambda s: isinstance(s, Spec))
        return jax.tree.broadcast(prefix, state, is_leaf=lambda s: isinstance(s, NamedSharding))

    def abstract(self) -> TrainState:
        """Shapes, types and shardings of a state, without making one."""
        # Shapes without memory: a resumed training would otherwise hold its state twice.
        shapes = jax.eval_shape(self._init, self.env.params, jax.random.PRNGKey(0))
        return jax.tree.map(
            lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), shapes, self.shardings(shapes)
        )

    def policy(self, state: TrainState) -> tuple[Any, Any]:
        """What acting needs: the actor's parameters, and mean and deviation of observations (or None)."""
        statistics = state.statistics
        return self.agent.policy(state.agent), (
            statistics.mean["obs"],
            statistics.std["obs"],
        ) if self.config.normalise else None

    # What runs on every device, over its share of the environments.

    def _init_share(self, params: Any, key: Any) -> TrainState:
        c, mine = self.config, self.config.envs // self.devices
        key_agent, key_env, key_run = jax.random.split(key, 3)
        rank = jax.lax.axis_index(AXIS)
        # By rank, or all devices would drive the same episodes.
        env = self.env.reset(params, jax.random.split(jax.random.fold_in(key_env, rank), mine))
        action = jnp.zeros((mine, self.env.action_size), env.obs.dtype)
        example = _transition(env, action, env)
        widths = {"obs": env.obs[0], "privileged": env.privileged[0]}
        return TrainState(
            agent=self.agent.init(key_agent),
            statistics=jax.tree.map(jnp.asarray, running_statistics.init_state(widths)),
            iterations=jnp.zeros((), jnp.int32),
            env=env,
            buffer=None if self.buffer is None else self.buffer.init(example),
            # every device spreads the whole range over its share
            noise=jnp.linspace(c.noise[0], c.noise[1], mine),
            key=jax.random.fold_in(key_run, rank)[None],
            guard=guard.start(env, action),
        )

    def _epoch_share(self, params: Any, state: TrainState) -> tuple[TrainState, Any]:
        def iteration(state: TrainState, _: Any) -> tuple[TrainState, Any]:
            state, seen = self._collect(params, state)
            state, losses = self._learn(state)
            return state, (seen, losses)

        def unroll(state: TrainState, _: Any) -> tuple[TrainState, Any]:
            return self._unroll(params, state)

        steps = self.config.epoch_steps
        if isinstance(self.config.algorithm, ON_POLICY):
            state, (seen, losses) = jax.lax.scan(unroll, state, length=steps // self.config.algorithm.unroll)
            seen = jax.tree.map(lambda a: a.reshape(steps, *a.shape[2:]), seen)
        else:
            state, (seen, losses) = jax.lax.scan(iteration, state, length=steps)
        numbers = self._summary(state, seen, losses)
        if not self.config.episodes:
            return state, (numbers, {})
        return state, (numbers, {name: seen[name].T for name in (*EPISODE, "done")})

    def _collect(self, params: Any, state: TrainState) -> tuple[TrainState, Any]:
        """One step of every environment, stored."""
        c = self.config
        key, key_noise = jax.random.split(state.key[0])
        obs = self._normalised(state.statistics, state.env.obs, "obs")
        action = self.agent.explore(state.agent, obs, state.noise, key_noise)
        # both are drawn in every step: a compiled loop has one program for random steps and later ones
        blind = jax.random.uniform(jax.random.fold_in(key_noise, 1), action.shape, action.dtype, -1.0, 1.0)
        action = jnp.where(state.iterations < c.random_steps, blind, action)
        env = self.env.step(params, state.env, action)
        assert self.buffer is not None and state.buffer is not None
        new = dataclasses.replace(
            state,
            env=env,
            # The true successors: `obs` may already be the next episode's.
            statistics=self._counted(state.statistics, env.final_obs, env.final_privileged),
            buffer=self.buffer.insert(state.buffer, _transition(state.env, action, env)),
            key=key[None],
            iterations=state.iterations + 1,
            guard=guard.watch(state.guard, state.env, action, env, state.iterations),
        )
        return new, self._seen(env)

    def _counted(self, statistics: Any, obs: Any, privileged: Any) -> Any:
        """The statistics after more observations."""
        if not self.config.normalise:
            return statistics
        return running_statistics.update(statistics, {"obs": obs, "privileged": privileged}, pmap_axis_name=AXIS)

    def _unroll(self, params: Any, state: TrainState) -> tuple[TrainState, Any]:
        """Some steps of every environment with one policy, and the updates that follow."""
        statistics, algorithm = state.statistics, self.config.algorithm
        assert isinstance(algorithm, ON_POLICY)

        def side_by_side(obs: Any, privileged: Any) -> Any:
            parts = (obs, "obs"), (privileged, "privileged")
            return jnp.concatenate([self._normalised(statistics, values, name) for values, name in parts], axis=-1)

        def taught(state: TrainState, _: Any) -> tuple[Any, State, Lesson]:
            obs = self._normalised(statistics, state.env.obs, "obs")
            # The teacher normalises by itself, as in its own training.
            action, lesson = self.agent.drive(state.agent, obs, state.env.privileged, state.iterations)
            return action, self.env.step(params, state.env, action), lesson

        def drawn(state: TrainState, key: Any) -> tuple[Any, State, Rollout]:
            seen = side_by_side(state.env.obs, state.env.privileged)
            action, raw, logits, log_prob = self.agent.draw(state.agent, seen, key)
            env = self.env.step(params, state.env, action)
            next_seen = side_by_side(env.final_obs, env.final_privileged)
            done, truncated = (a.astype(env.reward.dtype) for a in (env.done, env.truncated))
            return action, env, Rollout(seen, raw, logits, log_prob, env.reward, done, truncated, next_seen)

        def step(state: TrainState, _: Any) -> tuple[TrainState, Any]:
            key, key_action = jax.random.split(state.key[0])
            driven = taught if isinstance(algorithm, DistillConfig) else drawn
            action, env, row = driven(state, key_action)
            watched = guard.watch(state.guard, state.env, action, env, state.iterations)
            new = dataclasses.replace(state, env=env, key=key[None], iterations=state.iterations + 1, guard=watched)
            return new, (self._seen(env), row, (env.final_obs, env.final_privileged))

        state, (seen, rows, observed) = jax.lax.scan(step, state, length=algorithm.unroll)
        # scan stacks by time; minibatches are drawn by environment.
        rollout = jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), rows)
        agent, losses = self.agent.update(state.agent, rollout, jax.random.fold_in(state.key[0], 1), AXIS)
        # after the updates: divergence and ratios are of the policy that acted
        return dataclasses.replace(state, agent=agent, statistics=self._counted(statistics, *observed)), (seen, losses)

    def _seen(self, env: State) -> dict[str, Any]:
        """Numbers of a step for reports: sums over episodes that ended, and means over rovers of `PER_STEP`."""
        # Sums and counts instead of means: episodes of an epoch weigh alike, whenever they end.
        ended = {k: jnp.sum(jnp.where(env.done, v, 0.0)) for k, v in env.metrics.items() if not k.startswith(PER_STEP)}
        means = {k: jnp.mean(v) for k, v in env.metrics.items() if k.startswith(PER_STEP)}
        seen = {"ended": ended, "count": jnp.sum(env.done), "means": {**means, "reward": jnp.mean(env.reward)}}
        if self.config.episodes:
            seen |= {name: env.metrics[name] for name in EPISODE} | {"done": env.done}
        return seen

    def _learn(self, state: TrainState) -> tuple[TrainState, dict[str, Any]]:
        """The updates that follow a step."""
        c = self.config

        def once(carry: Any, _: Any) -> Any:
            agent, key = carry
            key, key_sample, key_update = jax.random.split(key, 3)
            assert self.buffer is not None and state.buffer is not None
            batch = self.buffer.sample(state.buffer, key_sample, c.batch // self.devices)
            agent, losses = self.agent.update(agent, self._normalised_batch(state.statistics, batch), key_update, AXIS)
            return (agent, key), losses

        def learn(agent: Any) -> Any:
            (agent, _), losses = jax.lax.scan(once, (agent, jax.random.fold_in(state.key[0], 1)), length=c.updates)
            return agent, jax.tree.map(jnp.mean, losses)

        def wait(agent: Any) -> Any:
            return agent, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(learn, agent)[1])

        # One program for both times: the buffer must hold whole n-step transitions first.
        agent, losses = jax.lax.cond(state.iterations >= c.random_steps, learn, wait, state.agent)
        return dataclasses.replace(state, agent=agent), losses

    def _normalised(self, statistics: Any, values: Any, name: str) -> Any:
        if not self.config.normalise:
            return values
        return normalised(values, statistics.mean[name], statistics.std[name])

    def _normalised_batch(self, statistics: Any, batch: Batch) -> Batch:
        return dataclasses.replace(
            batch,
            obs=self._normalised(statistics, batch.obs, "obs"),
            privileged=self._normalised(statistics, batch.privileged, "privileged"),
            next_obs=self._normalised(statistics, batch.next_obs, "obs"),
            next_privileged=self._normalised(statistics, batch.next_privileged, "privileged"),
        )

    def _summary(self, state: TrainState, seen: Any, losses: Any) -> dict[str, Any]:
        """Numbers of an epoch, the same on every device; means of ended episodes are nan where none ended."""
        ended, count = jax.lax.psum(jax.tree.map(jnp.sum, (seen["ended"], seen["count"])), AXIS)
        numbers = {k: jnp.where(count > 0, v / jnp.maximum(count, 1), jnp.nan) for k, v in ended.items()}
        rest = jax.tree.map(jnp.mean, {**seen["means"], **losses})
        return {
            **numbers,
            **jax.lax.pmean(rest, AXIS),
            "episodes": count,
            "tripped": jax.lax.pmax(state.guard.tripped[0].astype(jnp.int32), AXIS),
            "broken": guard.broken(state.agent).astype(jnp.int32),
        }


def _transition(before: State, action: Any, after: State) -> Transition:
    return Transition(
        before.obs,
        before.privileged,
        action,
        after.reward,
        after.terminated,
        after.truncated,
        after.final_obs,
        after.final_privileged,
    )
