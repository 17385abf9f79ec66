"""Measures exported policies: how far their graphs are from the policy, and how long an action takes on one core.

python benchmarks/rl/export.py --out benchmarks/rl/export.json
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import jax.export
import numpy as np
from harness import KEPT, save, say

from lunar_mjx.agents.export.write import NODE, export_policy
from lunar_mjx.agents.policy import load_policy, shipped_policy

COUNT, SEED = 2000, 0
"""Observations, drawn around the training's mean with 1.5 of its deviations."""


def measure(rover: str) -> dict[str, Any]:
    """Greatest errors of both graphs, and times of the exported folder's own node, ms."""
    path = shipped_policy(rover)
    assert path is not None, f"{rover} ships no policy"
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
        read = jax.export.deserialize(bytearray((folder / "policy.stablehlo").read_bytes()))
        other = np.asarray(read.call(obs))
    errors = {"onnx_error": np.stack(actions) - wanted, "stablehlo_error": other - wanted}
    spent = {"median_ms": np.median(times), "p99_ms": np.quantile(times, 0.99)}
    return {k: float(np.abs(v).max()) for k, v in errors.items()} | {k: float(v) for k, v in spent.items()}


def main() -> None:
    """Measures and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=KEPT / "export.json")
    out = parser.parse_args().out
    rows = {rover: measure(rover) for rover in ("luvmi_x", "viper")}
    say(json.dumps(rows))
    save(out.parent, out.stem, {"seed": SEED, "observations": COUNT, "rovers": rows})


if __name__ == "__main__":
    main()
