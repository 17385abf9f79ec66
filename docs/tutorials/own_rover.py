# %% [markdown]
# # Your own rover from URDF
#
# `lunar-mjx convert my_rover.urdf -o my_rover/` turns the URDF of a wheeled rover into MJCF. Here a small
# skid-steered rover is written down by hand: a box, and four wheels on continuous joints.

# %%
from pathlib import Path


def wheel(name: str, x: float, y: float) -> str:
    return f"""
  <link name="{name}_wheel">
    <inertial><mass value="0.8"/><inertia ixx="0.003" iyy="0.005" izz="0.003" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin rpy="1.5707963 0 0"/><geometry><cylinder radius="0.09" length="0.07"/></geometry></collision>
  </link>
  <joint name="{name}_drive" type="continuous">
    <parent link="body"/><child link="{name}_wheel"/><origin xyz="{x} {y} 0"/><axis xyz="0 1 0"/>
  </joint>"""


corners = {"lf": (0.22, 0.2), "rf": (0.22, -0.2), "lr": (-0.22, 0.2), "rr": (-0.22, -0.2)}
_ = Path("scout.urdf").write_text(
    """<robot name="scout">
  <link name="body">
    <inertial><mass value="14"/><inertia ixx="0.3" iyy="0.5" izz="0.6" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.1"/><geometry><box size="0.5 0.28 0.14"/></geometry></collision>
  </link>"""
    + "".join(wheel(name, *place) for name, place in corners.items())
    + "\n</robot>\n"
)

# %% [markdown]
# The converter finds the wheels by themselves and says what it assumed. Motors, springs and loops that a URDF cannot
# express go into `scout.rover.toml` beside it. Here the gear and the winding of a maxon ECX TORQUE 22 XL are enough;
# `torque_constant_Nm_A`, `resistance_ohm` and `current_limit_A` describe another motor. State what a current is worth
# (torque constant and gear) if logs with currents are to be read: what is left out is assumed, and told as a note.

# %%
from lunar_mjx.rover import convert, load_rover

_ = Path("scout.rover.toml").write_text(
    '[joints.drive]\nmode = "velocity"\nvelocity_gain = 8.0\ngear_ratio = 111.0\nwinding = 48\n'
)
convert("scout.urdf", "scout")
rover = load_rover("scout")
print(f"{rover.name}: {rover.mass:g} kg, wheels {[w.corner for w in rover.wheels]}, radius {rover.wheels[0].radius} m")
for note in rover.notes:
    print("note:", note)
assert rover.mass == 14 + 4 * 0.8 and len(rover.joints) == 4

# %% [markdown]
# Each wheel has a motor of its own. Where one motor drives all wheels of a side through chains, say so, and give the
# sides' motors in `[joints.drive]` (Husky: `models/husky/husky.rover.toml`):
#
# ```toml
# gravity = 9.81          # m/s2; the Moon's if left out
# [[drive_groups]]
# name = "left"
# wheels = ["lf", "lr"]   # of six wheels ["lf", "lm", "lr"]
# [[drive_groups]]
# name = "right"
# wheels = ["rf", "rr"]
# ```
#
# It runs on every engine. The reference engine, native MuJoCo in float64, needs no compilation: the right wheels faster
# than the left turn the rover to the left.

# %%
import numpy as np

from lunar_mjx.backends.native import NativeBackend
from lunar_mjx.model import make_model
from lunar_mjx.simulate import Commands, constant_commands

model = make_model("scout", "flat")
commands = constant_commands(model, 3.0, drive=1.5)
right = [name.startswith("r") for name in model.rover.joints]
backend = NativeBackend(model)
seen = backend.run(Commands(commands.values + 1.0 * np.array(right), commands.interval))
yaw = np.degrees(seen.euler.z[0, -1])
print(f"{np.hypot(seen.position.x[0, -1], seen.position.y[0, -1]):.2f} m, turned {yaw:.1f} deg to the left")
assert yaw > 1.0

# %% [markdown]
# `lunar-mjx simulate --rover scout` drives it on MJX.
