"""`lunar-mjx export`: what leaves the simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunar_mjx.errors import bad_input


def policy(
    agent: Annotated[
        str, typer.Argument(help="policy.npz, or a shipped policy: luvmi_x, viper, luvmi_x/ladder-3.")
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


def register(app: typer.Typer) -> None:
    """Adds the group `export` to the application."""
    group = typer.Typer(help="Take a policy out of the simulator.", no_args_is_help=True)
    group.command("policy")(policy)
    app.add_typer(group, name="export")
