"""Suggested formulas: each is a valid effect file, with units and a null; and what refuses a search."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.criticism.discover import discover
from lunar_mjx.criticism.probes import PROBES, unknown_input
from lunar_mjx.criticism.runs import VERDICT_FILE, Run
from lunar_mjx.criticism.terms import effect_of, terms, with_amount
from lunar_mjx.effects import catalogue, probe
from lunar_mjx.effects.base import PORTS
from lunar_mjx.effects.contract import base_list
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model

SENSORS = ("motor_drive_current_A", "gyro_rad_s")
LIBRARIES = {port: terms(port, SENSORS) for port in PORTS}


@pytest.mark.parametrize("port", PORTS)
def test_every_formula_is_an_effect_with_a_null_at_its_port(port):
    library = LIBRARIES[port]
    assert library
    names = [t.name for t in library]
    assert len(set(names)) == len(names)
    for term in library:
        effect = effect_of(term)
        assert tuple(effect.ports) == (port,)
        amount = effect.parameters["amount"]
        assert amount.null == 0.0
        assert amount.unit == term.unit
        assert amount.bounds[0] < 0.0 < amount.nominal < amount.bounds[1]
        assert term.formula in effect.doc


def test_the_file_that_is_written_loads_with_its_amount(tmp_path):
    term = next(t for t in LIBRARIES["wheel_normal"] if t.target == "resistance")
    path = tmp_path / "found.py"
    path.write_text(with_amount(term, 0.123456, "found", "lunar-mjx unknown on log1"))
    effect = catalogue.get(f"{path}:found")
    assert effect.parameters["amount"].nominal == pytest.approx(0.123456)
    assert effect.parameters["amount"].source == "lunar-mjx unknown on log1"
    assert effect.name == "found"


def test_a_search_needs_a_port(tmp_path):
    run = Run(tmp_path, (), make_model("luvmi_x", terrain="flat"))
    with pytest.raises(UserError, match="lunar-mjx why first, or give --port"):
        discover(run)
    run.save(VERDICT_FILE, {"details": {"localise": {"port": None}}})
    with pytest.raises(UserError, match="lunar-mjx why first"):
        discover(run)
    with pytest.raises(UserError, match="does not exist"):
        discover(run, "nowhere")


def test_amounts_are_numbers_of_clear_size():
    assert all(np.isfinite(t.size) and t.size > 0.0 for library in LIBRARIES.values() for t in library)


def _felt(effects):
    """What a rover feels, as shapes, with these effects beside the standing ones; an effect that cannot act raises."""
    moment = jax.tree.map(lambda v: jnp.asarray(v[0]), probe.states(1, 4))
    present = [*base_list(effects[0], without=True), *effects]
    return jax.eval_shape(functools.partial(probe.act, present, probe.terrain(), {}), moment)


@pytest.mark.parametrize("port", [p for p in PORTS if p != "sensor"])
def test_every_formula_acts_on_a_rover(port):
    assert "chassis_force" in _felt([effect_of(term) for term in LIBRARIES[port]])


def test_every_unknown_input_acts_on_a_rover():
    assert "chassis_force" in _felt([unknown_input(label, 8, 10.0) for label in PROBES])
