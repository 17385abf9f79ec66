"""The navigation task's settings, and everything that the paper leaves unsaid about it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from lunar_mjx.cameras import Pinhole, Sun, lens_of
from lunar_mjx.cameras.mount import FRONT_MOUNT
from lunar_mjx.envs.ladder.rungs import COLLISIONS, RUNGS, get_rung
from lunar_mjx.envs.navigation.actions import ACTION_MODES
from lunar_mjx.envs.navigation.kalman import KalmanConfig
from lunar_mjx.envs.navigation.observations import PAPER_OBSERVATION, check_blocks
from lunar_mjx.envs.navigation.randomise import Range
from lunar_mjx.envs.navigation.rewards import CONSISTENT_WEIGHTS, PAPER_ENDS, PAPER_WEIGHTS, TERMS, TOLD_BY_TALLY
from lunar_mjx.errors import bad_input, require_finite, require_within

DIVERGENCE = ("stop", "reset")


@dataclasses.dataclass(frozen=True)
class NavigationConfig:
    """Settings of the navigation task. Lengths in m, times in s, angles in rad.

    Attributes:
      decimation: physics steps per action.
      action: action mode, see `actions.ACTION_MODES`.
      four_wheel_steering: rear wheels steer opposite to the front ones.
      top_speed: rim speed at a wheel speed action of 1, m/s.
      load_share: tangential force at a drive torque action of 1, over the wheel's load.
      observations: blocks that the policy sees, see `observations.BLOCKS`.
      privileged: blocks that only a critic sees.
      goal_distance: least and greatest distance from start to goal.
      goal_radius: distance from the goal that counts as success.
      start_within: half side of the square about the origin in which episodes begin; anywhere on the terrain if None.
      start_yaw: episodes begin at headings within this of the goal's bearing; pi for any heading.
      episode_time: after which an episode is cut off.
      weights: of the reward terms, see `rewards.TERMS`.
      success, failure: reward at the end of an episode (G and V of the paper).
      most_tilt: lean of the body's up axis that counts as rolled over.
      stuck_time, stuck_distance: a rover that stays within the distance of a place for the time is stuck.
      edge: distance from the terrain's edge, within it, at which an episode fails.
      places: pairs of start and goal drawn on the host.
      place_seed: of those pairs.
      steepest: slope at start and goal.
      randomise: parameters drawn for every episode.
      posterior: draw those that the model's `[posterior]` tells from it, and not from `randomise`.
      kalman: the acceleration filter's tuning.
      delay: by which observations come late, in whole control steps, and with them what rules act by, but for the
        `planner`, which knows all; `last_action` is known at once.
      drift: share of the way by which odometry errs, to one side drawn per episode: in what tells of goal and map.
      mast: height above the ground of the sensor that makes the height scan: what it cannot see is told as 1.5 times
        the scan's lowest value; 0: it sees all.
      camera_width, camera_height: pixels of the blocks camera/rgb, camera/depth and camera/labels.
      camera_fovy_deg: vertical angle of view. camera_pitch_deg: how far the camera looks down. camera_far: how far it
        looks, m. camera_lens: its distortion, `D` of a ROS CameraInfo: k1, k2, p1, p2, k3; none if empty.
      camera_dust: whether camera/rgb shows the soil that wheels throw up; there is none on hard ground or in air.
      camera_tracks: whether camera/rgb shows pressed soil darker; needs a model with the effect `ruts`.
      sun_azimuth_deg, sun_elevation_deg: where the Sun stands, clockwise from north (y).
      divergence: what follows a state that is not finite: "stop" lets it through, so that a trainer's guard stops and
        dumps it; "reset" ends the episode as failed and counts it in the metric `diverged`, and so a rover that is
        faster or farther from the ground than any can be (`env.plausible`).
      tally: count way, energy, slip and collisions of every episode and tell them as metrics.
      collisions: what follows when a boulder comes under the rover's outline: nothing ("free"), a price by the reward
        term `collision` ("cost"), or the end of the episode as failed ("end").
      arrive_within: the rover must head within this of a drawn direction to have reached the goal; pi for any.
      rung: of the ladder, whose worlds take the terrain's place; 0 for none.
      worlds: of the rung, side by side; as many as it says if 0.
      hardness: by which the rung's slopes, craters, ridges and boulders are multiplied.
      curriculum_levels: of the ladder's training: on level k of n a rover begins on the shortest way where k/n of it
        is left. Every success raises a rover's level by one, every failure lowers it. 0 or 1 for none; evaluations
        (`NavigationEnv.place`) are always on the last level.
      renew: a training makes the ladder's worlds anew while it goes on, each when no rover is in it (`ladder.renewal`).
      escape_distance: episodes begin with the rover dug in (`navigation.digging`), and it succeeds this far from there,
        on any side; observations and rewards of the goal are then of the place to get away from. 0: drive to a goal.
    """

    decimation: int = 50
    action: str = "paper"
    four_wheel_steering: bool = False
    top_speed: float = 1.0
    load_share: float = 0.6
    observations: tuple[str, ...] = PAPER_OBSERVATION
    privileged: tuple[str, ...] = ()
    goal_distance: tuple[float, float] = (5.0, 10.0)
    goal_radius: float = 0.5
    start_within: float | None = None
    start_yaw: float = np.pi
    episode_time: float = 30.0
    weights: Mapping[str, float] = dataclasses.field(default_factory=lambda: dict(CONSISTENT_WEIGHTS))
    success: float = PAPER_ENDS.success
    failure: float = PAPER_ENDS.failure
    most_tilt: float = np.pi / 3
    stuck_time: float = 8.0
    stuck_distance: float = 0.1
    edge: float = 1.5
    places: int = 16384
    place_seed: int = 0
    steepest: float = np.radians(20.0)
    randomise: tuple[Range, ...] = ()
    posterior: bool = False
    kalman: KalmanConfig = dataclasses.field(default_factory=KalmanConfig)
    camera_width: int = 64
    camera_height: int = 48
    camera_fovy_deg: float = 60.0
    camera_pitch_deg: float = FRONT_MOUNT.pitch_deg
    camera_far: float = 60.0
    camera_lens: tuple[float, ...] = ()
    camera_dust: bool = False
    camera_tracks: bool = False
    sun_azimuth_deg: float = 135.0
    sun_elevation_deg: float = 15.0
    delay: float = 0.0
    drift: float = 0.0
    mast: float = 0.0
    divergence: str = "stop"
    tally: bool = False
    collisions: str = "free"
    arrive_within: float = np.pi
    rung: int = 0
    worlds: int = 0
    hardness: float = 1.0
    curriculum_levels: int = 0
    renew: bool = False
    escape_distance: float = 0.0

    def __post_init__(self) -> None:
        _check(self)

    @property
    def camera(self) -> Pinhole:
        """Optics of the front camera."""
        lens = lens_of(self.camera_lens, "navigation", "camera_lens")
        return Pinhole(self.camera_width, self.camera_height, self.camera_fovy_deg, lens=lens)

    @property
    def sun(self) -> Sun:
        """Where the light comes from."""
        return Sun(self.sun_azimuth_deg, self.sun_elevation_deg)

    def replace(self, **changes: Any) -> NavigationConfig:
        """A copy with other values, checked.

        Raises:
          UserError: unknown setting, or a value that makes no sense.
        """
        # `dataclasses.replace` would refuse it, too, with a TypeError that names no remedy.
        known = [f.name for f in dataclasses.fields(self)]
        for key in changes:
            if key not in known:
                raise bad_input("navigation", key, changes[key], "is no setting", f"use one of {', '.join(known)}")
        return dataclasses.replace(self, **changes)


def _check(c: NavigationConfig) -> None:
    for name in ("decimation", "places"):
        value = getattr(c, name)
        # True is an int in Python; from a command line's JSON it is a mistake.
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise bad_input("navigation", name, value, "is not a whole number of at least 1", "give one")
    for name in (
        "top_speed",
        "load_share",
        "goal_radius",
        "episode_time",
        "most_tilt",
        "stuck_time",
        "stuck_distance",
        "steepest",
        "camera_far",
        "arrive_within",
        "hardness",
    ):
        if require_finite("navigation", name, getattr(c, name)) <= 0.0:
            raise bad_input("navigation", name, getattr(c, name), "is not positive", "give a number above zero")
    for name in ("success", "failure", "edge", "start_yaw"):
        require_finite("navigation", name, getattr(c, name))
    for name, most in (("delay", 10.0), ("drift", 1.0), ("mast", 100.0), ("escape_distance", 1000.0)):
        value = getattr(c, name)
        # True counts as 1 in Python: `drift=true` would be a rover that errs by its whole way.
        if isinstance(value, bool | str):
            raise bad_input("navigation", name, value, "is not a number", "give one")
        require_within("navigation", name, value, 0.0, most)
    distance = c.goal_distance
    pair = isinstance(distance, list | tuple) and len(distance) == 2
    low, high = (require_finite("navigation", "goal_distance", v) for v in distance) if pair else (0.0, 0.0)
    # A goal within its own radius is reached at the start: an episode of no step.
    if not c.goal_radius < low <= high:
        raise bad_input(
            "navigation",
            "goal_distance",
            c.goal_distance,
            f"is not a range above goal_radius = {c.goal_radius}",
            "give least and greatest distance in m",
        )
    for name, allowed in (("action", ACTION_MODES), ("divergence", DIVERGENCE), ("collisions", COLLISIONS)):
        if getattr(c, name) not in allowed:
            raise bad_input("navigation", name, getattr(c, name), "does not exist", f"use one of {', '.join(allowed)}")
    if not -90.0 <= require_finite("navigation", "camera_pitch_deg", c.camera_pitch_deg) <= 90.0:
        raise bad_input("navigation", "camera_pitch_deg", c.camera_pitch_deg, "is no pitch", "give -90 to 90")
    # the optics and the light refuse values that make no sense, in words of their own
    _ = c.camera, c.sun
    for name in ("tally", "four_wheel_steering", "posterior", "renew", "camera_dust", "camera_tracks"):
        if not isinstance(getattr(c, name), bool):
            raise bad_input("navigation", name, getattr(c, name), "is neither true nor false", "give one of them")
    if not isinstance(c.kalman, KalmanConfig):
        raise bad_input("navigation", "kalman", c.kalman, "is no KalmanConfig", "set it in Python, or leave it out")
    if not all(isinstance(r, Range) for r in c.randomise):
        raise bad_input(
            "navigation", "randomise", c.randomise, "are no ranges", "give some Range(parameter, low, high)"
        )
    if not isinstance(c.weights, Mapping):
        raise bad_input("navigation", "weights", c.weights, "are no weights by name", f"use some of {', '.join(TERMS)}")
    check_blocks(c.observations, "observations")
    check_blocks(c.privileged, "privileged")
    if c.mast > 0.0 and not {"height_scan", "far_scan"} & {*c.observations, *c.privileged}:
        problem = "does nothing where no height_scan is observed"
        raise bad_input("navigation", "mast", c.mast, problem, "leave it out")
    if not c.observations:
        raise bad_input("navigation", "observations", c.observations, "is empty", "name at least one block")
    for name, weight in c.weights.items():
        if name not in TERMS:
            raise bad_input("navigation", "weights", name, "is no reward term", f"use some of {', '.join(TERMS)}")
        require_finite("navigation", f"weights.{name}", weight)
        # Such terms read the tally's counts; without it they would be zero, and the reward another one without a word.
        if name in TOLD_BY_TALLY and not c.tally:
            raise bad_input("navigation", "tally", c.tally, f"does not go with the reward term {name}", "give true")
        if name == "way" and not c.rung:
            raise bad_input("navigation", "weights", name, "is only known on the ladder", "leave it out")
        if name == "away" and not c.escape_distance:
            problem = "pays for driving away from a goal where escape_distance = 0"
            raise bad_input("navigation", "weights", name, problem, "give escape_distance, or leave the term out")
    if c.collisions != "free" and not c.tally:
        raise bad_input("navigation", "tally", c.tally, f"does not go with collisions = {c.collisions}", "give true")
    for name in ("rung", "worlds", "place_seed", "curriculum_levels"):
        value = getattr(c, name)
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise bad_input("navigation", name, value, "is not a whole number of at least 0", "give one")
    if c.rung:
        # Refuses a rung that does not exist, in words of its own.
        get_rung(c.rung)
    if c.renew and not c.rung:
        raise bad_input("navigation", "renew", c.renew, "is for the ladder only", "leave it out")
    if c.escape_distance and c.rung:
        problem = f"does not go with rung = {c.rung}: its worlds have goals"
        raise bad_input("navigation", "escape_distance", c.escape_distance, problem, "leave it out")
    if c.curriculum_levels > 1 and not c.rung:
        given = c.curriculum_levels
        raise bad_input("navigation", "curriculum_levels", given, "is for the ladder only", "leave it out")
    for field, names in (("observations", c.observations), ("privileged", c.privileged)):
        for name in ("arrival", "plan"):
            if name in names and not c.rung:
                raise bad_input("navigation", field, name, "is only told on the ladder", "leave it out")


EGOCENTRIC = (
    "goal_body",
    "up",
    "body_velocity",
    "body_rates",
    "acceleration",
    "joints",
    "slip",
    "last_action",
    "waited",
    "height_scan",
)
"""What the tuned policies see: nothing depends on where in the world the rover is or which way north lies."""

SOIL_RANGES = (
    Range("soil.k_phi", 0.5, 2.0, "log", relative=True),
    Range("soil.cohesion", 0.5, 2.0, "log", relative=True),
    Range("soil.friction_angle", 0.9, 1.1, relative=True),
    Range("soil.shear_modulus_x", 0.7, 1.4, "log", relative=True),
    Range("motor.torque_constant", 0.95, 1.05, relative=True),
    Range("motor.resistance", 0.95, 1.05, relative=True),
    Range("winding_temperature", 250.0, 330.0),
)
"""Training's spread of soils and motors about the model's values."""

UNSEEN_SOIL = (
    Range("soil.k_phi", 0.4, 0.5, "log", relative=True),
    Range("soil.cohesion", 0.4, 0.5, "log", relative=True),
    Range("soil.friction_angle", 1.1, 1.15, relative=True),
    Range("soil.shear_modulus_x", 0.6, 0.7, "log", relative=True),
    Range("motor.torque_constant", 0.93, 0.95, relative=True),
    Range("motor.resistance", 1.05, 1.07, relative=True),
    Range("winding_temperature", 240.0, 250.0),
)
"""The held-out soil: softer and less cohesive, with more friction that takes less slip to build up, and tired, colder
motors; outside training's range in every parameter. The weak end of all ranges at once is no test: slip is 0.7 on flat
ground, and 9 rovers of 10 dig in on the slopes of `world:train` without any rock."""

SOFT_SOIL = (
    Range("soil.k_phi", 0.15, 0.6, "log", relative=True),
    Range("soil.cohesion", 0.25, 1.0, "log", relative=True),
    Range("soil.friction_angle", 0.75, 0.95, relative=True),
)
"""Soils in which LUVMI-X digs itself in on level ground; a choice. In lunar nominal soil, at 1, it drives off."""

LOW_CHARGE = Range("battery.initial", 0.055, 0.075)
"""State of charge at which drives on a battery begin: 0.5 to 2.5 % above the cut-off, 10 to 48 W h. Electronics of 60 W
alone empty that in 10 to 48 minutes of shadow, and 500 m take LUVMI-X 12 minutes or more."""

TASKS: dict[str, NavigationConfig] = {
    "paper": NavigationConfig(
        weights=dict(PAPER_WEIGHTS), goal_distance=(4.0, 6.0), start_within=2.0, start_yaw=np.pi / 2
    ),
    "consistent": NavigationConfig(goal_distance=(4.0, 6.0), start_within=2.0, start_yaw=np.pi / 2),
    "large": NavigationConfig(
        action="velocity",
        four_wheel_steering=True,
        observations=EGOCENTRIC,
        privileged=("sinkage", "temperatures", "drawn"),
        goal_distance=(10.0, 40.0),
        episode_time=120.0,
        # no price on time: discounting presses enough, and a price makes it pay to end an episode by getting stuck
        weights={"progress": 20.0, "tilt": 0.05, "excite": 0.02, "jerkiness": 0.02},
        failure=-100.0,
        # a rover that rocks to and fro upon a stone is stuck too
        stuck_time=10.0,
        stuck_distance=0.3,
        randomise=SOIL_RANGES,
        divergence="reset",
    ),
    "escape": NavigationConfig(
        # 4 actions a second: rocking takes seconds, and a learner sees ahead by actions
        decimation=125,
        action="velocity",
        four_wheel_steering=True,
        # what the bus voltage of the preset `field` allows: both models of the soil are driven alike
        top_speed=0.25,
        observations=tuple(b for b in EGOCENTRIC if b != "height_scan"),
        privileged=("sinkage", "temperatures", "drawn"),
        episode_time=60.0,
        weights={"away": 20.0, "tilt": 0.05, "excite": 0.02, "jerkiness": 0.02},
        failure=-100.0,
        # to stand still is where it begins, and no end
        stuck_time=1e6,
        places=256,
        randomise=SOFT_SOIL,
        divergence="reset",
        # two lengths of LUVMI-X
        escape_distance=2.0,
    ),
}


def _ladder(number: int) -> NavigationConfig:
    """The task of a rung: `large` with the rung's worlds, goals, costs and time."""
    rung, any_heading = RUNGS[number], RUNGS[number].arrival_deg >= 180.0
    return TASKS["large"].replace(
        rung=number,
        tally=True,
        goal_distance=rung.goal_distance,
        episode_time=rung.episode_time,
        collisions=rung.collisions,
        weights=dict(rung.weights),
        arrive_within=np.pi if any_heading else float(np.radians(rung.arrival_deg)),
        observations=(*EGOCENTRIC, *(() if any_heading else ("arrival",)), *(("power",) if rung.battery else ())),
        randomise=(*SOIL_RANGES, LOW_CHARGE) if rung.battery else SOIL_RANGES,
        # a drive that is given up must stay dearer than any that goes on: a price on time is none
        stuck_time=15.0,
    )


