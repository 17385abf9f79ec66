"""A shipped policy with sensors as rovers have them, which it was not trained with, beside exact ones.

    python benchmarks/rl/sensors.py --out runs/sensors               # 64 episodes a row: 3 minutes on two CPU cores
    python benchmarks/rl/sensors.py --episodes 1024 --out runs/sensors    # one GPU

Each row is what `lunar-mjx evaluate AGENT --episodes N --env delay=0.3 ...` scores: the same unseen ground, soils and
goals.
"""

from __future__ import annotations

from pathlib import Path

from harness import Clock, ends, in_time, options, percent, save, say

from benchmarks.provenance import tree
from lunar_mjx.agents.evaluate import Evaluator
from lunar_mjx.agents.play import open_agent
from lunar_mjx.agents.run import unseen_params

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
    about, rows = {"tree": tree(), "agent": args.agent, "seed": SEED}, {}
    for name in in_time(Clock(args.seconds or float("inf")), ROWS):
        env, act, unseen = open_agent(args.agent, options=ROWS[name])
        evaluator = Evaluator(env, lambda _, state, key, act=act: act(state, key), args.episodes)
        rows[name] = {"options": ROWS[name], "score": evaluator(unseen_params(env, unseen), (), SEED).record()}
        save(args.out, "sensors", {**about, "rows": rows})
        say(f"{name}: {percent(rows[name]['score'])}, {ends(rows[name]['score'])}")


if __name__ == "__main__":
    main()
