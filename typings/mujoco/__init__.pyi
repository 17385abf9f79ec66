"""MuJoCo's compiled module ships no types: names are taken to be there, and to be of any kind."""

from typing import Any

def __getattr__(name: str) -> Any: ...
