"""`model.toml`: a whole model on disk. Unknown keys, wrong units and values out of bounds are refused by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import tomli_w

from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import Effect, Parameter
from lunar_mjx.effects.presets import PRESETS
from lunar_mjx.errors import UserError, bad_input, require_file, require_finite, require_name, require_within
from lunar_mjx.files import write_text
from lunar_mjx.model.ambient import SYNODIC_DAY
from lunar_mjx.model.model import (
    GAINS,
    ZERO_CELSIUS,
    Model,
    check_effects,
    check_settings,
    make_model,
    settled,
    with_position_gains,
)
from lunar_mjx.model.posterior import read_posterior
from lunar_mjx.model.sun import SunSettings, read_sun
from lunar_mjx.resources import shipped
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain import load_terrain
from lunar_mjx.toml_fields import read_toml
from lunar_mjx.trust import require_trust
from lunar_mjx.units import to_unit

FORMAT = "lunar-mjx-model/1"
_MARKERS = {"models": "rover.toml", "terrain": "terrain.toml"}
_TOP = (
    "format",
    "rover",
    "terrain",
    "preset",
    "gravity_m_s2",
    "timestep_s",
    "thermal_integrator",
    "effect_list",
    "ambient",
    "control",
    "effects",
    "priors",
    "grounds",
    "sun",
    "posterior",
)
_AMBIENT = ("temperature_degC", "noon_temperature_degC", "night_temperature_degC", "noon_time_s", "period_s")
_CONTROL = ("mode", *GAINS)
OF_LOGS = ("calibration", "between_drives")
"""First parts of the names of priors about logs and not about the model: errors of their instruments, and what differs
from one recording to the next. Only those who read logs know their second parts."""

T = TypeVar("T")


def load_model(path: str | Path) -> Model:
    """Reads a model from a `model.toml`.

    Shipped names mean what ships; other relative paths count from the file's folder.

    Raises:
      UserError: one sentence naming the file, the field, the value and the remedy.
    """
    path = require_file(path, "the model file")
    data = read_toml(path)
    _known(path, "", data, _TOP)
    if data.get("format") != FORMAT:
        raise bad_input(path, "format", data.get("format"), "is not known", f'write format = "{FORMAT}"')
    for key in ("rover", "terrain"):
        require_name(path, key, data.get(key), f"name a {key} or the path of one")
    preset = _text(path, "preset", data.get("preset", "consistent"))
    if preset not in PRESETS:
        raise bad_input(path, "preset", preset, "does not exist", f"use one of {', '.join(PRESETS)}")
    terrain = _near(path, "terrain", data["terrain"])
    model = make_model(
        _named(path, "rover", data["rover"], load_rover, _near(path, "models", data["rover"])),
        _named(path, "terrain", data["terrain"], load_terrain, terrain),
        preset,
    )
    ambient = _ambient(path, _table(path, "ambient", data.get("ambient", {})), model.ambient)
    modes, gains = _control(path, _table(path, "control", data.get("control", {})), model)
    model = dataclasses.replace(
        model,
        terrain_spec=settled("terrain", terrain, _MARKERS["terrain"]),
        gravity=_number(path, "gravity_m_s2", data.get("gravity_m_s2", model.gravity)),
        timestep=_number(path, "timestep_s", data.get("timestep_s", model.timestep)),
        thermal_integrator=_text(path, "thermal_integrator", data.get("thermal_integrator", model.thermal_integrator)),
        ambient=ambient,
        grounds=_grounds(path, data.get("grounds", [])),
        sun=read_sun(path, _table(path, "sun", data["sun"])) if "sun" in data else None,
        modes={**model.modes, **modes},
        gains={**model.gains, **gains},
    )
    check_settings(model, path)
    # A gain that the file states is kept, be it zero.
    model = with_position_gains(model, [g for g, entry in data.get("control", {}).items() if GAINS[0] in entry])
    model = _effects(path, data, model)
    model = dataclasses.replace(model, priors=_priors(path, _table(path, "priors", data.get("priors", {})), model))
    if "posterior" in data:
        posterior = _table(path, "posterior", data["posterior"])
        model = dataclasses.replace(model, posterior=read_posterior(path, posterior, model.effects, model.parameters))
    check_effects(model, path)
    return model


def save_model(model: Model, path: str | Path) -> Path:
    """Writes a model to a `model.toml` that `load_model` reads back to the same model; returns the path.

    Paths of the user's own rover, terrain and effects are written relative to the file's folder if they lie in it.

    Raises:
      UserError: the terrain or an effect was made in Python, where no file can name it, or the file cannot be written.
    """
    path = Path(path)
    text = tomli_w.dumps(_record(model, path))
    return write_text(path, text)


def _record(model: Model, path: Path) -> dict[str, Any]:
    """The contents of the file at `path`."""
    if not model.terrain_spec:
        raise bad_input(
            path,
            "terrain",
            model.terrain.name,
            "was made in Python and no file names it",
            "make the model with a terrain's name or path",
        )
    for effect in model.effects:
        spec = model.effect_files[effect.name]
        if ".py" not in spec and catalogue.CATALOGUE.get(spec) is not effect:
            raise bad_input(
                path,
                "effect_list",
                effect.name,
                "was made in Python and no file names it",
                f"put it into a file and add it as my_effects.py:{effect.name}",
            )
    noon, night, noon_time, period = (float(v) for v in model.ambient)
    # A constant temperature is written as one, so that a file reads as its author would write it.
    if noon == night and (noon_time, period) == (0.0, SYNODIC_DAY):
        ambient: dict[str, float] = {"temperature_degC": _celsius(noon)}
    else:
        ambient = {
            "noon_temperature_degC": _celsius(noon),
            "night_temperature_degC": _celsius(night),
            "noon_time_s": noon_time,
            "period_s": period,
        }
    folder = path.parent.resolve()
    return {
        "format": FORMAT,
        "rover": _spelled(settled("models", model.rover.folder, _MARKERS["models"]), folder),
        "terrain": _spelled(model.terrain_spec, folder),
        "preset": model.preset,
        "gravity_m_s2": float(model.gravity),
        "timestep_s": float(model.timestep),
        "thermal_integrator": model.thermal_integrator,
        "effect_list": [_spelled(model.effect_files[e.name], folder) for e in model.effects],
        "ambient": ambient,
        "control": {
            group: {"mode": mode} | dict(zip(GAINS, (float(g) for g in model.gains[group]), strict=True))
            for group, mode in model.modes.items()
        },
        "effects": {
            e.name: {k: _written(e.parameters[k], v) for k, v in model.parameters[e.name].items()}
            for e in model.effects
            if e.parameters
        },
        **({"sun": _sun(model.sun, folder)} if model.sun is not None else {}),
        **({"grounds": list(model.grounds)} if model.grounds else {}),
        **({"priors": {k: {"value": v, "std": s} for k, (v, s) in model.priors.items()}} if model.priors else {}),
        **({"posterior": model.posterior.record()} if model.posterior is not None else {}),
    }


def _sun(sun: SunSettings, folder: Path) -> dict[str, Any]:
    table = {k: v for k, v in dataclasses.asdict(sun).items() if v is not None}
    return table | ({"horizon_dem": _spelled(sun.horizon_dem, folder)} if sun.horizon_dem is not None else {})


def _spelled(spec: str, folder: Path) -> str:
    """An absolute path within `folder` as ./relative; anything else as it is."""
    path = Path(spec)
    return f"./{path.relative_to(folder).as_posix()}" if path.is_absolute() and path.is_relative_to(folder) else spec


def _celsius(kelvin: float) -> float:
    return round(kelvin - ZERO_CELSIUS, 9)


def _written(parameter: Parameter, value: Any) -> Any:
    plain = list(value) if isinstance(value, tuple) else float(value)
    return plain if parameter.unit == "1" else {"value": plain, "unit": parameter.unit}


def _control(path: Path, table: Mapping[str, Any], model: Model) -> tuple[dict[str, str], dict[str, tuple[float, ...]]]:
    """Modes and gains of the joint groups that the file names."""
    modes, gains = {}, {}
    for group, entry in table.items():
        field = f"control.{group}"
        if group not in model.modes:
            raise bad_input(
                path, field, entry, "names no joint group of the rover", f"use one of {', '.join(model.modes)}"
            )
        _known(path, field, _table(path, field, entry), _CONTROL)
        modes[group] = _text(path, f"{field}.mode", entry.get("mode", model.modes[group]))
        gains[group] = tuple(
            _number(path, f"{field}.{key}", entry.get(key, old))
            for key, old in zip(GAINS, model.gains[group], strict=True)
        )
    return modes, gains


def _grounds(path: Path, names: Any) -> tuple[str, ...]:
    if not isinstance(names, list) or not all(isinstance(n, str) and n for n in names):
        raise bad_input(path, "grounds", names, "is no list of names", 'write it like ["flooring", "asphalt"]')
    if len(set(names)) < len(names):
        raise bad_input(path, "grounds", names, "names one twice", "name every ground once")
    return tuple(names)


def _priors(path: Path, table: Mapping[str, Any], model: Model) -> dict[str, tuple[float, float]]:
    """Value and standard deviation by `effect.parameter` or a name of `OF_LOGS`, in the parameter's SI unit."""
    priors = {}
    for key, entry in table.items():
        field = f"priors.{key}"
        _known(path, field, _table(path, field, entry), ("value", "std"))
        effect, _, parameter = key.partition(".")
        known = {**catalogue.CATALOGUE, **{e.name: e for e in model.effects}}.get(effect)
        if effect not in OF_LOGS and (known is None or parameter not in known.parameters):
            remedy = "write effect.parameter, as effect show prints them, or calibration.name"
            raise bad_input(path, "priors", key, "is no parameter of an effect", remedy)
        value, std = (_number(path, f"{field}.{k}", entry.get(k)) for k in ("value", "std"))
        if std < 0.0:
            raise bad_input(path, f"{field}.std", std, "is negative", "give a standard deviation, or 0 to fix it")
        if known is not None and parameter in known.parameters:
            low, high = known.parameters[parameter].bounds
            require_within(path, f"{field}.value", value, low, high)
            # What is known no better than the whole range is not known, and is left out.
            require_within(path, f"{field}.std", std, 0.0, high - low)
        priors[key] = (value, std)
    return priors


