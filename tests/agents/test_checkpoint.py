"""Checkpoints bring back what was saved, where it was."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from lunar_mjx.agents.checkpoint import Checkpoints


def test_empty_arrays_come_back_on_the_devices_that_the_step_expects(tmp_path):
    """Rovers whose soil is not drawn anew have an array of no columns; orbax stores none, and a step refused it."""
    mesh = jax.make_mesh((1,), ("device",), axis_types=(jax.sharding.AxisType.Explicit,))
    split = NamedSharding(mesh, PartitionSpec("device", None))
    state = {"full": jnp.arange(8.0).reshape(4, 2), "empty": jnp.zeros((4, 0))}
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(3, jax.device_put(state, split), {"rows": [1]})
    like = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=split), state)
    found, notes = checkpoints.restore(3, like)
    checkpoints.close()
    assert notes == {"rows": [1]}
    np.testing.assert_array_equal(found["full"], state["full"])
    assert found["empty"].shape == (4, 0)
    assert found["full"].sharding == found["empty"].sharding == split
