"""What Stable-Baselines3's TD3 reaches with the seed paper's engine: one rover in PyBullet on the task `large`.

    python benchmarks/rl/sb3_bullet.py --out runs/sb3 --cpu-seconds 3600

The task, its observations, rewards and ends are those of `lunar_mjx.envs`; only the physics between two actions is
`PyBulletBackend`, with the NumPy forces that agree with the simulator's. Soil and motors are the model's own in every
episode, which is easier than the drawn ones of the large-batch training. SB3's TD3 has its defaults and the paper's
action noise N(0, 0.3). The record is written anew every minute; at the end
the last policy is scored on unseen ground, goals and soil.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import jax
import jax.numpy as jnp
import numpy as np
from harness import COMMIT, FINAL, ends, percent, say, write

from lunar_mjx.agents.configs import get_training
from lunar_mjx.agents.evaluate import evaluate
from lunar_mjx.agents.play import open_agent
from lunar_mjx.agents.policy import Policy, save_policy
from lunar_mjx.agents.run import environment_of, unseen_params
from lunar_mjx.backends.pybullet import PyBulletBackend
from lunar_mjx.commands.train import env_options
from lunar_mjx.effects.joint.motor import REFERENCE_TEMPERATURE
from lunar_mjx.envs import NavigationEnv, make
from lunar_mjx.envs.gymnasium_env import SingleEnv
from lunar_mjx.envs.navigation.env import ENDS, NavigationParams
from lunar_mjx.pytree import pytree

TASK = environment_of(get_training("large-td3"))
"""What TD3 with thousands of rovers learns, too."""


@pytree
class HostParams(NavigationParams):
    """Parameters with what another engine made of the action: state, slip and sinkage."""

    driven: Any = None


class HostEnv(NavigationEnv):
    """The navigation task around physics that ran elsewhere."""

    def _drive(self, params: Any, inner: Any, action: Any) -> Any:
        physics, *seen = params.driven
        return physics, tuple(seen)


class BulletNavigation(SingleEnv):
    """One rover in PyBullet for Gymnasium; `options` as for `make_navigation`."""

    def __init__(self, options: dict[str, Any]):
        made: Any = make("navigation", **options)
        super().__init__(HostEnv(made.model, made.config))
        self.env: Any
        self.backend = PyBulletBackend(made.model)
        assert (self.backend.numbers.mode == self.env.actions.mode).all(), "another control mode than the backend's"
        self._around, self._step = jax.jit(self._after), self._drive

    def _after(self, params: Any, state: Any, action: Any, driven: Any) -> Any:
        fields = {name: getattr(params, name) for name in NavigationParams.__dataclass_fields__}
        return self.env.step(HostParams(**fields, driven=driven), state, action)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode, in PyBullet where the task's own physics stands."""
        obs, info = super().reset(seed=seed)
        physics = self._state.inner.physics
        qpos = np.asarray(physics.qpos[0], float)
        w, x, y, z = qpos[3:7]
        yaw = float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
        warm = float(physics.temperature.winding[0, 0]) + REFERENCE_TEMPERATURE
        self.backend.reset(qpos[0], qpos[1], yaw, warm)
        return obs, info

    def _drive(self, params: Any, state: Any, action: Any) -> Any:
        """The state after an action: PyBullet drives, the task does the rest."""
        control = np.asarray(self.env.actions.controls(action), float)
        for _ in range(self.env.config.decimation):
            self.backend.step(control)
        seen, now, old = self.backend.observe(), self.backend.state(), state.inner.physics
        single = functools.partial(jnp.asarray, dtype=jnp.float32)
        kelvin = {"winding": now.winding_temperature, "housing": now.housing_temperature}
        warm = {name: single(value - REFERENCE_TEMPERATURE) for name, value in kelvin.items()}
        warm = dataclasses.replace(old.temperature, **warm)
        physics = dataclasses.replace(old, qpos=single(now.qpos), qvel=single(now.qvel), temperature=warm)
        return self._around(params, state, action, (physics, single(seen["slip"]), single(seen["sinkage"])))


