"""How often an agent succeeds: one episode per environment, with the interval that the number of episodes allows."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.envs.core import PER_STEP, Environment, split_keys
from lunar_mjx.envs.navigation.tally import METRICS
from lunar_mjx.envs.scripted import Agent


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """How episodes are scored."""

    piece: int = 50
    """Steps that run on the device between looks whether all episodes are over."""


EVALUATION = Evaluation()


@dataclasses.dataclass(frozen=True)
class Score:
    """Result of an evaluation.

    Attributes:
      episodes: how many. success: share that reached the goal. low, high: its 95 % Wilson interval.
      episode_return: mean; return_deviation: standard deviation. episode_time: mean, s.
      ends: share of every way in which episodes ended, those cut off as `time`.
      spl: success weighted by path length, the mean of success * shortest / max(shortest, travelled) (Anderson et al.
        2018, arXiv 1807.06757). collisions_per_km, wh_per_km: of all ways together. slip: mean size. All None where
        the environment keeps no tally.
    """

    episodes: int
    success: float
    low: float
    high: float
    episode_return: float
    return_deviation: float
    episode_time: float
    ends: dict[str, float]
    spl: float | None = None
    collisions_per_km: float | None = None
    wh_per_km: float | None = None
    slip: float | None = None

    def record(self) -> dict[str, Any]:
        """The score's fields as a dictionary for a JSON file."""
        return dataclasses.asdict(self)


def wilson(successes: float, count: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927)."""
    from scipy import stats

    # Wilson's interval stays within 0 and 1 and has a width for 0 of n, where the normal approximation has none.
    interval = stats.binomtest(round(successes), count).proportion_ci(0.95, "wilson")
    return float(interval.low), float(interval.high)


def success_text(score: Mapping[str, Any]) -> str:
    """The success of a score's record in percent, with its 95 % interval."""
    return f"{100 * score['success']:.1f} % ({100 * score['low']:.1f} to {100 * score['high']:.1f})"


def pooled(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Success and ends over the episodes of several scores' records together, with the 95 % interval."""
    count = sum(r["episodes"] for r in records)
    won = sum(r["success"] * r["episodes"] for r in records)
    low, high = wilson(won, count)
    ends = {k: sum(r["ends"][k] * r["episodes"] for r in records) / count for k in records[0]["ends"]}
    return {"success": won / count, "low": low, "high": high, "episodes": count, "ends": ends}


class Evaluator:
    """Scores agents in an environment; compiled once for all parameters and states of an agent.

    Args:
      env: the environment.
      agent: function of (agent's parameters, state, key) to actions.
      episodes: scored, one per environment: the first of each, so that short episodes do not count twice.
      copies: how often the same episodes lie side by side, one copy after another, for agents that `agent` tells apart
        by the environment's number.
    """

    def __init__(self, env: Environment, agent: Any, episodes: int, copies: int = 1):
        self.env, self.episodes, self.copies = env, episodes, copies
        self._reset: Any = jax.jit(
            lambda params, key: env.reset(params, jnp.tile(split_keys(key, episodes), (copies, 1)))
        )

        def piece(params: Any, agent_params: Any, carry: Any, key: Any) -> Any:
            def step(carry: Any, key: Any) -> Any:
                state, over, result = carry
                state = env.step(params, state, agent(agent_params, state, key))
                # Environments go on after their first episode: later ones would favour short episodes, and are not
                # counted.
                first = state.done & ~over
                seen = {k: v for k, v in state.metrics.items() if not k.startswith(PER_STEP)}
                result = jax.tree.map(lambda old, new: jnp.where(first, new, old), result, seen)
                return (state, over | state.done, result), None

            return jax.lax.scan(step, carry, jax.random.split(key, EVALUATION.piece))[0]

        self._piece: Any = jax.jit(piece)

    def compile(self, env_params: Any, agent_params: Any) -> None:
        """Compiles ahead for arguments like these; shapes suffice for the agent's."""
        key = jax.random.PRNGKey(0)
        reset = self._reset.lower(env_params, key)
        state = jax.eval_shape(self._reset, env_params, key)
        piece = self._piece.lower(env_params, agent_params, self._carry(state), key)
        self._reset, self._piece = reset.compile(), piece.compile()

    def _carry(self, state: Any) -> Any:
        """State, whether each first episode is over, and what it came to."""
        zero = jnp.zeros(self.copies * self.episodes)
        seen = {k: zero for k in state.metrics if not k.startswith(PER_STEP)}
        return state, zero.astype(bool), seen

    def __call__(self, env_params: Any, agent_params: Any, seed: int) -> Score:
        """The score of the first copy; arguments as of `scores`."""
        return self.scores(env_params, agent_params, seed)[0]

    def scores(self, env_params: Any, agent_params: Any, seed: int) -> list[Score]:
        """The score of one episode in each environment, for every copy.

        Args:
          env_params: of the environment: other terrain, places and ranges than in training.
          agent_params: of the agent.
          seed: of places, soils and random agents.
        """
        key_reset, key = jax.random.split(jax.random.PRNGKey(seed))
        state = self._reset(env_params, key_reset)
        carry = self._carry(state)
        # In pieces, so that an evaluation whose episodes are all over can end early.
        for i in range(math.ceil(self.env.episode_steps / EVALUATION.piece)):
            carry = self._piece(env_params, agent_params, carry, jax.random.fold_in(key, i))
            # Looked at between pieces only: a test in every step would wait for the device.
            if bool(carry[1].all()):
                break
        result = {k: v.reshape(self.copies, self.episodes) for k, v in jax.device_get(carry[2]).items()}
        return [score({k: v[i] for k, v in result.items()}, self.env.control_interval) for i in range(self.copies)]


class Judge:
    """Scores several agents on the same episodes, side by side in one program.

    Args:
      env: the environment. episodes: of each agent.
      policies: by name, functions of (policy, state, key) to actions; `policy` is whatever they share.
      rules: by name, functions of (state, key) to actions.
    """

    def __init__(
        self, env: Environment, episodes: int, policies: Mapping[str, Any], rules: Mapping[str, Agent] | None = None
    ):
        rules = rules or {}
        self.names = (*policies, *rules)
        # Which copy of the episodes an environment belongs to, and so which agent acts in it.
        row = jnp.repeat(jnp.arange(len(self.names)), episodes)

        def act(policy: Any, state: Any, key: Any) -> Any:
            actions = [agent(policy, state, key) for agent in policies.values()]
            actions += [rule(state, key) for rule in rules.values()]
            return jnp.take_along_axis(jnp.stack(actions), row[None, :, None], axis=0)[0]

        self._evaluator = Evaluator(env, act, episodes, len(self.names))

    def compile(self, env_params: Any, policy: Any = ()) -> None:
        """Compiles ahead for the environment's parameters; shapes suffice for the policy."""
        # without where the learner's devices hold it
        shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), policy)
        self._evaluator.compile(env_params, shapes)

    def __call__(self, env_params: Any, policy: Any, seed: int) -> dict[str, dict[str, Any]]:
        """The record of every agent's score, by name; arguments as of `Evaluator.scores`."""
        scores = self._evaluator.scores(env_params, jax.device_put(policy), seed)
        return {name: score.record() for name, score in zip(self.names, scores, strict=True)}


