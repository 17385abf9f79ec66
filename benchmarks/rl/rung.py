"""Trains on a rung of the ladder and scores the policy beside those that learn nothing, on the same unseen episodes.

    python benchmarks/rl/rung.py ladder-3 --seconds 500 --out runs/rung                # one GPU
    python benchmarks/rl/rung.py ladder-3 --seeds 1 2 3 4 --steps 60e6 --every inf --out runs/rung
    python benchmarks/rl/rung.py ladder-3 --tiny --seconds 400 --out runs/tiny         # the same code on two CPU cores
    python benchmarks/rl/rung.py --keep runs/rung/ladder-3.json                        # its seeds join the kept record
    python benchmarks/rl/rung.py --ship runs/rung/ladder-3_seed0.npz                   # to models/, with a card

Rows: the policy, the policy with all that comes from its scans blanked, straight ahead, the reactive rule as it was
tuned (`benchmarks/rl/ladder.json`), and `mapper`, which follows the way on the rover's own map if the policy is told
it. All rows are of one program, compiled beside the training's; all seeds use the same two. Each score writes
`NAME.json`, `NAME_seedN.npz` (best on the unseen worlds so far) and `NAME_seedN_last.npz`, so that a run that is cut
off leaves what it had. The final score is of other episodes than those by which the best was chosen; with
`--every inf` nothing is chosen. The documentation's tables of rungs are made from the kept records,
`benchmarks/rl/ladder-N.json`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from benchmarks.provenance import commit, tree
from benchmarks.rl.harness import DURING, FINAL, Clock, digits, in_threads, percent, save, say, write
from lunar_mjx.agents.configs import get_training, override
from lunar_mjx.agents.evaluate import score
from lunar_mjx.agents.learner import Learner, normalised
from lunar_mjx.agents.policy import load_policy, policy_of, save_policy
from lunar_mjx.agents.run import unseen_params
from lunar_mjx.agents.train import RunConfig, train
from lunar_mjx.envs import make, make_agent, split_keys
from lunar_mjx.envs.ladder.rungs import get_rung
from lunar_mjx.envs.scripted import Reactive, reactive_rule
from lunar_mjx.resources import shipped

SEES = ("height_scan", "far_scan", "plan")
"""Blocks that come from what the rover sees ahead."""
PIECE = 25
"""Control steps between looks at whether all episodes are over."""
TINY = {"envs": 16, "epoch_steps": 24, "minibatches": 2, "passes": 1}
"""What --tiny changes of the training."""
KEPT = ("steps", "elapsed_s", "steps_per_s", "success", "stuck")
"""Numbers of an epoch that the kept records hold."""


def tuned_rule(rung: int) -> Reactive:
    """The reactive rule's best settings on this rung, as measured; its own where there are none."""
    path = Path(__file__).parent / "ladder.json"
    tuned = json.loads(path.read_text(encoding="utf-8"))["tuned"] if path.is_file() else {}
    return Reactive(**tuned[str(rung)]["rows"][0]["settings"]) if str(rung) in tuned else Reactive()


