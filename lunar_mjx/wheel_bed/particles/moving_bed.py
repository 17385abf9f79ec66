"""Sand under wheels that go where they like: a patch of particles that goes with them. Needs the extra `particles`."""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# (the extra `particles` need not be installed where types are checked)

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_mjx.wheel_bed.particles.columns import Columns, Grains
from lunar_mjx.wheel_bed.particles.mesh import wheel_mesh
from lunar_mjx.wheel_bed.particles.sand_box import SAND_BOX, set_sand
from lunar_mjx.wheel_bed.particles.settings import BOX_SIZE, Numerics, ParticleWheel, Sand

RIM_VOXELS = 2.0
"""Width of the sand that is held around what moves: a node reaches one voxel far, and one more for what flows."""


class MovingBed:
    """Sand that answers wheels with impulses; its frame has the undisturbed surface as z = 0.

    Args:
      wheels: of the rover, in its order.
      sand: its strength. gravity: vector (3,), m/s2, in the frame.
      numerics: voxel, contact, iterations, tolerance and seed count.
      time_step: s.
      mobility: what one wheel's motion yields to an impulse: 1/mass, 1/kg, and 1/inertia about its axle, 1/(kg m2).
      device: name by Warp, of `open_device`.
    """

    def __init__(
        self,
        wheels: Sequence[ParticleWheel],
        sand: Sand,
        gravity: np.ndarray,
        numerics: Numerics,
        time_step: float,
        mobility: tuple[float, float],
        device: str,
    ) -> None:
        import newton
        import warp as wp
        from newton.solvers import SolverImplicitMPM

        outer = max(w.radius + w.grouser_height for w in wheels)
        voxel, self.device, self.time_step = numerics.voxel, device, time_step
        margin = BOX_SIZE.margin * outer
        depth = math.ceil(margin / voxel - 1e-9)
        reach = margin + 0.5 * max(w.width for w in wheels)
        self.columns = Columns(voxel, numerics.per_edge, depth, reach, RIM_VOXELS * voxel, numerics.seed)
        self.grains, self._count, n = Grains.none(), 0, len(wheels)
        self._restored = False
        capacity = n * self.columns.most_particles
        builder = newton.ModelBuilder()
        SolverImplicitMPM.register_custom_attributes(builder)
        spacing = voxel / numerics.per_edge
        self.particle_mass = float(sand.density * spacing**3)
        nowhere = [(0.0, 0.0, 0.0)] * capacity
        builder.add_particles(
            pos=nowhere, vel=nowhere, mass=[self.particle_mass] * capacity, radius=[0.5 * spacing] * capacity
        )
        floor = newton.ModelBuilder.ShapeConfig(mu=SAND_BOX.floor_friction, density=0.0)
        below = wp.transform(wp.vec3(0.0, 0.0, -depth * voxel - 0.5), wp.quat_identity())
        builder.add_shape_box(-1, xform=below, hx=1e3, hy=1e3, hz=0.5, cfg=floor)
        rough = newton.ModelBuilder.ShapeConfig(mu=sand.wheel_friction, density=0.0)
        for wheel in wheels:
            corners, faces = wheel_mesh(wheel)
            mesh = newton.Mesh(corners, faces.reshape(-1), compute_inertia=False)
            builder.add_shape_mesh(builder.add_body(mass=1.0), mesh=mesh, cfg=rough)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a wheel's inertia, which comes with `mobility`, looks odd to Newton
            self.model: Any = builder.finalize(device=device)
        set_sand(self.model, sand, 0.0)
        self.model.set_gravity(tuple(float(g) for g in gravity))
        self._state: Any = self.model.state()
        config = SolverImplicitMPM.Config()
        config.voxel_size, config.collider_basis = voxel, numerics.contact
        config.max_iterations, config.tolerance = numerics.iterations, numerics.tolerance
        # All particles wait at one place until wheels come: a grid needs a voxel at least.
        self.solver: Any = SolverImplicitMPM(self.model, config=config)
        spin = np.zeros((n, 3, 3), np.float32)
        spin[:, 1, 1] = mobility[1]  # the axle is the y axis of the wheel's mesh
        self.solver.setup_collider(
            body_mass=wp.array(np.full(n, 1.0 / mobility[0], np.float32), dtype=float, device=device),
            body_inv_inertia=wp.array(spin, dtype=wp.mat33, device=device),
            body_q=self._state.body_q,
        )
        self._total = wp.zeros((n + 1, 7), dtype=float, device=device)

    def push(
        self, place: np.ndarray, axes: np.ndarray, velocity: np.ndarray, spin: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advances the sand by a time step under wheels that would move so if it gave way.

        Args:
          place: of the wheels' centres at the step's beginning, (w, 3), m.
          axes: of the wheels, columns x, y (axle, to the left) and z, (w, 3, 3).
          velocity, spin: at the step's end without the impulses that are asked for, (w, 3), m/s and rad/s.

        Returns:
          Impulses (w, 3), N s, on the wheels and their moments (w, 3), N m s, about the centres.
        """
        import warp as wp

        from lunar_mjx.wheel_bed.particles.kernels import sum_impulses

        if self.columns.near(place[:, :2]):
            # What was restored is not in the solver yet.
            self._exchange(self.grains if self._restored else self.read())
            self._restored = False
        state = self._state
        turned = Rotation.from_matrix(axes).as_quat()
        state.body_q.assign(np.concatenate([place, turned], axis=1).astype(np.float32))
        state.body_qd.assign(np.concatenate([velocity, spin], axis=1).astype(np.float32))
        self.solver.step(state, state, None, None, self.time_step)
        self._total.zero_()
        wp.launch(
            sum_impulses,
            dim=state.impulse_field.dof_values.shape[0],
            device=self.device,
            inputs=[
                state.collider_ids,
                state.impulse_field.dof_values,
                state.collider_position_field.dof_values,
                self.solver.collider_body_index,
                state.body_q,
                -(self.columns.voxel**3),
                len(place),
                self._total,
            ],
        )
        total = self._total.numpy().astype(float)[:-1]
        return total[:, :3], total[:, 3:6]

    def read(self) -> Grains:
        """The particles that are computed, as they are now."""
        if self._restored:
            return self.grains
        n, state = self._count, self._state
        return Grains(
            state.particle_q.numpy()[:n],
            state.particle_qd.numpy()[:n],
            state.mpm.particle_qd_grad.numpy()[:n],
            self.grains.held,
        )

    def surface(self) -> np.ndarray:
        """Middle x, y of every column of sand and the height of its surface, (n, 3) m."""
        return self.columns.surface(self.read())

    def state(self) -> dict[str, np.ndarray]:
        """All sand, as arrays by name."""
        return {**dataclasses.asdict(self.read()), **self.columns.state()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Goes back to where `state` was taken; the solver then begins without a guess."""
        self.columns.restore(state)
        self.grains = Grains(**{f.name: state[f.name] for f in dataclasses.fields(Grains)})
        self._restored = True

    @property
    def particles(self) -> int:
        """Number of particles that are computed."""
        return len(self.grains.place)

    def _exchange(self, before: Grains) -> None:
        """Gives the solver the particles that the wheels need now, of those that it had and those outside."""
        import newton

        self.grains = grains = self.columns.exchange(before)
        capacity, n = self.model.particle_count, len(grains.place)
        if n > capacity:
            raise FloatingPointError(f"{n} particles crowd about the wheels, where {capacity} have room")
        self._count = n

        # Those in reserve wait among the held ones, spread out: they are left out of all sums, but not of the search.
        waiting = np.resize(grains.place[grains.held], (capacity - n, 3))

        def filled(values: np.ndarray, rest: Any) -> np.ndarray:
            out = np.empty((capacity, *values.shape[1:]), values.dtype)
            out[:n], out[n:] = values, rest
            return out

        state, model = self._state, self.model
        state.particle_q.assign(filled(grains.place, waiting))
        state.particle_qd.assign(filled(grains.velocity, 0.0))
        state.mpm.particle_qd_grad.assign(filled(grains.gradient, 0.0))
        # To the solver a particle without mass is one whose velocity is given.
        mass = np.where(grains.held, 0.0, self.particle_mass).astype(np.float32)
        model.particle_mass.assign(filled(mass, 0.0))
        flags = np.full(n, int(newton.ParticleFlags.ACTIVE), np.int32)
        model.particle_flags.assign(filled(flags, 0))
        self.solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)
