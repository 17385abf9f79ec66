"""One training from its name to its curve, policy and scores; what the command and the scripts in `train/` share."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.agents import CHOOSING_SEED, FINAL_SEED, UNSEEN_PLACES
from lunar_mjx.agents.configs import Training
from lunar_mjx.agents.curves import plot_episodes, plot_progress
from lunar_mjx.agents.evaluate import Evaluator, Score
from lunar_mjx.agents.learner import Learner, TrainState
from lunar_mjx.agents.networks import normalised
from lunar_mjx.agents.policy import policy_of, save_policy
from lunar_mjx.agents.train import Result, RunConfig, plain, train
from lunar_mjx.envs import NavigationEnv, make
from lunar_mjx.envs.navigation.config import UNSEEN_SOIL
from lunar_mjx.envs.navigation.env import default_preset
from lunar_mjx.files import write_text
from lunar_mjx.together import leads


def unseen_params(env: Any, options: Mapping[str, Any]) -> Any:
    """The environment's parameters for an evaluation: other terrain, soil and places than in training.

    Args:
      env: of the training. options: `terrain`, `ranges` = "unseen" for the held-out soil, and on the ladder
        `hardness` of the worlds.
    """
    if not isinstance(env, NavigationEnv):
        return env.params
    from lunar_mjx.envs.navigation.worlds import PREFIX, world

    model, terrain = env.model, options.get("terrain")
    if terrain is not None:
        ground = world(terrain.removeprefix(PREFIX)) if terrain.startswith(PREFIX) else terrain
        model = model.replace(terrain=ground)
    unseen = {r.parameter: r for r in UNSEEN_SOIL}
    ranges = None
    if options.get("ranges") == "unseen":
        ranges = tuple(unseen.get(r.parameter, r) for r in env.config.randomise)
    return env.place(model, ranges, seed=env.config.place_seed + UNSEEN_PLACES, hardness=options.get("hardness"))


def soil_note(env: Any) -> str:
    """One line about the soil of an evaluation that is the training's own; empty where there is nothing to say."""
    if not isinstance(env, NavigationEnv) or env.params.spread is None:
        return ""
    return f"drawn from [posterior] as in training, not unseen: {', '.join(env.params.spread.parameters)}"


def learner_agent(learner: Learner, blanked: Sequence[str] = ()) -> Any:
    """The learner's policy as an agent of `Evaluator`, whose parameters are those of `Learner.policy`.

    Args:
      learner: the learner. blanked: blocks of observations that the policy sees at their mean, which tells what they
        are worth to it; those that its environment lacks say nothing.
    """
    # Environments other than navigation name no blocks: nothing of theirs can be blanked.
    places = getattr(learner.env, "blocks", {})
    blank = np.zeros(learner.env.observation_size, bool)
    for name in set(blanked) & set(places):
        blank[places[name]] = True

    def agent(params: Any, state: Any, key: Any) -> Any:
        weights, statistics = params
        mean = 0.0 if statistics is None else statistics[0]
        obs = jnp.where(blank, mean, state.obs) if blank.any() else state.obs
        obs = obs if statistics is None else normalised(obs, *statistics)
        return learner.agent.act(weights, obs)

    return agent