def make_recorder(args: argparse.Namespace, env: BulletNavigation, record: dict[str, Any]) -> Any:
    """SB3's callback that keeps episodes, writes the record and the policy, and stops in time."""
    from stable_baselines3.common.callbacks import BaseCallback

    begin = time.monotonic()

    class Recorder(BaseCallback):
        last = 0.0

        def _on_step(self) -> bool:
            info = self.locals["infos"][0]
            now = {"cpu_s": time.process_time(), "wall_s": time.monotonic() - begin}
            if self.locals["dones"][0]:
                end = next((e for e in ENDS if info.get(e if e != "reached" else "success", 0.0) > 0.0), "time")
                told = {k: info[f"episode_{k}"] for k in ("return", "length")}
                episode = {"step": self.num_timesteps, **now, **told, "success": info["success"], "end": end}
                record["episodes"].append(episode)
            over = now["cpu_s"] >= args.cpu_seconds
            if over or now["wall_s"] - self.last >= 60.0:
                self.last = now["wall_s"]
                record.update(steps=self.num_timesteps, **now, finished=over)
                write(args.out / "sb3.json", record)
                keep_policy(self.model, env, args.out / "policy_sb3.npz", record)
            return not over

    return Recorder()


def keep_policy(model: Any, env: BulletNavigation, path: Path, record: dict[str, Any]) -> None:
    """SB3's actor as a policy file of this package: the same layers, so the same actions."""
    layers = [m for m in model.policy.actor.mu if hasattr(m, "weight")]
    arrays = [{"kernel": m.weight.detach().numpy().T, "bias": m.bias.detach().numpy()} for m in layers]
    network = {"obs": env.env.observation_size, "actions": env.env.action_size, "activation": "relu"}
    network |= {"layers": [m.out_features for m in layers[:-1]], "layer_norm": False}
    notes = {"algorithm": "stable-baselines3 TD3", "steps": record["steps"], "cpu_s": record["cpu_s"]}
    params = {"params": {f"hidden_{i}": layer for i, layer in enumerate(arrays)}}
    save_policy(Policy(params, None, None, network, {**TASK, "options": record["options"]}, notes), path)


def main() -> None:
    """Trains until the CPU time is over, and scores the policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--out", type=Path, required=True)
    add("--rover", default="luvmi_x")
    add("--seed", type=int, default=0)
    add("--steps", type=int, default=10_000_000)
    add("--cpu-seconds", type=float, default=3600.0, help="of this process, after which it stops")
    add("--score", type=int, default=128, help="episodes that score the last policy")
    add("--env", nargs="*", default=[], metavar="NAME=VALUE", help="options of the environment, as JSON")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    import pybullet
    import stable_baselines3
    import torch
    from stable_baselines3.common.noise import NormalActionNoise

    torch.set_num_threads(1)
    options = {**TASK["options"], "rover": args.rover}
    env = BulletNavigation({**options, "randomise": (), **env_options(args.env)})
    noise = NormalActionNoise(np.zeros(env.env.action_size), np.full(env.env.action_size, 0.3))
    model = stable_baselines3.TD3(
        "MlpPolicy", env, action_noise=noise, seed=args.seed, device="cpu", buffer_size=200_000
    )
    what = "SB3 TD3 defaults, action noise N(0, 0.3), PyBullet reference backend, one rover, one CPU thread"
    versions = {"stable_baselines3": stable_baselines3.__version__, "torch": torch.__version__}
    about = {**versions, "pybullet_api": pybullet.getAPIVersion()}
    asked = {"rover": args.rover, "options": options, "seed": args.seed}
    record = {"what": what, "about": about, "commit": COMMIT, **asked, "steps": 0, "cpu_s": 0.0, "episodes": []}
    model.learn(args.steps, callback=make_recorder(args, env, record))
    record["steps"] = model.num_timesteps
    keep_policy(model, env, args.out / "policy_sb3.npz", record)
    own, agent, unseen = open_agent(str(args.out / "policy_sb3.npz"))
    record["final"] = evaluate(own, agent, args.score, FINAL, unseen_params(own, unseen)).record()
    write(args.out / "sb3.json", record)
    say(f"{record['steps']:,} steps, {len(record['episodes'])} episodes in {record['cpu_s'] / 60:.0f} min of CPU time")
    say(f"its policy on unseen ground: {percent(record['final'])} of {args.score}, {ends(record['final'])}")


if __name__ == "__main__":
    main()
