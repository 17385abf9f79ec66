"""The seed paper's navigation task (section V) for a whole batch of rovers: pure functions on pytrees."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.cameras.batch import Light, pictures
from lunar_mjx.cameras.mount import front_mount
from lunar_mjx.dynamics import Params, System, build
from lunar_mjx.dynamics import State as Physics
from lunar_mjx.effects.power.supply import charge_of
from lunar_mjx.effects.presets import DEFAULT_PRESET
from lunar_mjx.effects.soil.ruts import Relief
from lunar_mjx.envs.core import State, side_by_side, split_keys, where
from lunar_mjx.envs.ladder import chart
from lunar_mjx.envs.ladder.pool import Pool, make_pool, way_left
from lunar_mjx.envs.ladder.renewal import Renewal, begins, worlds_in_use
from lunar_mjx.envs.ladder.renewal import pick as pick_open
from lunar_mjx.envs.ladder.rungs import Rung, get_rung
from lunar_mjx.envs.navigation import digging, kalman, randomise, rewards, sensing, tally
from lunar_mjx.envs.navigation.actions import action_map, reachable_speed
from lunar_mjx.envs.navigation.config import TASKS, NavigationConfig
from lunar_mjx.envs.navigation.observations import CAMERA, Scene, observe
from lunar_mjx.envs.navigation.places import draw_places
from lunar_mjx.envs.navigation.view import SCAN_SCALE, VIEW, Reader, View, goal_in_body, read
from lunar_mjx.envs.navigation.worlds import PREFIX, world
from lunar_mjx.errors import bad_input
from lunar_mjx.model import Model, make_model
from lunar_mjx.model.sun import SunSettings
from lunar_mjx.pytree import pytree

ENDS = ("reached", "rolled_over", "stuck", "off_terrain", "diverged")
"""Ways in which an episode terminates; the first is success, the others bring the failure reward. Where collisions end
an episode, `collided` is one more, and `drained` where a battery can cut the motors off."""
LADDER_PRESET = "consistent"
"""Physics of the ladder unless told otherwise. In `field` LUVMI-X slips 0.68 on 5 deg and slides back on 10 deg: the
upper rungs' slopes could not be driven."""
SUPPLY = ("motor_power", "electronics", "solar_panels", "battery")
"""Effects that a rung with a battery adds to a model that has none."""
LOW_SUN = SunSettings(azimuth_deg=135.0, elevation_deg=6.0)
"""Sun of such a rung: near the poles it stays this low, and relief of some degrees casts shadows."""
_USED = 0.125
"""Share of the rovers that may be without a prepared episode before all are prepared anew."""


@pytree
class NavigationParams:
    """Parameters that all environments of a batch share; others with arrays of equal shapes need no compilation.

    Attributes:
      system: physical parameters.
      starts, goals: (place, 2) m.
      bounds: (range, 2) low and high of every randomised parameter.
      gains: (n, 3, 2) of the Kalman filter.
      shortest: (place,) length of the shortest way, m, or as the crow flies; None without a tally.
      arrivals: (place,) heading to arrive in, rad; None where any will do.
      ground: lowest and highest ground, m; None to look anew.
      side: of the worlds that make up the terrain, m: leaving one's own fails; None if it is one.
      pool: the ladder's worlds, for planners and the reward `way`; None elsewhere.
      spread: of the model's posterior; None unless it is drawn from.
      least_level: of the curriculum, from 0: below it no rover begins; None without one.
      begins: (place,) see `renewal.begins`; None where episodes begin at all places.
      dug: (place, ...) rovers that have dug themselves in; None unless the task is to escape.
    """

    system: Params
    starts: Any
    goals: Any
    bounds: Any
    gains: Any
    shortest: Any = None
    arrivals: Any = None
    ground: Any = None
    side: Any = None
    pool: Pool | None = None
    spread: randomise.Spread | None = None
    least_level: Any = None
    begins: Any = None
    dug: digging.Dug | None = None


@pytree
class Ready:
    """The beginning of each rover's next episode, prepared; leading axis `env`.

    Attributes:
      obs, privileged, info: as in `State`. inner: with neither `ready` nor `used`, `chart` or `next_level` of its own.
    """

    obs: Any
    privileged: Any
    info: dict[str, Any]
    inner: Inner


@pytree
class Inner:
    """State of the task beyond the observation; leading axis `env`.

    Attributes:
      physics: of the rovers.
      key: raw random keys.
      drawn: parameters drawn for the episode.
      origin: where the episode began, m. goal: m.
      filtered: Kalman filter.
      slip, sinkage: of the last physics step.
      last_action: as given.
      anchor: (2,) place that the rover last left by the stuck distance, m. waited: time since then, s.
      steps: control steps of the episode. total: its return.
      place: number of the pair of start and goal. tally: of the episode. left: length of the shortest way to the
        goal from where the rover last stood on free ground, m. trail: (3, 2) means of past positions, m.
        visited: (place, 2) where it was, newest first, m. All None unless the task needs them.
      chart: what the rover knows of its world; None unless it is observed, and in a prepared beginning.
      level: of the curriculum on which the episode began, from 0. next_level: on which beginnings are prepared. None
        without one.
      late: (steps, ...) observations and `info` on their way, newest first. odometry: where the rover believes to be.
        Both None where sensors are at once and exact.
      ready: the next episode's beginning, from `key`. used: (env,) where it has been taken and not yet replaced.
    """

    physics: Physics
    key: Any
    drawn: dict[str, Any]
    origin: Any
    goal: Any
    filtered: kalman.KalmanState
    slip: Any
    sinkage: Any
    last_action: Any
    anchor: Any
    waited: Any
    steps: Any
    total: Any
    place: Any = None
    tally: tally.Tally | None = None
    left: Any = None
    trail: Any = None
    visited: Any = None
    chart: chart.Chart | None = None
    level: Any = None
    next_level: Any = None
    late: Any = None
    odometry: sensing.Odometry | None = None
    ready: Ready | None = None
    used: Any = None


