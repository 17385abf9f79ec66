# %% [markdown]
# # Your own terrain from a DEM
#
# A DEM comes as GeoTIFF, PDS, PNG, npy or ESRI ASCII. Here a small one is made by hand: a crater 12 m wide with a rim,
# on a 1 m grid, as an ESRI ASCII file.

# %%
from pathlib import Path

import numpy as np

at = np.arange(-20.0, 21.0)
x, y = np.meshgrid(at, at[::-1])  # the first row of such a file is the northernmost
r = np.hypot(x - 4.0, y) / 6.0
heights = np.where(r < 1.0, -1.2 * (1.0 - r**2), 0.0) + 0.25 * np.exp(-(((r - 1.0) / 0.2) ** 2)) + 0.03 * x
header = f"ncols {len(at)}\nnrows {len(at)}\nxllcorner -20.5\nyllcorner -20.5\ncellsize 1\nNODATA_value -9999\n"
Path("crater").mkdir()
_ = Path("crater/dem.asc").write_text(header + "\n".join(" ".join(f"{v:.4f}" for v in row) for row in heights) + "\n")

# %% [markdown]
# `terrain.toml` says what to do with it: refine it to 0.25 m with roughness that leaves the DEM's means as they are,
# and strew rocks. Heights then count from the ground in the middle, rounded to whole metres.

# %%
_ = Path("crater/terrain.toml").write_text(
    """
description = "A crater made by hand"
seed = 2

[dem]
file = "dem.asc"

[detail]
cell = 0.25
[detail.roughness]
deviation = 0.01

[rocks]
abundance = 0.02
"""
)

# %%
from lunar_mjx.terrain import load_terrain, sample, slope

terrain = load_terrain("crater")
bottom = float(sample(terrain.field, 4.0, 0.0)[0])
print(f"{terrain.field.heights.shape} nodes, {int((terrain.rocks.radii > 0).sum())} rocks")
print(f"bottom {float(sample(terrain.field, -6.0, 0.0)[0]) - bottom:.2f} m below the plain")
assert bottom < float(sample(terrain.field, -6.0, 0.0)[0]) - 0.5

# %% [markdown]
# `lunar-mjx terrain preview crater` draws the same picture.

# %%
from lunar_mjx.visual.plots import terrain_preview

terrain_preview(terrain)

# %% [markdown]
# What a rover on the rim would see of the heights around it, as a picture of 7 x 5 heights in metres over its chassis:
# far ahead first, left to right. It works for thousands of rovers at once, inside `jit`.

# %%
import jax.numpy as jnp

from lunar_mjx.cameras import height_scan

position = jnp.array([-2.5, 0.0, float(sample(terrain.field, -2.5, 0.0)[0])])
scan = height_scan(terrain, position, jnp.array(0.0), (7, 5), ahead=(0.0, 6.0), aside=2.0)
np.asarray(scan).round(2)

# %% [markdown]
# Any model takes the terrain: `lunar-mjx simulate --terrain crater`, or

# %%
from lunar_mjx.model import make_model

model = make_model("viper", terrain)
print(f"steepest under the start: {np.degrees(float(slope(model.terrain.field, 0.0, 0.0))):.1f} deg")
