"""The paper's own task with one rover per run, on CPU cores: part `paper` of rl_proof.py."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TRAININGS = ("paper-td3", "paper-ddpg")
_SIGNED = {"task": "consistent", "places": 1, "decimation": 100}
_STEADY = {
    "reward_scale": 0.01,
    "layer_norm": True,
    "n_step": 3,
    "actor_rate": 3e-4,
    "actor_layers": (256, 128),
    "critic_layers": (256, 128),
    "batch": 128,
    "buffer_steps": 60_000,
    "value_range": (-7.0, 6.2),
}
VARIANTS: dict[str, tuple[int, dict[str, Any], dict[str, Any], tuple[str, ...]]] = {
    "signed": (5, _SIGNED, {}, TRAININGS),
    "printed": (5, {"places": 1}, {}, TRAININGS),
    "drawn": (1, {"task": "consistent", "decimation": 100}, {}, TRAININGS),
    "scaled": (5, _SIGNED, {"reward_scale": 0.01}, TRAININGS),
    "slow actor": (4, _SIGNED, {"actor_rate": 1e-4}, TRAININGS[1:]),
    "scaled, slow actor": (4, _SIGNED, {"reward_scale": 0.01, "actor_rate": 1e-4}, TRAININGS[1:]),
    "scaled, layer norm, 3 steps": (4, _SIGNED, {"reward_scale": 0.01, "layer_norm": True, "n_step": 3}, TRAININGS[1:]),
    "steady": (5, _SIGNED, {**_STEADY, "gamma": 0.95}, TRAININGS),
    "steady, discount 0.99": (3, _SIGNED, _STEADY, TRAININGS[1:]),
    "scaled, discount 0.95": (3, _SIGNED, {"reward_scale": 0.01, "gamma": 0.95, "buffer_steps": 60_000}, TRAININGS[1:]),
    "ahead": (4, {**_SIGNED, "start_yaw": 0.5}, {}, TRAININGS[1:]),
}
"""Seeds, options of the environment, settings of the training, and the algorithms. `signed`: progress with its sign,
one predefined start and destination as in section V, acted on at 5 Hz. `printed`: the reward as printed, likewise, at
the task's 10 Hz; at 5 Hz and a discount of 0.99 driving on for ever would be worth more than arriving. `drawn`: start
and destination drawn for every episode. The others are `signed` with settings that might help: rewards scaled, a slower
actor, layer norm with returns of three steps, and a start that faces the destination within 0.5 rad. `steady`: a lone
critic's errors pile up as 1 / (1 - discount); progress pays at every step, so that a horizon of 20 steps (4 s) will do,
and targets stay below what arriving at once pays. The next two take that apart: the same with the long horizon, and the
short horizon alone."""
DEFAULT = ("signed", "printed", "drawn")
MAIN = "signed"
JUDGED_EVERY, JUDGED = 2500, 24
"""Steps between scores of the policy without noise, and their episodes."""


def paper_start(args: argparse.Namespace, seconds: float) -> list[dict[str, Any]]:
    """Starts one process per algorithm and seed, each on a core of its own; returns them."""
    folder = Path(tempfile.mkdtemp(prefix="rl_paper_"))
    cores = sorted(os.sched_getaffinity(0))
    jobs = [
        (variant, training, seed)
        for variant in args.variants
        for seed in range(VARIANTS[variant][0])
        for training in VARIANTS[variant][3]
    ]
    jobs = jobs[:2] if args.tiny else jobs
    # two cores are left to the process that drives the GPU
    free = cores[2:] if args.part == "all" and len(cores) > 2 else cores
    jobs = jobs[: max(2, len(free))]
    env = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "CUDA_VISIBLE_DEVICES": "",
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    }
    children = []
    for i, (variant, training, seed) in enumerate(jobs):
        out = folder / f"{list(VARIANTS).index(variant)}_{training}_{seed}"
        line = [
            sys.executable,
            str(Path(__file__).with_name("rl_proof.py")),
            "--part",
            "paper-child",
            "--training",
            training,
            "--first-seed",
            seed,
            "--seconds",
            seconds,
            "--out",
            out,
            "--core",
            free[i % len(free)],
            "--variants",
            variant,
            *(["--tiny"] if args.tiny else []),
        ]
        log = out.with_suffix(".log").open("w")
        process = subprocess.Popen([str(a) for a in line], env=env, stdout=log, stderr=log)
        children.append(
            {"variant": variant, "training": training, "seed": seed, "out": out, "process": process, "log": log}
        )
    print(f"paper: {len(jobs)} runs of {seconds:.0f} s on CPU cores", flush=True)
    return children


def paper_child(args: argparse.Namespace) -> None:
    """Runs of one or several seeds in a process of their own; the records are written anew every few seconds."""
    if args.core is not None:
        os.sched_setaffinity(0, {args.core})
    begin = time.monotonic()
    import jax
    import jax.numpy as jnp
    import numpy as np

    from lunar_mjx.agents.configs import get_training, override
    from lunar_mjx.agents.learner import EPISODE, Learner
    from lunar_mjx.agents.train import plain
    from lunar_mjx.envs import make

    _, changes, settings, _ = VARIANTS[args.variants[0]]
    training = override(get_training(args.training), **{"epoch_steps": 50 if args.tiny else 250, **settings})
    options = {**training.options, **changes}
    learner = Learner(make(training.environment, **options), training.train)
    seeds = range(args.first_seed, args.first_seed + args.together)
    records: list[dict[str, Any]] = [
        {
            "seed": seed,
            "train": plain(dataclasses.asdict(training.train)),
            "environment": plain(options),
            "episodes": {name: [] for name in (*EPISODE, "step")},
            "critic": {"step": [], "target": [], "loss": []},
            "without_noise": {"step": [], "success": []},
        }
        for seed in seeds
    ]
    # all seeds in one program, each with everything of its own
    epoch: Any = jax.jit(jax.vmap(learner._epoch, in_axes=(None, 0)), donate_argnums=1)
    state = jax.jit(jax.vmap(learner._init))(jnp.stack([jax.random.PRNGKey(seed) for seed in seeds]))
    judge, judged_every = judge_of(learner), 100 if args.tiny else JUDGED_EVERY
    steps, saved = 0, time.monotonic()
    while steps < (200 if args.tiny else training.steps) and time.monotonic() - begin < args.seconds:
        state, (numbers, found) = epoch(learner.env.params, state)
        numbers, found = jax.device_get((numbers, found))
        for i, record in enumerate(records):
            episodes, ended = record["episodes"], np.flatnonzero(found["done"][i, 0])
            for name in EPISODE:
                episodes[name] += found[name][i, 0, ended].astype(float).tolist()
            episodes["step"] += (steps + ended + 1.0).tolist()
            for name, value in (("step", steps), ("target", numbers["target"][i]), ("loss", numbers["critic_loss"][i])):
                record["critic"][name].append(float(value))
        steps += training.train.epoch_steps
        if steps % judged_every == 0:
            shares = jax.device_get(judge(learner.env.params, state.agent.actor, state.statistics))
            for record, share in zip(records, shares, strict=True):
                record["without_noise"]["step"].append(steps)
                record["without_noise"]["success"].append(float(share))
        if time.monotonic() - saved > 10.0 or steps == training.train.epoch_steps:
            saved = time.monotonic()
            keep(args.out / "record.json", records, steps, saved - begin)
    keep(args.out / "record.json", records, steps, time.monotonic() - begin)


def judge_of(learner: Any) -> Any:
    """A function of the environment's parameters, actors and statistics (leading axis: seed) to shares of successes."""
    import jax
    import jax.numpy as jnp

    from lunar_mjx.agents.learner import normalised
    from lunar_mjx.envs import split_keys

    env = learner.env

    def one(params: Any, actor: Any, statistics: Any) -> Any:
        def step(carry: Any, _: Any) -> Any:
            state, over, won = carry
            obs = state.obs
            if learner.config.normalise:
                obs = normalised(obs, statistics.mean["obs"], statistics.std["obs"])
            state = env.step(params, state, learner.agent.act(actor, obs))
            won = won | (state.done & ~over & (state.metrics["success"] > 0.0))
            return (state, over | state.done, won), None

        no = jnp.zeros(JUDGED, bool)
        begin = env.reset(params, split_keys(jax.random.PRNGKey(99), JUDGED))
        return jnp.mean(jax.lax.scan(step, (begin, no, no), length=env.episode_steps)[0][2])

    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))