@dataclasses.dataclass(frozen=True)
class Plausible:
    """Beyond these values a rover's state is taken for diverged."""

    most_speed: float = 30.0
    """m/s of the chassis: ten times the fastest rover that has driven on the Moon (LRV, 18 km/h), and a fall from 280
    m."""
    most_turn: float = 100.0
    """rad/s of the chassis and of every joint: a wheel of 0.1 m rim radius at 10 m/s."""
    most_height: float = 50.0
    """m above the highest and below the lowest ground."""
    most_value: float = 1e4
    """Largest observation and reward that a replay buffer and the normaliser are given."""


PLAUSIBLE = Plausible()


def plausible(qpos: Any, qvel: Any, ground: Any) -> Any:
    """Whether rovers are where and as fast as rovers can be, (env,); false for what is not finite.

    Args:
      qpos: (env, nq), qvel: (env, nv), of a free body and its joints. ground: lowest and highest ground, m.
    """
    low, high = ground[0] - PLAUSIBLE.most_height, ground[1] + PLAUSIBLE.most_height
    in_range = (qpos[:, 2] > low) & (qpos[:, 2] < high) & (jnp.abs(qpos[:, 7:]) < PLAUSIBLE.most_value).all(-1)
    slow = (jnp.abs(qvel[:, :3]) < PLAUSIBLE.most_speed).all(-1) & (jnp.abs(qvel[:, 3:]) < PLAUSIBLE.most_turn).all(-1)
    return in_range & slow


def bounded(a: Any) -> Any:
    """Values within `PLAUSIBLE.most_value`; 0 for what is not finite."""
    return jnp.clip(jnp.nan_to_num(a, nan=0.0, posinf=0.0, neginf=0.0), -PLAUSIBLE.most_value, PLAUSIBLE.most_value)


