"""Writes an exported policy: a folder that runs without this package."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from lunar_mjx.agents.export import graphs, ros2_node
from lunar_mjx.agents.export.contract import contract_of
from lunar_mjx.agents.policy import load_policy
from lunar_mjx.envs import make
from lunar_mjx.errors import bad_input
from lunar_mjx.files import replacing, write_text
from lunar_mjx.trust import require_trust

GRAPHS = {"onnx": ("policy.onnx", graphs.to_onnx), "stablehlo": ("policy.stablehlo", graphs.to_stablehlo)}
"""Graphs by name: the file, and what makes it."""
CONTRACT, NODE = "contract.json", "ros2_node.py"


def export_policy(path: Path, folder: Path, only: Sequence[str] = tuple(GRAPHS)) -> list[Path]:
    """Writes a policy's graphs, contract and ROS 2 node into a folder; returns their paths.

    Args:
      path: of the policy. folder: that exists. only: names of `GRAPHS`; the node needs `onnx`.

    Raises:
      UserError: no policy, an environment without a name, a graph that does not exist or cannot be made here.
    """
    for name in only:
        if name not in GRAPHS:
            raise bad_input("export", "--only", name, "is no format", f"use {' or '.join(GRAPHS)}")
    policy = load_policy(path)
    made_in = policy.environment
    if not made_in:
        remedy = "train it in an environment that has a name"
        raise bad_input(path, "environment.name", None, "says of no environment what its observations are", remedy)
    require_trust(path, "environment.name", made_in["name"])
    options = {k: tuple(v) if isinstance(v, list) else v for k, v in made_in["options"].items()}
    if str(options.get("task", "")).startswith("ladder/"):
        # names and units do not depend on how many worlds are made
        options["worlds"] = 1
    env = make(made_in["name"], **options)
    # The environment may have changed since the training; a contract of other observations would be worse than none.
    sizes = (env.observation_size, env.action_size)
    if sizes != (policy.network["obs"], policy.network["actions"]):
        raise bad_input(
            path,
            "network.obs, network.actions",
            (policy.network["obs"], policy.network["actions"]),
            f"are not {sizes}, as its environment has them now",
            "export it with the version that trained it",
        )
    made = {GRAPHS[name][0]: GRAPHS[name][1](policy) for name in only}
    written, hashes = [], {path.name: hashlib.sha256(path.read_bytes()).hexdigest()}
    for name, content in made.items():
        with replacing(folder / name) as part:
            part.write_bytes(content)
        hashes[name] = hashlib.sha256(content).hexdigest()
        written.append(folder / name)
    contract = contract_of(policy, env, path.name, hashes)
    write_text(folder / CONTRACT, json.dumps(contract.model_dump(), indent=1) + "\n")
    written.append(folder / CONTRACT)
    if GRAPHS["onnx"][0] in made and contract.rover is not None:
        with replacing(folder / NODE) as part:
            shutil.copyfile(str(ros2_node.__file__), part)
        written.append(folder / NODE)
    return written
