"""The command, given a mistake: one sentence and status 2, and nothing lost."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

from lunar_mjx.commands import app as cli
from lunar_mjx.model import make_model
from lunar_mjx.simulate import command_channels
from tests.cli_harness import MAIN, Result, Run, subprocess_run

DATA = Path(__file__).parents[1] / "rover" / "data"


def csv(**changes: object) -> str:
    """Commands of 0.2 s with some columns changed or, where None, dropped."""
    names = command_channels(make_model("luvmi_x", "flat"))
    columns = {"time_s": [0.0, 0.05, 0.1, 0.15], **{name: [0.1] * 4 for name in names}, **changes}
    return pd.DataFrame({k: v for k, v in columns.items() if v is not None}).to_csv(index=False)


def urdf(old: str, new: str, count: int = -1) -> str:
    text = (DATA / "steered.urdf").read_text()
    assert old in text
    return text.replace(old, new, count)


def toml(*lines: str) -> str:
    return "\n".join(['format = "lunar-mjx-model/1"', 'rover = "luvmi_x"', 'terrain = "flat"', *lines])


DRIVE = "command_lf_drive_speed_rad_s"
INERTIA = 'ixx="0.5" ixy="0" ixz="0" iyy="1.3" iyz="0" izz="1.6"'
LUVMI = ["simulate", "--rover", "luvmi_x", "--terrain", "flat", "--duration", "0.1", "--out", "OUT"]
CONVERT = ["convert", "FILES/rover.urdf", "--out", "OUT"]
MODEL = ["simulate", "--model", "FILES/model.toml", "--out", "OUT"]
TABLE = [*LUVMI, "--commands", "FILES/commands.csv"]
SHOW = ["effect", "show", "FILES/mine.py"]
ZERO = ["evaluate", "zero", "--task", "large", "--env"]
TRAINING = ["train", "FILES/t.toml", "--out", "OUT"]
POINT = 'environment = "point"\nsteps = 10\n[td3]\n'
BED = ["bed", "simulate", "OUT", "--radius", "0.1", "--width", "0.1", "--slips", "0.1", "--loads", "40"]
RECORDED = ["log", "simulate", "OUT/log", "--rover", "luvmi_x"]

STEADY: dict[str, object] = {
    "bed/log.toml": """format = "lunar-mjx-log/1"
