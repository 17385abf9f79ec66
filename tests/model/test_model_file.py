"""`model.toml`: what is saved is what is loaded, and every mistake is told by file, field, value and remedy."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w

from lunar_mjx.dynamics import build
from lunar_mjx.effects.base import effect
from lunar_mjx.errors import UserError
from lunar_mjx.model import Model, make_model
from lunar_mjx.model.file import FORMAT, load_model, save_model
from lunar_mjx.resources import shipped
from lunar_mjx.rover import convert
from lunar_mjx.terrain import flat
from lunar_mjx.trust import trusting

MY_EFFECT = """
from lunar_mjx.effects import Parameter, effect

@effect("motor_torque", torque=Parameter(0.5, 0.0, (0.0, 5.0), "N m", "Coulomb friction", "test", axis="joint"))
def my_friction(ctx, p, x, torque):
    "A constant loss."
    return torque - p.torque
"""
MINIMAL: dict[str, Any] = {"format": FORMAT, "rover": "luvmi_x", "terrain": "flat"}


def assert_same(a: Model, b: Model) -> None:
    """Bit by bit the same model (effects of a user's file are made anew by every load)."""
    settings = ("preset", "terrain_spec", "gravity", "timestep", "thermal_integrator", "ambient", "modes", "gains")
    for field in (*settings, "grounds"):
        assert getattr(a, field) == getattr(b, field), field
    assert a.effect_names == b.effect_names and a.effect_files == b.effect_files
    assert {k: dict(v) for k, v in a.parameters.items()} == {k: dict(v) for k, v in b.parameters.items()}
    assert a.rover.mjcf.resolve() == b.rover.mjcf.resolve()
    assert jax.tree.structure(a.terrain) == jax.tree.structure(b.terrain)
    for x, y in zip(jax.tree.leaves(a.terrain), jax.tree.leaves(b.terrain), strict=True):
        np.testing.assert_array_equal(x, y)


def varied(tmp_path: Path) -> dict[str, Model]:
    """Models that differ from their presets in every way that a file can say."""
    effects = tmp_path / "mine.py"
    effects.write_text(MY_EFFECT)
    base = make_model("luvmi_x", "flat")
    joints = len(base.rover.joints)
    return {
        "per joint": base.set("motor", resistance=np.linspace(1.0, 7.3, joints), gear_ratio={"steer": 333.3}),
        "per wheel": base.add("wheel_radius_error", "test", offset=[0.001, -0.002, 0.0, 1e-3 / 3.0]),
        "other effects": base.add("stress_integral").add("payload").remove("boulders"),
        "user's effect": base.add(f"{effects}:my_friction", "test", torque={"drive": 0.1 + 0.2}),
        "user's file of one effect": base.add(str(effects)),
        "lunar day": base.replace(ambient=(390.123456789, 100.1, 86400.0, 2551442.9)),
        "constant ambient with a phase": base.replace(ambient=(250.0, 250.0, 10.0, 1000.0)),
        "cold": base.replace(ambient=(40.1, 40.1, *base.ambient[2:])),
        "control": base.replace(
            modes={**base.modes, "drive": "torque", "steer": "current"}, gains={**base.gains, "steer": (1.0 / 3.0, 0.7)}
        ),
        "globals": base.replace(gravity=9.81, timestep=1e-3 / 3.0, thermal_integrator="euler"),
        "slope": make_model("luvmi_x", "slope:7.5deg", "paper"),
        "fitted": dataclasses.replace(base, grounds=("asphalt", "flooring")),
    }


@pytest.mark.parametrize("preset", ["consistent", "paper"])
@pytest.mark.parametrize("rover", ["viper", "luvmi_x"])
def test_round_trip_of_presets(rover: str, preset: str, tmp_path: Path) -> None:
    model = make_model(rover, "flat", preset)
    again = load_model(save_model(model, tmp_path / "model.toml"))
    assert_same(model, again)
    assert tomllib.loads((tmp_path / "model.toml").read_text())["rover"] == rover


def test_round_trip_of_every_change(tmp_path: Path) -> None:
    for name, model in varied(tmp_path).items():
        path = tmp_path / f"{name.replace(' ', '_')}.toml"
        again = load_model(save_model(model, path))
        assert_same(model, again)
        assert save_model(again, tmp_path / "again.toml").read_bytes() == path.read_bytes(), name


def test_a_short_file_is_the_preset(tmp_path: Path) -> None:
    path = write(tmp_path, MINIMAL)
    assert_same(load_model(path), make_model("luvmi_x", "flat"))


@pytest.mark.slow
def test_a_loaded_model_runs_to_the_same_numbers(tmp_path: Path) -> None:
    model = varied(tmp_path)["user's effect"].set("soil", cohesion=300.0).replace(gravity=1.7)
    first = build(model, "mjx")
    state, control = first.reset(first.params, 1.0, 2.0, 0.3), jnp.full(len(first.joint_names), 0.5)
    lowered = jax.jit(first.step).lower(first.params, state, control)
    second = build(load_model(save_model(model, tmp_path / "model.toml")), "mjx")
    other = second.reset(second.params, 1.0, 2.0, 0.3)
    assert jax.jit(second.step).lower(second.params, other, control).as_text() == lowered.as_text()
    run = lowered.compile()
    results = [run(s.params, start, control) for s, start in ((first, state), (second, other))]
    for a, b in zip(*(jax.tree.leaves(r) for r in results), strict=True):
        np.testing.assert_array_equal(a, b)
    torque = np.asarray(results[0][1].joint_torque)
    bare = run(build(model.set("my_friction", torque=[0.0] * 12), "mjx").params, state, control)[1].joint_torque
    friction = [0.1 + 0.2] * 4 + [0.5] * 8
    np.testing.assert_allclose(bare - torque, friction, rtol=1e-3, err_msg="the user's effect acts")


def test_own_files_beside_the_model_travel_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, away = tmp_path / "home", tmp_path / "away"
    home.mkdir()
    (home / "mine.py").write_text(MY_EFFECT)
    (home / "ground").mkdir()
    (home / "ground" / "terrain.toml").write_text("[plane]\nslope_deg = 3.0\nextent = 20.0\n")
    convert(shipped("models") / "luvmi_x" / "luvmi_x.urdf", home / "rover")
    monkeypatch.chdir(home)
    model = make_model("rover", "ground").add("mine.py:my_friction")
    save_model(model, home / "model.toml")
    written = tomllib.loads((home / "model.toml").read_text())
    assert written["rover"] == "./rover" and written["terrain"] == "./ground"
    assert written["effect_list"][-1] == "./mine.py:my_friction"
    home.rename(away)
    monkeypatch.chdir(tmp_path)
    with trusting():  # the file has come from elsewhere
        moved = load_model(away / "model.toml")
    assert moved.rover.mjcf.resolve() == (away / "rover" / "luvmi_x.xml").resolve()
    assert moved.terrain_spec == str(away / "ground")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    assert_same(load_model(save_model(moved, elsewhere / "model.toml")), moved)


def test_a_folder_that_is_called_like_a_shipped_terrain_is_not_taken_for_it(tmp_path: Path) -> None:
    (tmp_path / "flat").mkdir()
    (tmp_path / "luvmi_x").mkdir()
    assert_same(load_model(write(tmp_path, MINIMAL)), make_model("luvmi_x", "flat"))


def test_values_convert(tmp_path: Path) -> None:
    effects = {
        "soil": {
            "friction_angle": {"value": 30.0, "unit": "deg"},
            "cohesion": {"value": 0.5, "unit": "kPa"},
            "shear_modulus_x": {"value": 18.0, "unit": "mm"},
            "n": 1,
        },
        "thermal_cutoff": {
            "temperature": {"value": 150.0, "unit": "degC"},
            "hysteresis": {"value": 5.0, "unit": "delta_degC"},
        },
        "motor": {
            "resistance": {"value": {"drive": 2000, "steer": 3000.0}, "unit": "mohm"},
            "gear_ratio": {"drive": 99},
            "torque_constant": {"value": [50.0] * 12, "unit": "mN m/A"},
        },
    }
    model = load_model(write(tmp_path, {**MINIMAL, "effects": effects}))
    soil, motor = model.parameters["soil"], model.parameters["motor"]
    assert soil["friction_angle"] == pytest.approx(math.pi / 6.0)
    assert (soil["cohesion"], soil["shear_modulus_x"], soil["n"]) == pytest.approx((500.0, 0.018, 1.0))
    assert model.parameters["thermal_cutoff"] == {"temperature": pytest.approx(423.15), "hysteresis": 5.0}
    own = make_model("luvmi_x", "flat").parameters["motor"]["resistance"]
    assert isinstance(own, tuple)
    assert motor["resistance"] == pytest.approx((2.0,) * 4 + (3.0,) * 4 + own[8:])
    assert motor["torque_constant"] == pytest.approx((0.05,) * 12)
    assert isinstance(motor["gear_ratio"], tuple) and motor["gear_ratio"][:4] == (99.0,) * 4


def test_ambient(tmp_path: Path) -> None:
    constant = load_model(write(tmp_path, {**MINIMAL, "ambient": {"temperature_degC": -20}}))
    assert constant.ambient[:2] == pytest.approx((253.15, 253.15))
    table = {"noon_temperature_degC": 120.0, "night_temperature_degC": -170.0, "noon_time_s": 5.0, "period_s": 60.0}
    assert load_model(write(tmp_path, {**MINIMAL, "ambient": table})).ambient == pytest.approx(
        (393.15, 103.15, 5.0, 60.0)
    )


def test_saving_refuses_what_no_file_can_name(tmp_path: Path) -> None:
    @effect("command")
    def made_here(ctx, p, x, command):
        return command

    path = tmp_path / "model.toml"
    for model, words in (
        (make_model("luvmi_x", flat()), ("terrain = 'flat'", "made in Python")),
        (make_model("luvmi_x", "flat").add(made_here), ("effect_list = 'made_here'", "my_effects.py:made_here")),
    ):
        with pytest.raises(UserError) as caught:
            save_model(model, path)
        assert str(caught.value).startswith(f"{path}: ") and all(w in str(caught.value) for w in words)
    assert not path.exists()
    with pytest.raises(UserError, match="cannot be written"):
        save_model(make_model("luvmi_x", "flat"), tmp_path / "no" / "model.toml")


def write(folder: Path, data: dict[str, Any]) -> Path:
    path = folder / "model.toml"
    path.write_text(tomli_w.dumps(data), encoding="utf-8")
    return path


def soil(**values: Any) -> dict[str, Any]:
    return {"effects": {"soil": values}}


def unit(value: Any, name: Any) -> dict[str, Any]:
    return {"value": value, "unit": name}


# what is wrong: (changes to the minimal file, words that the message must hold)
MISTAKES: dict[str, tuple[dict[str, Any], list[str]]] = {
    "no format": ({"format": None}, ["format", "is not known", FORMAT]),
    "other format": ({"format": "lunar-mjx-model/9"}, ["'lunar-mjx-model/9'", FORMAT]),
    "no rover": ({"rover": None}, ["rover = None", "name a rover"]),
    "empty rover": ({"rover": ""}, ["rover = ''", "name a rover"]),
    "rover is a number": ({"rover": 3}, ["rover = 3", "is not a name"]),
    "unknown rover": ({"rover": "moonbuggy"}, ["rover = 'moonbuggy'", "luvmi_x, rocker_bogie, viper"]),
    "no terrain": ({"terrain": None}, ["terrain = None", "name a terrain"]),
    "unknown terrain": ({"terrain": "sea"}, ["terrain = 'sea'", "lunar_plain"]),
    "steep terrain": ({"terrain": "slope:95deg"}, ["terrain = 'slope:95deg'", "below 90"]),
    "unknown preset": ({"preset": "best"}, ["preset = 'best'", "consistent, field, paper"]),
    "preset is a number": ({"preset": 1}, ["preset = 1", "not a text"]),
    "unknown key": ({"gravity": 1.6}, ["gravity = 1.6", "unknown key", "gravity_m_s2"]),
    "negative gravity": ({"gravity_m_s2": -1.6}, ["gravity_m_s2 = -1.6", "magnitude"]),
    "gravity in words": ({"gravity_m_s2": "lunar"}, ["gravity_m_s2 = 'lunar'", "not a number"]),
    "gravity nan": ({"gravity_m_s2": math.nan}, ["gravity_m_s2 = nan", "not finite"]),
    "gravity true": ({"gravity_m_s2": True}, ["gravity_m_s2 = True", "not a number"]),
    "gravity huge": ({"gravity_m_s2": 10**400}, ["gravity_m_s2 = 1000", "too large"]),
    "time step zero": ({"timestep_s": 0}, ["timestep_s = 0.0", "outside [1e-5, 0.02] s"]),
    "time step large": ({"timestep_s": 1.0}, ["timestep_s = 1.0", "outside"]),
    "time step inf": ({"timestep_s": math.inf}, ["timestep_s = inf", "not finite"]),
    "integrator": ({"thermal_integrator": "rk4"}, ["thermal_integrator = 'rk4'", "heun, euler"]),
    "ambient is a number": ({"ambient": 25.0}, ["ambient = 25.0", "not a table", "[ambient]"]),
    "ambient unknown key": ({"ambient": {"temperature_K": 300.0}}, ["ambient.temperature_K", "temperature_degC"]),
    "below absolute zero": ({"ambient": {"temperature_degC": -300.0}}, ["-300.0", "absolute zero", "-273.15"]),
    "ambient both ways": (
        {"ambient": {"temperature_degC": 0.0, "period_s": 3.0}},
        ["ambient.temperature_degC = 0.0", "beside a lunar day"],
    ),
    "no night": ({"ambient": {"noon_temperature_degC": 100.0}}, ["ambient.night_temperature_degC", "missing"]),
    "night too cold": (
        {"ambient": {"noon_temperature_degC": 100.0, "night_temperature_degC": -273.15}},
        ["ambient.night_temperature_degC = -273.15", "absolute zero"],
    ),
    "day of no length": (
        {"ambient": {"noon_temperature_degC": 1.0, "night_temperature_degC": 0.0, "period_s": 0.0}},
        ["ambient.period_s = 0.0", "not positive"],
    ),
    "control is a list": ({"control": []}, ["control = []", "not a table"]),
    "unknown group": ({"control": {"arm": {"mode": "torque"}}}, ["control.arm", "drive, steer, suspension"]),
    "group is a text": ({"control": {"drive": "torque"}}, ["control.drive = 'torque'", "[control.drive]"]),
    "unknown control key": ({"control": {"drive": {"gain": 1.0}}}, ["control.drive.gain = 1.0", "mode"]),
    "unknown mode": ({"control": {"drive": {"mode": "magic"}}}, ["control.drive.mode = 'magic'", "velocity"]),
    "mode is a number": ({"control": {"drive": {"mode": 2}}}, ["control.drive.mode = 2", "not a text"]),
    "negative gain": (
        {"control": {"drive": {"velocity_gain_Nms_rad": -1.0}}},
        ["control.drive.velocity_gain_Nms_rad = -1.0", "negative"],
    ),
    "gain nan": (
        {"control": {"steer": {"position_gain_Nm_rad": math.nan}}},
        ["control.steer.position_gain_Nm_rad = nan", "not finite"],
    ),
    "effect list is a text": ({"effect_list": "soil"}, ["effect_list = 'soil'", "list effects as strings"]),
    "effect list of numbers": ({"effect_list": [1]}, ["effect_list = [1]", "list effects as strings"]),
    "unknown effect": ({"effect_list": ["motor", "warp"]}, ["effect_list = 'warp'", "lunar-mjx effect list"]),
    "effect twice": ({"effect_list": ["motor", "soil", "soil"]}, ["effect_list = 'soil'", "twice"]),
    "effect and its replacement": (
        {"effect_list": ["motor", "stress_integral", "closed_form_shear"]},
        ["effect_list = 'closed_form_shear'", "replaced by stress_integral"],
    ),
    "no motor": ({"effect_list": ["joint_control", "soil"]}, ["effect_list", "lacks motor", "joint_control"]),
    "effect file missing": ({"effect_list": ["motor", "gone.py:x"]}, ["effect_list = 'gone.py:x'", "not there"]),
    "effects is a list": ({"effects": [1]}, ["effects = [1]", "not a table"]),
    "effect not in the list": ({"effects": {"payload": {"mass": 1.0}}}, ["effects.payload", "effect_list"]),
    "effect is a number": ({"effects": {"soil": 3}}, ["effects.soil = 3", "not a table"]),
    "unknown parameter": (soil(stickiness=1.0), ["effects.soil.stickiness", "unknown", "cohesion"]),
    "parameter called name": (soil(name="regolith"), ["effects.soil.name", "unknown"]),
    "parameter called source": (soil(source=1.0), ["effects.soil.source", "unknown"]),
    "out of bounds": (soil(n=99), ["effects.soil.n = 99", "outside [0.1, 3]"]),
    "out of bounds by unit": (soil(cohesion=unit(5.0, "GPa")), ["effects.soil.cohesion = 5e+09 Pa", "outside"]),
    "parameter nan": (soil(n=math.nan), ["effects.soil.n = nan", "not finite"]),
    "parameter inf": (soil(cohesion=unit(math.inf, "kPa")), ["effects.soil.cohesion = inf", "not finite"]),
    "parameter is a text": (soil(n="1.0"), ["effects.soil.n = '1.0'", "not a number"]),
    "parameter is true": (soil(n=True), ["effects.soil.n = True", "not a number"]),
    "parameter is a list": (soil(n=[1.0, 1.0]), ["effects.soil.n", "takes one number"]),
    "wrong dimension": (soil(cohesion=unit(1.0, "m")), ["effects.soil.cohesion", "'1 m'", "give it in Pa"]),
    "unknown unit": (soil(cohesion=unit(1.0, "parsnips")), ["'1 parsnips'", "give it in Pa"]),
    "unit is a number": (soil(cohesion=unit(1.0, 3)), ["effects.soil.cohesion.unit = 3", "not a text"]),
    "unit without value": (soil(cohesion={"unit": "Pa"}), ["effects.soil.cohesion.value", "missing"]),
    "unknown key beside the unit": (
        soil(cohesion={**unit(1.0, "Pa"), "std": 1.0}),
        ["effects.soil.cohesion.std = 1.0", "value, unit"],
    ),
    "unit of another exponent": (soil(k_c=unit(1.0, "kN/m^(n+1)")), ["effects.soil.k_c", "give it in N/m^(n+1)"]),
    "degrees for a pure number": (soil(n=unit(60.0, "deg")), ["effects.soil.n", "give it in 1"]),
    "temperature difference in degC": (
        {"effects": {"thermal_cutoff": {"hysteresis": unit(20.0, "degC")}}},
        ["effects.thermal_cutoff.hysteresis = '20 degC'", "difference", "give it in K"],
    ),
    "cut-off in kelvin taken for degC": (
        {"effects": {"thermal_cutoff": {"temperature": 150.0}}},
        ["effects.thermal_cutoff.temperature = 150 K", "outside [273.15"],
    ),
    "list of wrong length": (
        {"effects": {"motor": {"resistance": unit([1.0, 2.0, 3.0], "ohm")}}},
        ["effects.motor.resistance", "3 values", "12, one per joint"],
    ),
    "list with a text": (
        {"effects": {"motor": {"resistance": [1.0, "two"]}}},
        ["effects.motor.resistance = 'two'", "not a number"],
    ),
    "nested list": ({"effects": {"motor": {"resistance": [[1.0]]}}}, ["effects.motor.resistance", "not a number"]),
    "value of no group": ({"effects": {"motor": {"gear_ratio": {"arm": 3.0}}}}, ["gear_ratio.arm = 3.0", "drive"]),
    "grounds that are no list": ({"grounds": "ice"}, ["grounds = 'ice'", "is no list of names"]),
    "groups for one number": (soil(n={"drive": 1.0}), ["effects.soil.n", "give one number here"]),
    "rover on two lines": ({"rover": "luvmi\nx"}, ["rover = 'luvmi", "no name of a file"]),
    "rover with a byte of zero": ({"rover": "a\0b"}, ["rover = 'a\\x00b'", "no name of a file"]),
    "rover longer than names are": ({"rover": "a" * 9000}, ["rover = 'aaa", "no name of a file"]),
    "effect file with a byte of zero": ({"effect_list": ["a\0.py"]}, ["effect_list", "no name of a file"]),
    "effect longer than names are": ({"effect_list": ["a" * 5000]}, ["effect_list", "no name of a file"]),
    "gain beyond single precision": (
        {"control": {"drive": {"velocity_gain_Nms_rad": 1e300}}},
        ["control.drive.velocity_gain_Nms_rad = 1e+300", "1e+09 at most"],
    ),
    "noon hotter than any rover outlives": (
        {"ambient": {"temperature_degC": 1e9}},
        ["ambient.noon_temperature_degC", "no temperature in degC"],
    ),
    "noon colder than the night": (
        {"ambient": {"noon_temperature_degC": -100.0, "night_temperature_degC": 100.0}},
        ["ambient.noon_temperature_degC = -100.0", "below that of the night"],
    ),
    "noon of no time": (
        {"ambient": {"noon_temperature_degC": 9.0, "night_temperature_degC": 0.0, "noon_time_s": 1e300}},
        ["ambient.noon_time_s = 1e+300", "out of range"],
    ),
    "day shorter than a second": (
        {"ambient": {"noon_temperature_degC": 9.0, "night_temperature_degC": 0.0, "period_s": 1e-300}},
        ["ambient.period_s = 1e-300", "give 1 or more"],
    ),
    "ground twice": ({"grounds": ["ice", "ice"]}, ["grounds = ['ice', 'ice']", "names one twice"]),
    "prior outside the bounds": (
        {"priors": {"soil.n": {"value": 1e9, "std": 0.1}}},
        ["priors.soil.n.value = 1000000000.0", "3 at most"],
    ),
    "prior wider than the bounds": (
        {"priors": {"soil.n": {"value": 1.0, "std": 1e300}}},
        ["priors.soil.n.std = 1e+300", "out of range"],
    ),
    "posterior without an end": (
        {"posterior": {"parameters": ["soil.n"], "log": [True], "std": [1e300], "correlation": [[1.0]]}},
        ["posterior.std of soil.n = 1e+300", "out of range"],
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake(mistake: str, tmp_path: Path) -> None:
    changes, words = MISTAKES[mistake]
    path = write(tmp_path, {k: v for k, v in {**MINIMAL, **changes}.items() if v is not None})
    assert_refused(path, words)


def assert_refused(path: Path, words: list[str]) -> None:
    with trusting(), pytest.raises(UserError) as caught:
        load_model(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and text.endswith(".") and ";" in text and "\n" not in text, text
    for word in words:
        assert word in text, text


BROKEN: dict[str, tuple[bytes, list[str]]] = {
    "not TOML": (b"format = \n", ["not valid TOML", "line 1"]),
    "key twice": (b'rover = "a"\nrover = "b"\n', ["not valid TOML"]),
    "not text": (b"\xff\xfe\x00", ["not a text file"]),
    "number of thousands of digits": (b"gravity_m_s2 = " + b"9" * 5000, ["not valid TOML"]),
    "nested too deeply": (b"a = " + b"[" * 100_000, ["not valid TOML"]),
    "empty": (b"", ["format", FORMAT]),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_file(case: str, tmp_path: Path) -> None:
    text, words = BROKEN[case]
    path = tmp_path / "model.toml"
    path.write_bytes(text)
    assert_refused(path, words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 +", ["does not run", "SyntaxError"]),
        ("import no_such_module", ["does not run", "no_such_module"]),
        ("x = 1", ["defines no effect"]),
        (MY_EFFECT, ["no effect is called 'other'", "my_friction"]),
    ],
)
def test_broken_effect_file(text: str, words: list[str], tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(text)
    path = write(tmp_path, {**MINIMAL, "effect_list": ["motor", "mine.py:other"]})
    assert_refused(path, ["effect_list = 'mine.py:other'", *words])


def test_missing_file_and_folder(tmp_path: Path) -> None:
    assert_refused(tmp_path / "gone.toml", ["not there"])
    assert_refused(tmp_path, ["is a folder"])


def test_a_byte_order_mark_is_no_part_of_a_model(tmp_path: Path) -> None:
    """As editors of Windows write it before UTF-8."""
    plain, marked = tmp_path / "a.toml", tmp_path / "b.toml"
    plain.write_bytes(tomli_w.dumps(MINIMAL).encode())
    marked.write_bytes(b"\xef\xbb\xbf" + plain.read_bytes())
    assert_same(load_model(marked), load_model(plain))