def score(result: dict[str, np.ndarray], interval: float) -> Score:
    """The score of episodes whose metrics are given, each (episode,); `interval` of control in s."""
    success, returns = result["success"], result["episode_return"]
    count = len(success)
    low, high = wilson(float(success.sum()), count)
    no_goal_metrics = {"episode_return", "episode_length", "success", *METRICS}
    ends = {k: float(v.mean()) for k, v in result.items() if k not in no_goal_metrics}
    return Score(
        episodes=count,
        success=float(success.mean()),
        low=low,
        high=high,
        episode_return=float(returns.mean()),
        return_deviation=float(returns.std()),
        episode_time=float(result["episode_length"].mean()) * interval,
        ends={
            "success": float(success.mean()),
            **ends,
            # What no end names was cut off; rounding must not make it negative.
            "time": max(0.0, 1.0 - float(success.mean()) - sum(ends.values())),
        },
        **(_costs(result) if "travelled" in result else {}),
    )


def _costs(result: dict[str, np.ndarray]) -> dict[str, float]:
    travelled, shortest = (np.asarray(result[k], float) for k in ("travelled", "shortest"))
    # A way shorter than the shortest (by the grid that it was planned on) counts as the shortest.
    direct = shortest / np.maximum(np.maximum(shortest, travelled), 1e-9)
    km = max(float(travelled.sum()) / 1000.0, 1e-9)
    return {
        "spl": float((result["success"] * direct).mean()),
        # Of all ways together: the mean of ratios would weigh short drives most.
        "collisions_per_km": float(result["collisions"].sum()) / km,
        "wh_per_km": float(result["energy"].sum()) / 3600.0 / km,
        "slip": float(result["slip"].mean()),
    }


def evaluate(env: Environment, agent: Agent, episodes: int, seed: int, env_params: Any = None) -> Score:
    """Scores an agent that has no parameters, such as those of `make_agent`."""
    return Evaluator(env, lambda _, state, key: agent(state, key), episodes)(
        env.params if env_params is None else env_params, (), seed
    )
