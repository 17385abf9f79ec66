# %% [markdown]
# # Train TD3 on a GPU
#
# Training is one command. On a GPU it drives thousands of rovers at once. Here the same code first learns a task so
# small that two CPU cores need seconds, so that every step can be seen. Then comes a rover, on a GPU the large task.
#
# The small task is a point without physics that has to reach a goal in the plane. It has the interface of the rovers:
# pure functions `reset` and `step` on a whole batch.

# %%
import jax

from lunar_mjx.envs import make, split_keys

env = make("point")
state = env.reset(env.params, split_keys(jax.random.PRNGKey(0), 3))
print(f"{env.observation_size} observations, {env.action_size} actions")
print("position and goal of three points, m:")
print(state.obs.round(2))

# %% [markdown]
# `lunar-mjx train point` trains it: 32 points act, and TD3 learns from their transitions. `--device cpu` keeps it off
# a GPU; without it the training takes whatever JAX sees.

# %%
import subprocess
import sys


def shell(line):
    command = [sys.executable, "-m", "lunar_mjx.cli", *line.split()[1:]]  # lunar-mjx of this Python
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    print(done.stdout.strip())


shell("lunar-mjx train point -o point --steps 48000 --quiet --device cpu")

# %% [markdown]
# The folder holds all there is to know: `progress.csv` (and `events/` for TensorBoard), `curve.png`, `checkpoints/`,
# and `policy.npz`, the weights with the options of their environment. Steps are counted over all points.

# %%
import pandas as pd

progress = pd.read_csv("point/progress.csv")
print(progress[["steps", "episode_return", "success"]].dropna().iloc[::2].round(2).to_string(index=False))
assert progress.success.iloc[-1] > 0.9

# %%
from matplotlib.figure import Figure


def curve(table):
    figure = Figure(figsize=(7, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(table.steps, table.episode_return)
    left.set(xlabel="environment steps", ylabel="return of ended episodes")
    right.plot(table.steps, 100 * table.success)
    right.set(xlabel="environment steps", ylabel="success in training, %", ylim=(-3, 103))
    return figure


curve(progress.dropna(subset=["episode_return"]))

# %% [markdown]
# In training the points explore, which costs successes. How good the policy is without that, over episodes that it
# has never seen, says

# %%
shell("lunar-mjx evaluate point/policy.npz --episodes 256 --device cpu")

# %% [markdown]
# A policy is a function of the observation, and needs nothing of the trainer:

# %%
from lunar_mjx.agents.policy import load_policy

policy = load_policy("point/policy.npz")
step, reached = jax.jit(env.step), {}
for count in range(1, 40):
    state = step(env.params, state, policy.act(state.obs))
    for i in state.terminated.nonzero()[0].tolist():
        reached.setdefault(i, round(count * env.control_interval, 1))
print("points 0, 1 and 2 reached their goals after", [reached[i] for i in range(3)], "s")

# %% [markdown]
# ## The same with rovers
#
# Nothing changes but the name of the training. `short` drives LUVMI-X on flat ground to goals 3 to 5 m away; whole, it
# takes minutes on two CPU cores. Here are the first 125 steps of 16 rovers, which learn next to nothing:

# %%
shell(
    "lunar-mjx train short -o rover --steps 2000 --set envs=16 --eval-episodes 4 --env episode_time=20 --quiet "
    "--device cpu"
)
rover = pd.read_csv("rover/progress.csv")
assert rover.steps.iloc[-1] >= 2000 and load_policy("rover/policy.npz").network["actions"] > 0

# %% [markdown]
# `large-td3` is the real one: rough ground with rocks, goals 10 to 40 m away. It wants a GPU, so this cell trains it
# where there is one (for two minutes; leave `--time-limit` out for the whole):

# %%
if jax.default_backend() == "gpu":
    shell("lunar-mjx train large-td3 -o large --time-limit 120 --quiet --device cuda")
    shell("lunar-mjx evaluate large/policy.npz --device cuda")
else:
    print("no GPU here: lunar-mjx train large-td3 -o large --time-limit 120 --device cuda")

# %% [markdown]
# Install the extra `gpu` (`pip install "lunar-mjx[gpu]"`) on a machine with an NVIDIA GPU, and check
# that `python -c "import jax; print(jax.devices())"` names it; `--device cuda` refuses to run without one. It drives
# thousands of rovers with all the physics of the model: it compiles first, then prints a line every few seconds.
# Meanwhile:
#
# - Ctrl-C or a kill loses nothing but the last minutes: the same command goes on from the newest checkpoint.
# - `--set name=value` changes a setting of the trainer (`--set envs=4096` if the GPU's memory is short), `--env
#   name=value` an option of the environment. `--env model=run2/model.toml` trains on the model that you have just
#   held against your own measurements and mended: that is what the [missing effect](find_missing_effect.md) was for.
# - `--time-limit 600` stops after ten minutes, `--target 0.95` as soon as that share of unseen episodes succeeds.
# - Environments and batches are shared among all the GPUs that JAX sees.
#
# Afterwards `lunar-mjx evaluate large/policy.npz` scores it on ground and soil that it has not met, and
# `lunar-mjx play large/policy.npz` makes a video of an episode. What has been reached so far, and what not yet,
# with its numbers, is on the page on [reinforcement learning](../reinforcement_learning.md).