kind = "steady_state"
file = "points.csv"
slip_definition = "wheel_frame"
[wheel]
radius_m = 0.1
width_m = 0.1
[noise.drawbar_pull_N]
std = 1.0
""",
    "bed/points.csv": "slip_ratio,slip_angle_deg,normal_load_N,drawbar_pull_N\n"
    + "".join(f"{0.05 * i:.2f},0,60,{2.3 * i - 5 + 0.7 * (i % 3):.2f}\n" for i in range(12)),
}
TABLE_RUN = ["compare", "FILES/bed", "--out", "OUT/run"]

# what is wrong: (arguments, files to write, words that the line must hold)
MISTAKES: dict[str, tuple[list[str], dict[str, object], list[str]]] = {
    "URDF missing": (CONVERT, {}, ["rover.urdf", "not there"]),
    "URDF is no XML": (CONVERT, {"rover.urdf": urdf("</robot>", "</robt>")}, ["rover.urdf", "not well-formed"]),
    "URDF with negative mass": (
        CONVERT,
        {"rover.urdf": urdf('<mass value="1.9"/>', '<mass value="-1.9"/>')},
        ["rover.urdf", "mass", "-1.9", "not positive"],
    ),
    "URDF with zero inertia": (
        CONVERT,
        {"rover.urdf": urdf(INERTIA, re.sub(r'"[\d.]+"', '"0"', INERTIA))},
        ["rover.urdf", "Body", "zero"],
    ),
    "URDF without wheels": (
        CONVERT,
        {"rover.urdf": urdf('<cylinder radius="0.12" length="0.09"/>', '<box size="1 1 1"/>')},
        ["rover.urdf", "wheels"],
    ),
    "URDF with a dangling joint": (
        CONVERT,
        {"rover.urdf": urdf('<child link="FrontLeftArm"/>', '<child link="Arm"/>')},
        ["rover.urdf", "FrontLeftArmJoint", "'Arm'"],
    ),
    "description missing": (
        [*CONVERT, "--description", "FILES/gone.toml"],
        {"rover.urdf": urdf("steered", "steered")},
        ["gone.toml", "not there"],
    ),
    "name that is no file name": (
        [*CONVERT, "--name", "../up"],
        {"rover.urdf": urdf("steered", "steered")},
        ["'../up'", "name"],
    ),
    "DEM missing": (["terrain", "info", "FILES/gone.tif"], {}, ["gone.tif", "not there"]),
    "DEM with only nodata": (
        ["terrain", "info", "FILES/a.asc"],
        {"a.asc": "ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\nNODATA_value -9\n-9 -9 -9\n-9 -9 -9\n"},
        ["a.asc", "nodata"],
    ),
    "PNG without scale": (
        ["terrain", "export", "FILES/a.png", "OUT/a.stl"],
        {"a.png": Image.new("L", (4, 4))},
        ["a.png", "height_scale = None", "without a scale"],
    ),
    "slope too steep": (["terrain", "info", "slope:95deg"], {}, ["slope:95deg", "below 90"]),
    "terrain unknown": (["terrain", "info", "sea"], {}, ["sea", "lunar_plain"]),
    "terrain.toml with an unknown key": (
        ["terrain", "info", "FILES/t.toml"],
        {"t.toml": "[plane]\nangle = 3.0\n"},
        ["t.toml", "plane.angle = 3.0", "slope_deg"],
    ),
    "mesh format unknown": (["terrain", "export", "flat", "OUT/a.step"], {}, ["a.step", "'.step'", ".stl"]),
    "mesh folder missing": (["terrain", "export", "flat", "FILES/no/a.stl"], {}, ["a.stl", "make it first"]),
    "DEM given to a slope": (
        ["terrain", "info", "slope:3deg", "--dem", "FILES/a.tif"],
        {},
        ["--dem", "a.tif", "does not go with slope:3deg"],
    ),
    "seed given to a DEM": (["terrain", "info", "FILES/a.tif", "--seed", "3"], {}, ["--seed = 3", "a.tif"]),
    "DEM given is missing": (
        ["terrain", "info", "de_gerlache_rim", "--dem", "FILES/gone.tif"],
        {},
        ["gone.tif", "not there"],
    ),
    "rover unknown": ([*LUVMI, "--rover", "moonbuggy"], {}, ["moonbuggy", "luvmi_x, rocker_bogie, viper"]),
    "simulated terrain unknown": ([*LUVMI, "--terrain", "sea"], {}, ["sea", "lunar_plain"]),
    "simulated slope too steep": ([*LUVMI, "--terrain", "slope:95deg"], {}, ["slope:95deg", "below 90"]),
    "simulated preset unknown": ([*LUVMI, "--preset", "best"], {}, ["'best'", "consistent, field, paper"]),
    "device unknown": ([*LUVMI, "--device", "tpu"], {}, ["--device = 'tpu'", "cpu or cuda"]),
    "drive nan": ([*LUVMI, "--drive", "nan"], {}, ["--drive = nan", "not finite"]),
    "steer inf": ([*LUVMI, "--steer", "inf"], {}, ["--steer = inf", "not finite"]),
    "start nan": ([*LUVMI, "--x", "nan"], {}, ["--x = nan", "not finite"]),
    "heading nan": ([*LUVMI, "--yaw-deg", "nan"], {}, ["--yaw-deg = nan", "not finite"]),
    "start off the terrain": ([*LUVMI, "--y", "500"], {}, ["y = 500", "off the terrain flat"]),
    "duration negative": ([*LUVMI, "--duration", "-3"], {}, ["duration = -3", "below 0.05 s"]),
    "duration endless": ([*LUVMI, "--duration", "1e12"], {}, ["duration = 1000000000000", "above 50000 s"]),
    "simulated effect unknown": ([*LUVMI, "--effects", "warp"], {}, ["'warp'", "catalogue"]),
    "simulated effect twice": ([*LUVMI, "--effects", "soil"], {}, ["--effects", "'soil'", "already"]),
    "commands missing": (TABLE, {}, ["commands.csv", "not there"]),
    "commands with nan": (
        TABLE,
        {"commands.csv": csv(**{DRIVE: [0.1, "nan", 0.1, 0.1]})},
        ["commands.csv", "line 3", f"{DRIVE} = nan", "not a finite"],
    ),
    "commands with text": (
        TABLE,
        {"commands.csv": csv(**{DRIVE: [0.1, 0.1, "fast", 0.1]})},
        ["commands.csv", "line 4", "'fast'"],
    ),
    "commands without a column": (TABLE, {"commands.csv": csv(**{DRIVE: None})}, ["commands.csv", f"lack {DRIVE}"]),
    "commands at uneven times": (
        TABLE,
        {"commands.csv": csv(time_s=[0.0, 0.05, 0.1, 0.3])},
        ["commands.csv", "time_s", "uneven"],
    ),
    "commands out of step": (
        TABLE,
        {"commands.csv": csv(time_s=[0.0, 0.005, 0.01, 0.015])},
        ["interval = '0.005 s'", "timestep_s"],
    ),
    "commands are no table": (TABLE, {"commands.csv": b"\xff\xfe\x00"}, ["commands.csv", "not a CSV table"]),
    "model missing": (MODEL, {}, ["model.toml", "not there"]),
    "model is no TOML": (MODEL, {"model.toml": "format = \n"}, ["model.toml", "not valid TOML", "line 1"]),
    "model with an unknown key": (
        MODEL,
        {"model.toml": toml("gravity = 1")},
        ["model.toml: gravity = 1", "unknown key"],
    ),
    "model of an unknown preset": (MODEL, {"model.toml": toml('preset = "best"')}, ["model.toml: preset = 'best'"]),
    "model with a wrong unit": (
        MODEL,
        {"model.toml": toml("[effects.soil]", 'cohesion = {value = 1.0, unit = "m"}')},
        ["model.toml: effects.soil.cohesion = '1 m'", "give it in Pa"],
    ),
    "model out of bounds": (
        MODEL,
        {"model.toml": toml("[effects.soil]", "n = -1.0")},
        ["model.toml: effects.soil.n = -1", "outside [0.1, 3]"],
    ),
    "model that knows of nothing": (
        MODEL,
        {"model.toml": toml('[priors."sail.area"]', "value = 1.0", "std = 0.1")},
        ["model.toml", "priors = 'sail.area'", "is no parameter of an effect"],
    ),
    "model with a received effect file": (
        MODEL,
        {"model.toml": toml('effect_list = ["motor", "mine.py"]'), "mine.py": "raise SystemExit\n"},
        ["model.toml: effect_list = ", "mine.py' is Python code that would run", "add --trust"],
    ),
    "model with a broken effect file": (
        [*MODEL, "--trust"],
        {"model.toml": toml('effect_list = ["motor", "mine.py"]'), "mine.py": "x = (\n"},
        ["model.toml: effect_list = 'mine.py'", "does not run", "SyntaxError"],
    ),
    "terrain is a table": (
        ["terrain", "info", "FILES/ground.csv"],
        {"ground.csv": "x,y,z\n0,0,0\n"},
        ["ground.csv", "suffix = '.csv'", ".tif", ".asc"],
    ),
    "terrain file missing": (["terrain", "info", "FILES/ground.tiff2"], {}, ["ground.tiff2", "not there"]),
    "preset unknown": (["preset", "best"], {}, ["'best'", "consistent, field, paper"]),
    "preset of an unknown rover": (["preset", "paper", "--rover", "moonbuggy"], {}, ["moonbuggy", "viper"]),
    "preset saved nowhere": (["preset", "paper", "--save", "FILES/no/m.toml"], {}, ["m.toml", "cannot be written"]),
    "preset saved on a folder": (["preset", "paper", "--save", "OUT"], {}, ["out", "cannot be written"]),
    "effect unknown": (["effect", "show", "warp"], {}, ["'warp'", "lunar-mjx effect list"]),
    "effect file missing": (SHOW, {}, ["mine.py", "not there"]),
    "effect file fails": (
        SHOW,
        {"mine.py": "raise ValueError('first\\nsecond')\n"},
        ["mine.py", "does not run", "ValueError: first second"],
    ),
    "effect file without effects": (SHOW, {"mine.py": "x = 1\n"}, ["mine.py", "defines no effect"]),
    "effect with crossed bounds": (
        SHOW,
        {"mine.py": "from lunar_mjx.effects import Parameter\nParameter(5.0, None, (0.0, 1.0), '1', 'a', 'b')\n"},
        ["nominal = 5.0", "outside the bounds"],
    ),
    "figure unknown": (["figures", "--only", "9", "--out", "OUT"], {}, ["--only = '9'", "3", "5", "slope"]),
    "figures on an unknown device": (["figures", "--device", "tpu", "--out", "OUT"], {}, ["--device = 'tpu'"]),
    "demo on an unknown device": (["demo", "--device", "tpu", "--out", "OUT"], {}, ["--device = 'tpu'"]),
    "port that is no number": (["view", "--port", "abc"], {}, ["view: --port = 'abc' is not a whole number"]),
    "duration that is no number": ([*LUVMI, "--duration=long"], {}, ["--duration = 'long' is not a number"]),
    "duration with an underscore": ([*LUVMI, "--duration=1_0"], {}, ["--duration = '1_0' is not a number"]),
    "seed of twenty digits": (
        ["terrain", "info", "lunar_plain", "--seed", "9" * 20],
        {},
        ["--seed = '99999999999999999999' is above 4294967295"],
    ),
    "checkpoints never told": (["train", "point", "--checkpoint-every", "nan", "--out", "OUT"], {}, ["is no time"]),
    "time limit below zero": (["train", "point", "--time-limit", "-5", "--out", "OUT"], {}, ["give above 0"]),
    "target beyond one": (["train", "point", "--target", "2", "--out", "OUT"], {}, ["--target = 2.0 is out of range"]),
    "evaluations nowhen": (["train", "point", "--eval-every", "nan", "--out", "OUT"], {}, ["--eval-every = nan"]),
    "learning rate below zero": (
        ["train", "point", "--set", "actor_rate=-1", "--out", "OUT"],
        {},
        ["actor_rate = -1.0 is out of range; give above 0"],
    ),
    "discount beyond one": (["train", "point", "--set", "gamma=1.5", "--out", "OUT"], {}, ["gamma = 1.5", "1 at most"]),
    "layers without width": (["train", "point", "--set", "actor_layers=0", "--out", "OUT"], {}, ["actor_layers = 0"]),
    "pictures beyond the range": (["render", "OUT", "--fps", "99"], {}, ["render: --fps = '99' is above 60"]),
    "seed below the range": (["terrain", "info", "flat", "--seed", "-1"], {}, ["--seed = '-1' is below 0"]),
    "speed of no rover": ([*LUVMI, "--drive", "1e300"], {}, ["lf_drive_speed_rad_s = 1e+300", "-100 to 100"]),
    "steering beyond a turn": (
        [*LUVMI, "--steer", "1e10"],
        {},
        ["lf_steer_angle_rad = 10000000000.0", "less than once"],
    ),
    "motion of no rover": ([*LUVMI, "--cmd-vel", "1e300,0,0"], {}, ["--cmd-vel", "10 at most"]),
    "heading of no rover": ([*LUVMI, "--yaw-deg", "1e308"], {}, ["--yaw-deg = 1e+308", "36000 at most"]),
    "command of no rover in a table": (
        TABLE,
        {"commands.csv": csv(**{DRIVE: [0.1, 0.1, -1e9, 0.1]})},
        [f"{DRIVE} = -1000000000.0", "out of range"],
    ),
    "simulated preset without a name": ([*LUVMI, "--preset", ""], {}, ["preset = ''", "consistent, field, paper"]),
    "rover in bytes of another encoding": ([*LUVMI, "--rover", "a\udcffb"], {}, ["a\\udcffb", "luvmi_x"]),
    "rover that turns the text around": ([*LUVMI, "--rover", "a\u202eb"], {}, ["a\\u202eb", "luvmi_x"]),
    "drive into a name too long": ([*LUVMI[:-1], "x" * 5000], {}, ["x" * 150, "check the path"]),
    "URDF in an unknown encoding": (
        CONVERT,
        {"rover.urdf": '<?xml version="1.0" encoding="klingon"?>\n' + urdf("steered", "steered")},
        ["rover.urdf", "encoding"],
    ),
    "URDF with a wheel beyond all numbers": (
        CONVERT,
        {"rover.urdf": urdf('radius="0.12"', 'radius="1e300"')},
        ["rover.urdf", "is what the rover would come out with", "in m and kg"],
    ),
    "URDF with an arm of a light year": (
        CONVERT,
        {"rover.urdf": urdf('xyz="0 0 -0.05" rpy="-1.570796 0 0"', 'xyz="0 1e16 -0.05" rpy="-1.570796 0 0"', 1)},
        ["rover.urdf", "link 'FrontLeftWheel' position", "more than 1000 m from the base"],
    ),
    "URDF with a wheel askew": (
        CONVERT,
        {
            "rover.urdf": urdf(
                '<child link="BackRightWheel"/>\n    <axis xyz="0 0 1"/>',
                '<child link="BackRightWheel"/>\n    <axis xyz="0 -1 1"/>',
            )
        },
        ["rover.urdf", "have none on the other side of BackLeftWheel", "name the wheels in the description"],
    ),
    "terrain without end": (
        ["terrain", "info", "FILES/t.toml"],
        {"t.toml": "[surface]\nwidth = 1e308\nheight = 8.0\ncell = 0.5\n"},
        ["width = 1e+308", "is more than 50000000 cells"],
    ),
    "height beyond all numbers": (
        ["terrain", "info", "FILES/a.asc"],
        {"a.asc": "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n1e400 3\n"},
        ["a.asc", "heights = 'inf' is not finite"],
    ),
    "URDF nested too deep": (CONVERT, {"rover.urdf": "<a>" * 20_000}, ["rover.urdf"]),
    "URDF whose name breaks the line": (
        CONVERT,
        {"rover.urdf": urdf('<robot name="steered">', '<robot name="a&#10;b">')},
        ["rover.urdf", "name"],
    ),
    "grid of endless columns": (
        ["terrain", "info", "FILES/a.asc"],
        {"a.asc": "ncols inf\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n3 4\n"},
        ["a.asc", "ncols", "inf"],
    ),
    "grid with two widths": (
        ["terrain", "info", "FILES/a.asc"],
        {"a.asc": "ncols 2\nncols 3\nnrows 1\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3\n"},
        ["a.asc", "ncols", "twice"],
    ),
    "grid nowhere": (
        ["terrain", "info", "FILES/a.asc"],
        {"a.asc": "ncols 2\nnrows 2\nxllcorner 1e300\nyllcorner 0\ncellsize 1\n1 2\n3 4\n"},
        ["a.asc", "xllcorner = '1e300'", "out of range"],
    ),
    "grid at no number": (
        ["terrain", "info", "FILES/a.asc"],
        {"a.asc": "ncols 2\nnrows 2\nxllcorner 0\nyllcorner nan\ncellsize 1\n1 2\n3 4\n"},
        ["a.asc", "yllcorner = 'nan'", "not finite"],
    ),
    "rover of 1e30 kg": (
        CONVERT,
        {"rover.urdf": re.sub(r'<mass value="[\d.]+"/>', '<mass value="1e30"/>', urdf("steered", "steered"))},
        ["mass", "above 100000 kg"],
    ),
    "log to look at without a run": (["view", "--web", "--log", "x"], {}, ["--log = 'x'", "--replay RUN"]),
    "engines that are none": (["parity", "--engines", ", ,", "--out", "OUT"], {}, ["--engines", "names no engine"]),
    "model with a key of 40 kB": (MODEL, {"model.toml": toml("k" * 40_000 + " = 1")}, ["model.toml"]),
    "model nested too deep": (MODEL, {"model.toml": toml("a = " + "[" * 3000)}, ["model.toml"]),
    "model with a number of 5000 digits": (MODEL, {"model.toml": toml("gravity_m_s2 = " + "9" * 5000)}, ["model.toml"]),
    "drive into nothing": ([*LUVMI[:-1], ""], {}, ["--out = ''", "empty; name a path"]),
    "mesh into nothing": (["terrain", "export", "flat", ""], {}, ["empty; name a path"]),
    "effect file raises what is no Exception": (
        SHOW,
        {"mine.py": "class A(BaseException): pass\nraise A('x')\n"},
        ["mine.py", "does not run", "A: x"],
    ),
    "option nested too deep": (["evaluate", "zero", "--env", "x=" + "[" * 3000], {}, ["x"]),
    "episodes without number": (["evaluate", "zero", "--episodes", "9" * 11], {}, ["--episodes", "above 1000000"]),
    "discrepancy below zero": ([*TABLE_RUN, "--discrepancy", "drawbar_pull=-1"], STEADY, ["drawbar_pull = -1", "0 or"]),
    "discrepancy without end": (
        [*TABLE_RUN, "--discrepancy", "drawbar_pull=1e300"],
        STEADY,
        ["drawbar_pull", "1e+09 at"],
    ),
    "discrepancy with an underscore": ([*TABLE_RUN, "--discrepancy", "drawbar_pull=1_0"], STEADY, ["is not a number"]),
    "run into its own log": (["compare", "FILES/bed", "--out", "FILES/bed/run"], STEADY, ["--out", "lies in the log"]),
    "discrepancy of nothing": ([*TABLE_RUN, "--discrepancy", "lift=1"], STEADY, ["'lift'", "drawbar_pull"]),
    "odds below zero": ([*TABLE_RUN, "--setting", "effect_odds=-1"], STEADY, ["effect_odds", "give above 0"]),
    "prior where none is read": ([*TABLE_RUN, "--prior", "soil.n=1+-0.1"], STEADY, ["--prior", "imposed wheel"]),
    "value held where none is read": ([*TABLE_RUN, "--fix", "soil.n=1"], STEADY, ["--fix", "imposed wheel speeds"]),
    "audit of no time": (["why", "OUT", "--audit", "nan"], {}, ["--audit = 'nan'", "below 0"]),
    "noise of a table": (["log", "noise", "FILES/bed"], STEADY, ["hold no drive", "logs of drives"]),
    "time constant below zero": (
        ["log", "check", "FILES/bed", "--slowest", "heat=-1"],
        STEADY,
        ["--slowest heat = -1", "give above 0"],
    ),
    "time constant of nothing": (
        ["log", "check", "FILES/bed", "--slowest", "nope=5"],
        STEADY,
        ["--slowest = 'nope=5'", "names no effect", "effect list"],
    ),
    "probability beyond one": ([*TABLE_RUN, "--setting", "sure=2"], STEADY, ["sure = 2", "1 at most"]),
    "share beyond one": ([*TABLE_RUN, "--setting", "mode_share=1.5"], STEADY, ["mode_share = 1.5", "1 at most"]),
    "setting twice": (
        [*TABLE_RUN, "--setting", "sure=0.9", "--setting", "sure=0.8"],
        STEADY,
        ["--setting = 'sure=0.8'", "gives sure twice"],
    ),
    "split twice": (
        [*TABLE_RUN, "--split", "bed=fit", "--split", "bed=test"],
        STEADY,
        ["--split = 'bed=test'", "gives bed twice"],
    ),
    "list of another length": ([*TABLE_RUN, "--setting", "shape_shares=0.3"], STEADY, ["shape_shares", "length"]),
    "size of nothing": ([*TABLE_RUN, "--setting", "usual_discrepancy=0"], STEADY, ["usual_discrepancy", "above 0"]),
    "size without end": ([*TABLE_RUN, "--setting", "usual_discrepancy=1e300"], STEADY, ["usual_discrepancy", "1e+06"]),
    "length of nothing": ([*TABLE_RUN, "--setting", "slip_length=0"], STEADY, ["slip_length", "above 0"]),
    "motion of no numbers": ([*LUVMI, "--cmd-vel", ""], {}, ["--cmd-vel = ''", "not three numbers"]),
    "simulated without gravity": ([*LUVMI, "--gravity", "0"], {}, ["--gravity = 0.0", "give 0.1 to 29 m/s2"]),
    "plot of a file": (["plot", "OUT/model.toml"], {}, ["RUN", "model.toml", "is not a folder"]),
    "video of a file": (["render", "OUT/model.toml"], {}, ["RUN", "model.toml", "is not a folder"]),
    "count below zero": ([*TABLE_RUN, "--setting", "most_refits=-1"], STEADY, ["most_refits = -1", "give 0 or more"]),
    "size in a list below zero": (
        [*TABLE_RUN, "--setting", "shape_shares=0.3,0.3,-0.4"],
        STEADY,
        ["shape_shares = -0.4", "give 0 or more"],
    ),
    "environments beyond the memory": (
        ["train", "point", "--set", "envs=1000000000", "--out", "OUT"],
        {},
        ["envs, buffer_steps, batch = '1000000000, 1000, 256'", "GB at least", "keep fewer steps"],
    ),
    "buffer beyond all counts": (
        ["train", "point", "--set", "buffer_steps=1000000000000", "--out", "OUT"],
        {},
        ["buffer_steps = 1000000000000", "give 1 or more"],
    ),
    "grid higher than any mountain": (
        ["terrain", "info", "FILES/a.asc"],
        {"a.asc": "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n88888 3\n"},
        ["a.asc", "heights = '1 to 88888 m'", "more than 35 km"],
    ),
    "animation of no kind": (
        ["report", "OUT", "--out", "OUT/report.html", "--animation", "OUT/x.bmp"],
        {},
        ["x.bmp", "no known kind", ".webp"],
    ),
    "distance of no range": (
        ["evaluate", "zero", "--task", "large", "--env", "goal_distance=nan"],
        {},
        ["goal_distance = 'nan'", "is not a range"],
    ),
    "weights without names": ([*ZERO, "weights=5"], {}, ["weights = 5", "are no weights by name"]),
    "ranges that are none": ([*ZERO, 'randomise=["x"]'], {}, ["randomise = ('x',)", "are no ranges"]),
    "tally of five": ([*ZERO, "tally=5"], {}, ["tally = 5", "neither true nor false"]),
    "terrain of nothing": ([*ZERO, "terrain=[]"], {}, ["spec = () is no terrain"]),
    "processes below one": (
        ["train", "point", "--processes", "0", "--out", "OUT"],
        {},
        ["--processes = '0' is below 1"],
    ),
    "seed by halves": ([*ZERO, "place_seed=1.5"], {}, ["place_seed = 1.5", "is not a whole number"]),
    "steps by halves": (TRAINING, {"t.toml": POINT.replace("10", "1.5")}, ["t.toml", "steps = 1.5", "no whole number"]),
    "unseen ground of an unknown key": (
        TRAINING,
        {"t.toml": f"{POINT}[unseen]\nfoo = 1\n"},
        ["unseen.foo = 1", "unknown"],
    ),
    "steps of thirty digits": (["train", "point", "--steps", "9" * 30, "--out", "OUT"], {}, ["--steps", "is above 1"]),
    "setting with an underscore": (
        ["train", "point", "--set", "envs=1_0", "--out", "OUT"],
        {},
        ["envs = '1_0'", "not like"],
    ),
    "episode of yes": (
        ["train", "point", "--env", "episode_steps=true", "--out", "OUT"],
        {},
        ["= True", "no whole number"],
    ),
    "Sun in no direction": (["view", "--web", "--sun", "1e300,5"], {}, ["--sun = 1e+300", "360 at most"]),
    "Sun with an underscore": (["view", "--web", "--sun", "1_0,5"], {}, ["--sun = '1_0,5'", "not two numbers"]),
    "top speed of no rover": (
        ["view", "--web", "--rover", "luvmi_x", "--terrain", "flat", "--port", "0", "--speed", "1e300"],
        {},
        ["--speed = 1e+300", "no speed of a rover"],
    ),
    "bed with a wheel of a planet": ([*BED, "--radius", "1e9"], {}, ["radius = 1000000000.0", "5 at most"]),
    "bed under a planet": ([*BED, "--loads", "1e300"], {}, ["--loads are positive, 100000 N at most"]),
    "bed without a way": ([*BED, "--path", "1e-9"], {}, ["path = 1e-09", "give 0.01 or more"]),
    "grid with an underscore": (
        ["terrain", "info", "FILES/a.asc"],
        {"a.asc": "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n1_0 3\n"},
        ["a.asc", "underscore"],
    ),
    "grid of no spacing": (
        ["terrain", "info", "FILES/a.asc"],
        {"a.asc": "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1e-300\n1 2\n10 3\n"},
        ["a.asc", "= 1e-300", "no spacing"],
    ),
    "model in a centrifuge": (
        MODEL,
        {"model.toml": toml("gravity_m_s2 = 1e9")},
        ["gravity_m_s2 = 1000000000.0", "above 100"],
    ),
    "log in a split of no name": ([*RECORDED, "--split", "x"], {}, ["--split = 'x'", "fit, select, test"]),
    "bias of no channel": ([*RECORDED, "--bias", "foo=1"], {}, ["--bias = 'foo'", "is no channel"]),
    "bias with an underscore": ([*RECORDED, "--bias", "gyro_z_rad_s=1_0"], {}, ["--bias", "is not name=number"]),
    "noise with an underscore": ([*RECORDED, "--noise", "scale:1_0"], {}, ["--noise = 'scale:1_0'", "is unknown"]),
    "bias beyond the channel": (
        ["log", "simulate", "OUT/log", "--rover", "luvmi_x", "--bias", "gyro_z_rad_s=1e300"],
        {},
        ["bias gyro_z_rad_s = 1e+300", "40 at most"],
    ),
    "option without its value": (["figures", "--only"], {}, ["--only", "requires an argument", "--help"]),
    "option unknown": (["view", "--prot", "3"], {}, ["--prot", "--port", "see lunar-mjx view --help"]),
    "command unknown": (["figurs"], {}, ["'figurs'", "lunar-mjx --help"]),
    "command of a group unknown": (["terrain", "look"], {}, ["terrain: no such command 'look'"]),
    "argument missing": (["plot"], {}, ["plot: missing argument", "lunar-mjx plot --help"]),
    "argument too many": (["plot", "a", "b"], {}, ["(b)", "lunar-mjx plot --help"]),
    "option missing": (CONVERT[:2], {}, ["missing option '--out'"]),
    "demo into a file": (["demo", "--out", "OUT/kept.txt"], {}, ["--out", "kept.txt", "not a folder"]),
    "figures into a file": (["figures", "--out", "OUT/kept.txt"], {}, ["--out", "kept.txt", "not a folder"]),
    "drive into a file": ([*LUVMI[:-1], "OUT/kept.txt"], {}, ["--out", "kept.txt", "not a folder"]),
    "drive into a folder in a file": ([*LUVMI[:-1], "OUT/kept.txt/a/b"], {}, ["--out", "kept.txt is a file"]),
    "convert into a file": (
        [*CONVERT[:-1], "OUT/kept.txt"],
        {"rover.urdf": urdf("steered", "steered")},
        ["--out", "kept.txt", "not a folder"],
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake(mistake: str, run: Run, tmp_path: Path) -> None:
    arguments, files, words = MISTAKES[mistake]
    given, out = tmp_path / "given", tmp_path / "out"
    given.mkdir()
    for name, content in files.items():
        (given / name).parent.mkdir(exist_ok=True)
        if isinstance(content, Image.Image):
            content.save(given / name)
        elif isinstance(content, bytes):
            (given / name).write_bytes(content)
        else:
            (given / name).write_text(str(content))
    kept = {"kept.txt": b"kept", "drive.csv": b"time_s\n", "model.toml": b"# mine\n", "rover.toml": b"# mine\n"}
    out.mkdir()
    for name, content in kept.items():
        (out / name).write_bytes(content)
    result = run(*(a.replace("FILES", str(given)).replace("OUT", str(out)) for a in arguments))
    assert_one_sentence(result, words)
    assert not result.out
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == kept, "bad input loses nothing"


def assert_one_sentence(result: Result, words: list[str]) -> None:
    assert result.status == 2, result
    assert len(result.err) < 1500, "a sentence, not a page"
    assert result.err.startswith("lunar-mjx: ") and result.err.endswith("\n") and result.err.count("\n") == 1, (
        result.err
    )
    assert "Traceback" not in result.err
    for word in words:
        assert word in result.err, result.err


def test_nothing_is_made_for_a_refused_drive(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    result = run("simulate", "--rover", "luvmi_x", "--terrain", "flat", "--duration", "-1", "--out", out)
    assert result.status == 2 and not (tmp_path / "a").exists()


def has_cuda() -> bool:
    import jax

    try:
        return bool(jax.devices("cuda"))
    except RuntimeError:
        return False


def test_cuda_asked_for_and_absent(tmp_path: Path) -> None:
    """In a process of its own, for JAX to look for devices anew."""
    if has_cuda():
        pytest.skip("this machine has CUDA")
    done = subprocess_run(MAIN, "simulate", "--device", "cuda", "--out", tmp_path / "out")
    words = ["--device = 'cuda'", "no CUDA device", "lunar-mjx[gpu]", "--device cpu"]
    assert_one_sentence(Result(done.returncode, done.stdout, done.stderr), words)
    assert not (tmp_path / "out").exists()


def test_a_mistake_in_a_process_of_its_own(tmp_path: Path) -> None:
    done = subprocess_run(MAIN, "simulate", "--terrain", "sea", "--out", tmp_path / "out")
    assert_one_sentence(Result(done.returncode, done.stdout, done.stderr), ["sea", "lunar_plain"])
    assert not done.stdout, "not even what MJX prints when it is imported"


def test_interrupted(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    # A process started in the background inherits a SIGINT that is ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(cli, "select_device", interrupt)
    try:
        assert run("simulate", "--rover", "luvmi_x") == (130, "", "lunar-mjx: interrupted\n")
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_full_disk_is_told(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", "runs/drive.csv")

    monkeypatch.setattr(cli, "select_device", full)
    assert_one_sentence(run("demo"), ["runs/drive.csv: No space left on device"])


def test_our_own_mistakes_keep_their_traceback(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(cli, "select_device", broken)
    with pytest.raises(ZeroDivisionError):
        run("demo")


def test_only_the_two_notices_are_held_back(capsys: pytest.CaptureFixture[str]) -> None:
    from lunar_mjx._quiet import without_warp_notices

    with without_warp_notices():
        print("Failed to import warp: No module named 'warp'")
        print("Failed to import something else")
        print("Failed to import mujoco_warp: No module named 'warp'")
    assert capsys.readouterr().out == "Failed to import something else\n"
    with pytest.raises(KeyError), without_warp_notices():
        print("told before the error")
        raise KeyError
    assert capsys.readouterr().out == "told before the error\n"