def _effects(path: Path, data: Mapping[str, Any], model: Model) -> Model:
    """Puts the file's list of effects into the model, and the file's values into the effects."""
    tables = _table(path, "effects", data.get("effects", {}))
    # The list first: values may then be given to effects that the preset lacks.
    if "effect_list" in data:
        model = _list_effects(path, data["effect_list"], model)
    for name, values in tables.items():
        if name not in model.effect_names:
            raise bad_input(
                path,
                f"effects.{name}",
                values,
                "is not in the list of effects",
                "add it to effect_list or drop the table",
            )
        effect = next(e for e in model.effects if e.name == name)
        values = _table(path, f"effects.{name}", values)
        model = model.set(name, str(path), **{k: _value(path, effect, k, v) for k, v in values.items()})
    return model


def _list_effects(path: Path, names: Any, model: Model) -> Model:
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise bad_input(path, "effect_list", names, "is not a list of names", "list effects as strings")
    parameters, effects, files = {}, [], {}
    for name in names:
        near = _near_effect(path, require_name(path, "effect_list", name, "list effects as strings"))
        # Before anything is loaded: naming an effect file in a model runs it.
        require_trust(path, "effect_list", near)
        effect = _named(path, "effect_list", name, catalogue.get, near)
        if effect.name in parameters:
            raise bad_input(path, "effect_list", effect.name, "stands there twice", "name every effect once")
        effects.append(effect)
        # An effect that the preset has, too, keeps its values there; others begin at their nominal ones.
        parameters[effect.name] = model.parameters.get(effect.name, effect.nominal())
        files[effect.name] = near
    for effect in effects:
        for other in effect.replaces:
            # After all are read: which of the two comes first in the file must not matter.
            if other in parameters:
                raise bad_input(path, "effect_list", other, f"is replaced by {effect.name}", "keep only one of the two")
    return dataclasses.replace(model, effects=tuple(effects), parameters=parameters, effect_files=files)


