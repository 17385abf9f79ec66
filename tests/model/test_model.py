"""A model: presets, adding, removing and setting effects, and the settings that are refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lunar_mjx.dynamics import build
from lunar_mjx.effects.base import Parameter, effect
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.presets import PRESET_PARAMETERS, PRESETS
from lunar_mjx.errors import UserError
from lunar_mjx.model import Model, check_effects, make_model, settled
from lunar_mjx.resources import shipped
from lunar_mjx.terrain import flat

MY_EFFECT = """
from lunar_mjx.effects import Parameter, effect

@effect("motor_torque", torque=Parameter(0.5, 0.0, (0.0, 5.0), "N m", "Coulomb friction", "test"))
def my_friction(ctx, p, x, torque):
    "A constant loss."
    return torque - p.torque
"""


@pytest.fixture(scope="module")
def model() -> Model:
    return make_model("luvmi_x", "flat")


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("rover", ["viper", "luvmi_x"])
def test_preset(preset: str, rover: str) -> None:
    model = make_model(rover, "flat", preset)
    assert model.effect_names == PRESETS[preset]
    assert model.thermal_integrator == ("euler" if preset == "paper" else "heun")
    for name, values in PRESET_PARAMETERS[preset].items():
        for key, value in values.items():
            if not isinstance(value, dict):
                assert np.all(np.asarray(model.parameters[name][key]) == value), (name, key)
    for e in model.effects:
        assert set(model.parameters[e.name]) == set(e.parameters)
        for key, value in model.parameters[e.name].items():
            low, high = e.parameters[key].bounds
            assert np.all((np.asarray(value) >= low) & (np.asarray(value) <= high)), (e.name, key)
    check_effects(model, "test")


def test_motors_are_the_rovers_own(model: Model) -> None:
    ratios = model.parameters["motor"]["gear_ratio"]
    assert isinstance(ratios, tuple)
    expected = [g.gear_ratio for g in model.rover.groups for _ in g.joints]
    assert list(ratios) == expected and len(set(expected)) > 1


def test_the_preset_paper_changes_the_drive_gear_alone() -> None:
    paper, own = make_model("viper", "flat", "paper"), make_model("viper", "flat")
    ratio, before = (np.array(m.parameters["motor"]["gear_ratio"]) for m in (paper, own))
    drives = [name in paper.rover.groups[0].joints for name in paper.rover.joints]
    assert (ratio[drives] == 62.0).all() and (ratio[~np.array(drives)] == before[~np.array(drives)]).all()
    assert paper.gains["steer"] == own.gains["steer"] and paper.gains["drive"] != own.gains["drive"]


def test_set_leaves_the_original_alone(model: Model) -> None:
    changed = model.set("soil", cohesion=1000.0)
    assert changed.parameters["soil"]["cohesion"] == 1000.0
    assert model.parameters["soil"]["cohesion"] == CATALOGUE["soil"].parameters["cohesion"].nominal


def test_set_by_group_keeps_the_others(model: Model) -> None:
    before = model.parameters["motor"]["resistance"]
    after = model.set("motor", resistance={"steer": 2.0}).parameters["motor"]["resistance"]
    assert isinstance(before, tuple) and isinstance(after, tuple)
    group = [g.name for g in model.rover.groups for _ in g.joints]
    assert [a for a, g in zip(after, group, strict=True) if g == "steer"] == [2.0] * group.count("steer")
    assert [a for a, g in zip(after, group, strict=True) if g != "steer"] == [
        b for b, g in zip(before, group, strict=True) if g != "steer"
    ]


def test_set_takes_arrays(model: Model) -> None:
    values = np.linspace(1.0, 2.0, len(model.rover.joints))
    assert model.set("motor", resistance=values).parameters["motor"]["resistance"] == tuple(values)
    assert model.set("soil", n=np.float64(1.2)).parameters["soil"]["n"] == 1.2


def test_add_takes_the_place_of_what_it_replaces(model: Model) -> None:
    new = CATALOGUE["stress_integral"]
    assert new.replaces
    changed = model.add("stress_integral")
    assert not set(new.replaces) & set(changed.effect_names)
    first = min(model.effect_names.index(r) for r in new.replaces if r in model.effect_names)
    assert changed.effect_names[first] == "stress_integral"
    assert set(changed.parameters) == set(changed.effect_names) == set(changed.effect_files)


def test_add_and_remove(model: Model) -> None:
    heavy = model.add("payload", "test", mass=20.0)
    assert heavy.effect_names == (*model.effect_names, "payload") and heavy.parameters["payload"]["mass"] == 20.0
    assert heavy.remove("payload").effect_names == model.effect_names


def test_add_a_users_effect(model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.py").write_text(MY_EFFECT)
    monkeypatch.chdir(tmp_path)
    mine = model.add("mine.py:my_friction", "test", torque=1.0)
    assert mine.parameters["my_friction"] == {"torque": 1.0}
    assert mine.effect_files["my_friction"] == f"{tmp_path.resolve() / 'mine.py'}:my_friction"


def test_parameters_may_be_called_like_arguments(model: Model) -> None:
    p = Parameter(0.0, 0.0, (0.0, 2.0), "1", "test", "test")

    @effect("command", source=p, name=p)
    def odd(ctx, p, x, command):
        return command

    changed = model.add(odd, "test", source=1.0, name=2.0)
    assert changed.parameters["odd"] == {"source": 1.0, "name": 2.0}


def test_settled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert settled("terrain", "slope:10deg", "terrain.toml") == "slope:10deg"
    assert settled("terrain", "flat", "terrain.toml") == "flat"
    assert settled("terrain", shipped("terrain") / "flat", "terrain.toml") == "flat"
    (tmp_path / "flat").mkdir()
    assert settled("terrain", "flat", "terrain.toml") == "flat", "a folder without terrain.toml is none"
    (tmp_path / "flat" / "terrain.toml").write_text("[plane]\n")
    assert settled("terrain", "flat", "terrain.toml") == str((tmp_path / "flat").resolve())


Change = Callable[[Model], Any]
REFUSED: dict[str, tuple[Change, list[str]]] = {
    "unknown effect": (lambda m: m.add("warp_drive"), ["'warp_drive'", "catalogue", "lunar-mjx effect list"]),
    "effect twice": (lambda m: m.add("soil"), ["soil", "already in the model"]),
    "effect that another replaces": (
        lambda m: m.add("stress_integral").add("closed_form_shear"),
        ["closed_form_shear", "is replaced by stress_integral", "remove stress_integral first"],
    ),
    "remove what is not there": (lambda m: m.remove("payload"), ["Model.remove", "payload", "not in the model"]),
    "set what is not there": (lambda m: m.set("payload", mass=1.0), ["payload", "not in the model", "soil"]),
    "more than the rover carries": (
        lambda m: m.add("payload", mass=5.1 * m.rover.mass),
        ["effects.payload.mass", "more than 5 times the 50 kg of the rover", "250 at most"],
    ),
    "unknown parameter": (lambda m: m.set("soil", stickiness=1.0), ["effects.soil.stickiness", "unknown", "cohesion"]),
    "unknown parameter by group": (lambda m: m.set("soil", sticky={"drive": 1.0}), ["effects.soil.sticky", "unknown"]),
    "out of bounds": (lambda m: m.set("soil", n=99.0), ["effects.soil.n = 99", "outside", "[0.1, 3]"]),
    "not finite": (lambda m: m.set("soil", n=math.nan), ["effects.soil.n = nan", "not finite"]),
    "not a number": (lambda m: m.set("soil", n="many"), ["effects.soil.n = 'many'", "not a number"]),
    "a list for one number": (lambda m: m.set("soil", n=[1.0, 1.0]), ["effects.soil.n", "takes one number"]),
    "wrong length": (lambda m: m.set("motor", resistance=[1.0, 2.0]), ["2 values", "12, one per joint"]),
    "nested list": (lambda m: m.set("motor", resistance=[[1.0], [2.0]]), ["nested", "flat list"]),
    "by group for one number": (lambda m: m.set("soil", n={"drive": 1.0}), ["effects.soil.n", "give one number here"]),
    "unknown group": (lambda m: m.set("motor", resistance={"arm": 1.0}), ["resistance.arm", "drive, steer"]),
    "list in a group": (lambda m: m.set("motor", resistance={"drive": [1.0]}), ["resistance.drive", "one number per"]),
    "group out of bounds": (lambda m: m.set("motor", resistance={"drive": -1.0}), ["motor.resistance = -1 ohm"]),
    "negative gravity": (lambda m: m.replace(gravity=-1.6), ["gravity_m_s2 = -1.6", "negative"]),
    "gravity not finite": (lambda m: m.replace(gravity=math.inf), ["gravity_m_s2 = inf", "not finite"]),
    "time step zero": (lambda m: m.replace(timestep=0.0), ["timestep_s = 0.0", "outside"]),
    "integrator": (lambda m: m.replace(thermal_integrator="rk4"), ["'rk4'", "heun, euler"]),
    "below absolute zero": (lambda m: m.replace(ambient=(-1.0, 300.0, 0.0, 1.0)), ["noon", "-274.15", "absolute"]),
    "three ambient numbers": (lambda m: m.replace(ambient=(1.0, 1.0, 1.0)), ["ambient", "four numbers"]),
    "day of no length": (lambda m: m.replace(ambient=(9.0, 9.0, 0.0, 0.0)), ["ambient.period_s", "not positive"]),
    "noon not finite": (lambda m: m.replace(ambient=(9.0, 9.0, math.nan, 1.0)), ["noon_time_s = nan", "not finite"]),
    "unknown mode": (lambda m: m.replace(modes={"drive": "magic"}), ["control.drive.mode", "'magic'", "torque"]),
    "mode of no group": (lambda m: m.replace(modes={"arm": "torque"}), ["control.arm", "drive, steer, suspension"]),
    "negative gain": (
        lambda m: m.replace(gains={"drive": (0.0, -1.0)}),
        ["control.drive.velocity_gain_Nms_rad = -1.0", "negative"],
    ),
    "one gain": (lambda m: m.replace(gains={"drive": (1.0,)}), ["control.drive", "two gains"]),
    "unknown preset": (lambda m: make_model(m.rover, m.terrain, "best"), ["'best'", "consistent, field, paper"]),
    "unknown rover": (lambda m: make_model("moonbuggy", m.terrain), ["moonbuggy", "luvmi_x, rocker_bogie, viper"]),
    "unknown terrain": (lambda m: make_model(m.rover, "sea"), ["sea", "lunar_plain"]),
    "gains of no group": (lambda m: make_model(m.rover, m.terrain, gains={"arm": (1, 1)}), ["control.arm"]),
    "unknown attribute": (lambda m: m.replace(weight=1.0), ["Model.replace", "weight", "unknown", "gravity"]),
    "ambient is one number": (lambda m: m.replace(ambient=300.0), ["ambient = 300.0", "four numbers"]),
    "soil that pulls": (
        lambda m: m.set("soil", k_c=-1.1e5, k_phi=1.2e6),
        ["effects.soil.k_c = -110000.0", "-175000", "0.08 m", "not positive"],
    ),
    "soil without stiffness": (lambda m: m.set("soil", k_c=0.0, k_phi=0.0), ["effects.soil.k_c = 0.0", "not positive"]),
    "build without motor": (lambda m: build(m.remove("motor")), ["build", "lacks motor", "joint_control"]),
    "no motor": (lambda m: check_effects(m.remove("motor"), "here"), ["here", "lacks motor", "joint_control"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(model: Model, case: str) -> None:
    change, words = REFUSED[case]
    with pytest.raises(UserError) as caught:
        change(model)
    text = str(caught.value)
    assert "\n" not in text and text.endswith(".")
    for word in words:
        assert word in text, text


def test_an_effect_list_without_any_reader_of_the_motor_is_fine(model: Model) -> None:
    for name in ("motor", "joint_control", "winding_conduction", "rotor_stator_path"):
        model = model.remove(name)
    check_effects(model, "test")


def test_a_terrain_made_in_python_has_no_spec() -> None:
    assert make_model("luvmi_x", flat()).terrain_spec == ""
    assert make_model("luvmi_x", {"plane": {"slope_deg": 3.0}}).terrain_spec == ""


def test_replace_keeps_the_modes_and_gains_of_other_groups(model: Model) -> None:
    changed = model.replace(modes={"drive": "torque"}, gains={"drive": (0.0, 5.0)})
    assert changed.modes == {**model.modes, "drive": "torque"}
    assert changed.gains == {**model.gains, "drive": (0.0, 5.0)}
    build(changed)


def test_replace_takes_a_terrain_and_its_name_together(model: Model) -> None:
    assert model.replace(terrain="slope:5deg").terrain_spec == "slope:5deg"
    assert model.replace(terrain="slope:5deg").terrain.name == "slope:5deg"
    assert model.replace(terrain=flat()).terrain_spec == "", "save_model must not write the old terrain's name"


def test_a_soil_of_negative_cohesive_modulus_is_fine_under_wide_wheels() -> None:
    soil = {"k_c": -1.1e5, "k_phi": 2.22e6, "n": 1.2}  # GRC-1, stiff where b > 0.0495 m
    assert make_model("luvmi_x", flat()).set("soil", **soil).parameters["soil"]["k_c"] == -1.1e5


def test_wheels_in_position_mode_get_a_gain_that_moves_them(model: Model) -> None:
    velocity = model.gains["drive"][1]
    assert model.gains["drive"][0] == 0.0
    assert model.replace(modes={"drive": "position"}).gains["drive"] == (20.0 * velocity, velocity)
    assert make_model("luvmi_x", flat(), modes={"drive": "position"}).gains["drive"] == (20.0 * velocity, velocity)
    assert model.replace(modes={"drive": "position"}, gains={"drive": (0.0, 5.0)}).gains["drive"] == (0.0, 5.0)
    made = make_model("luvmi_x", flat(), modes={"drive": "position"}, gains={"drive": (0.0, 5.0)})
    assert made.gains["drive"] == (0.0, 5.0)
