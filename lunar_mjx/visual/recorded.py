"""A drive that `simulate` wrote, read back: its table, its model, and the rover's coordinates at every row."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pandas as pd

from lunar_mjx.cameras.chase import tracks_of
from lunar_mjx.cameras.dust.grains import WheelMotion
from lunar_mjx.cameras.dust.recorded import Dust, wheel_motion
from lunar_mjx.cameras.texture import Track
from lunar_mjx.dynamics.signals import joint_channels
from lunar_mjx.errors import UserError, bad_input, one_line
from lunar_mjx.model import Model
from lunar_mjx.model.file import load_model
from lunar_mjx.terrain import Terrain, gradient

TABLE, MODEL = "drive.csv", "model.toml"

_CLOSING = 6
"""Newton iterations that close the rover's loops."""


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A drive from its folder; arrays lead with time.

    Attributes:
      folder: it came from. model: what drove. table: the channels of drive.csv.
    """

    folder: Path
    model: Model
    table: pd.DataFrame

    @property
    def time(self) -> np.ndarray:
        """Time since the drive began, (time,) s."""
        return self.table["time_s"].to_numpy(float)

    @functools.cached_property
    def position(self) -> np.ndarray:
        """Position of the chassis frame, (time, 3) m."""
        return self.columns([f"position_{a}_m" for a in "xyz"])

    @functools.cached_property
    def speed(self) -> np.ndarray:
        """Speed over the ground, (time,) m/s."""
        return np.hypot(*np.gradient(self.position[:, :2], self.time, axis=0).T)

    @property
    def corners(self) -> list[str]:
        """Names of the wheels."""
        return [w.corner for w in self.model.rover.wheels]

    def per_wheel(self, pattern: str) -> np.ndarray:
        """A channel of every wheel, such as `wheel_{}_slip_ratio`, (time, wheel)."""
        return self.columns([pattern.format(c) for c in self.corners])

    def per_motor(self, pattern: str) -> np.ndarray:
        """A channel of every motor, such as `winding_{}_temperature_degC`, (time, joint)."""
        return self.columns([pattern.format(j) for j in joint_channels(self.model.rover)])

    @property
    def power(self) -> np.ndarray:
        """Electrical power into all motors, (time,) W; negative while they brake more than they heat."""
        return np.sum(self.per_motor("motor_{}_voltage_V") * self.per_motor("motor_{}_current_A"), axis=1)

    @functools.cached_property
    def terrain(self) -> Terrain:
        """The ground, in host memory."""
        return jax.device_get(self.model.terrain)

    @functools.cached_property
    def slope(self) -> np.ndarray:
        """Slope of the ground under the chassis, (time, 2) deg: along the heading (positive uphill), up to the left."""
        x, y = self.position[:, 0], self.position[:, 1]
        east, north = (np.asarray(v, float) for v in gradient(self.model.terrain.field, x, y))
        # The terrain's gradient is east and north; a driver asks for along and across.
        yaw = np.radians(self.columns(["yaw_deg"])[:, 0])
        along, across = np.cos(yaw) * east + np.sin(yaw) * north, np.cos(yaw) * north - np.sin(yaw) * east
        return np.degrees(np.arctan(np.stack([along, across], axis=-1)))

    def columns(self, names: list[str]) -> np.ndarray:
        """Channels by name, (time, name)."""
        for name in names:
            if name not in self.table.columns:
                raise bad_input(
                    self.folder / TABLE,
                    "columns",
                    f"{len(self.table.columns)} channels",
                    f"lack {name}",
                    "write the drive anew with lunar-mjx simulate",
                )
        try:
            return self.table[names].to_numpy(float)
        except ValueError as error:
            problem = f"{self.folder / TABLE}: holds what is no number ({one_line(error)})"
            raise UserError(f"{problem}; write it anew with lunar-mjx simulate.") from None

    @functools.cached_property
    def qpos(self) -> np.ndarray:
        """Coordinates of the rover's MJCF, (time, nq), with its loops closed."""
        model = self.model.rover.compile()
        # The loops' Jacobian is read as a full matrix below, whatever MuJoCo would choose by size.
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        joints = self.model.rover.joints
        adr = [int(model.joint(j).qposadr[0]) for j in joints]
        out = np.tile(np.asarray(model.qpos0), (len(self.table), 1))
        out[:, :3] = self.position
        turned = self.columns([f"quaternion_{c}" for c in "wxyz"])
        # The digits of a table leave a quaternion not quite of length one.
        out[:, 3:7] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        out[:, adr] = self.per_motor("joint_{}_angle_rad")
        if self.model.rover.loops:
            driven = {int(model.joint(j).dofadr[0]) for j in joints}
            passive = np.array([d for d in range(6, model.nv) if d not in driven])
            passive_qpos = np.array([int(model.jnt_qposadr[model.dof_jntid[d]]) for d in passive])
            data = mujoco.MjData(model)
            for row in range(len(out)):
                # From where the last row closed: a few iterations suffice, and a linkage stays on its branch.
                if row:
                    out[row, passive_qpos] = out[row - 1, passive_qpos]
                _close(model, data, out[row], passive, passive_qpos)
        return out

    @functools.cached_property
    def wheel_motion(self) -> WheelMotion:
        """Places of the wheels and how far they have turned."""
        return wheel_motion(self.model.rover, self.qpos)

    def wheel_places(self) -> np.ndarray:
        """Centres of the wheels, (time, wheel, 3) m."""
        return self.wheel_motion.centre

    def tracks(self) -> list[Track]:
        """Where the wheels rolled, a row of places for each row of the table."""
        return tracks_of(self.model.rover, self.wheel_places())

    def dust(self) -> Dust:
        """What the wheels throw up."""
        model = self.model
        hard = "hard_surface" in model.effect_names
        return Dust(model.rover, self.terrain, self.time, self.wheel_motion, model.gravity, hard)


def _close(model: Any, data: Any, qpos: np.ndarray, passive: np.ndarray, at: np.ndarray) -> None:
    """Turns the passive joints, in place, until the pins of the loops meet."""
    for _ in range(_CLOSING):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeConstraint(model, data)
        apart = np.array(data.efc_pos[: data.nefc])
        jacobian = np.array(data.efc_J[: data.nefc * model.nv]).reshape(data.nefc, model.nv)[:, passive]
        qpos[at] -= np.linalg.lstsq(jacobian, apart, rcond=1e-9)[0]
        if np.abs(apart).max() < 1e-9:
            return


def read_drive(folder: str | Path) -> RecordedDrive:
    """Reads the folder that `lunar-mjx simulate` wrote.

    Raises:
      UserError: it is not such a folder, or its table is damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise bad_input("drive", "RUN", str(folder), "is not a folder", "give the folder that lunar-mjx simulate wrote")
    for name in (TABLE, MODEL):
        if not (folder / name).is_file():
            raise bad_input(
                "drive", "RUN", str(folder), f"holds no {name}", "give the folder that lunar-mjx simulate wrote"
            )
    try:
        table = pd.read_csv(folder / TABLE)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise UserError(f"{folder / TABLE}: is not a CSV table ({one_line(error)}); write it anew.") from None
    drive = RecordedDrive(folder, load_model(folder / MODEL), table)
    numbers = drive.columns(["time_s", *(f"position_{a}_m" for a in "xyz")])
    if len(table) < 2 or not np.isfinite(numbers).all() or (np.diff(numbers[:, 0]) <= 0).any():
        raise bad_input(
            folder / TABLE,
            "time_s",
            f"{len(table)} rows",
            "do not rise, or hold a gap",
            "give two rows or more, sorted by time",
        )
    return drive