class Scorer:
    """Scores a training's policy on unseen ground every so often; stops it at a wanted success rate.

    Args:
      env: the environment. unseen: see `unseen_params`.
      episodes: per evaluation. every: s of training between evaluations.
      target: success rate at which the training stops; never if None.
      folder: the policy with the best score is kept there as `best_policy.npz`.
    """

    def __init__(
        self,
        env: Any,
        unseen: Mapping[str, Any],
        episodes: int,
        every: float,
        target: float | None,
        folder: Path | None,
        environment: dict[str, Any],
    ):
        self.params = unseen_params(env, unseen)
        self.every, self.target, self.folder, self.environment = every, target, folder, environment
        self._best, self._evaluator = -1.0, None
        self._env, self._episodes = env, episodes
        self.restart()

    def restart(self) -> None:
        """Forgets the scores, for another seed."""
        self.scores: list[dict[str, Any]] = []
        self._next = self.every

    def __call__(self, learner: Learner, state: TrainState, row: dict[str, Any]) -> dict[str, Any] | None:
        # the others wait for the first one's word, so that only one of them scores
        if row["elapsed_s"] < self._next or not leads():
            return None
        score = self.score(learner, state)
        self._next = row["elapsed_s"] + self.every
        self.scores.append({"steps": row["steps"], "elapsed_s": row["elapsed_s"], **score.record()})
        if score.success > self._best and self.folder is not None:
            self._best = score.success
            # So that whoever finds the file alone knows how good it is, and after how much training.
            notes = {"score": score.record(), "steps": row["steps"], "elapsed_s": row["elapsed_s"]}
            save_policy(policy_of(learner, state, self.environment, notes), self.folder / "best_policy.npz")
        stop = self.target is not None and score.success >= self.target
        return {"unseen_success": score.success, "unseen_return": score.episode_return, "stop": stop}

    def score(self, learner: Learner, state: TrainState, seed: int = CHOOSING_SEED) -> Score:
        """Scores the policy of a state."""
        if self._evaluator is None:
            self._evaluator = Evaluator(self._env, learner_agent(learner), self._episodes)
        # To one device: the evaluator is compiled for one, whatever the training's mesh.
        params = jax.device_put(jax.device_get(learner.policy(state)))
        return self._evaluator(self.params, params, seed)


def environment_of(training: Training) -> dict[str, Any]:
    """How a training's environment is made, for policies and records; the preset among its options, since defaults
    change and policies stay."""
    options = dict(training.options)
    if training.environment == "navigation" and "model" not in options:
        options.setdefault("preset", default_preset(options.get("task", "consistent")))
    return {"name": training.environment, "options": plain(options), "unseen": plain(dict(training.unseen))}


@dataclasses.dataclass(frozen=True, eq=False)
class Report:
    """What `run_training` came to.

    Attributes:
      result: of the training. score: of its policy on unseen ground. record: what `curve.json` holds.
    """

    result: Result
    score: Score
    record: dict[str, Any]


def run_training(
    name: str,
    training: Training,
    run: RunConfig,
    folder: Path,
    eval_every: float = 15.0,
    eval_episodes: int = 512,
    target: float | None = None,
) -> Report:
    """Trains, scores on unseen ground, and writes policy, curve and scores into a folder; of several processes the
    first one writes.

    Files: `progress.csv`, `events/` (TensorBoard), `checkpoints/`, `policy.npz`, `best_policy.npz` (best on unseen
    ground during training), `curve.json`, `curve.png`.

    Args:
      name: of the training, for titles.
      training: what to train. run: how long.
      eval_every: s of training between scores. eval_episodes: of each.
      target: success rate on unseen ground at which to stop.
    """
    begin = time.monotonic()
    env = make(training.environment, **training.options)
    environment = environment_of(training)
    learner = Learner(env, training.train)
    scorer = Scorer(env, training.unseen, eval_episodes, eval_every, target, folder, environment)
    result = train(learner, run, folder, environment, scorer)
    score = scorer.score(learner, result.state, seed=FINAL_SEED)
    record = {
        "training": name,
        "environment": environment,
        "train": plain(dataclasses.asdict(training.train)),
        "seed": run.seed,
        "device": f"{jax.device_count()} x {jax.devices()[0].device_kind}",
        "finished": result.finished,
        "wall_s": time.monotonic() - begin,
        "rows": plain(result.rows),
        "episodes": plain(result.episodes),
        "unseen": plain(scorer.scores),
        "final": plain(score.record()),
    }
    if not leads():
        return Report(result, score, record)
    write_text(folder / "curve.json", json.dumps(record))
    plot_progress([record], folder / "curve.png", name)
    if result.episodes["step"]:
        plot_episodes({name: [record]}, folder / "episodes.png")
    return Report(result, score, record)
