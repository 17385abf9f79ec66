"""Trainings as files: an environment with its options, how to train in it, and for how long (the folder `train`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lunar_mjx.agents import ddpg, td3
from lunar_mjx.agents.from_brax import ppo, sac
from lunar_mjx.agents.from_teacher import distill
from lunar_mjx.agents.learner import TrainConfig
from lunar_mjx.errors import bad_input, plain_digits
from lunar_mjx.resources import shipped
from lunar_mjx.toml_fields import Fields


@dataclasses.dataclass(frozen=True)
class Training:
    """A training by name.

    Attributes:
      environment: name in `lunar_mjx.envs`, or my_env.py:make_env. options: of its maker.
      train: how to train.
      steps: environment steps, over all environments.
      unseen: options of the environment that evaluations use instead: other terrain, ranges and places.
      note: one sentence.
      settings: name of the training, or path of the file, that `train` comes from.
      borrowed: whether that is another file than the training's own.
    """

    environment: str
    options: Mapping[str, Any]
    train: TrainConfig
    steps: int
    unseen: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    note: str = ""
    settings: str = ""
    borrowed: bool = False


ALGORITHMS: Mapping[str, type] = {
    "td3": td3.TD3Config,
    "ddpg": ddpg.DDPGConfig,
    "sac": sac.SACConfig,
    "ppo": ppo.PPOConfig,
    "distill": distill.DistillConfig,
}
"""Tables of a training file that name the algorithm and hold its settings."""
_KEYS = ("note", "environment", "steps", "learner", "options", "unseen", "train", *ALGORITHMS)


def training_names() -> tuple[str, ...]:
    """Names of the trainings that ship: the files of the folder `train`."""
    return tuple(sorted(p.stem for p in shipped("train").glob("*.toml")))


def get_training(name: str | Path, learner: str | None = None) -> Training:
    """A training by the name of a shipped file, or by the path of a file like those.

    Args:
      name: of the training. learner: another algorithm than the file's, with the settings of the shipped training
        beside it: of `large-ppo` for `ppo` instead of `large-td3`.

    Raises:
      UserError: there is no such training, its file says something that no training has, or no settings of this learner
        stand beside it.
    """
    if str(name) in training_names():
        training = read_training(shipped("train") / f"{name}.toml")
    elif Path(name).suffix == ".toml":
        training = read_training(Path(name))
    else:
        training = None
    if training is not None:
        return training if learner is None else _with_learner(training, learner)
    known = ", ".join(training_names())
    raise bad_input("train", "training", str(name), "does not exist", f"use one of {known}, or a file my_training.toml")


def learner_name(training: Training) -> str:
    """Name of a training's algorithm."""
    return next(name for name, kind in ALGORITHMS.items() if isinstance(training.train.algorithm, kind))


MOST_STEPS = 10**15
"""Environment steps: a million a second for thirty years."""
UNSEEN = ("terrain", "ranges", "hardness")
"""What a file may say of the ground and soil of its evaluation."""


def _with_learner(training: Training, learner: str) -> Training:
    if learner not in ALGORITHMS:
        raise bad_input("train", "--learner", learner, "does not exist", f"use one of {', '.join(ALGORITHMS)}")
    own = learner_name(training)
    # Asked for by name: what the user's own file says of its learner still holds.
    if learner == own:
        return training
    # The shipped files are named family-learner; the family's own name stands for its usual learner.
    family, names = training.settings.removesuffix(f"-{own}"), training_names()
    for name in (f"{family}-{learner}", family):
        if name in names and learner_name(other := get_training(name)) == learner:
            # a file that only names its learner tells its task's steps; else the other learner's file does
            steps = training.steps if training.borrowed else other.steps
            return dataclasses.replace(training, train=other.train, steps=steps, settings=name)
    raise bad_input(
        "train",
        "--learner",
        learner,
        f"has no settings beside those of {training.settings}",
        f'give a file with a table [{learner}], or with learner = "large-{learner}" in place of the tables',
    )


