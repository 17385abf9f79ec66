"""Suggested formulas: each is a valid effect file, with units and a null; and what refuses a search."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from lunar_mjx.criticism import WheelBed, wheel_test
from lunar_mjx.diagnosis import verbs
from lunar_mjx.diagnosis.formulas.discover import _write, discover
from lunar_mjx.diagnosis.formulas.targets import STIFFNESS
from lunar_mjx.diagnosis.formulas.terms import FORMULA_PORTS, effect_of, term, terms, with_amount
from lunar_mjx.diagnosis.runs import VERDICT_FILE, Run
from lunar_mjx.diagnosis.unknown_inputs.inputs import smooth_inputs
from lunar_mjx.effect_contract import random_rovers as probe
from lunar_mjx.effect_contract.promises import base_list
from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import PORTS
from lunar_mjx.errors import UserError
from lunar_mjx.logs import Noise, write_steady_log
from lunar_mjx.model import make_model

SENSORS = ("motor_drive_current_A", "gyro_rad_s")
LIBRARIES = {port: terms(port, SENSORS) for port in FORMULA_PORTS}


@pytest.mark.parametrize("port", LIBRARIES)
def test_every_formula_is_an_effect_with_a_null_at_its_port(port):
    library = LIBRARIES[port]
    assert library
    names = [t.name for t in library]
    assert len(set(names)) == len(names)
    for made in library:
        effect = effect_of(made)
        assert tuple(effect.ports) == (port,)
        amount = effect.parameters["amount"]
        assert amount.null == 0.0
        assert amount.unit == made.unit
        assert amount.bounds[0] < 0.0 < amount.nominal < amount.bounds[1]
        assert made.formula in effect.doc


def test_the_file_that_is_written_loads_with_its_amount(tmp_path):
    made = next(t for t in LIBRARIES["wheel_normal"] if t.target == "resistance")
    path = tmp_path / "found.py"
    path.write_text(with_amount(made, 0.123456, "found", "lunar-mjx unknown on log1"))
    effect = catalogue.get(f"{path}:found")
    assert effect.parameters["amount"].nominal == pytest.approx(0.123456)
    assert effect.parameters["amount"].source == "lunar-mjx unknown on log1"
    assert effect.name == "found"


@pytest.mark.parametrize("amount", [-300.0, 1e-7, 40.0])
def test_an_amount_beyond_the_first_bounds_can_be_loaded(tmp_path, amount):
    made = term(STIFFNESS, "z/r")
    path = tmp_path / "own.py"
    path.write_text(with_amount(made, amount, "own", "a log"))
    found = catalogue.get(f"{path}:own").parameters["amount"]
    assert found.nominal == pytest.approx(amount) and found.bounds[0] < min(0.0, amount)
    assert found.bounds[1] > max(0.0, amount)


def test_a_second_suggestion_leaves_the_first_and_the_users_files_alone(tmp_path):
    model = make_model("luvmi_x", terrain="flat")
    run = Run(tmp_path, (), model)
    first, second = (functools.partial(with_amount, term(STIFFNESS, f), 0.1, provenance="x") for f in ("z/r", "s"))
    paths = [_write(run, None, "soil", 0, text) for text in (first, second, first)]
    assert [p.name for p in paths] == ["suggested_soil.py", "suggested_soil_2.py", "suggested_soil.py"]
    assert catalogue.get(f"{paths[1]}:suggested_soil_2").doc != catalogue.get(f"{paths[0]}:suggested_soil").doc
    grown = Run(tmp_path / "run2", (), model.add(f"{paths[0]}:suggested_soil", "add"))
    grown.folder.mkdir()
    assert _write(grown, None, "soil", 0, second).name == "suggested_soil_2.py", "a model holds a name once"
    mine = tmp_path / "mine.py"
    mine.write_text("# of my own")
    with pytest.raises(UserError, match="none of these suggestions"):
        discover(run, "soil", mine)
    assert mine.read_text() == "# of my own"


VERDICT = {"verdict": "NOISE_ONLY", "sentence": "", "effects": []}


def test_a_search_needs_a_port(tmp_path):
    run = Run(tmp_path, (), make_model("luvmi_x", terrain="flat"))
    with pytest.raises(UserError, match="lunar-mjx why first, or give --port"):
        discover(run)
    run.save(VERDICT_FILE, VERDICT)
    with pytest.raises(UserError, match="lunar-mjx why first"):
        discover(run)
    with pytest.raises(UserError, match="does not exist"):
        discover(run, "nowhere")
    with pytest.raises(UserError, match="has no formulas"):
        discover(run, "power")
    run.save(VERDICT_FILE, {**VERDICT, "verdict": "UNKNOWN", "port": "elsewhere"})
    with pytest.raises(UserError, match=r"elsewhere.*does not exist"):
        discover(run)  # the port of a verdict that weighs hypotheses is taken


def test_amounts_are_numbers_of_clear_size():
    assert all(np.isfinite(t.size) and t.size > 0.0 for library in LIBRARIES.values() for t in library)


def _felt(effects):
    """What a rover feels, as shapes, with these effects beside the standing ones; an effect that cannot act raises."""
    moment = jax.tree.map(lambda v: jnp.asarray(v[0]), probe.states(1, 4))
    present = [*base_list(effects[0], without=True), *effects]
    return jax.eval_shape(functools.partial(probe.act, present, probe.terrain(), {}), moment)


@pytest.mark.parametrize("port", [p for p in LIBRARIES if p != "sensor"])
def test_every_formula_acts_on_a_rover(port):
    assert "chassis_force" in _felt([effect_of(made) for made in LIBRARIES[port]])


def test_every_unknown_input_acts_on_a_rover():
    assert "chassis_force" in _felt([smooth_inputs(frozenset(PORTS))])


HIDDEN_LAW, AMOUNT = "log(Max(1 - s, 1/50))", 0.35
STD = {"drawbar_pull_N": 0.05, "side_force_N": 0.05, "driving_torque_Nm": 0.003, "sinkage_m": 5e-5}


def _table(folder):
    """A wheel's table with a law that no catalogue has: stiffness goes with a power of 1 - s."""
    slip, angle, load = (
        a.ravel() for a in np.meshgrid(np.linspace(-0.1, 0.7, 9), [0.0, 10.0, 20.0, 35.0], [8.0, 25.0])
    )
    law = effect_of(term(STIFFNESS, HIDDEN_LAW))
    bed = WheelBed.of_preset("consistent").with_effect(law, amount=AMOUNT)
    result = bed.run(wheel_test(slip, np.radians(angle), load, 0.0625, 0.05))
    columns = (result.drawbar_pull, result.side_force, result.driving_torque, result.sinkage)
    rng = np.random.default_rng(4)
    frame = pd.DataFrame({"slip_ratio": slip, "slip_angle_deg": angle, "normal_load_N": load})
    for (name, std), values in zip(STD.items(), columns, strict=True):
        frame[name] = values + std * rng.standard_normal(len(frame))
    write_steady_log(
        folder,
        frame,
        wheel={"radius_m": 0.0625, "width_m": 0.05},
        slip_definition="wheel_frame",
        noise={c: Noise(s, "datasheet") for c, s in STD.items()},
    )


@pytest.mark.slow
def test_a_law_that_no_catalogue_has_is_found_written_and_added(tmp_path):
    _table(tmp_path / "log")
    run = verbs.compare([tmp_path / "log"], make_model("luvmi_x", terrain="flat"), tmp_path / "run1")
    found = discover(run, "soil")
    assert found.number > 1000
    best = found.suggestions[0]
    assert best.formula == "k = k_0*(1 - s)**a"
    assert best.at_noise
    (part,) = best.parts
    assert abs(part.amount - AMOUNT) < 4.0 * part.std
    assert part.std < 0.1 * AMOUNT
    assert best.formula in found.text()
    (file,) = found.files
    grown = verbs.add(run, file, tmp_path / "run2")
    refitted = grown.load("comparison.json")["refitted"]["held_out"]
    # the file does in a bed of its own what the search promised
    assert refitted == pytest.approx(best.error["held_out"], abs=0.01)
    assert refitted < 1.15
    # tables have no formulas at ports that no slot of a wheel bed holds
    with pytest.raises(UserError, match="none of a wheel bed"):
        discover(run, "geometry")