class NavigationEnv:
    """Drive to a goal over lunar terrain; see `docs/reinforcement_learning.md` and `NavigationConfig`.

    Args:
      model: rover, terrain and effects.
      config: the task.
      engine: of the physics, as for `lunar_mjx.dynamics.build`.

    Raises:
      UserError: settings that do not fit the model.
    """

    def __init__(self, model: Model, config: NavigationConfig, engine: str = "auto"):
        # Before anything is compiled.
        randomise.check_ranges(model, config.randomise)
        if config.camera_tracks and "ruts" not in model.effect_names:
            remedy = 'make the model with model.add("rim_contact").add("ruts"), or leave it out'
            raise bad_input("navigation", "camera_tracks", True, "needs a model with the effect ruts", remedy)
        if config.posterior:
            told = randomise.spread_of(model).parameters
            config = config.replace(randomise=tuple(r for r in config.randomise if r.parameter not in told))
        self.model, self.config = model, config
        self.system: System = build(model, engine)
        self.actions = action_map(model, config.action, config.top_speed, config.load_share, config.four_wheel_steering)
        # the map's control modes differ between front and rear wheels, which those of the model cannot
        self.system.info = dataclasses.replace(self.system.info, mode=self.actions.mode)
        self.control_interval = config.decimation * model.timestep
        self.episode_steps = max(1, round(config.episode_time / self.control_interval))
        self._late_steps = round(config.delay / self.control_interval)
        if abs(self._late_steps * self.control_interval - config.delay) > 1e-6:
            remedy = f"give a multiple of {self.control_interval:g} s"
            raise bad_input("navigation", "delay", config.delay, "is no whole number of control steps", remedy)
        self._reader = Reader(self.system)
        self._wheels = len(model.rover.wheels)
        self._ride = model.rover.standing_height
        self._scale = SCAN_SCALE.get(model.rover.name, 1.0)
        self._outline = tally.Outline(self.system) if config.tally else None
        self._battery = "battery" in model.effect_names
        self._levels = config.curriculum_levels if config.curriculum_levels > 1 else 0
        if "power" in config.observations and not (self._battery and model.sun is not None):
            remedy = "add the effect battery and a Sun to the model, or leave it out"
            raise bad_input("navigation", "observations", "power", "needs a battery and a Sun", remedy)
        self._told = (*config.observations, *config.privileged)
        # Metrics have a fixed set of names, told once.
        more = ("collided",) if config.collisions == "end" else ()
        self._ends_told = (*ENDS, *more, *(("drained",) if self._battery else ()))
        self.params = self.place(model)
        if self._levels:
            # only the training's own parameters: all others that are made are for tests of what was learnt
            self.params = dataclasses.replace(self.params, least_level=jnp.int32(0))
        self.action_size = self.actions.size
        # Sizes are read off the program itself, so that no table of widths can be wrong.
        shapes = jax.eval_shape(self.reset, self.params, jax.ShapeDtypeStruct((1, 2), jnp.uint32))
        self.observation_size = shapes.obs.shape[1]
        self.privileged_size = shapes.privileged.shape[1]

    def place(
        self,
        model: Model | None = None,
        ranges: Sequence[randomise.Range] | None = None,
        seed: int | None = None,
        hardness: float | None = None,
    ) -> NavigationParams:
        """Parameters for another terrain, other ranges of the same parameters, or other places.

        Args:
          model: brings the terrain and physical parameters; this environment's own if None.
          ranges: with the same parameters as the configuration's, in the same order.
          seed: of the places; on the ladder of its worlds, too.
          hardness: of the ladder's worlds; the configuration's if None.

        Raises:
          UserError: ranges of other parameters, or a terrain without room.
        """
        from lunar_mjx.dynamics.system import default_params

        model, c = model or self.model, self.config
        ranges = c.randomise if ranges is None else tuple(ranges)
        if [(r.parameter, r.scale, r.relative) for r in ranges] != [
            (r.parameter, r.scale, r.relative) for r in c.randomise
        ]:
            raise bad_input(
                "navigation",
                "ranges",
                [r.parameter for r in ranges],
                "are not those of the task",
                "give the same parameters and scales in the same order",
            )
        bounds = np.array([(r.low, r.high) for r in ranges], np.float32).reshape(-1, 2)
        gains = kalman.gains(c.kalman, c.decimation * model.timestep).astype(np.float32)
        number = c.place_seed if seed is None else seed
        spread = randomise.spread_of(model) if c.posterior else None
        if c.rung:
            return dataclasses.replace(self._on_pool(model, self.pool(number, hardness), bounds, gains), spread=spread)
        starts, goals = draw_places(
            model.terrain,
            c.places,
            c.goal_distance,
            number,
            clearance=0.5 + 2.0 * self._ride,
            margin=c.edge + 1.0,
            steepest=c.steepest,
            within=c.start_within,
        )
        arrays = [jnp.asarray(a, jnp.result_type(float)) for a in (starts, goals, bounds, gains)]
        # out of a hole any straight way will do
        least = np.full(len(starts), c.escape_distance) if c.escape_distance else np.hypot(*(goals - starts).T)
        shortest = jnp.asarray(least, arrays[0].dtype) if c.tally else None
        params = NavigationParams(default_params(model), *arrays, shortest=shortest, spread=spread)
        if not c.escape_distance:
            return params
        # Made once and kept: an episode's reset then only picks, and no rover waits for another to dig.
        found = self._dig(params, split_keys(jax.random.PRNGKey(number), c.places))
        return dataclasses.replace(params, dug=digging.stuck_ones(*found))

    @functools.cached_property
    def _dig(self) -> Any:
        """The compiled maker: parameters and keys to rovers that have spun, what they drew, and which are stuck."""

        def dig(params: NavigationParams, keys: Any) -> tuple[Physics, dict[str, Any], Any]:
            fresh = self._fresh(params, keys)
            system, axes = randomise.apply(params.system, fresh.drawn)
            physics, stuck = digging.spin(self.system, system, axes, fresh.physics, self.actions)
            return physics, fresh.drawn, stuck

        return jax.jit(dig)

    def pool(self, seed: int, hardness: float | None = None) -> Pool:
        """The ladder's worlds of a seed, for this rover."""
        c = self.config
        rung, half_width = self._rung()
        hardness = c.hardness if hardness is None else hardness
        # Who begins within the goal's radius has arrived: such a level would teach nothing, and always be passed.
        if self._levels * c.goal_radius >= rung.goal_distance[0]:
            problem = f"lets rovers begin within goal_radius = {c.goal_radius:g} m of the goal"
            remedy = f"give less than {rung.goal_distance[0] / c.goal_radius:g}"
            raise bad_input("navigation", "curriculum_levels", c.curriculum_levels, problem, remedy)
        return make_pool(rung, seed, c.worlds or rung.worlds, half_width, hardness, self._levels)

    def _rung(self) -> tuple[Rung, float]:
        """The rung for this rover, and half its width with a margin, m."""
        half_width = (self._outline or tally.Outline(self.system)).half[1] + 0.1
        # Whole multiples of LUVMI-X's world: grids and boulders then divide as they do there.
        return get_rung(self.config.rung).scaled(max(1.0, round(half_width / 0.4))), half_width

    def renewal(self) -> Renewal | None:
        """Makes the ladder's worlds anew between epochs of a training (`renewed`); None unless the task says so.

        Raises:
          UserError: a single world.
        """
        c = self.config
        if not c.renew:
            return None
        rung, half_width = self._rung()
        return Renewal(rung, c.place_seed, c.worlds or rung.worlds, half_width, c.hardness, self._levels)

    def renewed(self, renewal: Renewal, params: NavigationParams, state: State) -> NavigationParams:
        """The parameters with all worlds anew in which no episode of `state` is under way or prepared.

        Nothing that is under way changes, and shapes stay, so that nothing is compiled again.
        """
        inner, pool = state.inner, self._whole(params)
        count = len(renewal.generation)
        used = worlds_in_use(pool.places.world, count, inner.place, inner.ready.inner.place, inner.used)
        pool = renewal(pool, used)
        return params if pool is None else self.on_renewed(renewal, params, pool)

    def _whole(self, params: NavigationParams) -> Pool:
        """The pool with its map, which the parameters keep but once."""
        assert params.pool is not None
        return dataclasses.replace(params.pool, terrain=params.system.terrain)

    def on_renewed(self, renewal: Renewal, params: NavigationParams, pool: Pool | None = None) -> NavigationParams:
        """The parameters on a pool of which only the open worlds are begun in; on their own if None."""
        pool = self._whole(params) if pool is None else pool
        at, heights = pool.places, pool.terrain.field.heights
        return dataclasses.replace(
            params,
            system=dataclasses.replace(params.system, terrain=pool.terrain),
            starts=at.starts,
            goals=at.goals,
            shortest=None if params.shortest is None else at.shortest,
            arrivals=None if params.arrivals is None else at.arrivals,
            ground=jnp.stack([heights.min(), heights.max()]),
            pool=dataclasses.replace(pool, terrain=None),
            begins=begins(at.world, renewal.is_open),
        )

    def _on_pool(self, model: Model, pool: Pool, bounds: Any, gains: Any) -> NavigationParams:
        from lunar_mjx.dynamics.system import default_params

        c, at = self.config, pool.places
        heights = pool.terrain.field.heights
        return NavigationParams(
            default_params(model.replace(terrain=pool.terrain)),
            at.starts,
            at.goals,
            *(jnp.asarray(a, jnp.result_type(float)) for a in (bounds, gains)),
            shortest=at.shortest if c.tally else None,
            arrivals=at.arrivals if c.arrive_within < np.pi or "arrival" in self._told else None,
            # Looked at once; over a map of many worlds it would cost every step.
            ground=jnp.stack([heights.min(), heights.max()]),
            side=pool.size,
            # the map is in `system` already
            pool=dataclasses.replace(pool, terrain=None),
            least_level=jnp.int32(self._levels - 1) if self._levels else None,
            begins=begins(at.world, np.ones(len(pool.middles), bool)) if c.renew else None,
        )

    @functools.cached_property
    def blocks(self) -> dict[str, slice]:
        """Where each block of the observation lies in it."""

        def widths(params: NavigationParams, keys: Any) -> dict[str, Any]:
            inner = self._fresh(params, keys)
            view = self._view(params, inner)
            scene = self._scene(self.config.observations, params, inner, view)
            return {name: observe((name,), view, scene) for name in self.config.observations}

        shapes = jax.eval_shape(widths, self.params, jax.ShapeDtypeStruct((1, 2), jnp.uint32))
        ends = np.cumsum([0, *(shapes[name].shape[1] for name in self.config.observations)]).tolist()
        return {name: slice(a, b) for name, a, b in zip(self.config.observations, ends[:-1], ends[1:], strict=True)}

    @property
    def picture(self) -> tuple[int, int, int, int] | None:
        """First number, rows, columns and colours of the observation's first picture; None without any."""
        for name, place in self.blocks.items():
            if name.startswith(CAMERA):
                rows, columns = self.config.camera_height, self.config.camera_width
                return place.start, rows, columns, (place.stop - place.start) // (rows * columns)
        return None

    def reset(self, params: NavigationParams, keys: Any) -> State:
        """Begins an episode in every environment; `keys` (env, 2) raw random keys."""
        # the first episode and the prepared one in one batch: half the program to compile
        level = self._first_level(params, keys)
        twice = None if level is None else jnp.tile(level, 2)
        begun = self._begin(params, jnp.concatenate([keys, _split(keys)[:, 0]]), twice)
        first, ready = (
            jax.tree.map(lambda a, p=part: a[p], begun) for part in (slice(keys.shape[0]), slice(keys.shape[0], None))
        )
        obs, privileged, inner = first.obs, first.privileged, first.inner
        zero, no = jnp.zeros(keys.shape[0], obs.dtype), jnp.zeros(keys.shape[0], bool)
        terms = (f"reward_{n}" for n in self.config.weights)
        metric_names = tally.METRICS if self.config.tally else ()
        told = ("curriculum_level",) if self._levels else ()
        names = ("episode_return", "episode_length", "success", *self._ends_told[1:], *metric_names, *terms, *told)
        metrics = dict.fromkeys(names, zero)
        inner = dataclasses.replace(inner, ready=ready, used=no, chart=self._blank(params, inner), next_level=level)
        return State(obs, privileged, zero, no, no, obs, privileged, metrics, first.info, inner)

    def step(self, params: NavigationParams, state: State, action: Any) -> State:
        """Acts in every environment, `action` (env, action) in [-1, 1], and resets those whose episode ended.

        Next episodes are prepared with `params` as they were then: after another terrain or range, call `reset`.
        """
        return self.restarted(params, self.act(params, state, action))

    def act(self, params: NavigationParams, state: State, action: Any) -> State:
        """The state after an action, that of the episode that ended where one did; `step` goes on from it."""
        c, inner = self.config, state.inner
        # before rewards see it: an agent must not be punished or paid for what the motors never got
        action = jnp.clip(action, -1.0, 1.0).astype(inner.last_action.dtype)
        # From the physics and not from the view: the view is of after the step.
        before = inner.goal - inner.physics.qpos[:, :2]
        inner, view = self._advance(params, inner, action)
        to_goal = inner.goal - view.position[:, :2]
        transition = rewards.Transition(
            before,
            to_goal,
            view.roll,
            view.pitch,
            view.yaw,
            view.filtered.acceleration[:, 2],
            action,
            state.inner.last_action,
            *self._costs(inner),
            nearer=None if inner.left is None else state.inner.left - inner.left,
        )
        terms = {name: weight * rewards.TERMS[name](transition) for name, weight in c.weights.items()}
        ends = self._ends(params, inner, view, to_goal)
        success = ends["reached"]
        terminated = functools.reduce(jnp.logical_or, ends.values())
        running = sum(terms.values())
        if c.divergence == "reset":
            # A state that is gone has no honest running reward; the failure's counts.
            running = jnp.where(ends["diverged"], 0.0, bounded(running))
        reward = running + jnp.where(success, c.success, jnp.where(terminated, c.failure, 0.0))
        inner = dataclasses.replace(inner, steps=inner.steps + 1, total=inner.total + reward)
        # not both: a learner bootstraps from the last state of a truncated episode, and not from that of an ended one
        truncated = ~terminated & (inner.steps >= self.episode_steps)
        metrics = {
            "episode_return": inner.total,
            "episode_length": inner.steps.astype(reward.dtype),
            "success": success.astype(reward.dtype),
            **{name: ends[name].astype(reward.dtype) for name in self._ends_told[1:]},
            **{f"reward_{name}": value for name, value in terms.items()},
        }
        if inner.tally is not None:
            metrics |= tally.metrics(inner.tally, self._shortest(params, inner.place, inner.level), inner.steps)
        if inner.level is not None:
            metrics["curriculum_level"] = 1.0 + inner.level.astype(reward.dtype)
            # The next episode is prepared already: this one's end decides about those that are prepared from now on.
            reached = jnp.clip(inner.level + jnp.where(success, 1, -1), params.least_level, self._levels - 1)
            after = jnp.where(terminated | truncated, reached, inner.next_level)
            inner = dataclasses.replace(inner, next_level=after)
        # before the restart: the successor in the replay buffer is the old episode's last state, not the new one's
        final_obs, final_privileged = self._observe(params, inner, view)
        info = self._info(view)
        if inner.late is not None:
            final_obs, info, inner = self._after_delay(inner, final_obs, info)
        if c.divergence == "reset":
            # the successor of a state that is gone carries no value, but must not poison a batch
            final_obs, final_privileged = bounded(final_obs), bounded(final_privileged)
        return State(
            final_obs,
            final_privileged,
            reward,
            terminated,
            truncated,
            final_obs,
            final_privileged,
            metrics,
            info,
            inner,
        )

    def restarted(self, params: NavigationParams, after: State) -> State:
        """The state of `act` with new episodes where one ended: `step` in two parts, for who records the ends."""
        return side_by_side(self._restart(params, after.inner, after))

    def _restart(self, params: NavigationParams, inner: Inner, state: State) -> State:
        """Begins anew where the episode ended, keeping the final observations.

        To begin takes many small kernels, to select few. So every rover keeps the beginning of its next episode; all
        are prepared anew once some have been taken, or where an episode ends whose rover has none. Which episode comes
        next depends on the rover's key alone, and not on when it was prepared.
        """
        done, kept = state.done, side_by_side((inner.ready, inner.used))
        # the prepared episode lies inside the state that it replaces, so that it is taken out before the selection
        alone = dataclasses.replace(inner, ready=None, used=None, chart=None, next_level=None)

        def prepare(carry: Any) -> Any:
            _, (_, used) = carry
            return jnp.zeros((), bool), side_by_side(
                (self._begin(params, inner.key, inner.next_level), jnp.zeros_like(used))
            )

        short = (done & inner.used).any() | (inner.used.mean(dtype=jnp.float32) > _USED)
        # a loop of no or one turn: unlike a conditional, it leaves what it does not change where it is
        _, (ready, used) = jax.lax.while_loop(lambda carry: carry[0], prepare, (short, kept))
        per_rover = side_by_side((state.obs, state.privileged, state.info, alone))
        obs, privileged, info, alone = where(done, (ready.obs, ready.privileged, ready.info, ready.inner), per_rover)
        known = inner.chart
        if known is not None:
            # a blank chart is cheaper made than kept
            known = where(done, self._blank(params, alone), known)
        inner = dataclasses.replace(alone, ready=ready, used=used | done, chart=known, next_level=inner.next_level)
        return dataclasses.replace(state, obs=obs, privileged=privileged, info=info, inner=inner)

    def _begin(self, params: NavigationParams, keys: Any, level: Any = None) -> Ready:
        """New episodes with their first observations, on levels of the curriculum where there is one."""
        inner = self._fresh(params, keys, level)
        view = self._view(params, inner)
        obs, privileged = self._observe(params, inner, view)
        info = self._info(view)
        if self._late_steps:
            inner = dataclasses.replace(inner, late=sensing.queue_of((obs, info), self._late_steps))
        return Ready(obs, privileged, info, inner)

    def _after_delay(self, inner: Inner, obs: Any, info: dict[str, Any]) -> tuple[Any, dict[str, Any], Inner]:
        """What arrives while `obs` and `info` are made; a rover knows at once what it has commanded itself."""
        (late, told), queue = sensing.arrived(inner.late, (obs, info))
        own = self.blocks.get("last_action")
        if own is not None:
            late = late.at[:, own].set(obs[:, own])
        # The true position is no sensor's: pictures and tests read it.
        return late, {**told, "position": info["position"]}, dataclasses.replace(inner, late=queue)

    def _costs(self, inner: Inner) -> tuple[Any, ...]:
        """Power, mean slip, hottest winding and collisions of a step, where the task keeps a tally."""
        if inner.tally is None:
            return (None,) * 4
        hottest = inner.physics.temperature.winding_kelvin.max(-1)
        return inner.tally.power, jnp.abs(jnp.clip(inner.slip, -1.0, 1.0)).mean(-1), hottest, inner.tally.struck

    def _drive(self, params: NavigationParams, inner: Inner, action: Any) -> tuple[Physics, tuple[Any, ...]]:
        """The physics of one action: its state after, and of its last step slip and sinkage (env, wheel), and the
        motors' electrical power (env, joint), W, where the task keeps a tally."""
        c = self.config
        system, axes = randomise.apply(params.system, inner.drawn)
        controls = self.actions.controls(action)
        power = (lambda seen: (seen.current * seen.voltage,)) if c.tally else (lambda seen: ())
        physics, seen = self.system.rollout_batch(
            system,
            inner.physics,
            controls[:, None],
            c.decimation,
            axes,
            lambda seen: (seen.slip, seen.sinkage, *power(seen)),
            # The step is compiled once, not once more for the steps whose telemetry nobody reads.
            one_body=True,
            last=True,
        )
        return physics, tuple(value[:, 0] for value in seen)

    def _advance(self, params: NavigationParams, inner: Inner, action: Any) -> tuple[Inner, View]:
        c = self.config
        physics, (slip, sinkage, *power) = self._drive(params, inner, action)
        # In the plane, like the shortest way that it is compared with.
        moved = rewards.length(physics.qpos[:, :2] - inner.physics.qpos[:, :2])
        position, velocity = physics.qpos[:, :3], physics.qvel[:, :3]
        filtered = kalman.update(params.gains, self.control_interval, inner.filtered, position, velocity)
        # way from an anchor and not speed: a rover that rocks to and fro in a hole moves and gets nowhere
        away = rewards.length(position[:, :2] - inner.anchor) > c.stuck_distance
        waited = jnp.where(away, 0.0, inner.waited + self.control_interval)
        inner = dataclasses.replace(
            inner,
            physics=physics,
            filtered=filtered,
            slip=slip,
            sinkage=sinkage,
            last_action=action,
            anchor=jnp.where(away[:, None], position[:, :2], inner.anchor),
            waited=waited,
        )
        believed = position[:, :2]
        if inner.odometry is not None:
            odometry = sensing.drifted(inner.odometry, moved, c.drift)
            inner, believed = dataclasses.replace(inner, odometry=odometry), believed + odometry.error
        if inner.trail is not None:
            fade = jnp.exp(-self.control_interval / jnp.asarray(VIEW.trail, position.dtype))[:, None]
            # Exponential means over three times: a memory of fixed size of where the rover has been.
            trail = believed[:, None] + fade * (inner.trail - believed[:, None])
            inner = dataclasses.replace(inner, trail=trail)
        if inner.visited is not None:
            far = rewards.length(believed - inner.visited[:, 0]) > VIEW.visited_apart
            more = jnp.concatenate([believed[:, None], inner.visited[:, :-1]], axis=1)
            inner = dataclasses.replace(inner, visited=jnp.where(far[:, None, None], more, inner.visited))
        if inner.left is not None and params.pool is not None:
            # the way from where a boulder's margin was entered counts until it is left, so that pressing into a ridge
            # towards its other side pays nothing
            left, known = way_left(params.pool, inner.place, position[:, :2])
            inner = dataclasses.replace(inner, left=jnp.where(known, left, inner.left))
        if inner.chart is not None:
            patience, yaw = chart.CHART.patience, self._reader.pose(physics)["yaw"]
            # tried in vain each time that as long has passed without progress
            vain = jnp.floor(waited / patience) > jnp.floor((waited - self.control_interval) / patience)
            vain = jnp.where(vain & (waited > 0.0), self.actions.ahead(action), 0.0)
            inner = dataclasses.replace(inner, chart=chart.look(inner.chart, self._errand(params, inner), yaw, vain))
        view = self._view(params, inner)
        if inner.tally is not None and self._outline is not None:
            touching = self._outline.touches(params.system.terrain, view)
            counted = tally.update(inner.tally, moved, power[0], slip, touching, self.control_interval)
            inner = dataclasses.replace(inner, tally=counted)
        return inner, view

    def _ends(self, params: NavigationParams, inner: Inner, view: View, to_goal: Any) -> dict[str, Any]:
        """Which end each episode came to; exclusive, in the order of `ENDS` but divergence first."""
        c, field = self.config, params.system.terrain.field
        physics = inner.physics
        fine = jnp.isfinite(physics.qpos).all(-1) & jnp.isfinite(physics.qvel).all(-1)
        if c.divergence == "reset":
            ground = params.ground
            if ground is None:
                ground = jnp.stack([field.heights.min(), field.heights.max()])
            diverged = ~(fine & plausible(physics.qpos, physics.qvel, ground))
        else:
            diverged = jnp.zeros_like(fine)
        position_xy = view.position[:, :2]
        inside = ((position_xy > view.corners[:, 0]) & (position_xy < view.corners[:, 1])).all(-1)
        reached = rewards.reached(to_goal, c.goal_radius)
        if c.escape_distance:
            reached = rewards.length(to_goal) > c.escape_distance
        if c.arrive_within < np.pi and view.arrival is not None:
            reached = reached & (jnp.cos(view.arrival - view.yaw) > np.cos(c.arrive_within))
        end_flags = {
            "diverged": diverged,
            "reached": reached,
            "rolled_over": rewards.rolled_over(view.up[:, 2], c.most_tilt),
            "stuck": rewards.stuck(inner.waited, c.stuck_time),
            "off_terrain": ~inside & fine,
        }
        if c.collisions == "end" and inner.tally is not None:
            end_flags["collided"] = inner.tally.struck > 0.0
        if self._battery:
            end_flags["drained"] = physics.effects["battery"]["flat"] > 0.5
        # Exclusive, so that the shares of all ends add up to one.
        no_reward = jnp.zeros_like(fine)
        for name, happened in end_flags.items():
            end_flags[name] = happened & ~no_reward
            no_reward = no_reward | happened
        return end_flags

    def _first_level(self, params: NavigationParams, keys: Any) -> Any:
        """Levels of the curriculum on which rovers begin, drawn evenly, so that all are driven from the first step on;
        None without one."""
        if not self._levels:
            return None
        # folded, so that everything else is drawn as without a curriculum
        draw = jax.vmap(lambda k: jax.random.randint(jax.random.fold_in(k, 0), (), 0, self._levels))
        return jnp.maximum(draw(keys), params.least_level)

    def _shortest(self, params: NavigationParams, place: Any, level: Any) -> Any:
        """Length of the shortest way of pairs of start and goal, from where a level of the curriculum begins."""
        if level is None or params.pool is None:
            return params.shortest[place]
        return params.pool.places.nearer_shortest[place, level]

    def _fresh(self, params: NavigationParams, keys: Any, level: Any = None) -> Inner:
        """New episodes, all at their beginning."""
        c, count = self.config, keys.shape[0]
        if level is None:
            level = self._first_level(params, keys)
        split = _split(keys)
        # One key for each environment: what an episode draws does not depend on how many others run beside it.
        if params.begins is None:
            pick = jax.vmap(lambda k: jax.random.randint(k, (), 0, params.starts.shape[0]))(split[:, 1])
        else:
            pick = pick_open(params.begins, jax.vmap(jax.random.uniform)(split[:, 1]))
        start, goal = params.starts[pick], params.goals[pick]
        if level is not None and params.pool is not None:
            start = params.pool.places.nearer[pick, level]
        if params.dug is None:
            physics, drawn = self._placed(params, split, start, goal)
        else:
            dug = jax.tree.map(lambda a: a[pick], params.dug)
            physics, drawn = dug.physics, dug.drawn
            # The place to get away from takes the goal's.
            start = goal = physics.qpos[:, :2]
        position = physics.qpos[:, :3]
        zero, wheels = jnp.zeros(count, position.dtype), jnp.zeros((count, self._wheels), position.dtype)
        return Inner(
            physics=physics,
            key=split[:, 0],
            drawn=drawn,
            origin=position,
            goal=goal,
            filtered=kalman.start(position, physics.qvel[:, :3]),
            slip=wheels,
            sinkage=wheels,
            last_action=jnp.zeros((count, self.actions.size), position.dtype),
            anchor=start,
            waited=zero,
            steps=jnp.zeros(count, jnp.int32),
            total=zero,
            place=pick if params.shortest is not None or params.arrivals is not None else None,
            tally=tally.start(count, position.dtype) if c.tally else None,
            left=self._shortest(params, pick, level) if "way" in c.weights and params.pool is not None else None,
            level=level,
            odometry=sensing.odometry_at_start(
                jax.vmap(lambda k: jax.random.fold_in(k, 1))(split[:, 2]), position.dtype
            )
            if c.drift > 0.0
            else None,
            trail=jnp.repeat(position[:, None, :2], len(VIEW.trail), axis=1) if "trail" in self._told else None,
            visited=jnp.full((count, VIEW.visited_kept, 2), VIEW.nowhere, position.dtype)
            if "visited" in self._told
            else None,
        )

    def _placed(self, params: NavigationParams, split: Any, start: Any, goal: Any) -> tuple[Physics, dict[str, Any]]:
        """Rovers at rest where their episodes begin, and the parameters drawn for them; `split` of their keys."""
        c = self.config
        turn = jax.vmap(lambda k: jax.random.uniform(k, (), minval=-1.0, maxval=1.0))(split[:, 2])
        # Headings are drawn about the goal's bearing.
        bearing = jnp.arctan2(goal[:, 1] - start[:, 1], goal[:, 0] - start[:, 0])
        drawn = randomise.draw(c.randomise, params.system, params.bounds, split[:, 3])
        if params.spread is not None:
            # Keys of its own: ranges draw the same numbers with and without a posterior beside them.
            own = jax.vmap(lambda k: jax.random.fold_in(k, 1))(split[:, 3])
            drawn |= randomise.draw_spread(params.spread, params.system, own)
        system, axes = randomise.apply(params.system, drawn)
        warm = drawn.get("winding_temperature")
        physics = jax.vmap(self.system.reset, in_axes=(axes, 0, 0, 0, None if warm is None else 0))(
            system, start[:, 0], start[:, 1], bearing + c.start_yaw * turn, warm
        )
        return physics, drawn

    def _corners(self, params: NavigationParams, inner: Inner) -> Any:
        """South-western and north-eastern corner of the ground that each rover must not leave, (env, 2, 2) m."""
        field = params.system.terrain.field
        rows, cols = field.heights.shape
        low = jnp.stack([field.x0, field.y0])
        high = low + jnp.asarray([cols - 1, rows - 1]) * field.cell
        start = inner.origin[:, :2]
        if params.side is None:
            low, high = (jnp.broadcast_to(corner, start.shape) for corner in (low, high))
        else:
            # the world in which the episode began
            # Nodes are the cells' middles, worlds meet at cells' edges.
            corner = low - 0.5 * field.cell
            # By where the episode began: a rover that crosses the border has left its world.
            low = corner + jnp.floor((start - corner) / params.side) * params.side
            high = low + params.side
        return jnp.stack([low + self.config.edge, high - self.config.edge], axis=1)

    def _errand(self, params: NavigationParams, inner: Inner) -> chart.Errand:
        """What the functions of `ladder.chart` take."""
        assert params.pool is not None
        pool, within = params.pool, self.config.arrive_within
        world = pool.places.world[inner.place]
        corner = pool.middles[world] - 0.5 * pool.size
        # The map is drawn about the rover, wherever that may be: what odometry errs by displaces the goal on it.
        goal = inner.goal if inner.odometry is None else inner.goal - inner.odometry.error
        return chart.Errand(
            pool.prices,
            world,
            inner.physics.qpos[:, :2] - corner,
            goal - corner,
            pool.size / pool.prices.shape[-1],
            pool.usual_price,
            pool.places.arrivals[inner.place] if within < np.pi else None,
            within,
        )

    def _blank(self, params: NavigationParams, inner: Inner) -> chart.Chart | None:
        """The charts of rovers that have seen nothing; None unless they are observed."""
        return chart.begin(self._errand(params, inner)) if "plan" in self._told else None

    def _plan(self, params: NavigationParams, inner: Inner) -> Any:
        """The field `plan` of `View`; of who has seen nothing yet, straight for the goal."""
        if "plan" not in self._told:
            return None
        errand = self._errand(params, inner)
        aim, nodes, left = chart.straight(errand) if inner.chart is None else chart.way(inner.chart, errand)
        return jnp.concatenate([aim, nodes.reshape(aim.shape[0], -1), left[:, None]], axis=-1)

    def _charge(self, params: NavigationParams, inner: Inner) -> Any:
        """Charge of the battery above its cut-off, 0 to 1, (env,); None without one."""
        if not self._battery:
            return None
        system, _ = randomise.apply(params.system, inner.drawn)
        p = SimpleNamespace(**system.effects["battery"])
        return charge_of(p, inner.physics.effects["battery"]["used"]) - p.cut_off

    def _view(self, params: NavigationParams, inner: Inner) -> View:
        return read(
            self._reader,
            inner.physics,
            slip=inner.slip,
            sinkage=inner.sinkage,
            origin=inner.origin,
            goal=inner.goal,
            filtered=inner.filtered,
            last_action=inner.last_action,
            waited=inner.waited,
            arrival=None if params.arrivals is None else params.arrivals[inner.place],
            charge=self._charge(params, inner),
            visited=inner.visited,
            corners=self._corners(params, inner),
            trail=inner.trail,
            plan=self._plan(params, inner),
            drift=None if inner.odometry is None else inner.odometry.error,
        )

    def _observe(self, params: NavigationParams, inner: Inner, view: View) -> tuple[Any, Any]:
        scene = self._scene((*self.config.observations, *self.config.privileged), params, inner, view)
        return observe(self.config.observations, view, scene), observe(self.config.privileged, view, scene)

    def _scene(self, names: Sequence[str], params: NavigationParams, inner: Inner, view: View) -> Scene:
        c, terrain = self.config, params.system.terrain
        seen = None
        if any(name.startswith(CAMERA) for name in names):
            # Pictures only where a block or a critic asks for them, and their light only where it shows.
            colour = CAMERA + "rgb" in names
            dusty = colour and c.camera_dust and "hard_surface" not in self.model.effect_names
            seen = pictures(
                terrain,
                self.model.rover,
                view.qpos,
                c.camera,
                front_mount(self.model.rover, c.camera_pitch_deg),
                Light(sun=c.sun),
                far=c.camera_far,
                lit=colour,
                qvel=inner.physics.qvel if dusty else None,
                gravity=self.model.gravity,
                ruts=self._ruts(params, inner) if colour and c.camera_tracks else None,
            )
        return Scene(terrain, inner.drawn, self._ride, self._scale, params.system.sun, seen, c.camera_far, c.mast)

    def _ruts(self, params: NavigationParams, inner: Inner) -> Relief:
        """What each rover's wheels did to the ground of its patch."""
        system, _ = randomise.apply(params.system, inner.drawn)
        width = np.mean([w.width for w in self.model.rover.wheels])
        kept = inner.physics.effects["ruts"]
        cell = jnp.broadcast_to(width * system.effects["ruts"]["cell"], kept["moved"].shape[:1])
        return Relief(kept["moved"], kept["pressed"], kept["tile"], cell)

    def _info(self, view: View) -> dict[str, Any]:
        return {
            "goal_body": goal_in_body(view),
            "position": view.position,
            "joint_angle": view.joint_angle,
            "body_velocity": view.body_velocity,
        }


