"""What Stable-Baselines3's TD3 reaches with the seed paper's engine: one rover in PyBullet on the task `large`.

    python benchmarks/rl/sb3_bullet.py --out runs/sb3 --cpu-seconds 3600
    python benchmarks/rl/sb3_bullet.py --out runs/sb3 --score 128      # scores that policy on unseen ground

The task, its observations, rewards and ends are those of `lunar_mjx.envs`; only the physics between two actions is
`PyBulletBackend`, with the NumPy forces that agree with the simulator's. Soil and motors are the model's own in every
episode, which is easier than the drawn ones of the large-batch training. SB3's TD3 has its defaults and the paper's
action noise N(0, 0.3). The record is written anew every minute.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from harness import FINAL, percent, write

from lunar_mjx.backends.pybullet import PyBulletBackend
from lunar_mjx.effects.joint.motor import REFERENCE_TEMPERATURE
from lunar_mjx.envs import NavigationEnv, make, split_keys
from lunar_mjx.envs.navigation.env import ENDS, NavigationParams
from lunar_mjx.pytree import pytree


@pytree
class HostParams(NavigationParams):
    """Parameters with what another engine made of the action: state, slip and sinkage."""

    driven: Any = None


class HostEnv(NavigationEnv):
    """The navigation task around physics that ran elsewhere."""

    def _drive(self, params: Any, inner: Any, action: Any) -> Any:
        physics, *seen = params.driven
        return physics, tuple(seen)


class BulletNavigation(gym.Env):
    """One rover in PyBullet for Gymnasium; `options` as for `make_navigation`."""

    def __init__(self, options: dict[str, Any]):
        made: Any = make("navigation", **options)
        self.env = HostEnv(made.model, made.config)
        self.backend = PyBulletBackend(made.model)
        assert (self.backend.numbers.mode == self.env.actions.mode).all(), "another control mode than the backend's"
        bound = 1e6
        self.observation_space = gym.spaces.Box(-bound, bound, (self.env.observation_size,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.env.action_size,), np.float32)
        self._reset: Any = jax.jit(self.env.reset)
        self._step: Any = jax.jit(self._after)
        self._state: Any = None
        self._diverged = False

    def _after(self, params: Any, state: Any, action: Any, driven: Any) -> Any:
        fields = {name: getattr(params, name) for name in NavigationParams.__dataclass_fields__}
        return self.env.step(HostParams(**fields, driven=driven), state, action)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        key = jax.random.PRNGKey(int(self.np_random.integers(2**31)))
        self._state = self._reset(self.env.params, split_keys(key, 1))
        physics = self._state.inner.physics
        qpos = np.asarray(physics.qpos[0], float)
        w, x, y, z = qpos[3:7]
        yaw = float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
        warm = float(physics.temperature.winding[0, 0]) + REFERENCE_TEMPERATURE
        self.backend.reset(qpos[0], qpos[1], yaw, warm)
        return np.asarray(self._state.obs[0], np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        action = jnp.asarray(action, jnp.float32)[None]
        control = np.asarray(self.env.actions.controls(action), float)
        for _ in range(self.env.config.decimation):
            self.backend.step(control)
        seen, now, old = self.backend.observe(), self.backend.state(), self._state.inner.physics
        single = jnp.float32
        warm = old.temperature.__class__(
            jnp.asarray(now.winding_temperature - REFERENCE_TEMPERATURE, single),
            old.temperature.winding_lost,
            jnp.asarray(now.housing_temperature - REFERENCE_TEMPERATURE, single),
            old.temperature.housing_lost,
        )
        physics = old.__class__(
            old.step, jnp.asarray(now.qpos, single), jnp.asarray(now.qvel, single), warm, old.effects
        )
        driven = (physics, jnp.asarray(seen["slip"], single), jnp.asarray(seen["sinkage"], single))
        self._state = self._step(self.env.params, self._state, action, driven)
        state = jax.device_get(self._state)
        metrics = {k: float(v[0]) for k, v in state.metrics.items() if not k.startswith("reward_")}
        return (
            np.asarray(state.final_obs[0], np.float32),
            float(state.reward[0]),
            bool(state.terminated[0]),
            bool(state.truncated[0]),
            metrics,
        )


def make_recorder(args: argparse.Namespace, env: BulletNavigation, record: dict[str, Any]) -> Any:
    """SB3's callback that keeps episodes, writes the record and the policy, and stops in time."""
    from stable_baselines3.common.callbacks import BaseCallback

    begin = time.monotonic()

    class Recorder(BaseCallback):
        last = 0.0

        def _on_step(self) -> bool:
            info = self.locals["infos"][0]
            cpu, wall = time.process_time(), time.monotonic() - begin
            if self.locals["dones"][0]:
                end = next((e for e in ENDS if info.get(e if e != "reached" else "success", 0.0) > 0.0), "time")
                record["episodes"].append(
                    {
                        "step": self.num_timesteps,
                        "cpu_s": cpu,
                        "wall_s": wall,
                        "return": info["episode_return"],
                        "length": info["episode_length"],
                        "success": info["success"],
                        "end": end,
                    }
                )
            over = cpu >= args.cpu_seconds
            if over or wall - self.last >= 60.0:
                self.last = wall
                record.update(steps=self.num_timesteps, cpu_s=cpu, wall_s=wall, finished=over)
                write(args.out / "sb3.json", record)
                keep_policy(self.model, env, args.out / "policy_sb3.npz", record)
            return not over

    return Recorder()


