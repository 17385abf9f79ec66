"""A user's own effect: a ten-line file, in no way second class; and what is said when the file is wrong."""

from __future__ import annotations

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.effects import catalogue
from lunar_mjx.effects.ports import Pipeline
from lunar_mjx.errors import UserError
from tests.effects.effects_harness import bare_context, parameters

FRICTION = """import jax.numpy as jnp
from lunar_mjx.effects import Parameter, effect

@effect("motor_torque", torque=Parameter(0.5, null=0.0, bounds=(0.0, 5.0), unit="N m",
                                         meaning="Coulomb friction of the gear", source="datasheet"))
def gear_friction(ctx, p, x, torque):
    "tau_f = tau_c sgn(omega), smoothed below 0.01 rad/s."
    return torque - p.torque * jnp.tanh(ctx.joint_speed / 0.01)
"""
TWO = FRICTION + FRICTION[FRICTION.index("@effect") :].replace("gear_friction", "seal_friction")


def write(folder: Path, text: str) -> Path:
    path = folder / "my_effects.py"
    path.write_text(text)
    return path


def one_sentence(error: pytest.ExceptionInfo[UserError], *words: str) -> None:
    """The message is a single line that ends in a full stop and names every one of the words."""
    message = str(error.value)
    assert "\n" not in message and message.endswith(".") and "Traceback" not in message
    assert ";" in message, "what is wrong; what to do"
    for word in words:
        assert word in message, f"{word!r} is not in {message!r}"


def test_a_ten_line_file_is_an_effect_like_any_other(tmp_path: Path) -> None:
    """Found by its path alone or with its name; its parameters, documentation and port work as those that ship."""
    path = write(tmp_path, FRICTION)
    assert list(catalogue.load_file(path)) == ["gear_friction"]
    for name in (str(path), f"{path}:gear_friction"):
        found = catalogue.get(name)
        assert found.name == "gear_friction" and tuple(found.ports) == ("motor_torque",)
        assert found.doc.startswith("tau_f") and found.nominal() == {"torque": 0.5} and found.null() == {"torque": 0.0}
    pipeline = Pipeline((found,))
    ctx = bare_context(joint_speed=jnp.asarray([1.0, -1.0, 0.0]), parameters=parameters(pipeline.effects))
    torque, _ = pipeline.run("motor_torque", ctx, {}, jnp.asarray([2.0, 2.0, 2.0]))
    assert np.asarray(torque) == pytest.approx([1.5, 2.5, 2.0])


def test_one_of_several_effects_in_a_file(tmp_path: Path) -> None:
    path = write(tmp_path, TWO)
    assert sorted(catalogue.load_file(path)) == ["gear_friction", "seal_friction"]
    assert catalogue.get(f"{path}:seal_friction").name == "seal_friction"
    with pytest.raises(UserError) as error:
        catalogue.get(str(path))
    one_sentence(error, "gear_friction", "seal_friction", str(path))
    with pytest.raises(UserError) as error:
        catalogue.get(f"{path}:gear_fricton")
    one_sentence(error, "gear_fricton", "gear_friction", str(path))


@pytest.mark.parametrize(
    "text, words",
    [
        ("def broken(:\n    pass\n", ("SyntaxError",)),
        ("import no_such_module_anywhere\n", ("ModuleNotFoundError", "no_such_module_anywhere")),
        ("raise ValueError('first\\nsecond')\n", ("ValueError", "first second")),
        ("raise SystemExit(3)\n", ("SystemExit",)),
        ("x = 1\n", ("no effect",)),
        (FRICTION.replace('"motor_torque"', '"motor_torqe"'), ("motor_torqe", "motor_torque", "gear_friction")),
        (FRICTION.replace("Parameter(0.5,", "Parameter(7.0,"), ("7.0", "bounds")),
        (FRICTION.replace("null=0.0", "null=-1.0"), ("null", "bounds")),
    ],
    ids=["syntax", "import", "raises", "exits", "nothing", "port", "bounds", "null"],
)
def test_a_wrong_file_gets_one_sentence(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    path = write(tmp_path, text)
    with pytest.raises(UserError) as error:
        catalogue.load_file(path)
    one_sentence(error, str(path), *words)


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.py", tmp_path):
        with pytest.raises(UserError) as error:
            catalogue.load_file(path)
        one_sentence(error, str(path))


def test_an_unknown_name_lists_the_catalogue() -> None:
    with pytest.raises(UserError) as error:
        catalogue.get("presure_sinkage")
    one_sentence(error, "presure_sinkage", "pressure_sinkage")


@pytest.mark.parametrize("value", [-1.0, 6.0, float("nan"), float("inf"), "much", (0.1, 0.2)])
def test_values_outside_what_a_parameter_admits(tmp_path: Path, value: object) -> None:
    """Refused by name, with the bounds and the unit where they are what is wrong."""
    found = catalogue.get(str(write(tmp_path, FRICTION)))
    with pytest.raises(UserError) as error:
        found.check("torque", value, "my_model.toml")
    one_sentence(error, "my_model.toml", "gear_friction.torque")
    if isinstance(value, float) and np.isfinite(value):
        assert re.search(r"\[0, 5\] N m", str(error.value))
    assert found.check("torque", 1, "my_model.toml") == 1.0
    with pytest.raises(UserError) as error:
        found.check("torqe", 1.0, "my_model.toml")
    one_sentence(error, "torqe", "torque", "my_model.toml")
