"""A trained policy as one small file: weights, observation statistics, and how its environment is made."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from lunar_mjx.agents.networks import ACTIVATIONS, make_actor, normalised
from lunar_mjx.envs import TASKS, NavigationConfig
from lunar_mjx.errors import UserError, bad_input, no_archive, require_file
from lunar_mjx.files import replacing
from lunar_mjx.resources import shipped

FORMAT = "lunar-mjx-policy/1"
FORMER_PRESET = "consistent"
"""Preset of policies that do not tell theirs: the environments' default until `field` became it."""


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A deterministic policy.

    Attributes:
      params: of the actor. mean, deviation: of the observations; None if they are not normalised.
      network: `obs`, `actions`, `layers`, `activation`, `layer_norm` of the actor; if it sees pictures also `picture`
        and `filters`, see `make_actor`.
      environment: name and options that make the environment that it was trained in; empty if it has no name.
      notes: what trained it, with what result.
    """

    params: Any
    mean: np.ndarray | None
    deviation: np.ndarray | None
    network: dict[str, Any]
    environment: dict[str, Any]
    notes: dict[str, Any]

    def act(self, obs: Any) -> Any:
        """Actions in [-1, 1], (env, action), for observations (env, obs)."""
        if self.mean is not None:
            obs = normalised(obs, jnp.asarray(self.mean), jnp.asarray(self.deviation))
        return make_actor(**self.network).apply(self.params, obs)


def shipped_policy(name: str) -> Path | None:
    """The trained policy that ships with a rover (`luvmi_x`), or of another training (`luvmi_x/ladder-3`), or None."""
    rover, _, training = name.partition("/")
    path = shipped("models") / rover / f"{training or 'policy'}.npz"
    return path if path.is_file() else None


def shipped_policies() -> list[str]:
    """Names that `shipped_policy` knows, sorted."""
    files = shipped("models").glob("*/*.npz")
    return sorted(f.parent.name if f.stem == "policy" else f"{f.parent.name}/{f.stem}" for f in files)


def taught_in(policy: Policy, source: str | Path) -> tuple[NavigationConfig, str | None]:
    """The navigation task that a policy was trained in, and its rover; None where only a model's file names it.

    Args:
      policy: of the environment `navigation`. source: who asks, for the sentence.

    Raises:
      UserError: its file names a task or setting that does not exist.
    """
    options = policy.environment["options"]
    made_by = ("task", "rover", "terrain", "preset", "model", "engine")
    # JSON knows lists only; settings are tuples.
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in options.items() if k not in made_by}
    task = options.get("task", "consistent")
    if not isinstance(task, str) or task not in TASKS:
        raise bad_input(source, "the policy's task", task, "does not exist", f"give one of {', '.join(TASKS)}")
    return TASKS[task].replace(**settings), None if "model" in options else options.get("rover", "luvmi_x")


def policy_of(learner: Any, state: Any, environment: dict[str, Any], notes: dict[str, Any]) -> Policy:
    """The policy of a state of a training's `Learner`; who drives it makes its environment without a curriculum."""
    options = {k: v for k, v in environment.get("options", {}).items() if k != "curriculum_levels"}
    environment = {**environment, "options": options} if environment else environment
    params, statistics = jax.device_get(learner.policy(state))
    config = learner.config.algorithm
    network = {
        "obs": learner.env.observation_size,
        "actions": learner.env.action_size,
        "layers": list(config.actor_layers),
        "activation": config.activation,
        "layer_norm": config.layer_norm,
        # Only where there are pictures: other policies stay readable for those who know of none.
        **getattr(learner.agent, "eye", {}),
    }
    mean, deviation = statistics if statistics is not None else (None, None)
    return Policy(params, mean, deviation, network, environment, notes)


def policy_of_sb3(model: Any, environment: dict[str, Any], notes: dict[str, Any]) -> Policy:
    """The policy of a TD3 or DDPG of Stable-Baselines3: the actor's layers, so the same actions.

    Args:
      model: SB3's, with its default activation. environment: see `Policy`. notes: see `Policy`.
    """
    layers = [part for part in model.policy.actor.mu if hasattr(part, "weight")]
    arrays = [{"kernel": a.weight.detach().numpy().T, "bias": a.bias.detach().numpy()} for a in layers]
    network = {"obs": layers[0].in_features, "actions": layers[-1].out_features, "activation": "relu"}
    network |= {"layers": [a.out_features for a in layers[:-1]], "layer_norm": False}
    params = {"params": {f"hidden_{i}": layer for i, layer in enumerate(arrays)}}
    return Policy(params, None, None, network, environment, notes)


