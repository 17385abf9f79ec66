"""A template of a log that its user fills in: `lunar-mjx log new`."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pandas as pd

from lunar_mjx.errors import bad_input
from lunar_mjx.files import write_text
from lunar_mjx.logs.recorder.instruments import RATES, Recording
from lunar_mjx.logs.schema import FORMAT
from lunar_mjx.logs.write import new_folder

_DRIVE = """# A measurement log: this file, and one table per sampling rate beside it (CSV, or Parquet with pyarrow).
# Fill in the tables, correct what is written here, then run: lunar-mjx log check {folder}
format = "{format}"
rover = "{rover}"                  # name of a shipped rover, or path of a rover's folder
manoeuvre = "{manoeuvre}"     # a canned manoeuvre or free text
gravity_m_s2 = 1.625               # 9.81 on Earth
terrain = "{terrain}"                   # flat, slope:10deg, or a path
# terrain_origin_m = [0.0, 0.0]    # where the log's origin lies in the terrain
# split = "fit"                    # fit, select or test; chosen for you if left out

[environment]                      # constants, or the name of a column; leave out what is not known
ambient_temperature_degC = {ambient}
# sun_azimuth_deg = 90.0           # from north, clockwise
# sun_elevation_deg = 5.0

[rover_changes]                    # what differs from the rover as drawn
{payload}

[initial]                          # what is known; anything left out is fitted
# position_m = [0.0, 0.0, 0.5]
# yaw_deg = 0.0

[imu]                              # where it is mounted in the chassis frame; quaternion w, x, y, z to the body's axes
# position_m = [0.0, 0.0, 0.0]
# quaternion = [1.0, 0.0, 0.0, 0.0]

# Tables. Every file begins with time_s: seconds, rising, from one origin for all tables (else clock_offset_s, which is
# added to a table's time). Names say quantity and unit; other units convert (position_x_mm, ..._degF, ..._rpm).
# Leave cells empty where a sample is missing, and leave out columns that you do not have.
{tables}
# Noise of one sample. source: datasheet, rest (a stretch at rest) or replicate. A name may hold *.
{noise}
[source]
who = ""
licence = ""
citation = ""
"""

_STEADY = """# A steady-state log: this file and points.csv with one row per run of a single-wheel test bed.
# Fill in the table, correct what is written here, then run: lunar-mjx log check {folder}
format = "{format}"
kind = "steady_state"
file = "points.csv"
slip_definition = "wheel_frame"    # rim speed against V cos beta (eq. 8); or "travel_speed": against V
gravity_m_s2 = 9.81
# split = "fit"                    # fit, select or test

[wheel]
radius_m = 0.0                     # without grousers
width_m = 0.0
grouser_count = 0
grouser_height_m = 0.0

# Noise of one run. Replicates (rows of the same slip angle and slip) tell it better and are used first.
# A column such as drawbar_pull_std_N gives it row by row.
[noise.drawbar_pull_N]
std = 1.0
source = "datasheet"

[noise.side_force_N]
std = 1.0
source = "datasheet"

[noise.driving_torque_Nm]
std = 0.1
source = "datasheet"

[noise.sinkage_m]
std = 0.001
source = "datasheet"

[source]
who = ""
licence = ""
citation = ""
"""

_POINTS = (
    "slip_ratio",
    "slip_angle_deg",
    "normal_load_N",
    "travel_speed_m_s",
    "drawbar_pull_N",
    "side_force_N",
    "driving_torque_Nm",
    "sinkage_m",
    "trial",
)


def new_log(folder: str | Path, rover: str = "viper", manoeuvre: str = "speed_staircase", steady: bool = False) -> Path:
    """Writes a commented template: `log.toml` and tables that hold their header only.

    Args:
      folder: must not exist, or be empty.
      rover: name or path; its joints give the columns.
      manoeuvre: canned name (its mode gives the command columns) or free text.
      steady: for a single-wheel test bed.

    Raises:
      UserError: the folder is not empty, or there is no such rover.
    """
    folder = Path(folder)
    if steady:
        new_folder(folder)
        _write(folder / "log.toml", _STEADY.format(folder=shlex.quote(str(folder)), format=FORMAT))
        _write(folder / "points.csv", ",".join(_POINTS) + "\n")
        return folder
    # The template is text that is read as TOML again.
    for field, value in (("--rover", rover), ("--manoeuvre", manoeuvre)):
        if any(c in value for c in '"\n\r\\'):
            raise bad_input("log new", field, value, "holds a quote, a backslash or a line break", "name it without")
    columns, settings = _columns(rover, manoeuvre)
    new_folder(folder)
    tables = noise = ""
    for name, channels in columns.items():
        tables += f'[tables.{name}]\nfile = "{name}.csv"\nrate_hz = {RATES[name]:g}.0\n\n'
        # Headers alone: a line of made-up numbers might be left in.
        empty = pd.DataFrame({"time_s": np.zeros(0)} | {c: np.zeros(0) for c in channels})
        _write(folder / f"{name}.csv", empty.to_csv(index=False))
    for instrument in Recording().instruments:
        if instrument.std and any(instrument.table == n for n in columns):
            noise += f'[noise."{instrument.pattern}"]        # {instrument.source}\n'
            noise += f'std = {instrument.std:g}\nsource = "datasheet"\n\n'
    text = _DRIVE.format(
        folder=shlex.quote(str(folder)),
        format=FORMAT,
        rover=rover,
        manoeuvre=manoeuvre,
        tables=tables,
        noise=noise,
        **settings,
    )
    _write(folder / "log.toml", text)
    return folder


def _columns(rover: str, manoeuvre: str) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Columns of every table for a rover, and what the manoeuvre says about terrain, ambient and payload."""
    from lunar_mjx.manoeuvres import MANOEUVRES, load_manoeuvre
    from lunar_mjx.model import make_model
    from lunar_mjx.simulate import command_channels, joint_channels

    model = make_model(rover, "flat")
    settings = {
        "terrain": "flat",
        "ambient": "20.0",
        "payload": "# payload_kg = 60.0\n# payload_position_m = [0.0, 0.0, 0.4]",
    }
    if manoeuvre in MANOEUVRES:
        plan = load_manoeuvre(manoeuvre)
        model = model.replace(modes={"drive": plan.drive_mode})
        settings["terrain"] = plan.terrain
        settings["ambient"] = f"{plan.environment.get('ambient_temperature_degC', 20.0):.1f}"
        if plan.payload_share:
            mass = plan.payload_share * model.rover.mass
            settings["payload"] = f"payload_kg = {mass:.1f}\npayload_position_m = [0.0, 0.0, 0.2]"
    joints, corners = joint_channels(model.rover), [w.corner for w in model.rover.wheels]
    per_joint = ("joint_{}_angle_rad", "joint_{}_speed_rad_s", "motor_{}_current_A", "motor_{}_voltage_V")
    drive = [f"position_{a}_m" for a in "xyz"] + [f"world_velocity_{a}_m_s" for a in "xyz"]
    drive += ["roll_deg", "pitch_deg", "yaw_deg"] + [p.format(j) for p in per_joint for j in joints]
    return {
        "drive": drive + command_channels(model),
        "imu": [f"gyro_{a}_rad_s" for a in "xyz"] + [f"accelerometer_{a}_m_s2" for a in "xyz"],
        "thermal": [f"{p}_{j}_temperature_degC" for p in ("winding", "housing") for j in joints],
        "camera": [f"wheel_{c}_{q}" for q in ("sinkage_m", "slip_ratio") for c in corners],
    }, settings


def _write(path: Path, text: str) -> None:
    write_text(path, text)
