"""Progress of a long command: a bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Reporter = Callable[[str, float], None]
"""Takes what is being done, and the share of the whole that is done, 0 to 1; NaN where nobody knows it."""

_LINE_EVERY = 5.0
"""Seconds between plain lines."""


@contextmanager
def console_progress(console: Console | None = None) -> Iterator[Reporter]:
    """A reporter to standard error: a bar on a terminal, else a line at most every five seconds and at each stage."""
    console = console or Console(stderr=True)
    # A file or another program would get the bar's control characters, and one line for each of its pictures.
    if not console.is_terminal:
        yield _lines(console)
        return
    columns = (
        TextColumn("{task.description:32}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("starting", total=1.0)

        def report(what: str, done: float) -> None:
            # a bar without a total pulses and promises no time; `update` takes None for "as it was"
            known = math.isfinite(done)
            bar.tasks[0].total = 1.0 if known else None
            bar.update(task, description=what, completed=done if known else 0.0)

        yield report


def _lines(console: Console) -> Reporter:
    start, last, stage = time.monotonic(), -_LINE_EVERY, ""

    def report(what: str, done: float) -> None:
        nonlocal last, stage
        elapsed_s = time.monotonic() - start
        if what == stage and elapsed_s - last < _LINE_EVERY:
            return
        last, stage = elapsed_s, what
        # The first hundredths are mostly compilation and say nothing of the pace.
        left = f", about {elapsed_s * (1.0 - done) / done:.0f} s left" if done > 0.02 else ""
        share = f"{100 * done:3.0f} %" if math.isfinite(done) else "  ..."
        console.print(f"{share}  {what} ({elapsed_s:.0f} s{left})", highlight=False, markup=False)

    return report
