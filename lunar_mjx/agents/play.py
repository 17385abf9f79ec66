"""One episode of an agent, looked at closely: its path, its commands and a video."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image
from scipy import ndimage

from lunar_mjx.agents.policy import load_policy, shipped_policies, shipped_policy, taught_in
from lunar_mjx.cameras.chase import Chase, tracks_of
from lunar_mjx.cameras.dust.recorded import Dust, wheel_motion
from lunar_mjx.cameras.ground_map import GroundMap
from lunar_mjx.envs import TASKS, NavigationEnv, make, make_agent, split_keys
from lunar_mjx.envs.core import PER_STEP
from lunar_mjx.envs.scripted import AGENTS, Agent
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.files import replacing, write_text
from lunar_mjx.terrain import height
from lunar_mjx.trust import require_trust

VIEWS = ("auto", "camera", "top")


def require_view(view: str) -> None:
    """Raises `UserError` for a view that does not exist."""
    if view not in VIEWS:
        raise bad_input("play", "view", view, "does not exist", f"use one of {', '.join(VIEWS)}")


END_WORDS = {
    "success": "goal reached",
    "rolled_over": "rolled over",
    "stuck": "stuck",
    "off_terrain": "left the terrain",
    "collided": "struck a boulder",
    "drained": "battery empty",
    "diverged": "diverged",
}
"""Ends of episodes by the metrics that tell them; where none does, time is up."""
UNSEEN_LADDER = {"ranges": "unseen", "hardness": 1.1}
"""What agents are scored on: worlds of another seed, harder than the training's by a tenth, and the held-out soil."""


@dataclasses.dataclass(frozen=True)
class EpisodePicture:
    """How an episode is drawn: a choice."""

    margin: float = 4.0
    """m around path and goal that the map shows."""
    most_frames: int = 300
    """Most frames of a video."""


EPISODE_PICTURE = EpisodePicture()


def open_agent(name: str, task: str = "large", options: dict[str, Any] | None = None) -> tuple[Any, Agent, dict]:
    """An agent with the environment that it was made for.

    Args:
      name: path of a policy, name of one that ships (`shipped_policy`), or of an agent that learns nothing (`AGENTS`).
      task: of agents without a policy.
      options: of the environment that differ from the policy's.

    Returns:
      The environment, the agent, and the options of the unseen ground that it is to be scored on.

    Raises:
      UserError: no such agent.
    """
    options = options or {}
    if name in AGENTS:
        if name == "mapper" and task in TASKS and "observations" not in options:
            # The mapper drives by a block that policies do not all have.
            options = {**options, "observations": (*TASKS[task].observations, "plan")}
        env = make("navigation", **{"task": task, **options})
        # Agents without a policy were trained nowhere: they are scored where trained ones are.
        unseen = {"terrain": "world:heldout", "ranges": "unseen"} if task == "large" else {}
        if task.startswith("ladder/"):
            unseen = UNSEEN_LADDER
        return env, make_agent(name, env), unseen
    path = Path(name) if name.endswith(".npz") else shipped_policy(name)
    if path is None:
        raise bad_input(
            "agent",
            "agent",
            name,
            "is no rover with a trained policy",
            f"give a policy.npz, one that ships ({', '.join(shipped_policies())}), or one of {', '.join(AGENTS)}",
        )
    policy = load_policy(path)
    made_in = policy.environment
    if not made_in:
        remedy = "take its actions in Python by load_policy, or train it in an environment that has a name"
        raise bad_input(path, "environment.name", None, "says of no environment how it is made", remedy)
    # JSON knows lists only; settings are compared as tuples.
    arguments = {k: tuple(v) if isinstance(v, list) else v for k, v in made_in["options"].items()}
    # A policy may name a Python file as its environment, which would run.
    require_trust(path, "environment.name", made_in["name"])
    env = make(made_in["name"], **{**arguments, **options})
    if isinstance(env, NavigationEnv) and made_in["name"] == "navigation":
        theirs, ours = taught_in(policy, path)[0].observations, env.config.observations
        # Other blocks of the same size together would be taken for those of the training.
        if theirs != ours:
            raise UserError(
                f"{path}: was trained on the observations {', '.join(theirs)}, and the environment has "
                f"{', '.join(ours)}; change no observations."
            )
    if env.observation_size != policy.network["obs"] or env.action_size != policy.network["actions"]:
        raise bad_input(
            path,
            "observations",
            policy.network["obs"],
            f"do not fit the environment's {env.observation_size}",
            "change no observations or actions",
        )
    theirs, ours = policy.network.get("picture"), getattr(env, "picture", None)
    if theirs is not None and (ours is None or list(theirs) != list(ours)):
        # A picture of as many pixels in other rows would pass for what it was trained on.
        problem = f"is not the environment's {ours}"
        raise bad_input(path, "network.picture", theirs, problem, "change no camera_width or camera_height")
    return env, lambda state, key: policy.act(state.obs), dict(made_in.get("unseen", {}))


def knowing(name: str, env: Any, params: Any, agent: Agent) -> Agent:
    """The agent, with the map of the worlds that it is to drive in if it is one that knows them (`planner`)."""
    return make_agent(name, env, params) if name == "planner" else agent


