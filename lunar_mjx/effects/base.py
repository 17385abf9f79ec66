"""What an effect is: a small pure function at one or several ports, with named, bounded, unit-carrying parameters.

A user's own effect is a Python file of about ten lines::

    import jax.numpy as jnp
    from lunar_mjx.effects import Parameter, effect

    @effect("motor_torque",
            torque=Parameter(0.5, 0.0, (0.0, 5.0), "N m", "Coulomb friction of the gear", "datasheet"),
            speed=Parameter(0.01, None, (1e-4, 1.0), "rad/s", "speed of full friction", "choice"))
    def gear_friction(ctx, p, x, torque):
        "tau_f = tau_c tanh(omega/omega_0): Coulomb friction, smoothed."
        return torque - p.torque * jnp.tanh(ctx.joint_speed / p.speed)

`lunar-mjx effect test my_effects.py` checks what every effect promises: that it vanishes at its null values, has finite
derivatives, holds in any base units (a bare 0.01 in place of `p.speed` would not), and costs little. A constant of
nature may stand in the file, if it says its unit: `SIGMA: Annotated[float, "W/m2/K4"] = 5.670374419e-8`.

A port function takes the context, the effect's parameters `p`, its state `x` and the port's value, and returns the new
value, or (new value, {state: new state}) where the effect owns state. It is written for one rover, elementwise over
wheels or joints, and knows nothing of the engine that calls it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from lunar_mjx.errors import UserError, bad_input, require_finite
from lunar_mjx.rover import Rover

# A step's order is physical: what the controller asks for, what the motor gives, the rover's true shape, the ground,
# then what the ground does to the wheels. Heat and readings come last because they need the rest.
PORTS = (
    "command",
    "motor_torque",
    "geometry",
    "soil",
    "wheel_normal",
    "wheel_shear",
    "body_wrench",
    "power",
    "heat",
    "sensor",
)
"""The ports, in the order in which a step calls them (`sensor` acts on the finished trajectory)."""

AXES = ("rover", "wheel", "joint")
"""What a parameter or state may have one entry per; "rover" is a single number."""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A physical parameter of an effect.

    Attributes:
      nominal: value used unless the model says otherwise, in `unit`.
      null: value at which the effect vanishes; None where the effect has no null in this parameter.
      bounds: physically admissible closed interval, in `unit`.
      unit: SI unit (or 1); powers that depend on the sinkage exponent are written as in N/m^(n+1).
      meaning: what it is, in a few words.
      source: where the nominal value comes from.
      axis: "rover" for a single number, or "wheel" or "joint" where a model may give one value each.
    """

    nominal: float
    null: float | None
    bounds: tuple[float, float]
    unit: str
    meaning: str
    source: str
    axis: str = "rover"

    def __post_init__(self) -> None:
        low, high = self.bounds
        # Bounds are checked when the effect is declared, at import, so that a typing error in a catalogue never reaches
        # a model.
        if not low <= self.nominal <= high:
            raise UserError(
                f"Parameter: nominal = {self.nominal} is outside the bounds {self.bounds}; widen the bounds."
            )
        # A null outside the bounds could not be set by a model, and no comparison with and without the effect could be
        # made.
        if self.null is not None and not low <= self.null <= high:
            raise UserError(f"Parameter: null = {self.null} is outside the bounds {self.bounds}; widen the bounds.")
        if self.axis not in AXES:
            raise UserError(f"Parameter: axis = {self.axis!r} is unknown; use one of {', '.join(AXES)}.")


@dataclasses.dataclass(frozen=True)
class StateVariable:
    """A state that an effect owns.

    Attributes:
      initial: value at reset.
      unit: SI unit.
      meaning: what it is, in a few words.
      axis: "rover", "wheel" or "joint".
      rate: whether the port function returns its time derivative (integrated by the step) instead of its new value.
      slots: length of a leading axis beside that, for a memory of fixed size; 0 for none.
      rounding_of: the state whose last sum's rounding this one keeps (Kahan's sum), so that it is zero but for that;
        "" for none.
    """

    initial: float
    unit: str
    meaning: str
    axis: str = "wheel"
    rate: bool = False
    slots: int = 0
    rounding_of: str = ""

    def reset(self, like: Any) -> Any:
        """The state at reset; `like` is an array of zeros over its axis."""
        # Slots come first, so that wheels or joints stay the last axis, along which ports broadcast.
        like = jnp.broadcast_to(like, (self.slots, *like.shape)) if self.slots else like
        # Added to the array of zeros, so that the state gets its type and shape from it.
        return like + self.initial


class Refusal(NamedTuple):
    """Why values of an effect make no sense together: the parameter to name, what is wrong with it, and a remedy."""

    parameter: str
    problem: str
    remedy: str


PortFunction = Callable[..., Any]
Validate = Callable[[Mapping[str, Any], Rover], Refusal | None]
"""From values by parameter and the rover to a refusal, or None where they are sound."""
Recall = Callable[[Any, Any], Any]
"""From an effect's state and the contact of the wheels as it is now to the contact as the soil remembers it."""
_EMPTY: Mapping[str, Any] = MappingProxyType({})