def _split(keys: Any) -> Any:
    """(env, 4, 2) keys of an episode; the first one is the next episode's."""
    # One key for what comes next, three for place, heading and parameters of now.
    return jax.vmap(lambda k: jax.random.split(k, 4))(keys)


def default_preset(task: str | NavigationConfig) -> str:
    """Preset of the physics in which a task is made unless one is named."""
    config = TASKS.get(task) if isinstance(task, str) else task
    return LADDER_PRESET if config is not None and config.rung else DEFAULT_PRESET


def make_navigation(
    task: str | NavigationConfig = "consistent",
    rover: str = "luvmi_x",
    terrain: Any = None,
    preset: str | None = None,
    model: Model | str | Path | None = None,
    engine: str = "auto",
    **settings: Any,
) -> NavigationEnv:
    """Makes the navigation environment.

    Args:
      task: name of a shipped task (`paper`, `consistent`, `large`, `escape`, `ladder/1` to `ladder/5`), or a
        configuration.
      rover: name or folder.
      terrain: anything `make_model` takes, or `world:train`, `world:heldout` and others of `worlds.WORLDS`; by default
        `lunar_plain`, for `large` `world:train`, for `escape` `flat`. The ladder makes its own.
      preset: of the physics; `default_preset(task)` if None.
      model: a model or `model.toml` instead of rover, terrain and preset; a terrain given beside it takes its place.
      engine: of the physics.
      **settings: that differ from the task's, see `NavigationConfig`. Unless `episode_time` is among them, a shipped
        task's time is longer by the factor by which the motors stay below its top speed (`actions.reachable_speed`):
        with the preset `field` LUVMI-X drives 0.28 m/s at most, not 1 m/s.

    Raises:
      UserError: unknown names, or settings that do not fit.
    """
    if task not in TASKS if isinstance(task, str) else not isinstance(task, NavigationConfig):
        raise bad_input("navigation", "task", task, "does not exist", f"use one of {', '.join(TASKS)}")
    if not isinstance(model, Model | str | Path | None):
        raise bad_input("navigation", "model", model, "is no model", "give a Model, or the path of a model.toml")
    config = TASKS[task] if isinstance(task, str) else task
    if rover == "viper" and "goal_radius" not in settings and config.goal_radius == TASKS["large"].goal_radius:
        settings = {"goal_radius": 1.0, **settings}
    config = config.replace(**settings)
    if config.rung and terrain is not None:
        raise bad_input("navigation", "terrain", terrain, f"does not go with rung = {config.rung}", "leave it out")
    if config.rung:
        # replaced by the worlds of the rung wherever parameters are made
        terrain = "flat"
    if terrain is None and model is None:
        terrain = {"large": PREFIX + "train", "escape": "flat"}.get(str(task), "lunar_plain")
    if isinstance(terrain, str) and terrain.startswith(PREFIX):
        terrain = world(terrain.removeprefix(PREFIX))
    if isinstance(model, str | Path):
        from lunar_mjx.model.file import load_model

        model = load_model(model)
    if model is None:
        model = make_model(rover, "lunar_plain" if terrain is None else terrain, preset or default_preset(task))
    elif terrain is not None:
        model = model.replace(terrain=terrain)
    if config.rung and get_rung(config.rung).battery and "battery" not in model.effect_names:
        for name in SUPPLY:
            model = model if name in model.effect_names else model.add(name)
        model = model.replace(sun=model.sun or LOW_SUN)
    if config.escape_distance:
        for name in digging.EFFECTS:
            model = model if name in model.effect_names else model.add(name)
    if isinstance(task, str) and "episode_time" not in settings:
        # a task's time is for its top speed, which the bus voltage may not allow
        slower = max(1.0, config.top_speed / reachable_speed(model))
        config = config.replace(episode_time=config.episode_time * slower)
    return NavigationEnv(model, config, engine)
