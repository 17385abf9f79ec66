# %% [markdown]
# # Learn from what the cameras see
#
# Every rover of a batch can carry a camera. Colour, depth and labels come from pure JAX functions as the physics does,
# without OpenGL. They show the ground, rocks, shadows and rovers that the physics knows. This tutorial looks
# through four front cameras, gives a task the depth image as its observation, and trains on it. The numbers are tiny,
# so that two CPU cores manage; on a GPU the same lines see thousands of rovers at once.

# %%
import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.cameras import LABELS, Light, Pinhole, Sun, pictures
from lunar_mjx.dynamics import build
from lunar_mjx.model import make_model

model = make_model("luvmi_x", "lunar_plain")
system = build(model)
places = [(11.0, -7.0, -1.4), (16.0, -9.0, 3.14), (-1.0, 10.0, 1.2), (5.0, -26.0, -0.9)]  # x, y in m, yaw in rad
qpos = jnp.stack([system.reset(system.params, *place).qpos for place in places])

# %% [markdown]
# `pictures` takes the ground, a rover and the coordinates of all rovers. Light comes from a Sun 8 degrees high.

# %%
eye = Pinhole(160, 120)
look = jax.jit(lambda terrain, q: pictures(terrain, model.rover, q, eye, light=Light(sun=Sun(200.0, 8.0))))
seen = jax.device_get(look(model.terrain, qpos))
print("colour, depth, labels:", seen.rgb.shape, seen.depth.shape, seen.label.shape)
for i, name in enumerate(LABELS):
    print(f"{name:8} {100 * (seen.label == i).mean():5.1f} % of the pixels")
assert np.isfinite(seen.depth[seen.label > 0]).all() and np.isinf(seen.depth[seen.label == 0]).all()

# %%
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from lunar_mjx.report.style import HEIGHTS_DOWN


def shown(seen):
    figure = Figure(figsize=(9, 3.9), layout="constrained")
    panels = figure.subplots(2, len(seen.rgb))
    for i, (above, below) in enumerate(panels.T):
        above.imshow(seen.rgb[i])
        above.set_title(f"rover {i}: colour")
        image = below.imshow(seen.depth[i], cmap=HEIGHTS_DOWN, norm=LogNorm(0.5, 50.0))
        below.set_title(f"rover {i}: distance")
    for axes in panels.ravel():
        axes.set_axis_off()
    figure.colorbar(image, ax=panels[1], ticks=(0.5, 5, 50), format="%g m")
    return figure


shown(seen)

# %% [markdown]
# ## The picture as an observation
#
# The navigation task takes `camera/depth`, `camera/rgb` and `camera/labels` beside other observations. Here a rover
# on flat ground is told where its goal is, and sees a depth image of 16 x 12.

# %%
from lunar_mjx.envs import make, split_keys

options = {
    "task": "consistent",
    "observations": ("goal_body", "camera/depth"),
    "camera_width": 16,
    "camera_height": 12,
    "goal_distance": (3.0, 5.0),
}
env = make("navigation", terrain="flat", **options)
state = jax.jit(lambda key: env.reset(env.params, split_keys(key, 4)))(jax.random.PRNGKey(0))
print(f"{env.observation_size} observations, {16 * 12} of them of the picture; {env.action_size} actions")
assert 16 * 12 < env.observation_size < 16 * 12 + 10 and bool(jnp.isfinite(state.obs).all())

# %% [markdown]
# ## Train on it
#
# The command is the one of [Train TD3 on a GPU](train_td3.md), with the observations as options of the environment.

# %%
import subprocess
import sys


def shell(line):
    command = [sys.executable, "-m", "lunar_mjx.cli", *line.split()[1:]]  # lunar-mjx of this Python
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    print(done.stdout.strip())


shell(
    "lunar-mjx train short -o eyes --steps 800 --set envs=16 --eval-episodes 4 --quiet --device cpu "
    '--env observations=["goal_body","camera/depth"] --env camera_width=16 --env camera_height=12'
)

# %% [markdown]
# So few steps teach nothing, and the success rate says so: it shows that the whole way works, from light on the ground
# to an update of the weights. On a GPU leave `--steps` and `--set` out. Whether a picture helps depends on the ground:
# where there are rocks in the way, compare with the same training on `goal_body` alone, and with `height_scan`, which
# knows the ground better than any camera.

# %%
from lunar_mjx.agents.policy import load_policy

policy = load_policy("eyes/policy.npz")
print("the policy takes", policy.network["obs"], "numbers and gives", policy.network["actions"])
assert policy.network["obs"] == env.observation_size
