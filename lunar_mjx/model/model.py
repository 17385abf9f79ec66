"""The model: a rover, a terrain and a list of effects, with one value for every parameter."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.effects import catalogue, presets
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.joint.motor import MODES, WINDINGS
from lunar_mjx.errors import bad_input, require_finite, require_within
from lunar_mjx.model.ambient import SYNODIC_DAY, require_environment
from lunar_mjx.model.posterior import Posterior
from lunar_mjx.model.sun import SunSettings
from lunar_mjx.resources import shipped
from lunar_mjx.rover import Rover, load_rover
from lunar_mjx.terrain import Terrain, load_terrain

LUNAR_GRAVITY = 1.625
"""m/s2, the seed paper's value."""

ROOM = 298.15
"""Room temperature, K (25 degC)."""
ZERO_CELSIUS = 273.15
"""K; 0 degC, by definition."""
GAINS = ("position_gain_Nm_rad", "velocity_gain_Nms_rad")


@dataclasses.dataclass(frozen=True)
class ModelLimits:
    """Settings beyond which no model of a rover lies: what is larger is in another unit, or torn."""

    gain: float = 1e9
    """N m/rad and N m s/rad: a thousand times what the stiffest joint of the shipped rovers is held with, and more."""
    shortest_day: float = 1.0
    longest_day: float = 1e11
    """s: of the ambient temperature; as no clock counts 3000 years in logs."""


MODEL_LIMITS = ModelLimits()
"""Names in `model.toml` of a joint group's two gains."""

THERMAL_INTEGRATORS = ("heun", "euler")
DEFAULT_TERRAIN = "lunar_plain"

