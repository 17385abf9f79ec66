"""Wheels in boxes of particle sand, several side by side in one solver (Newton's implicit material point method)."""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# (the extra `particles` need not be installed where types are checked)

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.wheel_bed.particles.mesh import wheel_mesh
from lunar_mjx.wheel_bed.particles.settings import BedRun, Layout, Sand, layout

EXTRA = "pip install 'lunar-mjx[particles]'"
DEVICES = ("auto", "cpu", "cuda")


@dataclasses.dataclass(frozen=True)
class SandBoxNumbers:
    """Numbers of the box of sand that no user sets."""

    damping: float = 1.0
    """Damping of the wheel's vertical motion, over critical damping by a spring m g/R: only its mean place counts."""
    jitter: float = 0.8
    """Range by which particles are moved off their lattice, in its spacings."""
    floor_friction: float = 0.6
    """Friction of the box's floor; its sides are smooth."""
    look_every: int = 40
    """Time steps between looks for numbers that are not finite."""


SAND_BOX = SandBoxNumbers()


@contextlib.contextmanager
def _without_native_warnings() -> Iterator[None]:
    """Holds back what compiled code writes to standard error: Warp warns there of every machine without a GPU."""
    # File descriptor 2 and not sys.stderr: compiled code knows nothing of Python's object.
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def open_device(device: str) -> str:
    """Warp's name of the device that computes, "cpu" or "cuda:0"; "auto" takes a GPU where there is one.

    Raises:
      UserError: the extra `particles` is not installed, no GPU is there though asked for, or the name is unknown.
    """
    if device not in DEVICES:
        raise bad_input("particles", "--device", device, "does not exist", f"use one of {', '.join(DEVICES)}")
    try:
        with _without_native_warnings():
            import warp as wp

            wp.config.log_level = wp.LOG_ERROR
            import newton

            wp.init()
    except ImportError as error:
        raise UserError(
            f"particles: Newton and Warp, which compute the sand, are not installed; install the extra: {EXTRA}."
        ) from error
    # A private method is overridden below (see `_slide_solver`), which other versions may not have.
    if not newton.__version__.startswith("1.8"):
        raise UserError(
            f"particles: newton {newton.__version__} is here, but 1.8 is needed; install the extra: {EXTRA}."
        )
    has_cuda = wp.is_cuda_available()
    if device == "cuda" and not has_cuda:
        raise bad_input(
            "particles",
            "--device",
            device,
            "is not here: Warp sees no NVIDIA GPU",
            "use --device cpu and larger voxels",
        )
    return "cuda:0" if has_cuda and device != "cpu" else "cpu"


@dataclasses.dataclass(frozen=True, eq=False)
class Series:
    """What one wheel did, (steps,) each; forces of the sand on the wheel.

    Attributes:
      time: at the end of each step, s.
      drawbar_pull: along the heading, N. side_force: to the right, N: positive where it opposes a positive slip angle.
      vertical_force: N. driving_torque: that the motor supplies, N m.
      sinkage: of the rim's lowest point below the undisturbed surface, m. travel: of the centre, m.
      contacts: number of nodes (or particles) that touch.
      momentum_error: what is left of the balance of momentum of the whole batch's sand, (3,), over gravity's impulse.
      particles: in this wheel's box.
    """

    time: np.ndarray
    drawbar_pull: np.ndarray
    side_force: np.ndarray
    vertical_force: np.ndarray
    driving_torque: np.ndarray
    sinkage: np.ndarray
    travel: np.ndarray
    contacts: np.ndarray
    momentum_error: np.ndarray
    particles: int


def particle_places(box: Layout, seed: int, jitter: float = SAND_BOX.jitter) -> np.ndarray:
    """Places of the particles of one box, (n, 3) m, from its corner; off their lattice by random amounts."""
    spacing = box.voxel / box.per_edge
    axes = [(np.arange(n * box.per_edge) + 0.5) * spacing for n in box.cells]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    # A perfect lattice would shear along its own planes.
    moved = jitter * spacing * (np.random.default_rng(seed).random(lattice.shape) - 0.5)
    return (lattice + moved).astype(np.float32)