def _value(path: Path, effect: Effect, key: str, value: Any) -> Any:
    """A parameter's value in its SI unit: a number, a list, a table per joint group, or any of these with a unit."""
    if key not in effect.parameters:
        return 0.0  # refused by name where it is set
    field, parameter = f"effects.{effect.name}.{key}", effect.parameters[key]
    unit, inner = parameter.unit, value
    # A table with these keys is a number with its unit; any other one names groups of joints.
    if isinstance(value, dict) and ("value" in value or "unit" in value):
        _known(path, field, value, ("value", "unit"))
        if "value" not in value:
            raise bad_input(path, f"{field}.value", None, "is missing", "give the number beside its unit")
        inner, unit = value["value"], _text(path, f"{field}.unit", value.get("unit", unit))

    def convert(number: Any) -> float:
        # a temperature whose bounds reach down to 0 K is a difference of temperatures
        difference = parameter.unit == "K" and parameter.bounds[0] <= 0.0
        return to_unit(_number(path, field, number), unit, parameter.unit, path, field, difference=difference)

    if isinstance(inner, list):
        return [convert(n) for n in inner]
    if isinstance(inner, dict):
        return {group: convert(n) for group, n in inner.items()}
    return convert(inner)


def _ambient(path: Path, table: Mapping[str, Any], default: tuple[float, ...]) -> tuple[float, float, float, float]:
    _known(path, "ambient", table, _AMBIENT)
    if not table:
        return default[0], default[1], default[2], default[3]

    def kelvin(key: str) -> float:
        celsius = _number(path, f"ambient.{key}", table[key])
        if celsius <= -ZERO_CELSIUS:
            raise bad_input(
                path, f"ambient.{key}", celsius, "is not above absolute zero", "give degrees Celsius above -273.15"
            )
        return round(celsius + ZERO_CELSIUS, 9)  # so that what was saved, rounded likewise, is the same again

    if "temperature_degC" in table:
        # A constant beside a lunar day says two things about one moment.
        if len(table) > 1:
            raise bad_input(
                path,
                "ambient.temperature_degC",
                table["temperature_degC"],
                "is given beside a lunar day",
                "give either temperature_degC or noon and night temperatures",
            )
        return kelvin("temperature_degC"), kelvin("temperature_degC"), 0.0, SYNODIC_DAY
    for key in ("noon_temperature_degC", "night_temperature_degC"):
        if key not in table:
            raise bad_input(path, f"ambient.{key}", None, "is missing", "give both noon and night temperatures")
    return (
        kelvin("noon_temperature_degC"),
        kelvin("night_temperature_degC"),
        _number(path, "ambient.noon_time_s", table.get("noon_time_s", 0.0)),
        _number(path, "ambient.period_s", table.get("period_s", SYNODIC_DAY)),
    )