Value = float | tuple[float, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """A rover, a terrain and a list of effects.

    Attributes:
      rover: the rover. terrain: the ground. terrain_spec: name or absolute path that it was loaded from; empty for a
        terrain made in Python.
      effects: in list order. parameters: value of every parameter, by effect and name.
      preset: name of the preset that the list started from.
      gravity: m/s2, positive. timestep: s. thermal_integrator: "heun" or "euler".
      ambient: noon temperature K, night temperature K, time of noon s, length of the day s; constant if both are equal.
      modes: control mode by joint group. gains: position gain N m/rad and velocity gain N m s/rad by joint group.
      effect_files: catalogue name or /absolute/file.py:name of every effect.
      priors: value and standard deviation of what is known of a parameter (`effect.parameter`) or of an instrument
        (`calibration.pitch`) before a fit; a standard deviation of zero fixes it.
      grounds: what the logs that it was fitted to were driven on, in their words.
      sun: where the Sun stands or how it moves, for power, heat and cameras; None where each has its own default.
      posterior: how far measurements leave the parameters open, about their values; None where nothing was fitted.
    """

    rover: Rover
    terrain: Terrain
    terrain_spec: str
    effects: tuple[Effect, ...]
    parameters: Mapping[str, Mapping[str, Value]]
    preset: str = "consistent"
    gravity: float = LUNAR_GRAVITY
    timestep: float = 0.002
    thermal_integrator: str = "heun"
    ambient: tuple[float, float, float, float] = (ROOM, ROOM, 0.0, SYNODIC_DAY)
    modes: Mapping[str, str] = dataclasses.field(default_factory=dict)
    gains: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    effect_files: Mapping[str, str] = dataclasses.field(default_factory=dict)
    priors: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    sun: SunSettings | None = None
    grounds: tuple[str, ...] = ()
    posterior: Posterior | None = None

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of the model's effects, in the order in which they act."""
        return tuple(e.name for e in self.effects)

    def add(self, effect: Effect | str, source: str = "Model.add", /, **values: Any) -> Model:
        """A model with one more effect, in the place of those that it replaces.

        Args:
          effect: an effect, a catalogue name, or file.py:name.
          source: what to name in errors.
          **values: parameter values that differ from the nominal ones.

        Raises:
          UserError: the effect is unknown, already in the list or replaced by one in it, or a value is unknown or out
            of bounds.
        """
        written = settled_effect(effect) if isinstance(effect, str) else effect.name
        added = catalogue.get(written) if isinstance(effect, str) else effect
        if added.name in self.effect_names:
            raise bad_input(source, "effect", added.name, "is already in the model", "set its parameters instead")
        for other in self.effects:
            if added.name in other.replaces and other.name not in added.replaces:
                raise bad_input(
                    source,
                    "effect",
                    added.name,
                    f"is replaced by {other.name}, which is in the model",
                    f"remove {other.name} first",
                )
        replaced = [i for i, e in enumerate(self.effects) if e.name in added.replaces]
        # Two effects for one thing would both act: forces would count twice.
        kept = [e for e in self.effects if e.name not in added.replaces]
        # In the place of the first that it replaces: order within a port may matter.
        kept.insert(replaced[0] if replaced else len(kept), added)
        # Values of effects that are gone must not be saved.
        parameters = {k: v for k, v in self.parameters.items() if k not in added.replaces}
        parameters[added.name] = added.nominal()
        files = {k: v for k, v in self.effect_files.items() if k not in added.replaces}
        model = dataclasses.replace(
            self,
            effects=tuple(kept),
            parameters=parameters,
            effect_files={**files, added.name: written},
            posterior=self.posterior and self.posterior.within([e.name for e in kept]),
        )
        return model.set(added.name, source, **values)

    def remove(self, name: str) -> Model:
        """A model without the effect `name`."""
        self._effect(name, "Model.remove")
        return dataclasses.replace(
            self,
            effects=tuple(e for e in self.effects if e.name != name),
            parameters={k: v for k, v in self.parameters.items() if k != name},
            effect_files={k: v for k, v in self.effect_files.items() if k != name},
            posterior=self.posterior and self.posterior.within([n for n in self.effect_names if n != name]),
        )

    def set(self, name: str, source: str = "Model.set", /, **values: Any) -> Model:
        """A model with other values for parameters of the effect `name`.

        A value is a number, one number per wheel or joint, or for joints a mapping from joint group to number, in which
        groups left out keep their value.

        Raises:
          UserError: unknown effect or parameter, or a value that is not finite or out of bounds.
        """
        effect = self._effect(name, source)
        new = dict(self.parameters[name])
        for key, value in values.items():
            if isinstance(value, Mapping):
                value = self._by_group(effect, key, value, source)
            # NumPy and JAX numbers become Python's, so that what is saved is what was set.
            elif hasattr(value, "tolist"):
                value = value.tolist()
            _check_flat(effect, key, value, source)
            checked = effect.check(key, value, source)
            if isinstance(checked, tuple):
                _check_length(self.rover, effect, key, checked, source)
            new[key] = checked
        model = dataclasses.replace(self, parameters={**self.parameters, name: new})
        # After all values are set: an order of setting must not refuse what is sound in the end.
        effect.check_together(new, self.rover, source)
        return model

    def replace(self, **changes: Any) -> Model:
        """A model with other attributes, checked.

        `modes` and `gains` may name some of the joint groups only. `terrain` may be a name or path, as in `make_model`.

        Raises:
          UserError: an attribute does not exist, or its value makes no sense.
        """
        given = set(changes.get("gains", {}))
        known = [f.name for f in dataclasses.fields(self)]
        for key in changes:
            if key not in known:
                raise bad_input("Model.replace", key, changes[key], "is unknown", f"use one of {', '.join(known)}")
        for key in ("modes", "gains"):
            if key in changes:
                changes[key] = {**getattr(self, key), **changes[key]}
        if "terrain" in changes:
            # the name of the old ground must not be saved for the new one
            changes = {**_ground(changes.pop("terrain")), **changes}
        model = dataclasses.replace(self, **changes)
        check_settings(model, "Model.replace")
        return with_position_gains(model, given)

    def _effect(self, name: str, source: str) -> Effect:
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise bad_input(source, "effect", name, "is not in the model", f"use one of {', '.join(self.effect_names)}")

    def _by_group(self, effect: Effect, key: str, value: Mapping[str, Any], source: str) -> tuple[float, ...]:
        """One value per joint from one per joint group."""
        field = f"effects.{effect.name}.{key}"
        if key not in effect.parameters or effect.parameters[key].axis != "joint":
            effect.check(key, effect.parameters[key].nominal if key in effect.parameters else 0.0, source)
            raise bad_input(source, field, dict(value), "has a value per joint group", "give one number here")
        groups = [g.name for g in self.rover.groups]
        for group in value:
            if group not in groups:
                raise bad_input(
                    source,
                    f"{field}.{group}",
                    value[group],
                    "names no joint group of the rover",
                    f"use one of {', '.join(groups)}",
                )
        # Groups that are left out keep what they have, which may be one value for all joints.
        present = self.parameters[effect.name][key]
        names = [g.name for g in self.rover.groups for _ in g.joints]
        old = present if isinstance(present, tuple) else (present,) * len(names)
        for group, number in value.items():
            if isinstance(number, list | tuple | Mapping):
                raise bad_input(source, f"{field}.{group}", number, "is not a number", "give one number per group")
        return tuple(
            effect.check_number(key, value[n], source) if n in value else o for n, o in zip(names, old, strict=True)
        )


def _check_length(rover: Rover, effect: Effect, key: str, value: Sequence[float], source: str) -> None:
    axis = effect.parameters[key].axis
    wanted = len(rover.wheels) if axis == "wheel" else len(rover.joints)
    if len(value) != wanted:
        raise bad_input(
            source,
            f"effects.{effect.name}.{key}",
            list(value),
            f"has {len(value)} values",
            f"give one number, or {wanted}, one per {axis}",
        )


def _check_flat(effect: Effect, key: str, value: Any, source: str) -> None:
    if isinstance(value, list | tuple) and any(isinstance(v, list | tuple | Mapping) for v in value):
        raise bad_input(source, f"effects.{effect.name}.{key}", value, "is nested", "give a flat list of numbers")


def check_effects(model: Model, source: str | Path) -> None:
    """Refuses a list of effects that cannot run, alone or on the model's terrain.

    Raises:
      UserError: an effect needs another one that is not in the list, or refuses what the terrain's maps hold.
    """
    present = set(model.effect_names)
    for missing in dict.fromkeys(name for e in model.effects for name in e.requires if name not in present):
        needy = [e.name for e in model.effects if missing in e.requires]
        raise bad_input(
            source,
            "effect_list",
            ", ".join(model.effect_names),
            f"lacks {missing}, which {needy[0]} reads",
            f"add {missing} or take out {', '.join(needy)}",
        )
    layers = {} if model.terrain.grids is None else model.terrain.grids.layers
    for effect in model.effects:
        mapped = {name: layers[name] for name in effect.mapped if name in layers}
        if mapped:
            values = {**model.parameters[effect.name], **mapped}
            effect.check_together(values, model.rover, f"{source}: soil grids of {model.terrain.name}")


_POSITION_RATE = 20.0
"""1/s; a wheel that gets its position loop from its velocity loop nears its target at about this rate."""


def with_position_gains(model: Model, given: Collection[str]) -> Model:
    """Gives groups in position mode that have no position gain one in proportion to their velocity gain.

    A group made for velocity control has none and would stand still whatever the target. Groups in `given` keep theirs.
    """
    gains = {
        # A velocity gain k in N m s/rad and a position gain r k make a loop whose error falls as exp(-r t).
        group: (_POSITION_RATE * gain[1], gain[1])
        for group, gain in model.gains.items()
        if model.modes.get(group) == "position" and gain[0] == 0.0 and group not in given
    }
    return dataclasses.replace(model, gains={**model.gains, **gains}) if gains else model


def check_settings(model: Model, source: str | Path) -> None:
    """Refuses model-wide settings that make no sense.

    Raises:
      UserError: the sentence names the field as it is called in `model.toml`.
    """
    if require_finite(source, "gravity_m_s2", model.gravity) < 0.0:
        raise bad_input(source, "gravity_m_s2", model.gravity, "is negative", "give the magnitude; it points down")
    if model.gravity > 100.0:  # of a centrifuge; as in logs
        raise bad_input(source, "gravity_m_s2", model.gravity, "is above 100", "check its unit")
    # Beyond, explicit contact forces are unstable; below, a drive takes days.
    if not 1e-5 <= require_finite(source, "timestep_s", model.timestep) <= 0.02:
        raise bad_input(source, "timestep_s", model.timestep, "is outside [1e-5, 0.02] s", "use about 0.002 s")
    if model.thermal_integrator not in THERMAL_INTEGRATORS:
        raise bad_input(
            source,
            "thermal_integrator",
            model.thermal_integrator,
            "does not exist",
            f"use one of {', '.join(THERMAL_INTEGRATORS)}",
        )
    _check_ambient(model.ambient, source)
    for group, mode in model.modes.items():
        _check_group(model.rover, f"control.{group}.mode", group, mode, source)
        if mode not in MODES:
            raise bad_input(source, f"control.{group}.mode", mode, "does not exist", f"use one of {', '.join(MODES)}")
    for group, gains in model.gains.items():
        _check_group(model.rover, f"control.{group}", group, gains, source)
        if len(gains) != len(GAINS):
            raise bad_input(source, f"control.{group}", gains, "are not two gains", f"give {' and '.join(GAINS)}")
        for name, gain in zip(GAINS, gains, strict=True):
            if require_finite(source, f"control.{group}.{name}", gain) < 0.0:
                raise bad_input(source, f"control.{group}.{name}", gain, "is negative", "give zero or more")
            require_within(source, f"control.{group}.{name}", gain, 0.0, MODEL_LIMITS.gain)


def _check_group(rover: Rover, field: str, group: str, value: Any, source: str | Path) -> None:
    if rover.group(group) is None:
        raise bad_input(
            source,
            field,
            value,
            "names no joint group of the rover",
            f"use one of {', '.join(g.name for g in rover.groups)}",
        )


def _check_ambient(ambient: Sequence[float], source: str | Path) -> None:
    if not hasattr(ambient, "__len__") or len(ambient) != 4:
        raise bad_input(
            source,
            "ambient",
            ambient,
            "is not four numbers",
            "give noon and night temperature in K, time of noon and length of the day in s",
        )
    noon, night, noon_time, period = ambient
    for field, kelvin in (("noon", noon), ("night", night)):
        if require_finite(source, f"ambient.{field}_temperature_degC", kelvin) <= 0.0:
            raise bad_input(
                source,
                f"ambient.{field}_temperature_degC",
                round(kelvin - ZERO_CELSIUS, 6),
                "is not above absolute zero",
                "give degrees Celsius above -273.15",
            )
        celsius = kelvin - ZERO_CELSIUS
        require_environment(source, f"ambient.{field}_temperature_degC", "ambient_temperature_degC", celsius)
    if noon < night:
        celsius = round(noon - ZERO_CELSIUS, 6)
        raise bad_input(source, "ambient.noon_temperature_degC", celsius, "is below that of the night", "swap the two")
    longest = MODEL_LIMITS.longest_day
    require_within(source, "ambient.noon_time_s", noon_time, -longest, longest)
    if require_finite(source, "ambient.period_s", period) <= 0.0:
        raise bad_input(source, "ambient.period_s", period, "is not positive", "give the length of the day in s")
    require_within(source, "ambient.period_s", period, MODEL_LIMITS.shortest_day, longest)


def settled(kind: str, spec: str | Path, marker: str) -> str:
    """A rover's or terrain's spec that holds in every folder.

    Args:
      kind: "models" or "terrain".
      spec: name of a shipped one, path, or anything else (such as slope:10deg).
      marker: file that a folder of this kind holds.

    Returns:
      A shipped one's name, else the absolute path where there is such a file or folder, else `spec` itself.
    """
    path = Path(spec)
    # A shipped name, or a spec that no file stands for.
    if not path.is_file() and not (path / marker).is_file():
        return str(spec)
    full = path.resolve()
    # By name, so that a saved model survives another installation.
    return full.name if full.is_dir() and full.parent == shipped(kind).resolve() else str(full)


def settled_effect(spec: str) -> str:
    """An effect's spec that holds in every folder: its catalogue name, or /absolute/file.py:name."""
    if ".py" not in spec:
        return spec
    file, colon, member = spec.partition(":")
    return f"{Path(file).resolve()}{colon}{member}"


def make_model(
    rover: str | Path | Rover = "viper",
    terrain: str | Path | dict[str, Any] | Terrain = DEFAULT_TERRAIN,
    preset: str = "consistent",
    **changes: Any,
) -> Model:
    """A model from a preset.

    Args:
      rover: name or folder of a rover, or a rover.
      terrain: name, file or folder of a terrain, the tables of a `terrain.toml` as a dict, or a terrain.
      preset: "consistent", "field" or "paper".
      **changes: attributes of `Model` that differ (gravity, timestep, ambient, modes, gains, ...); `modes` and `gains`
        may name some of the joint groups only.

    Raises:
      UserError: unknown rover, terrain, preset or attribute value.
    """
    if preset not in presets.PRESETS:
        raise bad_input("make_model", "preset", preset, "does not exist", f"use one of {', '.join(presets.PRESETS)}")
    loaded = rover if isinstance(rover, Rover) else load_rover(rover)
    effects = tuple(catalogue.CATALOGUE[name] for name in presets.PRESETS[preset])
    modes = {g.name: g.mode for g in loaded.groups} | dict(changes.pop("modes", {}))
    given_gains = dict(changes.pop("gains", {}))
    model = Model(
        rover=loaded,
        **_ground(terrain),
        effects=effects,
        parameters={e.name: e.nominal() for e in effects},
        preset=preset,
        # The paper's own integration; Heun is of second order at twice the heat's cost.
        thermal_integrator="euler" if preset == "paper" else "heun",
        modes=modes,
        gravity=LUNAR_GRAVITY if loaded.gravity is None else loaded.gravity,
        timestep=loaded.timestep,
        effect_files={e.name: e.name for e in effects},
    )
    if preset in presets.PRESET_AMBIENT:
        model = dataclasses.replace(model, ambient=(*presets.PRESET_AMBIENT[preset], 0.0, SYNODIC_DAY))
    # The preset after the rover: a preset may state another gear.
    model = preset_values(rover_motors(model))
    model = dataclasses.replace(model, gains=_gains_of_gear(model, loaded))
    # What the rover's own files say, by their name.
    check_settings(model, loaded.folder)
    # Last, since gains that are given are meant as they are, whatever the gear.
    return model.replace(**changes, gains=given_gains)


def _ground(terrain: str | Path | dict[str, Any] | Terrain) -> dict[str, Any]:
    """The attributes `terrain` and `terrain_spec` of a model; a terrain made in Python has no name to save."""
    if isinstance(terrain, Terrain):
        return {"terrain": terrain, "terrain_spec": ""}
    spec = settled("terrain", terrain, "terrain.toml") if isinstance(terrain, str | Path) else ""
    return {"terrain": load_terrain(terrain), "terrain_spec": spec}


def preset_values(model: Model) -> Model:
    """The values in which the model's preset departs from the nominal ones."""
    for name, values in presets.PRESET_PARAMETERS[model.preset].items():
        model = model.set(name, f"preset {model.preset}", **values)
    return model


def _gains_of_gear(model: Model, rover: Rover) -> dict[str, tuple[float, float]]:
    """The gains of the rover, scaled with the inertia at the joint, which a preset's gear changes."""
    ratios = model.parameters["motor"]["gear_ratio"]
    assert isinstance(ratios, tuple)
    compiled = rover.compile()
    gains = {}
    for group in rover.groups:
        ratio = ratios[rover.joints.index(group.joints[0])]
        inertia = float(compiled.dof_M0[compiled.joint(group.joints[0]).dofadr[0]])
        rotor = group.rotor_inertia / rover.wheels_per_motor(group.joints[0])
        # The compiled inertia holds the rotor through the rover's own gear already; only the difference is added.
        reflected = rotor * (ratio**2 - group.gear_ratio**2)
        # Gains in proportion to the inertia keep the loop's bandwidth.
        scale = (inertia + reflected) / inertia
        gains[group.name] = (group.position_gain * scale, group.velocity_gain * scale)
    return gains


def rover_motors(model: Model) -> Model:
    """Motor parameters that the rover's folder states for each joint group.

    A motor that drives n wheels is the same as n motors side by side, one at each wheel, each with 1/n of the current
    and of the rotor's inertia and n times the resistance: the currents of its wheels add up to the motor's.
    """
    groups = model.rover.groups
    windings = {
        g.name: {
            k: WINDINGS[g.winding][k] if (own := getattr(g, k)) is None else own
            for k in ("resistance", "torque_constant", "current_limit")
        }
        for g in groups
    }
    driven = np.array([model.rover.wheels_per_motor(j) for j in model.rover.joints], float)

    def by_joint(values: Mapping[str, float]) -> np.ndarray:
        return np.array([values[g.name] for g in groups for _ in g.joints])

    model = model.set(
        "motor",
        str(model.rover.folder),
        gear_ratio={g.name: g.gear_ratio for g in groups},
        gear_efficiency={g.name: g.gear_efficiency for g in groups},
        rotor_inertia=by_joint({g.name: g.rotor_inertia for g in groups}) / driven,
        resistance=by_joint({n: w["resistance"] for n, w in windings.items()}) * driven,
        torque_constant={n: w["torque_constant"] for n, w in windings.items()},
    )
    limits = by_joint({n: w["current_limit"] for n, w in windings.items()}) / driven
    return model.set("joint_control", current_limit=limits)
