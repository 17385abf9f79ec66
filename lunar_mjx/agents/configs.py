"""Trainings by name: an environment with its options, how to train in it, and for how long."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from lunar_mjx.agents import ddpg, td3
from lunar_mjx.agents.learner import TrainConfig
from lunar_mjx.errors import bad_input


@dataclasses.dataclass(frozen=True)
class Training:
    """A training by name.

    Attributes:
      environment: name in `lunar_mjx.envs`, or my_env.py:make_env. options: of its maker.
      train: how to train.
      steps: environment steps, over all environments.
      unseen: options of the environment that evaluations use instead: other terrain, ranges and places.
      note: one sentence.
    """

    environment: str
    options: Mapping[str, Any]
    train: TrainConfig
    steps: int
    unseen: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    note: str = ""


_LARGE = TrainConfig(
    td3.TUNED,
    envs=8192,
    batch=16384,
    updates=4,
    buffer_steps=256,
    random_steps=8,
    noise=(0.02, 0.4),
    normalise=True,
    epoch_steps=50,
    episodes=False,
)
_SMALL_TD3 = td3.TD3Config(
    actor_layers=(128, 128),
    critic_layers=(128, 128),
    actor_last_scale=0.01,
    layer_norm=True,
    actor_rate=3e-4,
    critic_rate=1e-3,
    gamma=0.95,
    tau=0.02,
    n_step=3,
    reward_scale=0.02,
)
_SHORT_OPTIONS = {
    "task": "consistent",
    "action": "velocity",
    "terrain": "flat",
    "goal_distance": (3.0, 5.0),
    "episode_time": 12.0,
    "decimation": 100,
    "observations": ("goal_body", "body_velocity", "body_rates"),
}
_POINT = TrainConfig(
    td3.TD3Config(actor_layers=(64, 64), critic_layers=(64, 64), n_step=3, tau=0.02),
    envs=32,
    batch=256,
    updates=2,
    buffer_steps=1000,
    random_steps=20,
    noise=(0.05, 0.4),
    normalise=True,
    epoch_steps=100,
)
_UNSEEN = {"terrain": "world:heldout", "ranges": "unseen"}

TRAININGS: dict[str, Training] = {
    "paper-td3": Training(
        "navigation",
        {"task": "paper"},
        TrainConfig(td3.TD3Config(), batch=100, buffer_steps=200_000),
        120_000,
        note="section V with SB3's defaults of TD3",
    ),
    "paper-ddpg": Training(
        "navigation",
        {"task": "paper"},
        TrainConfig(ddpg.DDPGConfig(), batch=100, buffer_steps=200_000),
        120_000,
        note="section V with SB3's defaults of DDPG",
    ),
    "large-td3": Training(
        "navigation",
        {"task": "large"},
        _LARGE,
        60_000_000,
        _UNSEEN,
        note="TD3 with thousands of rovers on rough ground, goals 10 to 40 m away",
    ),
    "large-ddpg": Training(
        "navigation",
        {"task": "large"},
        dataclasses.replace(_LARGE, algorithm=ddpg.TUNED),
        60_000_000,
        _UNSEEN,
        note="DDPG likewise",
    ),
    "short": Training(
        "navigation",
        _SHORT_OPTIONS,
        TrainConfig(
            _SMALL_TD3,
            envs=64,
            batch=256,
            updates=8,
            buffer_steps=400,
            random_steps=10,
            noise=(0.05, 0.5),
            normalise=True,
            epoch_steps=25,
        ),
        48_000,
        note="TD3 on flat ground, goals 3 to 5 m away: learns within minutes on two CPU cores",
    ),
    "point": Training("point", {}, _POINT, 96_000, note="a point without physics: seconds"),
}
"""Trainings that `lunar-mjx train` knows by name."""


def get_training(name: str) -> Training:
    """A training by name.

    Raises:
      UserError: there is no such training.
    """
    if name not in TRAININGS:
        raise bad_input("train", "training", name, "does not exist", f"use one of {', '.join(TRAININGS)}")
    return TRAININGS[name]


def override(training: Training, **values: Any) -> Training:
    """A training with other values for fields of its `TrainConfig` or of its algorithm, by field name.

    Raises:
      UserError: neither has such a field.
    """
    train, algorithm = training.train, training.train.algorithm
    for name, value in values.items():
        if name in {f.name for f in dataclasses.fields(train)} - {"algorithm"}:
            train = dataclasses.replace(train, **{name: _like(getattr(train, name), name, value)})
        elif name in {f.name for f in dataclasses.fields(algorithm)}:
            algorithm = dataclasses.replace(algorithm, **{name: _like(getattr(algorithm, name), name, value)})
        else:
            known = [f.name for c in (train, algorithm) for f in dataclasses.fields(c) if f.name != "algorithm"]
            raise bad_input("train", name, value, "is no setting of this training", f"use one of {', '.join(known)}")
    return dataclasses.replace(training, train=dataclasses.replace(train, algorithm=algorithm))


def _like(old: Any, name: str, value: Any) -> Any:
    """A value of the type that stands there; text is read as on the command line."""
    if not isinstance(value, str):
        return tuple(value) if isinstance(old, tuple) else value
    try:
        if isinstance(old, bool):
            return {"true": True, "false": False}[value.lower()]
        if isinstance(old, tuple):
            kind = type(old[0])
            return tuple(kind(part) for part in value.split(","))
        return type(old)(value)
    except (KeyError, ValueError):
        raise bad_input("train", name, value, f"is not like {old}", f"write it like {old}") from None
