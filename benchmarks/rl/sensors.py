"""A shipped policy with sensors as rovers have them, which it was not trained with, beside exact ones.

    python benchmarks/rl/sensors.py --out runs/sensors               # 64 episodes a row: 3 minutes on two CPU cores
    python benchmarks/rl/sensors.py --episodes 1024 --out runs/sensors    # one GPU

Each row is what `lunar-mjx evaluate AGENT --episodes N --env delay=0.3 ...` writes: the same unseen ground, soils and
goals.
"""

from __future__ import annotations

from pathlib import Path

from harness import Clock, in_time, options, read, save

from benchmarks.provenance import tree
from lunar_mjx.commands.train import evaluate

ROWS = {
    "exact": {},
    "delay 0.3 s": {"delay": 0.3},
    "drift 2 %": {"drift": 0.02},
    "delay 0.3 s, drift 2 %": {"delay": 0.3, "drift": 0.02},
    "scan from a mast of 1 m": {"mast": 1.0},
}
"""Options of the environment by row."""
SEED = 54321
"""Of the episodes: that of `lunar-mjx evaluate`."""


def main() -> None:
    """Scores and writes after every row."""
    parser = options(__doc__, Path("runs/sensors"))
    parser.add_argument("--agent", default="luvmi_x")
    parser.add_argument("--episodes", type=int, default=64)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    about, rows, out = {"tree": tree(), "agent": args.agent, "seed": SEED}, {}, args.out / "row.json"
    for name in in_time(Clock(args.seconds or float("inf")), ROWS):
        evaluate(args.agent, None, args.episodes, SEED, env=[f"{k}={v}" for k, v in ROWS[name].items()], out=out)
        score = {k: v for k, v in read(out).items() if k != "agent"}
        rows[name] = {"options": ROWS[name], "score": score}
        save(args.out, "sensors", {**about, "rows": rows})


if __name__ == "__main__":
    main()