class Rows:
    """Scores of several agents on the same episodes, one program for all policies of a learner.

    Args:
      env: the environment. learner: whose policy to score. params: of the environment, unseen. episodes: of each row.
    """

    def __init__(self, env: Any, learner: Learner, params: Any, episodes: int):
        self.env, self.params, self.episodes = env, params, episodes
        blank = np.zeros(env.observation_size, bool)
        for name in SEES:
            if name in env.blocks:
                blank[env.blocks[name]] = True
        rules = {
            "scripted": make_agent("scripted", env),
            "reactive, tuned": reactive_rule(env, tuned_rule(env.config.rung)),
        }
        if "plan" in env.blocks:
            rules["mapper"] = make_agent("mapper", env)
        self.names = ("policy", "policy, scans blanked", *rules)
        row = jnp.repeat(jnp.arange(len(self.names)), episodes)

        def act(policy: Any, state: Any, key: Any) -> Any:
            weights, statistics = policy
            mean = statistics[0] if statistics is not None else jnp.zeros(env.observation_size)
            obs = jnp.where((row == 1)[:, None] & blank, mean, state.obs)
            if statistics is not None:
                obs = normalised(obs, *statistics)
            chosen = learner.agent.act(weights, obs)
            for i, rule in enumerate(rules.values()):
                chosen = jnp.where((row == 2 + i)[:, None], rule(state, key), chosen)
            return chosen

        def piece(params: Any, policy: Any, carry: Any, key: Any) -> Any:
            def step(carry: Any, key: Any) -> Any:
                state, over, kept = carry
                state = env.step(params, state, act(policy, state, key))
                first = state.done & ~over
                kept = {k: jnp.where(first, state.metrics[k], v) for k, v in kept.items()}
                return (state, over | state.done, kept), None

            return jax.lax.scan(step, carry, jax.random.split(key, PIECE))[0]

        self._reset: Any = jax.jit(env.reset)
        self._piece: Any = jax.jit(piece)

    def _carry(self, state: Any) -> Any:
        zero = jnp.zeros(len(self.names) * self.episodes)
        blank = {k: zero for k in state.metrics if not k.startswith("reward_")}
        return state, zero.astype(bool), blank

    def compile(self, policy: Any) -> None:
        """Compiles ahead; `policy` as of `Learner.policy`, shapes suffice."""
        policy = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), policy)
        keys = jax.ShapeDtypeStruct((len(self.names) * self.episodes, 2), jnp.uint32)
        carry = jax.eval_shape(self._carry, jax.eval_shape(self.env.reset, self.params, keys))
        self._reset = self._reset.lower(self.params, keys).compile()
        self._piece = self._piece.lower(self.params, policy, carry, jax.random.PRNGKey(0)).compile()

    def __call__(self, policy: Any, seed: int) -> dict[str, dict[str, Any]]:
        """Rows by agent."""
        policy = jax.device_put(jax.device_get(policy))
        key_reset, key = jax.random.split(jax.random.PRNGKey(seed))
        carry = self._carry(
            self._reset(self.params, jnp.tile(split_keys(key_reset, self.episodes), (len(self.names), 1)))
        )
        for i in range(-(-self.env.episode_steps // PIECE)):
            carry = self._piece(self.params, policy, carry, jax.random.fold_in(key, i))
            if bool(carry[1].all()):
                break
        told = {k: np.asarray(v).reshape(len(self.names), self.episodes) for k, v in carry[2].items()}
        interval = self.env.control_interval
        return {
            name: dataclasses.asdict(score({k: v[i] for k, v in told.items()}, interval))
            for i, name in enumerate(self.names)
        }


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("training", nargs="?", default="ladder-3", help="a shipped training of the ladder, or a file like it")
    add("--out", type=Path, default=Path("runs/rung"))
    add("--name", help="of the files; the training's unless told")
    add("--learner", help="another algorithm than the file's")
    add("--seconds", type=float, default=500.0, help="for everything, compiling and the last score among it")
    add("--last", type=float, default=70.0, help="of them kept for the last two scores")
    add("--steps", type=float, help="of the environment, of each seed; the training's own unless told")
    add("--target", type=float, help="success of the policy at which the training stops")
    add("--every", type=float, default=90.0, help="s of training between scores; inf: the final one alone")
    add("--episodes", type=int, default=256, help="of each row")
    add("--seeds", type=int, nargs="+", default=[0], help="one after another, as many as there is time for")
    add("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings of the training")
    add("--env", nargs="*", default=[], metavar="NAME=VALUE", help="options of the environment, as JSON")
    add("--tiny", action="store_true", help="small enough for two CPU cores")
    add("--keep", type=Path, nargs="+", metavar="JSON", help="train nothing; add the seeds of these to the kept record")
    add(
        "--ship", type=Path, metavar="NPZ", help="train nothing; a policy of the kept record goes to its rover's folder"
    )
    return parser.parse_args()


def told(value: str) -> Any:
    """An option's value: JSON, or the text itself."""
    try:
        found = json.loads(value)
    except json.JSONDecodeError:
        return value
    return tuple(found) if isinstance(found, list) else found


def keep(paths: list[Path], home: Path = Path(__file__).parent) -> Path:
    """The kept record of a training, with the finished seeds of further runs in it; a seed told twice is the later's.

    Raises:
      ValueError: runs of different trainings, environments or settings.
    """
    records = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    home = home / f"{records[0]['training']}.json"
    if home.is_file():
        records.insert(0, json.loads(home.read_text(encoding="utf-8")))
    first, seeds = records[0], {}
    for record in records:
        for same in ("training", "environment", "train"):
            if record[same] != first[same]:
                raise ValueError(f"{home.name}: {same} is not the same in all runs: {first[same]}; {record[same]}")
        about = {k: record[k] for k in ("commit", "tree", "worlds_s", "compile_s") if k in record}
        for run in record["seeds"]:
            if "final" in run:
                epochs = [{k: row[k] for k in KEPT if k in row} for row in run["epochs"]]
                seeds[run["seed"]] = {"device": record["about"]["device"], **about, **run, "epochs": epochs}
    kept = {k: first[k] for k in ("about", "training", "environment", "train", "learner")}
    write(home, digits({**kept, "seeds": [seeds[n] for n in sorted(seeds)]}))
    return home


CARD = """# Policy of {rover} for rung {rung} of the ladder

`{training}.npz` ({size:.2f} MB): weights, observation statistics and the environment's options, without pickles.

    lunar-mjx play {rover}/{training}
    lunar-mjx evaluate {rover}/{training}

**Task.** `ladder/{rung}`: {note}; goals {near:.0f} to {far:.0f} m away. Options: `{options}`.

**Training.** {learner}, {envs:,} rovers in {worlds} worlds, seed {seed}: {steps:.0f} M environment steps in
{elapsed_s:.0f} s on one {device}, after {worlds_s:.0f} s for the worlds and {compile_s:.0f} s of compiling.
Commit {commit}. Script: `benchmarks/rl/rung.py {training}`; record: `benchmarks/rl/{training}.json`.

**Score** in worlds and soil never trained on (`{unseen}`), {episodes} episodes, 95 % Wilson interval:

| agent | success | weighted by path length | collisions/km | W h/km | mean slip |
|---|---|---|---|---|---|
{rows}

Ends of this policy's episodes: {ends}.

**Limits.** It is told `plan`: the way on a map that the rover draws while it drives, from the true ground within its
view, at its exact pose. It learns to drive along that way, not to map: the rule `mapper`, which learns nothing, arrives
about as often. Trained in simulation only. It has driven no real rover.
"""


def ship(path: Path) -> Path:
    """Copies a policy of the kept record into its rover's folder and writes its card; returns the copy."""
    policy = load_policy(path)
    seed, options = policy.notes["seed"], policy.environment["options"]
    training = path.stem.partition("_")[0]
    record = json.loads((Path(__file__).parent / f"{training}.json").read_text(encoding="utf-8"))
    run = next(r for r in record["seeds"] if r["seed"] == seed)
    assert run["final"]["steps"] == policy.notes["steps"], f"{path}: not the policy that the kept record scores"
    rows = run["final"]["rows"]
    rover = options.get("rover", "luvmi_x")
    number = int(options["task"].rpartition("/")[2])
    home = shipped("models") / rover / f"{training}.npz"
    shutil.copyfile(path, home)
    lines = [
        f"| {name} | {percent(r)} | {r['spl']:.2f} | {r['collisions_per_km']:.0f} | {r['wh_per_km']:.0f} "
        f"| {r['slip']:.2f} |"
        for name, r in {"this policy": rows["policy"], **rows}.items()
        if name != "policy"
    ]
    text = CARD.format(
        rover=rover,
        training=training,
        rung=number,
        note=get_rung(number).note,
        near=get_rung(number).goal_distance[0],
        far=get_rung(number).goal_distance[1],
        size=home.stat().st_size / 1e6,
        options=json.dumps(options),
        learner=record["learner"].removesuffix("Config"),
        envs=record["train"]["envs"],
        worlds=record["environment"]["options"]["worlds"],
        seed=seed,
        steps=run["final"]["steps"] / 1e6,
        elapsed_s=run["final"]["elapsed_s"],
        device=run["device"],
        worlds_s=run["worlds_s"],
        compile_s=max(run["compile_s"]),
        commit=run["commit"],
        unseen=json.dumps(record["environment"]["unseen"]),
        episodes=rows["policy"]["episodes"],
        rows="\n".join(lines),
        ends=json.dumps({k: round(v, 4) for k, v in rows["policy"]["ends"].items()}),
    )
    home.with_suffix(".md").write_text(text, encoding="utf-8")
    return home


class Trials:
    """Trainings from several seeds with the same two programs.

    Args:
      args: the command line. training: what to train.
    """

    def __init__(self, args: argparse.Namespace, training: Any):
        self.args, self.clock = args, Clock(args.seconds)
        files = {"commit": commit(), "tree": tree()}
        more: Mapping[str, Any] = {k: told(v) for k, v in (pair.split("=", 1) for pair in args.env)}
        if args.tiny:
            names = {f.name for c in (training.train, training.train.algorithm) for f in dataclasses.fields(c)}
            training = override(training, **{k: v for k, v in TINY.items() if k in names})
            more, args.episodes = {"worlds": 2, "episode_time": 20.0, **more}, min(args.episodes, 2)
        settings = {**training.options, **more}
        self.steps = int(args.steps or training.steps)
        self.name = args.name or Path(args.training).stem
        args.out.mkdir(parents=True, exist_ok=True)
        env = make(training.environment, **settings)
        worlds_s = self.clock.spent
        self.learner = learner = Learner(env, training.train)

        def prepare() -> None:
            self.rows = Rows(env, learner, unseen_params(env, training.unseen), args.episodes)
            self.rows.compile(jax.eval_shape(learner.policy, learner.abstract()))

        self.rows: Rows
        compile_s = in_threads(learner.compile, prepare)
        say(f"worlds {worlds_s:.0f} s, compiled after {compile_s}, {self.clock.left:.0f} s left")
        self.environment = {"name": training.environment, "options": settings, "unseen": dict(training.unseen)}
        self.record: dict[str, Any] = {
            **files,
            "training": self.name,
            "environment": self.environment,
            "train": dataclasses.asdict(training.train),
            "learner": type(training.train.algorithm).__name__,
            "worlds_s": worlds_s,
            "compile_s": compile_s,
            "seeds": [],
        }

    def store(self, seed: int, state: Any, row: Mapping[str, Any], score: Any, word: str = "") -> None:
        """Writes the policy of a state; `word` ends the file's name."""
        # whoever drives the policy makes as many worlds as the rung has, not all that it was trained in
        options = {k: v for k, v in self.environment["options"].items() if k != "worlds"}
        notes = {"score": score, "seed": seed, "commit": self.record["commit"], "tree": self.record["tree"]}
        notes |= {k: row[k] for k in ("steps", "elapsed_s")}
        policy = policy_of(self.learner, state, {**self.environment, "options": options}, notes)
        save_policy(policy, self.args.out / f"{self.name}_seed{seed}{word}.npz")

    def __call__(self, seed: int) -> None:
        """Trains and scores one seed."""
        args, learner = self.args, self.learner
        run: dict[str, Any] = {"seed": seed, "scores": [], "epochs": []}
        self.record["seeds"].append(run)
        best, due = {"success": -1.0}, [args.every]
        chosen: list[Any] = []

        def look(state: Any, row: Mapping[str, Any]) -> None:
            begin = time.monotonic()
            policy = jax.device_get(learner.policy(state))
            found = self.rows(policy, DURING)
            run["scores"].append({"steps": row["steps"], "elapsed_s": row["elapsed_s"], "seed": DURING, "rows": found})
            self.store(seed, state, row, found["policy"], "_last")
            if found["policy"]["success"] > best["success"]:
                best["success"] = found["policy"]["success"]
                chosen[:] = [policy, row]
                self.store(seed, state, row, found["policy"])
            save(args.out, self.name, self.record)
            say(f"{row['steps']:.3g} steps, {row['elapsed_s']:.0f} s: scored in {time.monotonic() - begin:.0f} s")
            shown(found, "    ")

        def after_epoch(_: Learner, state: Any, row: dict[str, Any]) -> dict[str, Any]:
            run["epochs"].append({k: row[k] for k in row if not k.startswith("reward_")})
            if row["elapsed_s"] >= due[0]:
                look(state, row)
                due[0] = row["elapsed_s"] + args.every
            there = args.target is not None and best["success"] >= args.target
            return {"stop": there or self.clock.left < args.last}

        result = train(learner, RunConfig(self.steps, seed, quiet=True), None, self.environment, after_epoch)
        last = result.rows[-1]
        if math.isinf(args.every):
            chosen = [jax.device_get(learner.policy(result.state)), last]
        elif not run["scores"] or run["scores"][-1]["steps"] < last["steps"]:
            look(result.state, last)
        policy, row = chosen
        found = self.rows(policy, FINAL)
        run["final"] = {"steps": row["steps"], "elapsed_s": row["elapsed_s"], "seed": FINAL, "rows": found}
        if math.isinf(args.every):
            self.store(seed, result.state, row, found["policy"])
        save(args.out, self.name, self.record)
        shown(found, f"seed {seed} final ")
        say(f"done after {self.clock.spent:.0f} s, {last['steps']:.3g} steps, {last['steps_per_s']:.3g} steps/s")


def shown(rows: Mapping[str, Any], before: str) -> None:
    """Prints the rows of a score."""
    for agent, one in rows.items():
        ends = {k: round(v, 3) for k, v in one["ends"].items() if v}
        say(f"{before}{agent}: {percent(one)}, SPL {one['spl']:.2f}, {one['collisions_per_km']:.0f}/km, {ends}")


def main() -> None:
    """Trains, scores and writes."""
    args = options()
    if args.keep:
        say(str(keep(args.keep)))
    if args.ship:
        say(str(ship(args.ship)))
    if args.keep or args.ship:
        return
    training = get_training(args.training, args.learner)
    trials = Trials(args, override(training, **dict(pair.split("=", 1) for pair in args.set)))
    longest = 0.0
    for seed in args.seeds:
        # a seed that would be cut short is no equal of the others
        if trials.clock.left < longest:
            say(f"no time for seed {seed}: {trials.clock.left:.0f} s left")
            break
        begin = trials.clock.spent
        trials(seed)
        longest = max(longest, trials.clock.spent - begin)


if __name__ == "__main__":
    main()