def read_training(path: Path) -> Training:
    """A training from its file; settings that it leaves out have their defaults.

    Raises:
      UserError: the file is missing, or a field is unknown or of another kind.
    """
    fields = Fields.read(path, "the training")
    fields.known(_KEYS)
    named = [a for a in ALGORITHMS if a in fields.values]
    settings = path.stem if path.parent == shipped("train") else str(path)
    if "learner" in fields.values:
        if named or "train" in fields.values:
            table = (named or ["train"])[0]
            raise bad_input(path, "learner", fields.text("learner"), f"stands beside [{table}]", "give one of them")
        other = get_training(fields.text("learner"))
        train, settings = other.train, other.settings
    # The table names the algorithm: two of them would be two trainings.
    elif len(named) != 1:
        tables = " or ".join(f"[{a}]" for a in ALGORITHMS)
        raise bad_input(path, "algorithm", " and ".join(named) or "none", "is not one table", f"give one of {tables}")
    else:
        algorithm = _settings(ALGORITHMS[named[0]](), fields.table(named[0]))
        train = _settings(TrainConfig(algorithm), fields.table("train"), _unused(algorithm))
    steps = fields.positive("steps", most=MOST_STEPS)
    if steps != int(steps):
        raise bad_input(path, "steps", steps, "is no whole number", "give a number of environment steps")
    fields.table("unseen").known(UNSEEN)
    return Training(
        fields.text("environment"),
        _tuples(fields.table("options").values),
        train,
        int(steps),
        _tuples(fields.table("unseen").values),
        fields.text("note", ""),
        settings,
        "learner" in fields.values,
    )


def _unused(algorithm: Any) -> tuple[str, ...]:
    """Fields of `TrainConfig` that say nothing to an algorithm."""
    return getattr(algorithm, "UNUSED", ())


def _settings(defaults: Any, table: Fields, unused: tuple[str, ...] = ()) -> Any:
    """A dataclass of settings with the values of a table."""
    table.known([f.name for f in dataclasses.fields(defaults) if f.name not in ("algorithm", *unused)])
    return dataclasses.replace(defaults, **{k: _as(getattr(defaults, k), table, k) for k in table.values})


def _as(old: Any, table: Fields, key: str) -> Any:
    """A value of the kind that the setting has: a whole number serves for a number, a list for a tuple."""
    value = table.values[key]

    def fits(kind: Any, part: Any) -> bool:
        # Whoever writes 1 for 1.0 means the number; true for 1.0 is a mistake.
        return kind is None or type(part) is type(kind) or (isinstance(kind, float) and type(part) is int)

    def made(kind: Any, part: Any) -> Any:
        return float(part) if isinstance(kind, float) else part

    if isinstance(old, tuple) and isinstance(value, list):
        # TOML has lists; frozen settings hold tuples, so that they can be hashed and compared.
        kind = old[0] if old else None
        if all(fits(kind, part) for part in value):
            return tuple(made(kind, part) for part in value)
    elif fits(old, value):
        return made(old, value)
    raise bad_input(table.path, table.field(key), value, f"is not like {old}", f"write it like {old}")


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}


def override(training: Training, **values: Any) -> Training:
    """A training with other values for fields of its `TrainConfig` or of its algorithm, by field name.

    Raises:
      UserError: neither has such a field.
    """
    train, algorithm = training.train, training.train.algorithm
    # A setting that the algorithm does not read would be taken, and change nothing.
    unused = {"algorithm", *_unused(algorithm)}
    for name, value in values.items():
        if name in {f.name for f in dataclasses.fields(train)} - unused:
            train = dataclasses.replace(train, **{name: _like(_example(train, name), name, value)})
        elif name in {f.name for f in dataclasses.fields(algorithm)}:
            algorithm = dataclasses.replace(algorithm, **{name: _like(_example(algorithm, name), name, value)})
        else:
            known = [f.name for c in (train, algorithm) for f in dataclasses.fields(c) if f.name not in unused]
            raise bad_input("train", name, value, "is no setting of this training", f"use one of {', '.join(known)}")
    return dataclasses.replace(training, train=dataclasses.replace(train, algorithm=algorithm))


def _example(settings: Any, name: str) -> Any:
    """The value of a setting, or its default where an empty list tells no type."""
    value = getattr(settings, name)
    return next(f.default for f in dataclasses.fields(settings) if f.name == name) if value == () else value


def _like(old: Any, name: str, value: Any) -> Any:
    """A value of the type that stands there; text is read as on the command line."""
    if not isinstance(value, str):
        return tuple(value) if isinstance(old, tuple) else value
    try:
        if isinstance(old, bool):
            return {"true": True, "false": False}[value.lower()]
        if isinstance(old, str):
            return value
        plain = plain_digits(value)
        if isinstance(old, tuple):
            kind = type(old[0])
            return tuple(kind(part) for part in plain.split(","))
        return type(old)(plain)
    except (KeyError, ValueError):
        raise bad_input("train", name, value, f"is not like {old}", f"write it like {old}") from None
