"""A wheel bed with everything that is unknown about it as one compiled program: values and exact derivatives.

Points are run in chunks of one length, so that tables of any length share the program: compiling it takes a thousand
times as long as running it.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.diagnosis.tables.port_gains import EFFECT, GAINS, gains_effect
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.wheel_bed.bed import WheelBed, WheelTest
from lunar_mjx.wheel_bed.table import QUANTITIES

CHUNK = 32
"""Points of one call: enough that a call's overhead hardly shows, few enough that little is spent on filling up."""

ABSCISSAE = (
    "slip zero",
    "slip scale",
    "slip angle zero",
    "slip angle scale",
    "load zero",
    "load scale",
    "wheel radius",
    "wheel width",
)
"""What may be wrong about the imposed quantities: slip in its unit, slip angle in rad, all else as a share."""


class Imposed(NamedTuple):
    """What a table imposes, one entry per point.

    Attributes:
      test: speeds, slip angle, load, radius and width.
      slip: slip ratio as the table states it.
      lever: change of the travel speed per rim speed and change of a driving wheel's slip (1, or 1/cos of the slip
        angle where slip is that of the wheel's frame).
      mean_load: N, of the whole table.
    """

    test: WheelTest
    slip: Any
    lever: Any
    mean_load: Any


class WheelProgram:
    """Predictions of drawbar pull, side force, driving torque and sinkage, and derivatives by everything unknown."""

    def __init__(self, bed: WheelBed, coordinates: Sequence[Coordinate]):
        """Makes the program; compiled programs are shared by beds of the same effects and coordinates.

        Args:
          bed: with all effects that may be missing, at their null.
          coordinates: what a fit may move.
        """
        self.bed = bed.with_effect(gains_effect()) if EFFECT not in bed.parameters else bed
        self._layout = tuple((c.effect, c.name, c.log) for c in coordinates)
        self._scales = np.array([[c.start, c.scale] for c in coordinates], float).reshape(-1, 2)
        effects = tuple(e if e.name != EFFECT else EFFECT for e in self.bed.effects)
        self._run = _compiled((tuple(map(_identity, effects)), self._layout), self.bed, self._layout)

    @property
    def width(self) -> int:
        """Number of derivatives: coordinates, gains, abscissae."""
        return len(self._layout) + len(GAINS) + len(ABSCISSAE)

    def __call__(self, u: np.ndarray, imposed: Imposed) -> tuple[np.ndarray, np.ndarray]:
        """Values and derivatives at a place of the coordinates, without discrepancy and calibration errors.

        Args:
          u: (coordinates,).
          imposed: fields of shape (points,).

        Returns:
          (4, points) by `QUANTITIES`, SI units; (4, points, width).
        """
        points = len(np.asarray(imposed.slip))
        fill = -points % CHUNK
        with jax.enable_x64(True):
            z = jnp.asarray(np.concatenate([u, np.zeros(self.width - len(u))]))
            scales, parameters = jnp.asarray(self._scales), self.bed.parameters
            gravity = jnp.asarray(float(self.bed.gravity))
            parameters = {e: {k: jnp.asarray(v, float) for k, v in p.items()} for e, p in parameters.items()}
            padded = jax.tree.map(lambda a: np.pad(np.asarray(a, float), (0, fill), mode="edge"), imposed)
            parts = []
            for at in range(0, points + fill, CHUNK):
                chunk = jax.tree.map(lambda a, at=at: jnp.asarray(a[at : at + CHUNK]), padded)
                parts.append(self._run(z, scales, parameters, gravity, chunk))
            slopes, values = zip(*jax.device_get(parts), strict=True)
        return np.concatenate(values, axis=1)[:, :points], np.concatenate(slopes, axis=1)[:, :points]


_PROGRAMS: dict[Any, tuple[WheelBed, Any]] = {}
_MOST_PROGRAMS = 24


def _identity(effect: Any) -> Any:
    return effect if isinstance(effect, str) else id(effect)


def _compiled(key: Any, bed: WheelBed, layout: Sequence[tuple[str, str, bool]]) -> Any:
    if key not in _PROGRAMS:

        def values(z: Any, scales: Any, parameters: Any, gravity: Any, imposed: Imposed) -> tuple[Any, Any]:
            # Gravity is a number like others: a table from another laboratory shares the program.
            here = copy.copy(bed)
            here.gravity = gravity
            own = {e: dict(v) for e, v in parameters.items()}
            for i, (effect, name, log) in enumerate(layout):
                start, scale = scales[i, 0], scales[i, 1]
                own[effect][name] = start * jnp.exp(scale * z[i]) if log else start + scale * z[i]
            count = len(layout)
            for i in range(len(GAINS)):
                own[EFFECT][f"gain_{i}"] = z[count + i]
            result = here(own, _off(imposed, z[count + len(GAINS) :]))
            found = jnp.stack([getattr(result, q) for q in QUANTITIES])
            return found, found

        while len(_PROGRAMS) >= _MOST_PROGRAMS:
            _PROGRAMS.pop(next(iter(_PROGRAMS)))
        # The bed is kept beside its program, so that no other effect takes the identity of one of its own.
        _PROGRAMS[key] = bed, jax.jit(jax.jacfwd(values, has_aux=True))
    return _PROGRAMS[key][1]


def _off(imposed: Imposed, a: Any) -> WheelTest:
    """The test with the errors `a` of its abscissae, in the order of `ABSCISSAE`, to first order."""
    test = imposed.test
    slip = a[0] + a[1] * imposed.slip
    driving = imposed.slip >= 0.0
    # A driving wheel slips more where it travels less, a braked one where it turns more.
    travel = test.travel_speed - jnp.where(driving, test.rim_speed * imposed.lever * slip, 0.0)
    rim = test.rim_speed + jnp.where(driving, 0.0, test.travel_speed / imposed.lever * slip)
    return dataclasses.replace(
        test,
        rim_speed=rim,
        travel_speed=travel,
        slip_angle=test.slip_angle * (1.0 + a[3]) + a[2],
        normal_load=test.normal_load * (1.0 + a[5]) + a[4] * imposed.mean_load,
        radius=test.radius * (1.0 + a[6]),
        width=test.width * (1.0 + a[7]),
    )
