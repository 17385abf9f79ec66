"""Measures exported policies: how far their graphs are from the policy, and how long an action takes on one core.

python benchmarks/rl/export.py --out benchmarks/rl/export.json
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.export
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from benchmarks.provenance import commit
from benchmarks.rl.harness import save, say
from lunar_mjx.agents.export.write import NODE, export_policy
from lunar_mjx.agents.play import shipped_policy
from lunar_mjx.agents.policy import load_policy

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
    return {
        "onnx_error": float(np.abs(np.stack(actions) - wanted).max()),
        "stablehlo_error": float(np.abs(other - wanted).max()),
        "median_ms": float(np.median(times)),
        "p99_ms": float(np.quantile(times, 0.99)),
    }


def main() -> None:
    """Measures and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/rl/export.json"))
    args = parser.parse_args()
    rows = {rover: measure(rover) for rover in ("luvmi_x", "viper")}
    say(json.dumps(rows))
    save(args.out.parent, args.out.stem, {"commit": commit(), "seed": SEED, "observations": COUNT, "rovers": rows})


if __name__ == "__main__":
    main()