def _named(path: Path, field: str, value: str, load: Callable[[str], T], spec: str) -> T:
    """Loads what a field of the file names, and says so where that fails."""
    try:
        return load(spec)
    except UserError as error:
        # The inner sentence knows what is wrong, and not which model asked for it.
        raise UserError(f"{path}: {field} = {value!r} cannot be loaded: {error}") from error


def _near(path: Path, kind: str, name: str) -> str:
    """The shipped rover or terrain called `name`, else a relative path counted from the file; else `name`."""
    # A shipped name wins over a folder that happens to be called so; a path (with a slash) means the user's own.
    if name == Path(name).name and (shipped(kind) / name / _MARKERS[kind]).is_file():
        return str(shipped(kind) / name)
    near = path.parent.resolve() / name
    return str(near) if near.is_file() or (near / _MARKERS[kind]).is_file() else name


def _near_effect(path: Path, name: str) -> str:
    if ".py" not in name:
        return name
    file, colon, member = name.partition(":")
    return f"{path.parent.resolve() / file}{colon}{member}"


def _table(path: Path, field: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise bad_input(path, field, value, "is not a table", f"write it as [{field}]")
    return value


def _known(path: Path, field: str, table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for key in table:
        if key not in known:
            where = f"{field}.{key}" if field else key
            raise bad_input(path, where, table[key], "is an unknown key", f"use one of {', '.join(known)}")


def _number(path: Path, field: str, value: Any) -> float:
    # bool is an int to Python; `true` is no number to a reader.
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise bad_input(path, field, value, "is not a number", "give a number")
    try:
        return require_finite(path, field, value)
    except OverflowError:
        raise bad_input(path, field, value, "is too large", "give a number below 1e308") from None


def _text(path: Path, field: str, value: Any) -> str:
    if not isinstance(value, str):
        raise bad_input(path, field, value, "is not a text", "give a name in quotes")
    return value
