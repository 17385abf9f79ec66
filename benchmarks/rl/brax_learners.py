"""Part `brax` of measure.py: brax's PPO and SAC on the task `large`, scored as TD3 is.

Both see what the policy of TD3 sees; brax's critics get nothing privileged. Time is brax's own count of training,
without scores and, for the first epoch, without compilation.
"""

from __future__ import annotations

import argparse
import functools
import sys
import threading
import time
import tomllib
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

from harness import DURING, FINAL, Clock, episodes_of, percent, save, say, training_of

SETTINGS = tomllib.loads(Path(__file__).with_name("brax_settings.toml").read_text(encoding="utf-8"))
LAYERS = (512, 256, 128)


def prepare() -> None:
    """Lets brax's trainers run with a newer JAX, and where orbax is not whole: nothing is checkpointed here."""
    import jax
    import jax.numpy as jnp

    if not hasattr(jax, "device_put_replicated"):

        def replicate(tree: Any, devices: Any) -> Any:
            return jax.tree.map(lambda leaf: jnp.stack([leaf] * len(devices)), tree)

        jax.device_put_replicated = replicate
    try:
        import orbax.checkpoint  # noqa: F401
    except ImportError:
        for name in ("", "agents.ppo.", "agents.sac."):
            sys.modules[f"brax.training.{name}checkpoint"] = types.ModuleType("checkpoint")


class OutOfTime(Exception):
    """Ends a training of brax, which has no end of its own but its steps."""


class Watch:
    """Takes the place of brax's evaluator: keeps the parameters, so that the judge of this benchmark scores them."""

    last: Any = None

    def __init__(self, eval_env: Any, eval_policy_fn: Any, **_: Any):
        self.make, self.params = eval_policy_fn, None
        Watch.last = self

    def run_evaluation(self, policy_params: Any, training_metrics: Any, **_: Any) -> dict[str, Any]:
        self.params = policy_params
        return dict(training_metrics)

    def act(self, params: Any, state: Any, key: Any) -> Any:
        return self.make(params)(state.obs, key)[0]


class Scores:
    """One training: what is called after every epoch, and what it came to."""

    def __init__(
        self,
        name: str,
        task: tuple[Any, Any, int],
        seconds: float,
        target: float,
        keep: Callable[[dict[str, Any]], None],
    ):
        self.name, self.task, self.target, self.keep = name, task, target, keep
        self.clock, self.rows, self.seconds = Clock(seconds), [], []
        self._walltime, self._judge, self._compiling = 0.0, None, None

    def progress(self, steps: int, metrics: dict[str, Any]) -> None:
        """Scores the policy; the first call, before any training, compiles the judge beside brax's own compiling."""
        from lunar_mjx.agents.evaluate import Evaluator

        env, unseen, episodes = self.task
        if self._judge is None:
            self._judge = Evaluator(env, Watch.last.act, episodes)
            self._compiling = threading.Thread(target=self._judge.compile, args=(unseen, Watch.last.params))
            self._compiling.start()
            return
        walltime = float(metrics["training/walltime"])
        self.seconds.append(walltime - self._walltime)
        self._walltime = walltime
        self._compiling.join()
        score = self.score(DURING)
        self.rows.append({"steps": int(steps), **score})
        record = self.record()
        say(f"{self.name}: {record['unseen'][-1]['elapsed_s']:.1f} s, {int(steps):,} steps, unseen {percent(score)}")
        self.keep(record)
        if self.clock.left < 0.0:
            raise OutOfTime

    def score(self, seed: int) -> dict[str, Any]:
        """Score of the last parameters."""
        assert self._judge is not None
        return self._judge(self.task[1], Watch.last.params, seed).record()

    def record(self) -> dict[str, Any]:
        """The scores; the first epoch, which compiles, counts like the quickest of the others."""
        rest = self.seconds[1:]
        times = [(min(rest) if rest else float("nan")) + sum(rest[:i]) for i in range(len(self.rows))]
        rows = [{**row, "elapsed_s": t} for row, t in zip(self.rows, times, strict=True)]
        reached = next((r for r in rows if r["success"] >= self.target), None)
        return {
            "unseen": rows,
            "first_epoch_s": self.seconds[0] if self.seconds else None,
            "seconds_to_target": reached and reached["elapsed_s"],
            "steps_to_target": reached and reached["steps"],
            "process_s": self.clock.spent,
        }


def run(name: str, env: Any, settings: dict[str, Any], seed: int, per_epoch: int, scores: Scores) -> None:
    """Trains with one of brax's learners until time is up."""
    from brax.training import acting
    from brax.training.agents.ppo import networks as ppo_networks
    from brax.training.agents.ppo import train as ppo
    from brax.training.agents.sac import networks as sac_networks
    from brax.training.agents.sac import train as sac

    from lunar_mjx.envs.brax_env import BraxEnv, wrap

    theirs, epochs = acting.Evaluator, 5000
    if name == "ppo":
        module, layers = ppo, {"policy_hidden_layer_sizes": LAYERS, "value_hidden_layer_sizes": LAYERS}
        networks: Any = functools.partial(ppo_networks.make_ppo_networks, **layers)
        step = settings["batch_size"] * settings["num_minibatches"] * settings["unroll_length"]
    else:
        module, norm = sac, {"policy_network_layer_norm": True, "q_network_layer_norm": True}
        networks = functools.partial(sac_networks.make_sac_networks, hidden_layer_sizes=LAYERS, **norm)
        step = settings["num_envs"]
    acting.Evaluator = Watch  # pyright: ignore[reportAttributeAccessIssue]
    try:
        module.train(
            BraxEnv(env),
            num_timesteps=epochs * per_epoch * step,
            num_evals=epochs + 1,
            episode_length=env.episode_steps,
            wrap_env_fn=wrap,
            network_factory=networks,
            seed=seed,
            deterministic_eval=True,
            max_devices_per_host=1,
            progress_fn=scores.progress,
            num_eval_envs=1,
            **settings,
        )
    except OutOfTime:
        pass
    finally:
        acting.Evaluator = theirs


def brax(args: argparse.Namespace, clock: Clock) -> None:
    """PPO, then SAC, each for half of the time that is left."""
    prepare()
    from lunar_mjx.agents.run import unseen_params
    from lunar_mjx.envs import make

    training = training_of(args)
    env = make(training.environment, **training.options)
    task = (env, unseen_params(env, dict(training.unseen)), episodes_of(args))
    runs: dict[str, Any] = {}
    for i, name in enumerate(("ppo", "sac")):
        settings = {**SETTINGS[name], **(SETTINGS["tiny"][name] if args.tiny else {})}

        def keep(record: dict[str, Any], name: str = name, settings: dict[str, Any] = settings) -> None:
            about = {"settings": settings, "layers": LAYERS, "seed": args.first_seed}
            runs[name] = {**runs.get(name, {}), **about, **record}
            save(args.out, "brax", {"rover": args.rover, "target": args.target, "runs": runs})

        scores, begin = Scores(name, task, clock.left / (2 - i) - 8.0, args.target, keep), time.monotonic()
        try:
            run(name, env, settings, args.first_seed, 3 if args.tiny else SETTINGS["per_epoch"][name], scores)
            keep({**scores.record(), "final": scores.score(FINAL)})
            say(f"{name}: at the end {percent(runs[name]['final'])}, {time.monotonic() - begin:.0f} s in all")
        except Exception as error:  # the other one still runs
            say(f"{name}: {type(error).__name__}: {error}")
            keep({**scores.record(), "error": f"{type(error).__name__}: {error}"})
