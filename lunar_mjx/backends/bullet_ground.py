"""Bullet's own contact of wheels and height field, with the stiffness, damping and friction of the model's effects."""

from __future__ import annotations

from typing import Any

import numpy as np

from lunar_mjx.backends.physics import Ground
from lunar_mjx.errors import bad_input
from lunar_mjx.model import Model

_WHEELS, _TERRAIN = 2, 4
"""Bits of Bullet's collision filter: wheels and terrain meet each other, and nothing else meets either."""


class BulletGround:
    """The height field as a body, and which wheels it bears.

    Args:
      p: the module pybullet. client: of the world. body: the rover. wheels: its wheel links.
      model: whose effect `penalty_contact` (with `engine_friction`) or else `hard_ground` gives the contact.
      ground: the terrain.
    """

    def __init__(self, p: Any, client: int, body: int, wheels: list[int], model: Model, ground: Ground) -> None:
        self._p, self._body, self._id = p, body, {"physicsClientId": client}
        values = model.parameters
        normal = values.get("penalty_contact", values.get("hard_ground"))
        if normal is None:
            raise bad_input(
                "pybullet",
                "contact",
                "engine",
                "needs the effect penalty_contact or hard_ground",
                "add one, or use contact numpy",
            )
        mu = values["engine_friction"]["mu"] if "engine_friction" in values else normal.get("mu", 0.0)
        field = ground.field
        heights = field.flat.reshape(field.rows, field.cols)
        shape = p.createCollisionShape(
            p.GEOM_HEIGHTFIELD,
            meshScale=[field.cell, field.cell, 1.0],
            heightfieldData=heights.ravel().tolist(),
            # Bullet's rows run along x, ours along y.
            numHeightfieldRows=field.cols,
            numHeightfieldColumns=field.rows,
            **self._id,
        )
        # Bullet puts the middle of the grid and of the heights at the body's origin
        middle = [
            field.x0 + 0.5 * (field.cols - 1) * field.cell,
            field.y0 + 0.5 * (field.rows - 1) * field.cell,
            0.5 * float(heights.min() + heights.max()),
        ]
        self._terrain = p.createMultiBody(0, shape, basePosition=middle, **self._id)
        p.changeDynamics(
            self._terrain,
            -1,
            lateralFriction=mu,
            contactStiffness=normal["stiffness"],
            contactDamping=normal["damping"],
            restitution=0.0,
            **self._id,
        )
        p.setCollisionFilterGroupMask(self._terrain, -1, _TERRAIN, _WHEELS, **self._id)
        for wheel in wheels:
            p.setCollisionFilterGroupMask(body, wheel, _WHEELS, _TERRAIN, **self._id)
            # frictions multiply, and stiffnesses act in series: the wheel must not add its own
            p.changeDynamics(body, wheel, lateralFriction=1.0, restitution=0.0, collisionMargin=0.0, **self._id)
        self._bears = np.zeros(len(wheels), bool)
        self.bear(wheels, self._bears, force=True)

    def bear(self, wheels: list[int], bears: np.ndarray, force: bool = False) -> None:
        """Turns contact on for the wheels that stand on rock, off for the others."""
        for i, wheel in enumerate(wheels):
            if force or bears[i] != self._bears[i]:
                self._p.setCollisionFilterPair(self._body, self._terrain, wheel, -1, int(bears[i]), **self._id)
        self._bears = bears.copy()

    def force(self, link: int, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Force and moment about `center` on a link in the last step, world coordinates."""
        force, moment = np.zeros(3), np.zeros(3)
        for touch in self._p.getContactPoints(self._body, self._terrain, link, -1, **self._id):
            # Fields of getContactPoints: 7 and 9 the normal and its force, 10 to 13 both directions of friction, 5 the
            # place on the first body (PyBullet Quickstart Guide).
            push = touch[9] * np.array(touch[7]) + touch[10] * np.array(touch[11]) + touch[12] * np.array(touch[13])
            force += push
            moment += np.cross(np.array(touch[5]) - center, push)
        return force, moment
