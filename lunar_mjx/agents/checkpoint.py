"""Checkpoints of a whole training with orbax: written aside and renamed, so that a kill leaves the last one whole."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from lunar_mjx.errors import UserError

_KEEP = 2


class Checkpoints:
    """The checkpoints of one training, in a folder.

    Args:
      folder: made if it is not there.
      keep: how many of the newest to keep.
    """

    def __init__(self, folder: Path, keep: int = _KEEP):
        logging.getLogger("absl").setLevel(logging.ERROR)
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, create=True, enable_async_checkpointing=False)
        self.folder = Path(folder).resolve()
        self._manager = ocp.CheckpointManager(self.folder, options=options)

    def latest(self) -> int | None:
        """Number of the newest whole checkpoint, or None."""
        return self._manager.latest_step()

    def save(self, step: int, state: Any, notes: dict[str, Any]) -> None:
        """Writes a checkpoint: a pytree of arrays, and notes that JSON can hold."""
        self._manager.save(
            step, args=ocp.args.Composite(state=ocp.args.StandardSave(_flat(state)), notes=ocp.args.JsonSave(notes))
        )
        self._manager.wait_until_finished()

    def restore(self, step: int, like: Any) -> tuple[Any, dict[str, Any]]:
        """Reads a checkpoint.

        Args:
          step: its number.
          like: shapes, types and shardings, from `Learner.abstract`.

        Raises:
          UserError: the checkpoint belongs to other settings.
        """
        try:
            found = self._manager.restore(
                step, args=ocp.args.Composite(state=ocp.args.StandardRestore(_flat(like)), notes=ocp.args.JsonRestore())
            )
        except (ValueError, KeyError) as error:
            reason = str(error).split("\n")[0][:200]
            raise UserError(
                f"{self.folder}: the checkpoint does not fit these settings ({reason}); "
                "train with the settings and the version that made it, or into another folder."
            ) from error
        leaves = [
            # an empty array, too, must lie as the compiled step expects it
            found["state"][jax.tree_util.keystr(path)]
            if leaf.size
            else jnp.zeros(leaf.shape, leaf.dtype, device=getattr(leaf, "sharding", None))
            for path, leaf in jax.tree_util.tree_leaves_with_path(like)
        ]
        return jax.tree.unflatten(jax.tree.structure(like), leaves), found["notes"]

    def close(self) -> None:
        self._manager.close()


def _flat(tree: Any) -> dict[str, Any]:
    """Leaves by path, so that the layout on disk does not depend on the classes of the tree, but for empty ones."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves if leaf.size}
