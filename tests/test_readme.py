"""What the README shows runs as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from lunar_mjx.effects.catalogue import get
from lunar_mjx.model import make_model

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
FIRST_STEPS, OWN_EFFECT = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.slow
def test_first_steps(capsys: pytest.CaptureFixture[str]) -> None:
    shown: dict[str, object] = {}
    exec(compile(FIRST_STEPS, "README.md", "exec"), shown)
    seen = shown["seen"]
    assert np.isfinite(np.asarray(seen.slip)).all()
    assert float(capsys.readouterr().out.split()[0]) > 1.0, "10 s at 0.8 rad/s on wheels of 0.25 m"


def test_own_effect(tmp_path: Path) -> None:
    file = tmp_path / "my_effects.py"
    file.write_text(OWN_EFFECT, encoding="utf-8")
    model = make_model("viper", "flat").add(get(f"{file}:gear_friction"), torque=0.2)
    assert model.parameters["gear_friction"]["torque"] == 0.2