TASKS |= {f"ladder/{number}": _ladder(number) for number in RUNGS}
"""`paper`: section V with its reward as printed. `consistent`: the same with signed progress. `large`: the task of the
large-batch trainings, goals 10 to 40 m away over rough ground, drawn soils and motors. `escape`: get out of a hole that
the wheels have dug in soft soil. `ladder/1` to `ladder/5`: the rungs of the ladder."""

UNSAID: dict[str, tuple[str, str]] = {
    "rover": ("luvmi_x", "the smaller of the two that the paper ships; every setting takes viper as well"),
    "terrain": (
        "lunar_plain",
        "the paper says lunar terrain; its de Gerlache map at 1:100 has hills as large as rovers",
    ),
    "goal distance": ("4 to 6 m", "some body lengths of the rover: reached in 400 episodes of one rover"),
    "start": ("within 2 m of the origin, heading within 90 deg of the goal", "the paper shows one place only"),
    "goal radius": ("0.5 m", "about half the body's length"),
    "episode length": (
        "30 s, longer where the bus voltage keeps the wheels below 1 m/s; then truncated, not terminated",
        "several times what the drive takes",
    ),
    "time step": ("2 ms physics, 0.1 s control", "the physics' own; 10 Hz is what rover electronics do"),
    "torque at action 1": (
        "drive: 0.6 of a wheel's load times its radius; steering: turns the motor's inertia to its limit in 0.5 s; "
        "suspension: half the wheel's load times the arm",
        "15 N m is 12 times what the soil can carry under this rover",
    ),
    "rear steering": ("held straight", "the paper steers with the two front motors"),
    "rolled over": ("up axis more than 60 deg from the vertical", "beyond it no rover comes back"),
    "stuck": ("within 0.1 m of one place for 8 s", "a wheel turns 13 times meanwhile at 1 m/s"),
    "leaving the terrain": ("1.5 m from its edge counts as failed", "beyond the edge the ground is not defined"),
    "action noise N(0, 0.3)": ("standard deviation 0.3", "SB3's NormalActionNoise takes the deviation"),
    "Kalman filter": ("R from 1 cm and 2 cm/s, white jerk of 3 m/s^2.5", "time constant of about 0.1 s at 10 Hz"),
    "frame of positions": ("world axes, origin at the episode's start", "so that places on a large map look alike"),
    "reward of a control step": ("once per action, not per physics step", "as a Gym environment returns it"),
    "r_prog": ("distance in the plane", "the goal has no height"),
    "algorithm settings": (
        "Stable-Baselines3's defaults of the paper's time (before 2.3), batches of 100, one update per step",
        "the paper changes none",
    ),
}
"""What the paper leaves unsaid about the task: the choice and its reason."""
