"""`lunar-mjx export`: what leaves the simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunar_mjx.commands.options import MOST_SEED
from lunar_mjx.commands.train import (
    MOST_EPISODES,
    SHIPPED_AGENT,
    AgentArgument,
    AgentOption,
    DeviceOption,
    EnvSetOption,
    TaskOption,
    env_options,
    one_agent,
)
from lunar_mjx.errors import bad_input


def policy(
    agent: Annotated[
        str, typer.Argument(help="policy.npz, or a shipped policy: luvmi_x, viper, luvmi_x/ladder-3, luvmi_x/escape.")
    ] = "luvmi_x",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")] = Path("runs/export"),
    only: Annotated[list[str] | None, typer.Option(help="onnx or stablehlo; both if left out.")] = None,
) -> None:
    """Write a policy as ONNX and StableHLO, with its contract and a ROS 2 node that runs it without this package."""
    from lunar_mjx.commands.options import check_folder, make_folder, select_device

    check_folder(out)
    # A graph is traced, not run: it needs no GPU.
    select_device("cpu")
    from lunar_mjx.agents.export.write import GRAPHS, export_policy
    from lunar_mjx.agents.policy import shipped_policy

    path = Path(agent) if agent.endswith(".npz") else shipped_policy(agent)
    if path is None:
        raise bad_input("export", "policy", agent, "is no rover with a trained policy", "give a policy.npz")
    for written in export_policy(path, make_folder(out), only or tuple(GRAPHS)):
        print(written)


def dataset(
    agent: AgentArgument = SHIPPED_AGENT,
    agent_option: AgentOption = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")] = Path("runs/datasets"),
    name: Annotated[str, typer.Option(help="Name of the dataset, as Minari takes it.")] = "lunar-mjx/drives-v0",
    frames: Annotated[int, typer.Option(min=1, max=10**9, help="Steps of all rovers together.")] = 100_000,
    rovers: Annotated[int, typer.Option(min=1, max=MOST_EPISODES, help="Side by side.")] = 256,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED)] = 0,
    task: TaskOption = "large",
    unseen: Annotated[bool, typer.Option(help="On the ground and soil of evaluations, not of the training.")] = False,
    env: EnvSetOption = None,
    device: DeviceOption = "auto",
) -> None:
    """Drive an agent and write its episodes, with slip and sinkage of every wheel, as a dataset for Minari (HDF5)."""
    from lunar_mjx.commands.options import check_folder, make_folder, select_device

    check_folder(out)
    select_device(device)
    from lunar_mjx.agents.export.dataset import check_dataset, export_dataset
    from lunar_mjx.agents.play import knowing, open_agent
    from lunar_mjx.agents.run import unseen_params

    # Before minutes of compiling.
    check_dataset(name, frames, rovers)
    wanted = one_agent("export", agent, agent_option)
    options = env_options(env)
    made, act, ground = open_agent(wanted, task, options)
    params = unseen_params(made, ground) if unseen else made.params
    # After the ground is chosen: an agent that knows the map must know this one.
    act = knowing(wanted, made, params, act)
    about = {"algorithm_name": wanted, "unseen": unseen, "options": options}
    print(export_dataset(made, params, act, make_folder(out), name, rovers, frames, seed, print, about))


def register(app: typer.Typer) -> None:
    """Adds the group `export` to the application."""
    group = typer.Typer(help="Take policies and drives out of the simulator.", no_args_is_help=True)
    group.command("policy")(policy)
    group.command("dataset")(dataset)
    app.add_typer(group, name="export")