def keep_policy(model: Any, env: BulletNavigation, path: Path, record: dict[str, Any]) -> None:
    """SB3's actor as a policy file of this package: the same layers, so the same actions."""
    from lunar_mjx.agents.policy import Policy, save_policy

    layers = [m for m in model.policy.actor.mu if hasattr(m, "weight")]
    params = {
        "params": {
            f"hidden_{i}": {"kernel": m.weight.detach().numpy().T, "bias": m.bias.detach().numpy()}
            for i, m in enumerate(layers)
        }
    }
    network = {
        "obs": env.env.observation_size,
        "actions": env.env.action_size,
        "layers": [m.out_features for m in layers[:-1]],
        "activation": "relu",
        "layer_norm": False,
    }
    notes = {"algorithm": "stable-baselines3 TD3", "steps": record["steps"], "cpu_s": record["cpu_s"]}
    environment = {
        "name": "navigation",
        "options": {"task": "large", "rover": record["rover"]},
        "unseen": {"terrain": "world:heldout", "ranges": "unseen"},
    }
    save_policy(Policy(params, None, None, network, environment, notes), path)


def train(args: argparse.Namespace) -> None:
    import pybullet
    import stable_baselines3
    import torch
    from stable_baselines3.common.noise import NormalActionNoise

    torch.set_num_threads(1)
    options = {"task": "large", "rover": args.rover, "randomise": ()}
    if args.tiny:
        options |= {"terrain": "flat", "goal_distance": (2.0, 4.0), "places": 256, "episode_time": 2.0}
    env = BulletNavigation(options)
    noise = NormalActionNoise(np.zeros(env.env.action_size), np.full(env.env.action_size, 0.3))
    model = stable_baselines3.TD3(
        "MlpPolicy", env, action_noise=noise, seed=args.seed, device="cpu", buffer_size=200_000
    )
    versions = {
        "stable_baselines3": stable_baselines3.__version__,
        "torch": torch.__version__,
        "pybullet_api": pybullet.getAPIVersion(),
    }
    record: dict[str, Any] = {
        "what": "SB3 TD3 defaults, action noise N(0, 0.3), PyBullet reference backend, one rover, one CPU thread",
        "about": versions,
        "rover": args.rover,
        "options": {k: v for k, v in options.items() if k != "randomise"},
        "seed": args.seed,
        "steps": 0,
        "cpu_s": time.process_time(),
        "episodes": [],
    }
    model.learn(args.steps, callback=make_recorder(args, env, record))
    won = [e["success"] for e in record["episodes"]]
    print(
        f"{record['steps']} steps, {len(won)} episodes, success of the last 50 "
        f"{np.mean(won[-50:]) if won else float('nan'):.2f}, {record['cpu_s']:.0f} s of CPU time"
    )


def score(args: argparse.Namespace) -> None:
    """Adds the policy's success on unseen ground, goals and soil to the record."""
    from lunar_mjx.agents.evaluate import Evaluator
    from lunar_mjx.agents.policy import load_policy
    from lunar_mjx.agents.run import agent_of, unseen_params

    policy = load_policy(args.out / "policy_sb3.npz")
    env = make("navigation", **policy.environment["options"])
    params = unseen_params(env, policy.environment["unseen"])
    result = Evaluator(env, agent_of(policy), args.score)(params, (), FINAL)
    path = args.out / "sb3.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    record["final"] = result.record()
    write(path, record)
    print(f"unseen {percent(record['final'])}, {result.ends}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rover", default="luvmi_x")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=10_000_000)
    parser.add_argument("--cpu-seconds", type=float, default=3600.0, help="of this process, after which it stops")
    parser.add_argument("--score", type=int, help="score the policy that lies there, by so many episodes")
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.score:
        score(args)
    else:
        train(args)


if __name__ == "__main__":
    main()