def keep(path: Path, records: list[dict[str, Any]], steps: int, elapsed: float) -> None:
    """Writes records, whole at every moment; the time counts from the process' beginning, compilation included."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps([{**r, "steps": steps, "elapsed_s": elapsed} for r in records]), encoding="utf-8")
    part.replace(path)


def paper_merge(children: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """Waits for the runs, ends what is left, and puts their records together."""
    deadline = time.monotonic() + max(seconds, 1.0)
    runs: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for child in children:
        try:
            child["process"].wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            child["process"].kill()
            child["process"].wait()
        child["log"].close()
        path, what = child["out"] / "record.json", f"{child['variant']}, {child['training']}"
        if path.is_file():
            group = runs.setdefault(child["variant"], {}).setdefault(child["training"], [])
            group += json.loads(path.read_text(encoding="utf-8"))
        else:
            print(
                f"paper: {what} seed {child['seed']} left nothing: "
                f"{Path(child['log'].name).read_text(encoding='utf-8')[-600:]}",
                flush=True,
            )
    for variant, groups in runs.items():
        for name, found in groups.items():
            lasts = [r["episodes"]["success"][-50:] for r in found]
            print(
                f"paper: {variant}, {name}: steps {[r['steps'] for r in found]}, episodes "
                f"{[len(r['episodes']['success']) for r in found]}, success of the last 50 "
                f"{[round(sum(last) / max(1, len(last)), 2) for last in lasts]}",
                flush=True,
            )
    about = {v: {"options": VARIANTS[v][1], "settings": VARIANTS[v][2]} for v in (MAIN, *runs)}
    others = {v: {**about[v], "runs": found} for v, found in runs.items() if v != MAIN}
    return {"variant": MAIN, **about[MAIN], "runs": runs.get(MAIN, {}), "others": others}