@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
    """One episode; arrays lead with time.

    Attributes:
      env, params: where. qpos, yaw, position, action, reward: at every step. goal: m. end: how it ended.
    """

    env: NavigationEnv
    params: Any
    qpos: np.ndarray
    yaw: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    goal: np.ndarray
    end: str

    @property
    def sentence(self) -> str:
        """One sentence of how the episode ended, its time, way and return."""
        length = float(np.hypot(*np.diff(self.qpos[:, :2], axis=0).T).sum())
        time = len(self.reward) * self.env.control_interval
        return f"{self.end} after {time:.1f} s and {length:.1f} m, return {self.reward.sum():.1f}"

    def write(self, folder: Path, view: str = "auto") -> list[Path]:
        """Writes the table of the drive, a picture of the path and an animated WebP; returns their paths.

        Raises:
          UserError: unknown view, or `camera` without OpenGL.
        """
        require_view(view)
        frames, still = self._frames(view)
        table = np.column_stack(
            [
                np.arange(len(self.reward)) * self.env.control_interval,
                self.qpos[:-1, :3],
                self.yaw[:-1],
                self.reward,
                self.action,
            ]
        )
        names = [
            "time_s",
            "position_x_m",
            "position_y_m",
            "position_z_m",
            "yaw_rad",
            "reward",
            *(f"action_{n}" for n in self.env.actions.names),
        ]
        csv, picture, video = (folder / n for n in ("episode.csv", "path.png", "episode.webp"))
        with replacing(csv) as part:
            np.savetxt(part, table, delimiter=",", header=",".join(names), comments="", fmt="%.6g")
        with replacing(picture) as part:
            Image.fromarray(still).save(part)
        # A long drive keeps its file small by fewer pictures, not by smaller ones.
        stride = max(1, len(self.reward) // EPISODE_PICTURE.most_frames)
        images = [Image.fromarray(f) for f in frames]
        with replacing(video) as part:
            images[0].save(
                part,
                save_all=True,
                append_images=images[1:],
                loop=0,
                quality=75,
                duration=max(20, round(1000 * stride * self.env.control_interval / 4)),
            )
        note = {"end": self.end, "goal_m": self.goal.tolist(), "speed_up": 4}
        write_text(folder / "episode.json", json.dumps(note) + "\n")
        return [csv, picture, video]

    def _frames(self, view: str) -> tuple[list[np.ndarray], np.ndarray]:
        terrain, rover = self.params.system.terrain, self.env.model.rover
        places = np.vstack([self.qpos[:, :2], self.goal[None]])
        radius, size = self.env.config.goal_radius, 5.0 * self.env.model.rover.standing_height
        top = GroundMap(
            terrain, places.min(axis=0) - EPISODE_PICTURE.margin, places.max(axis=0) + EPISODE_PICTURE.margin
        )
        steps = range(0, len(self.qpos), max(1, len(self.reward) // EPISODE_PICTURE.most_frames))

        def drawn(i: int) -> np.ndarray:
            return top.frame(self.qpos[i], float(self.yaw[i]), self.goal, radius, list(self.qpos[: i + 1, :2]), size)

        still = drawn(len(self.qpos) - 1)
        if view != "top":
            motion = wheel_motion(rover, self.qpos)
            try:
                camera = Chase(rover, terrain, places, tracks=tracks_of(rover, motion.centre))
            except UserError:
                if view == "camera":
                    raise
            else:
                ground = float(height(terrain.field, *self.goal[:2]))
                # Smoothed over a second, or the camera shakes with the rover.
                yaw = ndimage.gaussian_filter1d(np.unwrap(self.yaw), 1.0 / self.env.control_interval, mode="nearest")
                interval, model = self.env.control_interval, self.env.model
                hard = "hard_surface" in model.effect_names
                dust = Dust(rover, terrain, interval * np.arange(len(self.qpos)), motion, model.gravity, hard)
                frames = [
                    camera.frame(self.qpos[i], float(yaw[i]), self.goal, ground, i, dust=dust.at(interval * i))
                    for i in steps
                ]
                camera.close()
                return frames, still
        return [drawn(i) for i in steps], still


def play_episode(env: Any, params: Any, agent: Agent, seed: int = 0) -> Episode:
    """Drives one rover for one episode.

    Raises:
      UserError: an environment without a rover.
    """
    if not isinstance(env, NavigationEnv):
        raise UserError("play: the environment has no rover; give the navigation task.")
    step = jax.jit(lambda params, state, key: _acted(env, agent, params, state, key))
    state = jax.jit(lambda params, key: env.reset(params, split_keys(key, 1)))(params, jax.random.PRNGKey(seed))
    goal = np.asarray(state.inner.goal[0])
    qpos, actions, rewards, end = [np.asarray(state.inner.physics.qpos[0])], [], [], "time is up"
    for i in range(env.episode_steps):
        action, state = step(params, state, jax.random.fold_in(jax.random.PRNGKey(seed + 1), i))
        actions.append(np.asarray(action[0]))
        rewards.append(float(state.reward[0]))
        if bool(state.done[0]):
            flags = {k: float(v[0]) for k, v in state.metrics.items() if not k.startswith(PER_STEP)}
            end = next((text for k, text in END_WORDS.items() if flags.get(k, 0.0) > 0), end)
            # the pose after the last step is gone with the reset: the picture ends one step before
            qpos.append(qpos[-1])
            break
        qpos.append(np.asarray(state.inner.physics.qpos[0]))
    table = np.stack(qpos)
    w, x, y, z = table[:, 3:7].T
    yaw = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    return Episode(env, params, table, yaw, np.stack(actions), np.array(rewards), goal, end)


def _acted(env: Any, agent: Agent, params: Any, state: Any, key: Any) -> Any:
    action = agent(state, key)
    return action, env.step(params, state, action)
