"""Part `export` of measure.py: how far exported policies' graphs are from the policy, and how long an action takes.

python benchmarks/rl/measure.py export --out runs/export        # a core
"""

from __future__ import annotations

import argparse
import importlib.util
import tempfile
import time
from pathlib import Path
from typing import Any

import jax.export
import numpy as np
from harness import Clock, save, say

from lunar_mjx.agents.export.write import NODE, export_policy
from lunar_mjx.agents.policy import load_policy, shipped_policy

COUNT, SEED = 2000, 0
"""Observations, drawn around the training's mean with 1.5 of its deviations."""


def measured(path: Path) -> dict[str, float]:
    """Greatest errors of both graphs, and times of the exported folder's own node, ms."""
    policy = load_policy(path)
    assert policy.mean is not None and policy.deviation is not None
    drawn = np.random.default_rng(SEED).normal(0.0, 1.5, (COUNT, policy.network["obs"]))
    obs = (drawn * policy.deviation + policy.mean).astype(np.float32)
    wanted = np.asarray(policy.act(obs))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export_policy(path, folder)
        spec: Any = importlib.util.spec_from_file_location("node", folder / NODE)
        node = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(node)
        taken, actions, times = node.Policy(name), [], []
        for row in obs:
            begin = time.perf_counter()
            actions.append(taken.act(row))
            times.append(1e3 * (time.perf_counter() - begin))
        graph = jax.export.deserialize(bytearray((folder / "policy.stablehlo").read_bytes()))
        other = np.asarray(graph.call(obs))
    return {
        "onnx_error": float(np.abs(np.stack(actions) - wanted).max()),
        "stablehlo_error": float(np.abs(other - wanted).max()),
        "median_ms": float(np.median(times)),
        "p99_ms": float(np.quantile(times, 0.99)),
    }


def export(args: argparse.Namespace, _: Clock) -> None:
    """Measures the policies that ship with rovers."""
    paths = {rover: shipped_policy(rover) for rover in ("luvmi_x", "viper")}
    rows = {rover: measured(path) for rover, path in paths.items() if path is not None}
    say(str(rows))
    save(args.out, "export", {"seed": SEED, "observations": COUNT, "rovers": rows})
