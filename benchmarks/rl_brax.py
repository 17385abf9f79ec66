"""Part `brax` of rl_proof.py: brax's PPO and SAC on the task `large`, scored as TD3 is.

Both see what the policy of TD3 sees; brax's critics get nothing privileged. Their settings are written down below, set
once and not tuned; time is brax's own count of training, without scores and, for the first epoch, without compilation.
"""

from __future__ import annotations

import argparse
import functools
import sys
import threading
import time
import types
from collections.abc import Callable
from typing import Any

from rl_common import Clock, save, say
from rl_large import DURING, FINAL, percent, training_of

PPO = {
    "num_envs": 8192,
    "unroll_length": 24,
    "batch_size": 2048,
    "num_minibatches": 4,
    "num_updates_per_batch": 5,
    "learning_rate": 3e-4,
    "learning_rate_schedule": "ADAPTIVE_KL",
    "desired_kl": 0.01,
    "entropy_cost": 0.005,
    "discounting": 0.995,
    "gae_lambda": 0.95,
    "clipping_epsilon": 0.2,
    "max_grad_norm": 1.0,
    "reward_scaling": 0.01,
    "normalize_observations": True,
}
"""As rovers and legged robots are commonly trained by the thousand (Rudin et al. 2022)."""
SAC = {
    "num_envs": 8192,
    "batch_size": 8192,
    "grad_updates_per_step": 8,
    "learning_rate": 3e-4,
    "discounting": 0.995,
    "tau": 0.05,
    "reward_scaling": 0.1,
    "min_replay_size": 8192 * 16,
    "max_replay_size": 8192 * 128,
    "normalize_observations": True,
}
LAYERS = (512, 256, 128)
PER_EPOCH = {"ppo": 40, "sac": 300}
"""Training steps between two scores."""


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
        for name in (
            "brax.training.checkpoint",
            "brax.training.agents.ppo.checkpoint",
            "brax.training.agents.sac.checkpoint",
        ):
            sys.modules[name] = types.ModuleType(name)


class OutOfTime(Exception):
    """Ends a training of brax, which has no end of its own but its steps."""


class Watch:
    """Takes the place of brax's evaluator: keeps the parameters, so that the judge of this benchmark scores them."""

    def __init__(self, eval_env: Any, eval_policy_fn: Any, **_: Any):
        self.make, self.params = eval_policy_fn, None
        Watch.last = self

    last: Any = None

    def run_evaluation(self, policy_params: Any, training_metrics: Any, **_: Any) -> dict[str, Any]:
        self.params = policy_params
        return dict(training_metrics)

    def act(self, params: Any, state: Any, key: Any) -> Any:
        return self.make(params)(state.obs, key)[0]


class Training:
    """One training: what is called after every epoch, and what it came to."""

    def __init__(
        self,
        name: str,
        env: Any,
        unseen: Any,
        episodes: int,
        seconds: float,
        target: float,
        keep: Callable[[dict[str, Any]], None],
    ):
        self.name, self.target, self.keep = name, target, keep
        self.env, self.unseen, self.episodes = env, unseen, episodes
        self.clock = Clock(seconds)
        self.rows: list[dict[str, Any]] = []
        self.seconds: list[float] = []
        self._walltime, self._judge = 0.0, None
        self._compiling: Any = None

    def progress(self, steps: int, metrics: dict[str, Any]) -> None:
        """Scores the policy; the first call, before any training, compiles the judge beside brax's own compiling."""
        from lunar_mjx.agents.evaluate import Evaluator

        watch = Watch.last
        if self._judge is None:
            self._judge = Evaluator(self.env, watch.act, self.episodes)
            params = watch.params
            self._compiling = threading.Thread(target=self._judge.compile, args=(self.unseen, params))
            self._compiling.start()
            return
        walltime = float(metrics["training/walltime"])
        self.seconds.append(walltime - self._walltime)
        self._walltime = walltime
        self._compiling.join()
        score = self._judge(self.unseen, watch.params, DURING)
        self.rows.append({"steps": int(steps), "elapsed_s": self.elapsed(), **score.record()})
        say(
            f"{self.name}: {self.elapsed():.1f} s, {int(steps):,} steps, unseen {percent(score.record())}, return "
            f"{score.episode_return:.0f}"
        )
        self.keep(self.record())
        if self.clock.left < 0.0:
            raise OutOfTime

    def elapsed(self) -> float:
        """s of training so far; the first epoch, which compiles, counts like the quickest of the others."""
        rest = self.seconds[1:]
        return (min(rest) if rest else float("nan")) + sum(rest)

    def record(self) -> dict[str, Any]:
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

    def final(self) -> dict[str, Any]:
        """Score of the last parameters on the episodes of final scores."""
        assert self._judge is not None
        return self._judge(self.unseen, Watch.last.params, FINAL).record()


