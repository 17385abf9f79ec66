"""Short drives of both rovers on native MuJoCo, written as `simulate` writes them: no compilation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lunar_mjx.backends.base import telemetry
from lunar_mjx.backends.native import NativeBackend
from lunar_mjx.model import make_model
from lunar_mjx.model.file import save_model
from lunar_mjx.simulate import constant_commands


def write_drive(folder: Path, rover: str, duration: float) -> np.ndarray:
    """Writes drive.csv and model.toml of a turning drive; returns the coordinates at the rows, (time, nq)."""
    model = make_model(rover, "slope:5deg")
    backend = NativeBackend(model)
    commands = constant_commands(model, duration, drive=1.5, steer=0.1)
    every = round(commands.interval / model.timestep)
    qpos, rows = [], []
    for control in commands.values:
        qpos.append(backend.state().qpos[0])
        for i in range(every):
            backend.step(control)
            if i == 0:
                rows.append(backend.observe())
    folder.mkdir()
    backend.channels(telemetry(rows), commands).to_csv(folder / "drive.csv", index=False, float_format="%.9g")
    save_model(model, folder / "model.toml")
    return np.array(qpos)


@pytest.fixture(scope="session")
def viper(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("drives") / "viper"
    return folder, write_drive(folder, "viper", 0.6)


@pytest.fixture(scope="session")
def luvmi(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("drives") / "luvmi"
    return folder, write_drive(folder, "luvmi_x", 1.5)
