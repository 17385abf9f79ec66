"""Trains one policy and scores it on unseen ground; run it again to resume.

    python train/navigation.py large-td3 --out runs/large/seed0 --seed 0 --minutes 8 --eval-every 10 --target 0.95
    python train/navigation.py large-td3 --out runs/viper --env rover=viper --set envs=8192 batch=32768 updates=2

Writes `curve.json`, `curve.png`, `progress.csv`, TensorBoard events, checkpoints, `policy.npz` and `best_policy.npz`.
`--list` names the trainings; `--set` changes any field of a training's settings, `--env` any option of its environment.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

from lunar_mjx.agents.configs import TRAININGS, get_training, override
from lunar_mjx.agents.run import run_training
from lunar_mjx.agents.train import RunConfig
from lunar_mjx.commands.train import env_options, pairs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("training", nargs="?", default="large-td3")
    parser.add_argument("--out", type=Path, default=Path("runs/navigation"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, help="of this process; it saves and stops then")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--target", type=float, help="success rate on unseen ground at which to stop")
    parser.add_argument("--eval-every", type=float, default=15.0, help="s of training")
    parser.add_argument("--eval-episodes", type=int, default=512)
    parser.add_argument("--checkpoint-every", type=float, default=240.0, help="s; inf for none")
    parser.add_argument("--restart", action="store_true")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--env", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--list", action="store_true")
    args = parser.parse_args()
    if args.list:
        for name, training in TRAININGS.items():
            print(f"{name:12} {training.note}")
        return
    training = override(get_training(args.training), **pairs("--set", args.set))
    training = dataclasses.replace(training, options={**training.options, **env_options(args.env)})
    limit = None if args.minutes is None else 60.0 * args.minutes
    run = RunConfig(args.steps or training.steps, args.seed, limit, args.checkpoint_every, not args.restart)
    args.out.mkdir(parents=True, exist_ok=True)
    report = run_training(args.training, training, run, args.out, args.eval_every, args.eval_episodes, args.target)
    rows = report.record["rows"]
    steady = sorted(r["steps_per_s"] for r in rows[1:]) or [0.0]
    print(
        json.dumps(
            {
                "final": report.record["final"],
                "finished": report.result.finished,
                "train_s": rows[-1]["elapsed_s"],
                "median_steps_per_s": steady[len(steady) // 2],
            }
        )
    )


if __name__ == "__main__":
    main()
