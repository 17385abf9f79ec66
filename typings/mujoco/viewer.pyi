"""MuJoCo's window, which is written in Python without types."""

from typing import Any

def __getattr__(name: str) -> Any: ...
