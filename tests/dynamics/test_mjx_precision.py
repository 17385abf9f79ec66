"""The MJX engine keeps every bit of float32, on a GPU too."""

import jax
import jax.numpy as jnp

from lunar_mjx.dynamics import build
from lunar_mjx.model import make_model


def test_products_keep_all_bits():
    """A GPU shortens the factors of a matrix product to ten bits unless it is told not to."""
    system = build(make_model("viper", "flat"), "mjx")
    control = jnp.zeros(len(system.joint_names))
    state = jax.eval_shape(lambda: system.reset(system.params))
    text = str(jax.make_jaxpr(lambda p, s: system.step(p, s, control)[0])(system.params, state))
    assert text.count("dot_general[") > 50 and text.count("Precision.HIGHEST") >= text.count("dot_general[")
    assert "precision=None" not in text
