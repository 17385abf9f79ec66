# %% [markdown]
# # Drive a rover
#
# A model is a rover, a terrain and a list of physical effects. `make_model` takes the corrected physics, preset
# `consistent`, unless told otherwise. (Commands such as `lunar-mjx simulate` take `field`, with
# all that a drive outdoors needs.)

# %%
from lunar_mjx.model import make_model

model = make_model("luvmi_x", terrain="slope:6deg")
print(f"{model.rover.name}: {model.rover.mass:g} kg, {len(model.rover.joints)} motors")
print(", ".join(model.effect_names))

# %% [markdown]
# Commands are targets of all actuated joints over time. The drives take rad/s, the steering rad: four seconds
# straight up the slope, with the front wheels turned to the left at the end.

# %%
from lunar_mjx.simulate import Commands, channels, constant_commands, front_steering, simulate

straight = constant_commands(model, 4.0, drive=1.5)
turned = front_steering(model, straight, 0.3)
half = len(straight.values) // 2
values = straight.values.copy()
values[half:] = turned.values[half:]
commands = Commands(values, straight.interval)
system, seen = simulate(model, commands)

# %% [markdown]
# `seen` is telemetry with time first: wheels slip and sink, and the windings warm.

# %%
climb = float(seen.position.x[-1] - seen.position.x[0])
print(f"{climb:.3f} m in {seen.time[-1]:.2f} s; without slip it would be {1.5 * 0.1 * seen.time[-1]:.3f} m")
print(f"slip {seen.slip[half].mean():.2f}, sinkage {1e3 * seen.sinkage[half].max():.1f} mm")
assert 0.1 < climb < 1.5 * 0.1 * seen.time[-1]

# %% [markdown]
# As a table of log channels, with the unit in every name, and saved as `lunar-mjx simulate` would save it:

# %%
from pathlib import Path

from lunar_mjx.model.file import save_model

table = channels(system, seen, commands)
Path("climb").mkdir()
table.to_csv("climb/drive.csv", index=False)
save_model(model, "climb/model.toml")
shown = ["time_s", "position_x_m", "wheel_lf_slip_ratio", "winding_lf_drive_temperature_degC"]
print(table[shown].iloc[::20].round(4).to_string(index=False))

# %% [markdown]
# `lunar-mjx plot climb` makes this picture, and `lunar-mjx render climb -o climb.mp4` a video.

# %%
from lunar_mjx.visual.plots import drive_summary
from lunar_mjx.visual.recorded import read_drive

drive_summary(read_drive("climb"))
