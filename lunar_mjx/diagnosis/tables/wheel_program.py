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
from lunar_mjx.effects import catalogue
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
      gravity: of the table that a point belongs to, m/s2.
    """

    test: WheelTest
    slip: Any
    lever: Any
    mean_load: Any
    gravity: Any


class WheelProgram:
    """Predictions of drawbar pull, side force, driving torque and sinkage, and derivatives by everything unknown."""

    def __init__(self, bed: WheelBed, coordinates: Sequence[Coordinate]):
        """Makes the program; compiled programs are shared by beds of the same effects and parameters.

        Effects and parameters take the catalogue's order: a model that an effect was added to shares the program in
        which it was a candidate.

        Args:
          bed: with all effects that may be missing, at their null.
          coordinates: what a fit may move.
        """
        rank = {name: i for i, name in enumerate(catalogue.CATALOGUE)}
        effects = sorted(
            (e for e in bed.effects if e.name != EFFECT), key=lambda e: (rank.get(e.name, len(rank)), e.name)
        )
        self.bed = WheelBed([*effects, gains_effect()], bed.parameters, bed.gravity)
        self._order = np.array(sorted(range(len(coordinates)), key=lambda i: coordinates[i].key), int)
        ordered = [coordinates[i] for i in self._order]
        self._layout = tuple((c.effect, c.name) for c in ordered)
        # Numbers on the device, of the points that were asked last: handing them over takes as long as the program.
        self._held: tuple[Imposed, tuple[Any, Any], list[Any]] | None = None
        self._scales = np.array([[c.start, c.scale, c.log] for c in ordered], float).reshape(-1, 3)
        self._run = _compiled((tuple(map(id, effects)), self._layout), self.bed, self._layout)

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
        values = np.empty((len(QUANTITIES), points))
        slopes = np.empty((*values.shape, self.width))
        with jax.enable_x64(True):
            if self._held is None or self._held[0] is not imposed:
                self._held = imposed, self._constants(), self._chunks(imposed)
            _, constants, chunks = self._held
            # gains and errors of abscissae are differentiated at zero: they enter hypotheses to first order alone
            z = jnp.asarray(np.concatenate([u[self._order], np.zeros(self.width - len(u))]))
            parts = [(rows, self._run(z, *constants, *chunk)) for rows, chunk in chunks]
            for rows, (slope, value) in parts:
                values[:, rows], slopes[:, rows] = np.asarray(value)[:, : len(rows)], np.asarray(slope)[:, : len(rows)]
        slopes[..., self._order] = slopes[..., : len(u)].copy()
        return values, slopes

    def _constants(self) -> tuple[Any, Any]:
        parameters = {e: {k: jnp.asarray(v, float) for k, v in p.items()} for e, p in self.bed.parameters.items()}
        return jnp.asarray(self._scales), parameters

    def _chunks(self, imposed: Imposed) -> list[tuple[np.ndarray, tuple[Any, Any]]]:
        """Places of the points of each chunk, and its gravity and what is imposed there."""
        gravities = np.asarray(imposed.gravity, float)
        whole = jax.tree.map(lambda a: np.asarray(a, float), imposed)
        chunks = []
        for gravity in np.unique(gravities):
            mine = np.flatnonzero(gravities == gravity)
            for at in range(0, len(mine), CHUNK):
                rows = mine[at : at + CHUNK]
                # repeats the last point: zeros would be a wheel without a load or a radius, and its derivatives not
                # finite
                filled = np.pad(rows, (0, CHUNK - len(rows)), mode="edge")
                chunk = jax.tree.map(lambda a, filled=filled: jnp.asarray(a[filled]), whole)
                chunks.append((rows, (jnp.asarray(gravity), chunk)))
        return chunks


_PROGRAMS: dict[Any, tuple[WheelBed, Any]] = {}
_MOST_PROGRAMS = 24
"""Compiled programs that are kept; the oldest goes first."""


def _compiled(key: Any, bed: WheelBed, layout: Sequence[tuple[str, str]]) -> Any:
    if key not in _PROGRAMS:

        def values(z: Any, scales: Any, parameters: Any, gravity: Any, imposed: Imposed) -> tuple[Any, Any]:
            # Gravity is a number like others: a table from another laboratory shares the program.
            traced_bed = copy.copy(bed)
            traced_bed.gravity = gravity
            own = {e: dict(v) for e, v in parameters.items()}
            count = len(layout)
            start, change = scales[:, 0], scales[:, 1] * z[:count]
            log = scales[:, 2] > 0.0
            # The exponent is zero where it is not taken, so that none overflows.
            moved = jnp.where(log, start * jnp.exp(jnp.where(log, change, 0.0)), start + change)
            for i, (effect, name) in enumerate(layout):
                own[effect][name] = moved[i]
            for i in range(len(GAINS)):
                own[EFFECT][f"gain_{i}"] = z[count + i]
            result = traced_bed(own, _off(imposed, z[count + len(GAINS) :]))
            loads = jnp.stack([getattr(result, q) for q in QUANTITIES])
            return loads, loads

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