@dataclasses.dataclass(frozen=True)
class Effect:
    """A physical effect: functions at ports, and the parameters and state that they share.

    Attributes:
      name: name in the catalogue and in `model.toml`.
      ports: port name -> function(ctx, p, x, value).
      parameters: parameter name -> `Parameter`.
      state: state name -> `StateVariable`.
      replaces: names of effects that must leave the list when this one enters it.
      order: effects at one port run by rising order, and in list order where equal.
      transient: the effect vanishes on a wheel in steady state, or needs its history or its place, so that a
        steady-state wheel test bed leaves it out.
      requires: names of effects whose parameters it reads: they must be in the list.
      validate: refuses values that make no sense together or for the rover, though each is within its bounds.
      mapped: parameters whose place the soil grids of a terrain take where they hold them; `validate` sees those, too.
      recall: what its state says about the contact of wheel and ground, for the ports from `soil` on: the only way by
        which one effect's state is seen by others.
      doc: equation and source.
    """

    name: str
    ports: Mapping[str, PortFunction]
    parameters: Mapping[str, Parameter] = dataclasses.field(default_factory=dict)
    state: Mapping[str, StateVariable] = dataclasses.field(default_factory=dict)
    replaces: tuple[str, ...] = ()
    order: int = 0
    transient: bool = False
    doc: str = ""
    requires: tuple[str, ...] = ()
    validate: Validate | None = None
    recall: Recall | None = None
    mapped: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise UserError(f"effect: name = {self.name!r} is not an identifier; use letters, digits and underscores.")
        for port in self.ports:
            if port not in PORTS:
                raise UserError(f"effect {self.name}: port = {port!r} does not exist; use one of {', '.join(PORTS)}.")
        if not self.ports:
            raise UserError(f"effect {self.name}: ports is empty; name at least one of {', '.join(PORTS)}.")
        # Other effects see a state only through `recall`; without a state there is nothing to see.
        if self.recall is not None and not self.state:
            raise UserError(f"effect {self.name}: recall is given without a state; declare the state that it reads.")

    def nominal(self) -> dict[str, float]:
        """The nominal value of every parameter."""
        return {name: parameter.nominal for name, parameter in self.parameters.items()}

    def null(self) -> dict[str, float]:
        """The values at which the effect vanishes; parameters without a null keep their nominal value."""
        return {k: p.nominal if p.null is None else p.null for k, p in self.parameters.items()}

    def check(self, name: str, value: Any, source: str) -> float | tuple[float, ...]:
        """Returns a parameter's value if it is a finite number (or a sequence of them) within its bounds.

        Args:
          name: parameter name.
          value: number, or one number per wheel or joint.
          source: file or function to name in the error.

        Raises:
          UserError: unknown parameter, not a number, not finite, or out of bounds.
        """
        field = f"effects.{self.name}.{name}"
        if name not in self.parameters:
            known = ", ".join(self.parameters) or "none"
            raise UserError(f"{source}: {field} is unknown; the parameters of {self.name} are {known}.")
        parameter = self.parameters[name]
        if isinstance(value, list | tuple):
            if parameter.axis == "rover":
                raise UserError(f"{source}: {field} = {value} has several values; {self.name} takes one number here.")
            # Each entry is checked by itself: one wheel out of bounds is named like a single number.
            return tuple(self.check_number(name, v, source) for v in value)
        return self.check_number(name, value, source)

    def check_number(self, name: str, value: Any, source: str) -> float:
        """Returns one number of a parameter if it is finite and within its bounds.

        Args:
          name: of a parameter that the effect has. value: of it, in its unit. source: file or function to name.

        Raises:
          UserError: not a number, not finite, or out of bounds.
        """
        field, parameter = f"effects.{self.name}.{name}", self.parameters[name]
        number = require_finite(source, field, value)
        low, high = parameter.bounds
        if not low <= number <= high:
            raise UserError(
                f"{source}: {field} = {number:g} {parameter.unit} is outside [{low:g}, {high:g}] {parameter.unit}; "
                f"give the {parameter.meaning} within these bounds."
            )
        return number

    def check_together(self, values: Mapping[str, Any], rover: Rover, source: str) -> None:
        """Refuses values that make no sense together, or for the rover.

        Args:
          values: of all parameters, each checked by itself or, where a terrain maps it, an array over the map.
          rover: that is to have the effect.
          source: file or function to name in the error.

        Raises:
          UserError: what `validate` refuses.
        """
        refusal = None if self.validate is None else self.validate(values, rover)
        if refusal is not None:
            field, value = f"effects.{self.name}.{refusal.parameter}", values[refusal.parameter]
            # A map has thousands of values, of which a sentence holds two.
            shown = f"{np.min(value):g} to {np.max(value):g}" if np.ndim(value) > 1 else value
            raise bad_input(source, field, shown, refusal.problem, refusal.remedy)


def effect(
    port: str,
    *,
    state: Mapping[str, StateVariable] = _EMPTY,
    replaces: tuple[str, ...] = (),
    order: int = 0,
    transient: bool = False,
    requires: tuple[str, ...] = (),
    validate: Validate | None = None,
    recall: Recall | None = None,
    mapped: tuple[str, ...] = (),
    **parameters: Parameter,
) -> Callable[[PortFunction], Effect]:
    """Decorator: makes an `Effect` of a function at one port; the function's docstring states equation and source."""

    def build(function: PortFunction) -> Effect:
        return Effect(
            name=function.__name__,
            ports={port: function},
            parameters=parameters,
            state=dict(state),
            replaces=replaces,
            order=order,
            transient=transient,
            doc=(function.__doc__ or "").strip(),
            requires=requires,
            validate=validate,
            recall=recall,
            mapped=mapped,
        )

    return build
