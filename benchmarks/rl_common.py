"""What the parts of rl_proof.py share: their clock, their files and what they say."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any


class Clock:
    """Time of a part of the benchmark."""

    def __init__(self, seconds: float):
        self.seconds, self._begin = seconds, time.monotonic()

    @property
    def spent(self) -> float:
        return time.monotonic() - self._begin

    @property
    def left(self) -> float:
        return self.seconds - self.spent


def save(out: Path, name: str, record: dict[str, Any]) -> None:
    import jax
    import mujoco

    from lunar_mjx.agents.train import plain

    about = {
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
    }
    text = json.dumps(plain({"about": about, **record}), indent=None) + "\n"
    (out / f"rl_{name}.json").write_text(text, encoding="utf-8")


def say(text: str) -> None:
    print(text, flush=True)
