# %% [markdown]
# # Your rover's log, from CSV to the missing effect
#
# A Clearpath Husky was driven by hand over a hard floor and over sandy loam, and wrote CSV files: currents and wheel
# speeds of each side at 6.5 Hz, an IMU at 100 Hz. Nobody recorded commands or a pose. This tutorial takes two of these
# recordings as they were published (BorealTC, CC0), and asks what a model of the hard floor lacks on the sand. The
# same steps serve your own rover; what differs is one small file, the *map*.
#
# `lunar-mjx log example raw` puts the recordings there, as a logger would have left them.

# %%
from pathlib import Path

from lunar_mjx.logs.example import copy_example

for file in sorted(copy_example("raw").iterdir()):
    first = file.read_text().splitlines()[0]
    print(f"{file.name:15} {first[:60] if file.suffix == '.csv' else ''}")

# %% [markdown]
# ## From CSV to a log
#
# A map says which column is which channel, in which unit, and what cannot be read off the numbers. The Husky's ships
# by name (`husky_borealtc`); yours is a file beside your data. `lunar-mjx log channels` lists all channels' names.

# %%
from lunar_mjx.logs.readers.import_map import SHIPPED

print((SHIPPED / "husky_borealtc.toml").read_text())

# %% [markdown]
# Three lines carry the weight. `imposed = "wheel_speed"`: the wheel speeds were measured, so the simulated wheels will
# turn as the real ones did. `magnitudes`: the currents have no sign, and show 0.6 A where nothing flows.
# `clock_offset_std_s`: the two files' clocks do not start together. Import it (`lunar-mjx log import raw --map
# husky_borealtc -o logs`) and let the gate look at it (`lunar-mjx log check logs/*`).

# %%
from lunar_mjx.criticism import check, read_campaign
from lunar_mjx.logs.readers.import_log import import_drives

imported = import_drives("raw", "logs", "husky_borealtc")
for folder, seconds in zip(imported.logs, imported.seconds, strict=True):
    print(f"{folder}: {seconds:.0f} s")
print("findings:", [f.message for f in check(read_campaign(["logs"])) if f.severity == "bad_data"])

# %% [markdown]
# ## The model learns the hard floor
#
# Your rover needs a folder of its own: a URDF and a short description of its motors, through `lunar-mjx convert`
# ([own rover](own_rover.md)). The Husky's ships. `lunar-mjx compare logs/floor -o floor` begins with a hard, level
# floor and the data sheet; then it fits friction, efficiency and instruments, each with a prior. The drive is cut into
# windows of two seconds, each begun at what was measured, so that drift cannot drown the physics.

# %%
from lunar_mjx.criticism import compare
from lunar_mjx.model.hard_floor import hard_floor

floor = compare(["logs/floor"], hard_floor("husky"), "floor")
found = floor.load("comparison.json")
print({k: {s: round(v, 2) for s, v in found[k].items()} for k in ("as_given", "refitted")})
print("these logs hardly tell:", ", ".join(found["not_told"]))

# %% [markdown]
# Errors are in standard deviations of the noise, which is learnt from the drive. The last line comes before anything
# is named: what a short drive on one floor cannot tell. What it did tell is in `floor/fitted.toml`, as values and as
# priors for the next drive.
#
# ## On sand
#
# `lunar-mjx compare logs/sand --model floor/fitted.toml -o sand`

# %%
from lunar_mjx.model.file import load_model

sand = compare(["logs/sand"], load_model("floor/fitted.toml"), "sand")
found = sand.load("comparison.json")
print({k: {s: round(v, 2) for s, v in found[k].items()} for k in ("as_given", "refitted")})
for row in found["by_channel"]:
    print(f"{row['split']:5} {row['channel']:30} {row['as_given_si']:.2f} -> {row['refitted_si']:.2f} {row['unit']}")

# %% [markdown]
# ## What is missing?
#
# `lunar-mjx why sand --seconds 300` weighs effects, parameters and instruments in one list: a soft ground, more
# friction in the gears, a heavier load, a current sensor that is off, a clock that is late. (Here it is asked about
# five of them, to save time; leave `only` out to ask about all.)

# %%
from lunar_mjx.criticism import why

listed = ["soft_ground", "coulomb_friction.torque", "payload", "hard_ground.mu", "calibration.current_scale"]
diagnosis = why("sand", only=listed, seconds=900.0)
print(diagnosis.verdict.label, *diagnosis.effects)
print(diagnosis.sentence)
for name, chance in list(diagnosis.probabilities.items())[:6]:
    print(f"{chance:6.1%}  {name}")

# %% [markdown]
# Twenty seconds of driving rarely suffice for one name, and a wrong name would be worse than none; the list says what
# is still open. (The whole data set has minutes of every ground: [real drives](../real_drives.md).) What happens if
# soft ground takes the hard floor's place? `lunar-mjx add sand soft_ground -o soft`

# %%
from lunar_mjx.criticism import add

soft = add("sand", "soft_ground", "soft")
before, after = (run.load("comparison.json") for run in (sand, soft))
for split in after["refitted"]:
    print(f"{split:8} {before['refitted'][split]:.2f} -> {after['refitted'][split]:.2f} standard deviations")
print("certificate:", "; ".join(after["certificate"]["problems"]) or "complete")
assert after["refitted"]["fit"] < before["as_given"]["fit"]

# %% [markdown]
# The error falls a little, on the windows that were held out as well. The certificate would say so if an error rose or
# nothing moved. It says that the stiffness ended at a bound: twenty seconds do not tell it.
# The current of the left motor, measured and by both models:

# %%
import numpy as np
from matplotlib.figure import Figure


def current(folder):
    with np.load(Path(folder) / "series.npz") as data:
        at = list(data["series_channel"]).index("motor_left_drive_current_A")
        part = slice(data["series_start"][at], [*data["series_start"][1:], None][at])
        row = list(data["labels"]).index("refitted")
        return data["time"][part], data["measured"][part], data["predicted"][row][part]


def picture(time, measured, **models):
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(time, measured, ".", color="black", markersize=3, label="measured")
    for (name, values), (colour, line) in zip(models.items(), (("#E69F00", "--"), ("#0072B2", "-")), strict=True):
        axes.plot(time, values, line, color=colour, label=name.replace("_", " "))
    axes.set_xlabel("time, s")
    axes.set_ylabel("current of the left motor, A")
    axes.legend(frameon=False)
    return figure


picture(*current("sand")[:2], hard_floor=current("sand")[2], soft_ground=current("soft")[2])

# %% [markdown]
# `lunar-mjx report sand soft -o report.html` puts the steps on one page. With your own rover, drive slopes, turns and
# several speeds, on the ground you know first: what the rover is must be known before what the ground is can be told.

# %%
from lunar_mjx.criticism import report

page = report(["sand", "soft"], "report.html")
print(f"{page.name}: {page.stat().st_size / 1e6:.1f} MB")
