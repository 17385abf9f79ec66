"""What training costs and what it comes to, measured in one command; every part saves as it goes.

    python benchmarks/rl_proof.py --out runs/proof                       # all parts in 9 minutes on one GPU
    python benchmarks/rl_proof.py --out runs/proof --part large --seconds 300 --rover viper
    python benchmarks/rl_proof.py --out runs/tiny --tiny                 # the same code on two CPU cores

Parts, each with its own JSON file:
`large`: TD3 from thousands of rovers, scored on unseen ground, goals and soil, seed after seed while time is left;
zero, random and straight-line agents on the same episodes; learner updates per second; the best policy as .npz.
`rates`: environment steps per second, with observation, reward, reset and randomisation, against the bare physics.
`paper`: TD3 and DDPG on the paper's own task with one rover each, five seeds each, on CPU cores beside the GPU.
`scaling`: steps of whole training per second on 1, 2, 4, ... devices of the host, the same share for each device.
`brax`: brax's PPO and SAC in the same environment, with the same scores.
`realism`: TD3 trained with and without the thermal and soil effects, each scored with and without them.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rl_brax import brax
from rl_common import Clock, save, say
from rl_large import large, training_of
from rl_paper import DEFAULT, VARIANTS, paper_child, paper_merge, paper_start
from rl_realism import realism

PERIOD = {
    "all": 535.0,
    "large": 300.0,
    "rates": 200.0,
    "paper": 400.0,
    "scaling": 150.0,
    "brax": 340.0,
    "realism": 300.0,
}
"""s that each part may take."""


# Rates of the environment


def rates(args: argparse.Namespace, clock: Clock) -> None:
    """Compiles every row in threads, waits for quiet if told to, and measures."""
    from lunar_mjx.envs import make_navigation
    from lunar_mjx.envs.navigation.observations import PAPER_OBSERVATION

    ground = {"terrain": "flat", "goal_distance": (2.0, 4.0), "places": 256} if args.tiny else {}
    few = {"observations": PAPER_OBSERVATION, "privileged": ()}
    plan = [
        ("17 numbers", 5, 65536),
        ("all observations", 50, 65536),
        ("17 numbers", 5, 1024),
        ("17 numbers", 5, 2048),
        ("17 numbers", 5, 4096),
        ("17 numbers", 5, 8192),
        ("17 numbers", 5, 16384),
        ("17 numbers", 5, 32768),
        ("17 numbers", 50, 65536),
        ("all observations", 5, 65536),
        ("all observations", 50, 4096),
        ("17 numbers", 5, 262144),
    ]
    plan = [row for row in plan if args.rows is None or f"{row[0][:2]}/{row[1]}/{row[2]}" in args.rows]
    plan = [("17 numbers", 5, 8)] if args.tiny else plan
    made: dict[tuple[str, int], Any] = {}
    for label, decimation, _ in plan:
        options = {"decimation": decimation, "places": 2048, **(few if label == "17 numbers" else {}), **ground}
        if (label, decimation) not in made:
            made[label, decimation] = make_navigation("large", args.rover, **options)
    with ThreadPoolExecutor(8) as pool:
        waits = [
            pool.submit(Rate, made[label, decimation], size, 4 if args.tiny else max(20, 1000 // decimation))
            for label, decimation, size in plan
        ]
        ready = [w.result() for w in waits]
    say(f"rates: {len(ready)} rows compiled after {clock.spent:.0f} s")
    wait(args, clock)
    rows: list[dict[str, Any]] = []
    for (label, decimation, size), rate in zip(plan, ready, strict=True):
        if clock.left < 2.0:
            say("rates: no time for more")
            return
        row = rate.measure(1 if args.tiny else 5)
        rows.append({"observation": label, "decimation": decimation, "rovers": size, **row})
        say(
            f"rates: {label}, decimation {decimation}, {size:,} rovers: "
            f"{row['env_steps_per_s']:,.0f} environment steps/s, bare physics {row['bare_steps_per_s']:,.0f}, "
            f"ratio {row['ratio']:.3f}"
        )
        save(args.out, "rates", {"rover": args.rover, "rows": rows})


def wait(args: argparse.Namespace, clock: Clock) -> None:
    """Until the file of --wait-for is there, or time is up."""
    while args.wait_for is not None and not args.wait_for.exists() and clock.left > 0.0:
        time.sleep(0.5)


class Rate:
    """The environment under random actions, and its physics alone under the same changes; compiled when made."""

    def __init__(self, env: Any, size: int, steps: int):
        import jax
        import jax.numpy as jnp

        self.env, self.size, self.steps = env, size, steps
        decimation, key = env.config.decimation, jax.random.PRNGKey(0)

        def drive(params: Any, state: Any) -> Any:
            def step(carry: Any, key: Any) -> Any:
                state, ended = carry
                action = jax.random.uniform(key, (size, env.action_size), minval=-1.0)
                state = env.step(params, state, action)
                # each rover counts: a sum over all, XLA fuses with the environment's last kernel, run by one block then
                return (state, ended + state.done), None

            start = (state, jnp.zeros(size, jnp.int32))
            (state, ended), _ = jax.lax.scan(step, start, jax.random.split(key, steps))
            return state, jnp.sum(ended)

        shares = jax.random.uniform(key, (steps, env.action_size), minval=-1.0)
        controls = env.actions.controls(shares)

        def bare(params: Any, state: Any) -> Any:
            return env.system.rollout_batch(params.system, state, controls, decimation, report=lambda t: None)[0]

        keys = jax.ShapeDtypeStruct((size, 2), jnp.uint32)
        state = jax.eval_shape(env.reset, env.params, keys)
        self._reset = jax.jit(env.reset).lower(env.params, keys).compile()
        self._drive = jax.jit(drive, donate_argnums=1).lower(env.params, state).compile()
        self._bare = jax.jit(bare, donate_argnums=1).lower(env.params, state.inner.physics).compile()

    def measure(self, repeats: int) -> dict[str, Any]:
        """Best of several repetitions, in turns."""
        import jax
        import jax.numpy as jnp

        from lunar_mjx.envs import split_keys

        params = self.env.params
        state = jax.block_until_ready(self._reset(params, split_keys(jax.random.PRNGKey(0), self.size)))
        # episodes at every stage, so that as many end in one step as in the next
        share = jax.random.uniform(jax.random.PRNGKey(1), (self.size,))
        inner = dataclasses.replace(state.inner, waited=share * self.env.config.stuck_time)
        state = dataclasses.replace(state, inner=inner)
        physics = jax.tree.map(jnp.copy, state.inner.physics)
        held = sum(leaf.nbytes for leaf in jax.tree.leaves(state)) / self.size
        ours, naked, ended = [], [], 0
        for _ in range(repeats + 1):
            begin = time.monotonic()
            state, ended = jax.block_until_ready(self._drive(params, state))
            middle = time.monotonic()
            physics = jax.block_until_ready(self._bare(params, physics))
            ours.append(middle - begin)
            naked.append(time.monotonic() - middle)
        best, bare = min(ours[1:]), min(naked[1:])
        memory = self._drive.memory_analysis()
        return {
            "env_steps_per_s": self.size * self.steps / best,
            "physics_steps_per_s": self.size * self.steps * self.env.config.decimation / best,
            "bare_steps_per_s": self.size * self.steps / bare,
            "ratio": bare / best,
            "resets_per_step": int(ended) / self.steps,
            "seconds": ours[1:],
            "bare_seconds": naked[1:],
            "state_bytes_per_rover": held,
            "temporary_bytes_per_rover": getattr(memory, "temp_size_in_bytes", 0) / self.size,
        }


# Several devices


def scaling(args: argparse.Namespace, clock: Clock) -> None:
    """Whole training epochs per second on more and more devices, the same rovers and transitions on each."""
    import jax
    import numpy as np
    from jax.sharding import Mesh

    from lunar_mjx.agents.learner import AXIS, Learner
    from lunar_mjx.envs import make

    training = training_of(args)
    env = make(training.environment, **training.options)
    counts = [2**i for i in range(jax.device_count().bit_length())]
    learners = {}
    for count in counts:
        config = dataclasses.replace(
            training.train, envs=training.train.envs * count, batch=training.train.batch * count
        )
        learners[count] = Learner(env, config, Mesh(np.array(jax.devices()[:count]), (AXIS,)))
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda learner: learner.compile(), learners.values()))
    say(f"scaling: compiled after {clock.spent:.0f} s")
    wait(args, clock)
    rows: list[dict[str, Any]] = []
    for count, learner in learners.items():
        config = learner.config
        state = learner.init(0)
        best = float("inf")
        for i in range(2 if args.tiny else 9):
            begin = time.monotonic()
            state, _ = jax.block_until_ready(learner.epoch(env.params, state))
            if i:
                best = min(best, time.monotonic() - begin)
        rate = config.envs * config.epoch_steps / best
        rows.append(
            {
                "devices": count,
                "steps_per_s": rate,
                "updates_per_s": config.updates * config.epoch_steps / best,
                "efficiency": rate / count / (rows[0]["steps_per_s"] if rows else rate),
            }
        )
        say(f"scaling: {count} devices, {rate:,.0f} steps/s, efficiency {rows[-1]['efficiency']:.3f}")
        save(args.out, "scaling", {"rover": args.rover, "rows": rows})
        del state


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--part", choices=(*PERIOD, "paper-child"), default="all")
    parser.add_argument("--seconds", type=float, help="that the part may take")
    parser.add_argument("--tiny", action="store_true", help="small enough for two CPU cores")
    parser.add_argument("--rover", default="luvmi_x")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=2_000_000_000, help="most environment steps of a seed")
    parser.add_argument("--seed-seconds", type=float, default=150.0, help="most s of one seed of part large")
    parser.add_argument("--eval-every", type=float, default=15.0, help="s of training")
    parser.add_argument(
        "--compare",
        nargs="*",
        default=[],
        metavar="NAME=VALUE",
        help="other settings of part large, trained if the first miss the target",
    )
    parser.add_argument("--target", type=float, default=0.95)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings of the training")
    parser.add_argument("--env", nargs="*", default=[], metavar="NAME=VALUE", help="options of the environment")
    parser.add_argument("--unseen-terrain", help="on which policies are scored, such as world:heldout_boulders")
    parser.add_argument("--only", nargs="*", help="of part realism, such as 3/with 4/without (seed/effects)")
    parser.add_argument("--training", default="paper-td3", help="of part paper-child")
    parser.add_argument("--rows", nargs="*", help="of part rates, such as 17/5/65536 (numbers/decimation/rovers)")
    parser.add_argument("--variants", nargs="*", default=list(DEFAULT), choices=list(VARIANTS), help="of part paper")
    parser.add_argument("--together", type=int, default=1, help="seeds in one program of part paper-child")
    parser.add_argument("--core", type=int, help="CPU core of part paper-child")
    parser.add_argument("--wait-for", type=Path, help="parts rates and scaling measure once this file is there")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    clock = Clock(args.seconds or PERIOD.get(args.part, 60.0))
    if args.tiny:
        args.seeds, args.steps, args.eval_every = min(args.seeds, 2), min(args.steps, 4000), 1.0
    if args.part == "paper-child":
        paper_child(args)
        return
    children = []
    if args.part in ("all", "paper"):
        children = paper_start(args, clock.left - 25.0)
    try:
        if args.part in ("all", "large"):
            large(args, Clock(0.7 * clock.left if args.part == "all" else clock.left))
        if args.part in ("all", "rates"):
            rates(args, Clock(clock.left - 15.0))
        for name, function in (("scaling", scaling), ("brax", brax), ("realism", realism)):
            if args.part == name:
                function(args, clock)
    finally:
        if children:
            save(args.out, "paper", paper_merge(children, clock.left))
    say(f"done in {clock.spent:.0f} s")


if __name__ == "__main__":
    main()
