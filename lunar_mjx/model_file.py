"""`model.toml`: a whole model on disk. Unknown keys, wrong units and values out of bounds are refused by name."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from lunar_mjx.dynamics.state import SYNODIC_DAY
from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import Effect, Parameter
from lunar_mjx.errors import UserError, bad_input, require_file, require_finite
from lunar_mjx.model import LUNAR_GRAVITY, Model, make_model
from lunar_mjx.resources import shipped
from lunar_mjx.units import to_unit

FORMAT = "lunar-mjx-model/1"
ZERO_CELSIUS = 273.15
_TOP = ("format", "rover", "terrain", "preset", "gravity_m_s2", "timestep_s", "thermal_integrator", "effect_list",
        "ambient", "control", "effects")  # fmt: skip
_AMBIENT = ("temperature_degC", "noon_temperature_degC", "night_temperature_degC", "noon_time_s", "period_s")
_CONTROL = ("mode", "position_gain_Nm_rad", "velocity_gain_Nms_rad")


def load_model(path: str | Path) -> Model:
    """Reads a model from a `model.toml`.

    Raises:
      UserError: one sentence naming the file, the field, the value and the remedy.
    """
    path = require_file(path, "the model file")
    data = _read(path)
    _known(path, "", data, _TOP)
    if data.get("format") != FORMAT:
        raise bad_input(path, "format", data.get("format"), "is not known", f'write format = "{FORMAT}"')
    for key in ("rover", "terrain"):
        if not isinstance(data.get(key), str):
            raise bad_input(path, key, data.get(key), "is not a name", f"name a {key} or the path of one")
    control = _table(path, "control", data.get("control", {}))
    modes, gains = {}, {}
    for group, entry in control.items():
        _known(path, f"control.{group}", _table(path, f"control.{group}", entry), _CONTROL)
        modes[group] = entry.get("mode")
    model = make_model(
        _beside(path, data["rover"]),
        _beside(path, data["terrain"]),
        _text(path, "preset", data.get("preset", "consistent")),
        timestep=_number(path, "timestep_s", data.get("timestep_s", 0.002)),
        gravity=_number(path, "gravity_m_s2", data.get("gravity_m_s2", LUNAR_GRAVITY)),
    )
    for group, entry in control.items():
        if group not in model.modes:
            raise bad_input(path, f"control.{group}", dict(entry), "names no joint group of the rover",
                            f"use one of {', '.join(model.modes)}")  # fmt: skip
        modes[group] = _text(path, f"control.{group}.mode", entry.get("mode", model.modes[group]))
        gains[group] = tuple(
            _number(path, f"control.{group}.{key}", entry.get(key, old))
            for key, old in zip(_CONTROL[1:], model.gains[group], strict=True)
        )
    model = model.replace(
        modes={**model.modes, **modes},
        gains={**model.gains, **gains},
        ambient=_ambient(path, _table(path, "ambient", data.get("ambient", {})), model.ambient),
        thermal_integrator=_text(path, "thermal_integrator", data.get("thermal_integrator", model.thermal_integrator)),
        terrain_spec=data["terrain"],
    )
    return _effects(path, data, model)


def save_model(model: Model, path: str | Path) -> Path:
    """Writes a model to a `model.toml` that `load_model` reads back to the same model; returns the path."""
    path = Path(path)
    noon, night, noon_time, period = model.ambient
    if noon == night:
        ambient: dict[str, float] = {"temperature_degC": _celsius(noon)}
    else:
        ambient = {"noon_temperature_degC": _celsius(noon), "night_temperature_degC": _celsius(night),
                   "noon_time_s": noon_time, "period_s": period}  # fmt: skip
    folder = model.rover.folder
    data = {
        "format": FORMAT,
        "rover": folder.name if folder.parent == shipped("models") else str(folder),
        "terrain": model.terrain_spec,
        "preset": model.preset,
        "gravity_m_s2": float(model.gravity),
        "timestep_s": float(model.timestep),
        "thermal_integrator": model.thermal_integrator,
        "effect_list": [model.effect_files[e.name] for e in model.effects],
        "ambient": ambient,
        "control": {
            group: {"mode": mode, _CONTROL[1]: float(model.gains[group][0]), _CONTROL[2]: float(model.gains[group][1])}
            for group, mode in model.modes.items()
        },
        "effects": {
            e.name: {k: _written(e.parameters[k], v) for k, v in model.parameters[e.name].items()}
            for e in model.effects
            if e.parameters
        },
    }
    path.write_text(tomli_w.dumps(data))
    return path


def _celsius(kelvin: float) -> float:
    return round(float(kelvin) - ZERO_CELSIUS, 9)


def _written(parameter: Parameter, value: Any) -> Any:
    plain = list(value) if isinstance(value, tuple) else float(value)
    return plain if parameter.unit == "1" else {"value": plain, "unit": parameter.unit}


def _effects(path: Path, data: Mapping[str, Any], model: Model) -> Model:
    """Puts the file's list of effects into the model, and the file's values into the effects."""
    tables = _table(path, "effects", data.get("effects", {}))
    if "effect_list" in data:
        model = _list_effects(path, data["effect_list"], model)
    for name, values in tables.items():
        if name not in model.effect_names:
            raise bad_input(path, f"effects.{name}", values,
                            "is not in the list of effects", "add it to effect_list or drop the table")  # fmt: skip
        effect = next(e for e in model.effects if e.name == name)
        values = _table(path, f"effects.{name}", values)
        model = model.set(name, str(path), **{k: _value(path, effect, k, v) for k, v in values.items()})
    return model


def _list_effects(path: Path, names: Any, model: Model) -> Model:
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise bad_input(path, "effect_list", names, "is not a list of names", "list effects as strings")
    parameters, effects, files = {}, [], {}
    for name in names:
        effect = catalogue.get(_beside(path, name))
        if effect.name in parameters:
            raise bad_input(path, "effect_list", effect.name, "stands there twice", "name every effect once")
        effects.append(effect)
        parameters[effect.name] = model.parameters.get(effect.name, effect.nominal())
        files[effect.name] = name
    for effect in effects:
        for other in effect.replaces:
            if other in parameters:
                raise bad_input(path, "effect_list", other, f"is replaced by {effect.name}", "keep only one of the two")
    return dataclasses.replace(model, effects=tuple(effects), parameters=parameters, effect_files=files)


def _value(path: Path, effect: Effect, key: str, value: Any) -> Any:
    """A parameter's value in its SI unit: a number, a list, a table per joint group, or any of these with a unit."""
    if key not in effect.parameters or not isinstance(value, dict) or "value" not in value:
        return value
    field = f"effects.{effect.name}.{key}"
    _known(path, field, value, ("value", "unit"))
    unit = _text(path, f"{field}.unit", value.get("unit", effect.parameters[key].unit))

    def convert(number: Any) -> float:
        return to_unit(_number(path, field, number), unit, effect.parameters[key].unit, path, field)

    inner = value["value"]
    if isinstance(inner, list):
        return [convert(n) for n in inner]
    if isinstance(inner, dict):
        return {group: convert(n) for group, n in inner.items()}
    return convert(inner)


