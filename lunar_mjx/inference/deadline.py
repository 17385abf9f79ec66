"""A time by which work must have ended, and how it ends that is not done by then."""

from __future__ import annotations

import math
import time


class TimeUp(Exception):
    """The time is over. What was begun has no result; what was finished before stands."""


class Deadline:
    """A time by which work must have ended.

    Attributes:
      until: of the monotonic clock, s; infinite for work that may last as long as it takes.
    """

    def __init__(self, seconds: float = math.inf):
        """A deadline in some seconds from now."""
        # Not the time of day, which may be set while the work is under way.
        self.until = time.monotonic() + seconds

    def left(self) -> float:
        """Seconds that are left; negative after the deadline."""
        return self.until - time.monotonic()

    def check(self, needed: float = 0.0) -> None:
        """Raises `TimeUp` where less is left than is needed, s."""
        if self.left() < needed:
            raise TimeUp