def run_ppo(env: Any, settings: dict[str, Any], seed: int, per_epoch: int, watch: Training) -> None:
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo

    step = settings["batch_size"] * settings["num_minibatches"] * settings["unroll_length"]
    run(
        ppo,
        env,
        settings,
        seed,
        per_epoch * step,
        watch,
        functools.partial(
            networks.make_ppo_networks, policy_hidden_layer_sizes=LAYERS, value_hidden_layer_sizes=LAYERS
        ),
    )


def run_sac(env: Any, settings: dict[str, Any], seed: int, per_epoch: int, watch: Training) -> None:
    from brax.training.agents.sac import networks
    from brax.training.agents.sac import train as sac

    run(
        sac,
        env,
        settings,
        seed,
        per_epoch * settings["num_envs"],
        watch,
        functools.partial(
            networks.make_sac_networks,
            hidden_layer_sizes=LAYERS,
            policy_network_layer_norm=True,
            q_network_layer_norm=True,
        ),
    )


def run(module: Any, env: Any, settings: dict[str, Any], seed: int, epoch: int, watch: Training, networks: Any) -> None:
    from brax.training import acting

    from lunar_mjx.envs.brax_env import BraxEnv, wrap

    theirs, epochs = acting.Evaluator, 5000
    acting.Evaluator = Watch  # pyright: ignore[reportAttributeAccessIssue]
    try:
        module.train(
            BraxEnv(env),
            num_timesteps=epochs * epoch,
            num_evals=epochs + 1,
            episode_length=env.episode_steps,
            wrap_env_fn=wrap,
            network_factory=networks,
            seed=seed,
            deterministic_eval=True,
            max_devices_per_host=1,
            progress_fn=watch.progress,
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
    unseen = unseen_params(env, dict(training.unseen))
    runs: dict[str, Any] = {}
    for i, (name, settings, function) in enumerate((("ppo", PPO, run_ppo), ("sac", SAC, run_sac))):
        per_epoch = PER_EPOCH[name]
        if args.tiny:
            small = (
                {"num_envs": 64, "batch_size": 32, "unroll_length": 5, "num_minibatches": 2}
                if name == "ppo"
                else {"num_envs": 64, "batch_size": 64, "min_replay_size": 128, "max_replay_size": 1024}
            )
            settings, per_epoch = {**settings, **small}, 3

        def keep(record: dict[str, Any], name: str = name, settings: dict[str, Any] = settings) -> None:
            runs[name] = {
                **runs.get(name, {}),
                "settings": settings,
                "layers": LAYERS,
                "seed": args.first_seed,
                **record,
            }
            save(args.out, "brax", {"rover": args.rover, "target": args.target, "runs": runs})

        watch = Training(name, env, unseen, 32 if args.tiny else 1024, clock.left / (2 - i) - 8.0, args.target, keep)
        begin = time.monotonic()
        try:
            function(env, settings, args.first_seed, per_epoch, watch)
            keep({**watch.record(), "final": watch.final()})
            say(f"{name}: at the end {percent(runs[name]['final'])}, {time.monotonic() - begin:.0f} s in all")
        except Exception as error:  # the other one still runs
            say(f"{name}: {type(error).__name__}: {error}")
            keep({**watch.record(), "error": f"{type(error).__name__}: {error}"})
