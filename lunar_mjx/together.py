"""What several processes of one training decide together: the first one's values, and whether all go on.

Processes meet in collective operations. One that ends, or that takes another way because of its own clock, file or
callback, leaves the others waiting there. So whatever may differ between processes is exchanged before it decides.
With one process nothing is exchanged.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from lunar_mjx.errors import UserError, bad_input


def join(coordinator: str | None, processes: int, process: int) -> None:
    """Makes this process one of several that run one program over the devices of all; nothing if `coordinator` is None.

    Args:
      coordinator: host:port of the first process, which the others can reach. processes: how many there are.
      process: which one this is, from 0.

    Raises:
      UserError: numbers that do not fit together, or nobody answers within JAX's five minutes.
    """
    if coordinator is None:
        if processes != 1 or process != 0:
            raise bad_input("train", "--coordinator", "left out", "is needed for several processes", "give HOST:PORT")
        return
    host, colon, port = coordinator.rpartition(":")
    # The first nine digits only: whole numbers of thousands of digits are slow to read.
    if not (host and colon and port.isdecimal() and 0 < int(port[:9]) < 2**16):
        raise bad_input("train", "--coordinator", coordinator, "is not HOST:PORT", "give it as 10.0.0.1:1234")
    if processes < 2:
        raise bad_input("train", "--processes", processes, "is below 2", "say how many processes train together")
    if not 0 <= process < processes:
        raise bad_input("train", "--process", process, f"is not one of 0 to {processes - 1}", "number them from 0")
    # how processes on CPUs exchange values
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        raise UserError(
            f"train: --coordinator = {coordinator} cannot be joined as process {process} of {processes} "
            f"({str(error).splitlines()[0]}); start all of them within five minutes, each with its own --process."
        ) from error


def leads() -> bool:
    """Whether this is the process that writes files and prints: the first, or the only one."""
    return jax.process_index() == 0


class OtherProcessError(UserError):
    """Another process of the same training ended with an error."""


def of_the_first(*values: float) -> np.ndarray:
    """(n,) the values that the first process gave; a collective operation."""
    # All give theirs and take the first's: an exchange needs everybody.
    return _of_all(*values)[0]


@contextlib.contextmanager
def agreed(doing: str) -> Iterator[None]:
    """A context that all processes leave with an error if one of them does; no collective operation may stand in it.

    Args:
      doing: what is done in it, for the sentence.

    Raises:
      OtherProcessError: in the processes that are well where another one is not.
    """
    if jax.process_count() == 1:
        yield
        return
    try:
        yield
    except BaseException:
        # told before it is raised: the others wait in the same exchange and end with a sentence instead of hanging
        _of_all(1.0)
        raise
    # Every process meets here once, whether it failed or not.
    failed = np.flatnonzero(_of_all(0.0)[:, 0])
    if len(failed):
        raise OtherProcessError(
            f"train: process {failed[0]} of {jax.process_count()} ended with an error while {doing}; it says which. "
            "Mend it there, and start all processes again: they go on from the last checkpoint."
        )


def everywhere(tree: Any) -> Any:
    """The whole arrays of a pytree, as NumPy's in every process, however they are spread; a collective operation."""
    if jax.process_count() == 1:
        return jax.device_get(tree)
    from jax.experimental import multihost_utils

    return multihost_utils.process_allgather(tree, tiled=True)


def _of_all(*values: float) -> np.ndarray:
    """(process, n) values of every process."""
    # JAX exchanges float32 here; with one process values are rounded alike, so that both decide the same
    own = np.asarray(values, np.float32)
    if jax.process_count() == 1:
        return own[None]
    from jax.experimental import multihost_utils

    return np.asarray(multihost_utils.process_allgather(own)).reshape(jax.process_count(), len(values))