def add_sand(builder: Any, box: Layout, sand: Sand, count: int) -> float:
    """Adds particles whose places come later; returns the mass of one, kg."""
    spacing = box.voxel / box.per_edge
    mass = float(sand.density * spacing**3)
    # Number, mass and radius only; places are assigned as one array after the model is made.
    nowhere = [(0.0, 0.0, 0.0)] * count
    builder.add_particles(pos=nowhere, vel=nowhere, mass=[mass] * count, radius=[0.5 * spacing] * count)
    return mass


def add_walls(builder: Any, box: Layout, boxes: int) -> None:
    """Adds a rough floor and smooth sides for boxes side by side."""
    import newton
    import warp as wp

    length, width, depth = box.size
    gap, thick = box.gap * box.voxel, 0.1
    across = boxes * box.pitch
    high = 0.5 * depth + 0.4

    def wall(x: float, y: float, z: float, hx: float, hy: float, hz: float, friction: float) -> None:
        cfg = newton.ModelBuilder.ShapeConfig(mu=friction, density=0.0)
        middle = wp.transform(wp.vec3(x, y, z), wp.quat_identity())
        builder.add_shape_box(-1, xform=middle, hx=hx, hy=hy, hz=hz, cfg=cfg)

    half = 0.5 * across + 2.0 * gap
    wall(0.5 * length, 0.5 * across, -thick, 0.5 * length + 0.3, half, thick, SAND_BOX.floor_friction)
    for x in (-thick, length + thick):
        wall(x, 0.5 * across, high - 0.1, thick, half, high, 0.0)
    for y in (-gap, *(k * box.pitch + width for k in range(boxes))):
        wall(0.5 * length, y + 0.5 * gap, high - 0.1, 0.5 * length + 0.25, 0.5 * gap, high, 0.0)


def set_sand(model: Any, sand: Sand, gravity: float) -> None:
    """Gives a model its gravity, downward, and all its particles the sand's strength."""
    model.set_gravity((0.0, 0.0, -gravity))
    model.mpm.friction.fill_(sand.friction)
    model.mpm.yield_stress.fill_(sand.strength)
    # At critical state: sand that has been sheared far enough no longer changes its volume.
    model.mpm.dilatancy.fill_(0.0)


def _slide_solver() -> Any:
    """Newton's solver with wheels that answer to the sand by moving up and down alone."""
    import warp as wp
    from newton.solvers import SolverImplicitMPM

    from lunar_mjx.wheel_bed.particles.kernels import keep_vertical

    class SlideSolver(SolverImplicitMPM):
        def _build_collider_rigidity_operator(self, *args: Any, **options: Any) -> Any:
            operator = super()._build_collider_rigidity_operator(*args, **options)
            if operator is not None and operator[1].values.shape[0]:
                response = operator[1].values
                wp.launch(keep_vertical, dim=response.shape[0], inputs=[response], device=response.device)
            return operator

    return SlideSolver


