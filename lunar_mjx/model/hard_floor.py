"""A wheeled rover on hard, level ground, from what its folder says: where criticism of drives on Earth begins."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from lunar_mjx.effects import catalogue
from lunar_mjx.model.model import Model, make_model
from lunar_mjx.rover import Rover

EFFECTS = (
    "joint_control",
    "motor",
    "directional_gear_efficiency",
    "coulomb_friction",
    "viscous_friction",
    "com_offset",
    "soil",
    "hard_surface",
    "pressure_sinkage",
    "shear_state",
    "closed_form_shear",
    "hard_ground",
)
"""Motors with friction in their gears, and tyres with friction that hardly sink."""


@dataclasses.dataclass(frozen=True)
class Tyres:
    """Tyres and gears of a rover on hard ground."""

    tyre_sinkage: float = 0.018
    """Depth by which a tyre under its share of the rover yields, over its radius: 3 mm of a Husky's 0.165 m."""
    tyre_damping: float = 0.23
    """Damping of the rover on its tyres over the critical one."""
    gear_friction: float = 0.02
    """Coulomb friction of a drive over the torque that lifts the whole weight at the rim; 2 N m of a Husky's 97."""
    gear_drag: float = 0.01
    """Torque of a drive's viscous friction at a rim speed of 1 m/s over the torque that lifts the whole weight at the
    rim. A choice: half of the Coulomb friction; a fit takes it a factor of e up or down."""
    # Rubber on floors and asphalt: friction; slip at which it is reached to 1/e; friction across a tyre over along
    # it.
    friction: float = 0.6
    slip_scale: float = 0.05
    side: float = 0.75


TYRES = Tyres()


def hard_floor(rover: str | Path | Rover, gravity: float | None = None) -> Model:
    """The model of a rover on hard, level ground, with tyres and gear friction in proportion to its weight.

    Values are starting points for `compare`, which fits them to drives.

    Args:
      rover: name or folder of a rover, or a rover.
      gravity: m/s2; the rover's own where None.
    """
    model = make_model(rover, terrain="flat", preset="consistent", **({} if gravity is None else {"gravity": gravity}))
    effects = tuple(catalogue.CATALOGUE[name] for name in EFFECTS)
    model = dataclasses.replace(
        model,
        effects=effects,
        parameters={e.name: model.parameters.get(e.name, e.nominal()) for e in effects},
        effect_files={e.name: e.name for e in effects},
    )
    wheels = model.rover.wheels
    radius = sum(w.radius for w in wheels) / len(wheels)
    load = model.rover.mass * model.gravity / len(wheels)
    # In proportion to weight and wheel, so that any rover stands on its tyres like the one that was measured.
    stiffness = load / (TYRES.tyre_sinkage * radius)
    # 2 sqrt(k m) is critical, here with a wheel's share of the mass.
    damping = 2.0 * TYRES.tyre_damping * (stiffness * model.rover.mass / len(wheels)) ** 0.5
    model = model.set(
        "hard_ground",
        "hard floor",
        stiffness=stiffness,
        damping=damping,
        mu=TYRES.friction,
        slip_scale=TYRES.slip_scale,
        side=TYRES.side,
    )
    lifting = load * len(wheels) * radius
    model = model.set("viscous_friction", "hard floor", damping=TYRES.gear_drag * lifting * radius)
    return model.set("coulomb_friction", "hard floor", torque=TYRES.gear_friction * lifting)
