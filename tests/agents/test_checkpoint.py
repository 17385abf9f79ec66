"""Checkpoints bring back what was saved, where it was."""

from __future__ import annotations

import random
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec

from lunar_mjx.agents import train as training
from lunar_mjx.agents.checkpoint import Checkpoints
from lunar_mjx.agents.configs import get_training, override
from lunar_mjx.agents.learner import Learner
from lunar_mjx.agents.train import LOCK, RunConfig, train
from lunar_mjx.envs import PointEnv
from lunar_mjx.errors import UserError
from lunar_mjx.files import only_writer


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
    assert notes["rows"] == [1]
    np.testing.assert_array_equal(found["full"], state["full"])
    assert found["empty"].shape == (4, 0)
    assert found["full"].sharding == found["empty"].sharding == split


LIKE = {"w": jax.ShapeDtypeStruct((64,), np.float32)}


def _two(folder: Path, settings: dict | None = None) -> Checkpoints:
    checkpoints = Checkpoints(folder, settings)
    for step in (1, 2):
        checkpoints.save(step, {"w": jnp.full(64, float(step))}, {"epochs": step})
    return checkpoints


def _damages() -> list[tuple[str, str]]:
    return [
        (name, how)
        for how in ("cut", "emptied", "flipped", "removed")
        for name in ("metadata", "_METADATA", "d/*", "manifest.ocdbt")
    ]


@pytest.mark.parametrize(("name", "how"), _damages())
def test_a_damaged_newest_checkpoint_gives_way_to_the_one_before(tmp_path, capfd, name, how):
    _two(tmp_path).close()
    found = [f for f in (tmp_path / "2").rglob("*") if f.is_file() and f.match(name)]
    assert found
    for file in found:
        data = bytearray(file.read_bytes())
        if how == "removed":
            file.unlink()
        elif how == "flipped":
            at = random.Random(0).randrange(len(data))
            data[at] ^= 0xFF
            file.write_bytes(data)
        else:
            file.write_bytes(data[: len(data) // 2] if how == "cut" else b"")
    checkpoints = Checkpoints(tmp_path)
    value, notes = checkpoints.newest(LIKE)
    said = capfd.readouterr().err
    step = notes["epochs"]
    assert (np.asarray(value["w"]) == step).all()
    assert step == 2 or ("train: checkpoint 2 is damaged" in said and "going on from 1" in said)
    if step == 1:
        checkpoints.save(2, {"w": jnp.full(64, 7.0)}, {"epochs": 2})
        assert float(checkpoints.newest(LIKE)[0]["w"][0]) == 7.0
    checkpoints.close()


def test_a_checkpoint_of_other_settings_is_refused_by_name(tmp_path):
    _two(tmp_path, {"train": {"envs": 8}, "seed": 0}).close()
    for settings, said in (
        ({"train": {"envs": 8}, "seed": 1}, "seed = 1 is not 0"),
        ({"train": {"envs": 16}, "seed": 0}, "train.envs = 16 is not 8"),
    ):
        other = Checkpoints(tmp_path, settings)
        with pytest.raises(UserError, match=said):
            other.newest(LIKE)
        other.close()
    same = Checkpoints(tmp_path, {"train": {"envs": 8}, "seed": 0})
    assert same.newest(LIKE) is not None
    same.clear()
    assert same.newest(LIKE) is None
    same.close()


def test_a_second_training_in_one_folder_is_refused_at_once(tmp_path):
    first = only_writer(tmp_path, LOCK, "training")
    with pytest.raises(UserError, match="another training writes there"):
        train(_learner(), RunConfig(160, quiet=True), tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == [training.LOCK]
    first.close()
    only_writer(tmp_path, LOCK, "training").close()


def _learner() -> Learner:
    return Learner(PointEnv(), override(get_training("point"), epoch_steps=5).train)


def test_another_seed_does_not_take_over_old_weights(tmp_path):
    train(_learner(), RunConfig(160, quiet=True), tmp_path)
    with pytest.raises(UserError, match="seed = 5 is not 0, with which the training there began"):
        train(_learner(), RunConfig(320, seed=5, quiet=True), tmp_path)
    again = train(_learner(), RunConfig(160, seed=5, resume=False, quiet=True), tmp_path)
    resumed = train(_learner(), RunConfig(320, seed=5, quiet=True), tmp_path)
    assert [r["reward"] for r in resumed.rows[:1]] == [r["reward"] for r in again.rows]
    assert len(again.rows) == 1 and len(resumed.rows) == 2


def test_stops_at_the_time_limit_of_its_clock_and_goes_on_later(tmp_path):
    now = [0.0]

    def later(*_: object) -> None:
        now[0] += 10.0

    config = RunConfig(160 * 4, time_limit=15.0, checkpoint_every=1e9, quiet=True)
    first = train(_learner(), config, tmp_path, callback=later, clock=lambda: now[0])
    assert not first.finished and len(first.rows) == 2
    second = train(_learner(), config, tmp_path, callback=later, clock=lambda: now[0])
    assert second.finished and len(second.rows) == 4
