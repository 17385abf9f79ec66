"""Checkpoints of a whole training with orbax: written aside and renamed, so that a kill leaves the last one whole."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from lunar_mjx.errors import UserError, bad_input

_KEEP = 2
"""Newest checkpoints that stay: the last one may be damaged, and the one before it is only an interval older."""


class Checkpoints:
    """The checkpoints of one training, in a folder.

    Args:
      folder: made if it is not there.
      settings: of the training, as JSON holds them: a checkpoint of others is refused.
      keep: how many of the newest to keep.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any] | None = None, keep: int = _KEEP):
        # orbax reports each of its steps through absl, in the middle of the table of a training.
        logging.getLogger("absl").setLevel(logging.ERROR)
        # Synchronous: a state is donated to the next epoch, which would overwrite what is still being written.
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, create=True, enable_async_checkpointing=False)
        self.folder, self.settings = Path(folder).resolve(), settings
        self._manager = ocp.CheckpointManager(self.folder, options=options)

    def clear(self) -> None:
        """Removes all: orbax saves none with a lower number than the newest."""
        for step in self._manager.all_steps():
            self._manager.delete(step)

    def save(self, step: int, state: Any, notes: dict[str, Any]) -> None:
        """Writes a checkpoint: a pytree of arrays, and notes that JSON can hold.

        Raises:
          UserError: it cannot be written; the one before it stays.
        """
        notes = {**notes, "settings": self.settings}
        items_to_save = ocp.args.Composite(state=ocp.args.StandardSave(_flat(state)), notes=ocp.args.JsonSave(notes))
        try:
            self._manager.save(step, args=items_to_save)
            self._manager.wait_until_finished()
        except Exception as error:  # orbax raises what the writer of each part raises
            raise UserError(
                f"{self.folder}: checkpoint {step} cannot be written ({_first_line(error)}); make room there, and give "
                "the command again: it goes on from the checkpoint before."
            ) from error

    def newest(self, like: Any) -> tuple[Any, dict[str, Any]] | None:
        """Reads the newest checkpoint that is whole; damaged ones that are newer are told of and removed.

        Args:
          like: shapes, types and shardings, from `Learner.abstract`.

        Returns:
          The pytree and the notes; None if there is no checkpoint.

        Raises:
          UserError: the checkpoint belongs to other settings, or none can be read.
        """
        failed: list[tuple[int, Exception]] = []
        # Newest first: a kill may have damaged the last one, and the one before it is only an interval older.
        for step in sorted(self._manager.all_steps(), reverse=True):
            try:
                restored = self.restore(step, like)
            except _OtherSettings:
                raise
            except Exception as error:  # orbax raises what the reader of each part raises
                failed.append((step, error))
                continue
            for damaged, error in failed:
                print(
                    f"train: checkpoint {damaged} is damaged ({_first_line(error)}); going on from {step}",
                    file=sys.stderr,
                )
                self._manager.delete(damaged)
            return restored
        if failed:
            raise UserError(
                f"{self.folder}: no checkpoint fits these settings ({_first_line(failed[0][1])}); train with the "
                "settings and the version that made it, add --restart to begin anew, or train into another folder."
            ) from failed[0][1]
        return None

    def restore(self, step: int, like: Any) -> tuple[Any, dict[str, Any]]:
        """Reads one checkpoint; see `newest`. Whatever orbax raises goes through."""
        notes = self._manager.restore(step, args=ocp.args.Composite(notes=ocp.args.JsonRestore()))["notes"]
        # Settings first: arrays of another network would fail later, with a message that names a shape.
        self._compare(notes.get("settings"))
        items_to_restore = ocp.args.Composite(state=ocp.args.StandardRestore(_flat(like)))
        restored_state = self._manager.restore(step, args=items_to_restore)["state"]
        leaves = [
            # an empty array, too, must lie as the compiled step expects it
            restored_state[jax.tree_util.keystr(path)]
            if leaf.size
            else jnp.zeros(leaf.shape, leaf.dtype, device=getattr(leaf, "sharding", None))
            for path, leaf in jax.tree_util.tree_leaves_with_path(like)
        ]
        return jax.tree.unflatten(jax.tree.structure(like), leaves), notes

    def _compare(self, kept: Mapping[str, Any] | None) -> None:
        if self.settings is None or kept is None:
            return
        current, saved = _by_name(self.settings), _by_name(kept)
        for name in sorted(current.keys() | saved.keys()):
            if current.get(name) != saved.get(name):
                problem = f"is not {saved.get(name)}, with which the training there began"
                remedy = "give the same, add --restart to begin anew, or train into another folder"
                raise _OtherSettings(str(bad_input(self.folder, name, current.get(name), problem, remedy)))

    def close(self) -> None:
        """Waits for saves that are under way, and frees what the manager holds."""
        self._manager.close()


class _OtherSettings(UserError):
    pass


def _by_name(settings: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Settings by dotted names."""
    by_name: dict[str, Any] = {}
    for name, value in settings.items():
        by_name |= _by_name(value, f"{before}{name}.") if isinstance(value, Mapping) else {before + name: value}
    return by_name


def _first_line(error: Exception) -> str:
    return (str(error).split("\n")[0] or type(error).__name__)[:200]


def _flat(tree: Any) -> dict[str, Any]:
    """Leaves by path, so that the layout on disk does not depend on the classes of the tree, but for empty ones."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves if leaf.size}