def _ambient(path: Path, table: Mapping[str, Any], default: tuple[float, ...]) -> tuple[float, float, float, float]:
    _known(path, "ambient", table, _AMBIENT)
    constant = "temperature_degC" in table
    if constant and len(table) > 1:
        raise bad_input(path, "ambient.temperature_degC", table["temperature_degC"], "is given beside a lunar day",
                        "give either temperature_degC or noon and night temperatures")  # fmt: skip
    if constant:
        kelvin = _number(path, "ambient.temperature_degC", table["temperature_degC"]) + ZERO_CELSIUS
        return kelvin, kelvin, 0.0, SYNODIC_DAY
    if not table:
        return default[0], default[1], default[2], default[3]
    for key in ("noon_temperature_degC", "night_temperature_degC"):
        if key not in table:
            raise bad_input(path, f"ambient.{key}", None, "is missing", "give both noon and night temperatures")
    return (
        _number(path, "ambient.noon_temperature_degC", table["noon_temperature_degC"]) + ZERO_CELSIUS,
        _number(path, "ambient.night_temperature_degC", table["night_temperature_degC"]) + ZERO_CELSIUS,
        _number(path, "ambient.noon_time_s", table.get("noon_time_s", 0.0)),
        _number(path, "ambient.period_s", table.get("period_s", SYNODIC_DAY)),
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text())
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path}: is not valid TOML ({error}); mend that line.") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not a text file; give a model.toml.") from None


def _beside(path: Path, name: str) -> str:
    """A relative path counts from the file that names it; anything else stays a name."""
    file, colon, member = name.partition(":") if ".py" in name else (name, "", "")
    near = path.parent / file
    return f"{near}{colon}{member}" if file and near.exists() and not Path(file).is_absolute() else name


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
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise bad_input(path, field, value, "is not a number", "give a number")
    return require_finite(path, field, value)


def _text(path: Path, field: str, value: Any) -> str:
    if not isinstance(value, str):
        raise bad_input(path, field, value, "is not a text", "give a name in quotes")
    return value