class SandBoxes:
    """Several runs of one wheel, sand, gravity and numerics, each in a box of its own, computed together.

    Boxes share nothing but the solver's stopping test.
    """

    def __init__(self, runs: list[BedRun], device: str):
        import newton
        import warp as wp

        from lunar_mjx.wheel_bed.particles.kernels import IMPOSED, PLACE, RECORDED

        first = runs[0]
        if any(
            (r.wheel, r.sand, r.gravity, r.speed, r.time_step)
            != (first.wheel, first.sand, first.gravity, first.speed, first.time_step)
            for r in runs
        ):
            raise UserError(
                "particles: runs of one batch differ in wheel, sand, gravity or time step; batch them apart."
            )
        self.runs, self.device, self.box = runs, device, layout(runs)
        # All boxes run as long as the longest; each series is cut at its own end.
        self.steps = max(r.steps for r in runs) + math.ceil(first.ramp_time / first.time_step)
        corner = [k * self.box.pitch for k in range(len(runs))]
        places = [
            # Each box has its own jitter, or the scatter between boxes would be none.
            particle_places(self.box, 1000 * r.numerics.seed + k) + np.array([0.0, y, 0.0], np.float32)
            for k, (r, y) in enumerate(zip(runs, corner, strict=True))
        ]
        builder = newton.ModelBuilder()
        solver_class = _slide_solver()
        solver_class.register_custom_attributes(builder)
        self.particle_mass = add_sand(builder, self.box, first.sand, sum(len(p) for p in places))
        add_walls(builder, self.box, len(runs))
        corners, faces = wheel_mesh(first.wheel)
        mesh = newton.Mesh(corners, faces.reshape(-1), compute_inertia=False)
        rough = newton.ModelBuilder.ShapeConfig(mu=first.sand.wheel_friction, density=0.0)
        for _ in runs:
            builder.add_shape_mesh(builder.add_body(mass=1.0), mesh=mesh, cfg=rough)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a wheel's inertia, which is imposed and never used, looks odd to Newton
            # Newton declares arrays of a model as possibly missing: after `finalize` they are there
            self.model: Any = builder.finalize(device=device)
        set_sand(self.model, first.sand, first.gravity)
        self.model.particle_q.assign(np.concatenate(places))
        self.model.particle_qd.zero_()

        self.state: Any = self.model.state()
        imposed = np.stack([self._imposed(r) for r in runs]).astype(np.float32)
        place = np.zeros((len(runs), PLACE), np.float32)
        place[:, 0] = self.box.start
        place[:, 1] = [y + 0.5 * self.box.size[1] for y in corner]
        clear = 0.25 * first.numerics.voxel if first.numerics.contact == "S2" else 0.0
        # Sinkage counts from the surface as strewn.
        self.hub_height = self.box.size[2] + first.wheel.radius  # of a wheel that just touches
        place[:, 2] = self.hub_height + first.wheel.grouser_height + clear
        assert imposed.shape[1] == IMPOSED
        n = len(runs)
        self.imposed = wp.array(imposed, dtype=float, device=device)
        self.place = wp.array(place, dtype=float, device=device)
        self.total = wp.zeros((n + 1, 7), dtype=float, device=device)
        self.record = wp.zeros((self.steps, n, RECORDED), dtype=float, device=device)
        self.record_walls = wp.zeros((self.steps, 3), dtype=float, device=device)
        self._move(0)
        self.solver = self._solver(solver_class, imposed)
        self.start_momentum = self._momentum()

    def _imposed(self, run: BedRun) -> list[float]:
        angle = math.radians(run.point.slip_angle)
        mass = run.point.load / run.gravity
        # Of a spring m g/R: the stiffness of sand in which the wheel sinks by its radius under its weight.
        damping = SAND_BOX.damping * 2.0 * mass * math.sqrt(run.gravity / run.wheel.radius)
        arrived = run.settle_time + run.ramp_time + run.drive_time
        # The larger of both is 1 in a point, so `speed` is that of the faster one.
        travel, turn = run.speed * run.point.travel, run.speed * run.point.rim / run.wheel.radius
        # A wheel that slides to its left along x points to the right of x.
        return [travel, turn, math.cos(angle), -math.sin(angle), run.point.load, mass, damping, arrived]

    def _solver(self, solver_class: Any, imposed: np.ndarray) -> Any:
        import warp as wp

        numerics, dt = self.runs[0].numerics, self.runs[0].time_step
        config = solver_class.Config()
        config.voxel_size = numerics.voxel
        config.max_iterations = numerics.iterations
        config.tolerance = numerics.tolerance
        config.collider_basis = numerics.contact
        solver = solver_class(self.model, config=config)
        n = len(self.runs)
        solver.setup_collider(
            # The mass that the implicit damper lets the sand feel.
            body_mass=wp.array(imposed[:, 5] + dt * imposed[:, 6], dtype=float, device=self.device),
            body_inv_inertia=wp.zeros(n, dtype=wp.mat33, device=self.device),
            body_q=self.state.body_q,
        )
        return solver

    def _move(self, step: int) -> None:
        import warp as wp

        from lunar_mjx.wheel_bed.particles.kernels import record_and_move

        first = self.runs[0]
        wp.launch(
            record_and_move,
            dim=len(self.runs),
            device=self.device,
            inputs=[
                step,
                first.time_step,
                0.5 * first.settle_time,
                first.settle_time,
                first.ramp_time,
                self.imposed,
                self.place,
                self.total,
                self.record,
                self.record_walls,
                self.state.body_q,
                self.state.body_qd,
            ],
        )

    def _momentum(self) -> np.ndarray:
        return self.particle_mass * self.state.particle_qd.numpy().astype(float).sum(axis=0)

    def advance(self, step: int) -> None:
        """One time step; steps count from 1."""
        import warp as wp

        from lunar_mjx.wheel_bed.particles.kernels import sum_impulses

        solver, state = self.solver, self.state
        solver.step(state, state, None, None, self.runs[0].time_step)
        self.total.zero_()
        impulse, place, collider = (
            state.impulse_field.dof_values,
            state.collider_position_field.dof_values,
            state.collider_ids,
        )
        wp.launch(
            sum_impulses,
            dim=impulse.shape[0],
            device=self.device,
            inputs=[
                collider,
                impulse,
                place,
                solver.collider_body_index,
                state.body_q,
                # The field counts, per volume of a voxel, what the wheel gives the sand; the sign turns it to what the
                # wheel gets.
                -(self.box.voxel**3),
                len(self.runs),
                self.total,
            ],
        )
        self._move(step)

    def run(self, going_on: Callable[[float], bool]) -> list[Series] | None:
        """Computes all runs.

        Args:
          going_on: called after each step with the share that is done; False ends it.

        Returns:
          One series for each run, or None where `going_on` ended it.

        Raises:
          FloatingPointError: a wheel's place is no longer finite.
        """
        for step in range(1, self.steps + 1):
            self.advance(step)
            # Each look waits for the GPU and copies from it.
            if step % SAND_BOX.look_every == 0 and not np.isfinite(self.place.numpy()).all():
                raise FloatingPointError(f"a wheel's place is not finite after step {step}")
            if not going_on(step / self.steps):
                return None
        return self.series()

    def series(self) -> list[Series]:
        """What was recorded, for each run up to its own end."""
        record = self.record.numpy().astype(float)
        walls = self.record_walls.numpy().astype(float)
        dt = self.runs[0].time_step
        weight = self.runs[0].gravity * self.particle_mass * self.box.particles * len(self.runs) * self.steps * dt
        impulse = walls.sum(axis=0)
        for k, r in enumerate(self.runs):
            angle = -math.radians(r.point.slip_angle)
            along, left, up = (dt * record[:, k, i].sum() for i in range(3))
            cosine, sine = math.cos(angle), math.sin(angle)
            impulse += [cosine * along - sine * left, sine * along + cosine * left, up]
        # Gravity's impulse less what walls and wheels took: zero but for the solver's error.
        left_over = self._momentum() - self.start_momentum + impulse + np.array([0.0, 0.0, weight])
        out = []
        for k, r in enumerate(self.runs):
            own = record[: r.steps, k]
            out.append(
                Series(
                    time=dt * np.arange(1, r.steps + 1),
                    drawbar_pull=own[:, 0],
                    # Test beds call the force positive that opposes a slip angle to the left.
                    side_force=-own[:, 1],
                    vertical_force=own[:, 2],
                    driving_torque=-own[:, 3],
                    sinkage=self.hub_height - own[:, 4],
                    travel=own[:, 5] - self.box.start,
                    contacts=own[:, 6],
                    momentum_error=left_over / weight,
                    particles=self.box.particles,
                )
            )
        return out
