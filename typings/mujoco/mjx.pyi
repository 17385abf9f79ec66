"""MJX, which is written in Python and takes MuJoCo's types."""

from typing import Any

def __getattr__(name: str) -> Any: ...