class _Network(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    obs: Annotated[int, Field(ge=1, le=100_000)]
    actions: Annotated[int, Field(ge=1, le=10_000)]
    layers: Annotated[list[Annotated[int, Field(ge=1, le=100_000)]], Field(max_length=100)]
    activation: str
    layer_norm: bool
    picture: Annotated[list[Annotated[int, Field(ge=0, le=100_000)]], Field(min_length=4, max_length=4)] | None = None
    filters: Annotated[list[Annotated[int, Field(ge=1, le=10_000)]], Field(max_length=10)] = []


class _Environment(BaseModel):
    model_config = ConfigDict(strict=True)
    name: str
    options: dict[str, Any]
    unseen: dict[str, Any] = {}


class _Nameless(BaseModel):
    """Environment of a policy that was trained in Python, where it has no name."""

    model_config = ConfigDict(extra="forbid")


class _Record(BaseModel):
    """What `policy.npz` says of itself."""

    model_config = ConfigDict(strict=True)
    format: str
    network: _Network
    environment: _Environment | _Nameless
    notes: dict[str, Any]


def save_policy(policy: Policy, path: Path) -> Path:
    """Writes a policy as an .npz file without pickles; returns the path."""
    leaves: dict[str, Any] = {
        f"params{jax.tree_util.keystr(p)}": np.asarray(a) for p, a in jax.tree_util.tree_leaves_with_path(policy.params)
    }
    if policy.mean is not None:
        leaves |= {"mean": np.asarray(policy.mean), "deviation": np.asarray(policy.deviation)}
    record = {"format": FORMAT, "network": policy.network, "environment": policy.environment, "notes": policy.notes}
    with replacing(path) as part:
        np.savez_compressed(part, record=np.array(json.dumps(record)), **leaves)
    return path


def load_policy(path: str | Path) -> Policy:
    """Reads a policy that `save_policy` wrote.

    Raises:
      UserError: the file is missing or holds no policy.
    """
    path = require_file(path, "the policy")
    try:
        # NumPy leaves a file open that is no archive
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            # JSON within the archive: no pickle, and readable by anything.
            record = json.loads(str(data["record"]))
            arrays = {name: data[name] for name in data.files if name != "record"}
        _Record.model_validate(record)
    except Exception as error:  # archives, their compression and NumPy's headers raise a dozen kinds
        reason = no_archive(error)[:200]
        raise UserError(f"{path}: is no policy ({reason}); give an .npz that `lunar-mjx train` wrote.") from None
    environment = record["environment"]
    if environment.get("name") == "navigation" and not {"model", "preset"} & environment["options"].keys():
        # A policy's physics must not change with the default.
        environment["options"]["preset"] = FORMER_PRESET
    if record.get("format") != FORMAT:
        raise bad_input(path, "format", record.get("format"), "is not known", f"give a file of format {FORMAT}")
    network = record["network"]
    if network["activation"] not in ACTIVATIONS:
        known = ", ".join(ACTIVATIONS)
        raise bad_input(path, "network.activation", network["activation"], "does not exist", f"use one of {known}")
    if picture := network.get("picture"):
        start, rows, columns, colours = picture
        if rows * columns * colours < 1 or start + rows * columns * colours > network["obs"]:
            problem = f"does not lie within {network['obs']} observations"
            raise bad_input(path, "network.picture", picture, problem, "fetch it again")
    for name, array in arrays.items():
        wanted = (network["obs"],) if name in ("mean", "deviation") else None
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            raise UserError(f"{path}: {name} holds values that are no finite numbers; train anew, or fetch it again.")
        if (wanted is not None and array.shape != wanted) or (name == "deviation" and (array <= 0.0).any()):
            raise UserError(f"{path}: {name} does not fit the network's {network['obs']} observations; fetch it again.")
    if ("mean" in arrays) != ("deviation" in arrays):
        raise UserError(f"{path}: holds only one of mean and deviation; fetch it again.")
    # The network's record says which weights must be there, and of what shape.
    shapes = jax.eval_shape(make_actor(**network).init, jax.random.PRNGKey(0))
    leaves = []
    for place, leaf in jax.tree_util.tree_leaves_with_path(shapes):
        name = f"params{jax.tree_util.keystr(place)}"
        if name not in arrays or arrays[name].shape != leaf.shape:
            raise UserError(f"{path}: the weights {name} do not fit its network; write the policy anew.")
        leaves.append(jnp.asarray(arrays[name], jnp.float32))
    params = jax.tree.unflatten(jax.tree.structure(shapes), leaves)
    return Policy(params, arrays.get("mean"), arrays.get("deviation"), network, record["environment"], record["notes"])
