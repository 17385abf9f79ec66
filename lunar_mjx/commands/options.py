"""Options that several commands take, and the checks of their values."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from lunar_mjx.errors import bad_input

MOST_SEED = 2**32 - 1
"""Seeds are 32 bits wide: what JAX takes on every platform."""
RoverOption = Annotated[str, typer.Option(help="Name of a shipped rover, or folder that `convert` wrote.")]
TerrainOption = Annotated[str, typer.Option(help="Shipped terrain, flat, slope:10deg, DEM file or terrain.toml.")]
PresetOption = Annotated[str | None, typer.Option(help="field (by default), consistent or paper.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")]
DeviceOption = Annotated[str, typer.Option(help="auto, cpu or cuda.")]


def select_device(device: str) -> None:
    """Makes JAX use `device`.

    Raises:
      UserError: unknown name, or CUDA asked for where JAX sees none.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise bad_input("lunar-mjx", "--device", device, "does not exist", "use auto, cpu or cuda")
    # JAX's own choice: a GPU where there is one.
    if device == "auto":
        return
    import jax

    if device == "cpu":
        # Before JAX starts its backends; later it has no effect.
        jax.config.update("jax_platforms", "cpu")
        return
    try:
        found = jax.devices("cuda")
    except RuntimeError:
        found = []
    if not found:
        raise bad_input(
            "lunar-mjx",
            "--device",
            device,
            "is not here: JAX sees no CUDA device",
            "install the extra lunar-mjx[gpu] on a machine with an NVIDIA GPU, or use --device cpu",
        )


HOLDS = {"log.toml": "a log", "run.json": "a run of compare"}
"""What a folder keeps, by the file that tells; nothing else is written among it, or one would spoil the other."""


def check_folder(out: Path, own: str = "", option: str = "--out") -> None:
    """Refuses, before any work is done, an output folder that holds something else, or that `check_place` refuses.

    Args:
      out: the folder. own: file of `HOLDS` that the command itself writes there. option: which names the folder.
    """
    for name, what in HOLDS.items():
        if name != own and (out / name).exists():
            raise bad_input("lunar-mjx", option, str(out), f"holds {what} ({name})", "name another folder")
    check_place(out, option)


def check_place(out: Path, option: str = "--out") -> None:
    """Refuses, before any work is done, an output folder that is a file, lies in one, or cannot be written to."""
    # The nearest part that exists decides; what lies below it can be made.
    for path in (out, *out.parents):
        if path.is_symlink() and not path.exists():
            raise bad_input("lunar-mjx", option, str(out), f"cannot be made: {path} leads nowhere", "mend that link")
        if path.exists():
            if not path.is_dir():
                raise bad_input("lunar-mjx", option, str(out), f"is not a folder: {path} is a file", "name a folder")
            try:
                # Tried, and not asked: permissions say nothing of disks that can only be read.
                with tempfile.TemporaryFile(dir=path):
                    return
            except OSError as error:
                problem = f"cannot be written: {path} takes no file ({error.strerror or error})"
                raise bad_input("lunar-mjx", option, str(out), problem, "name another folder") from None


def make_folder(out: Path, own: str = "") -> Path:
    """Makes the output folder; see `check_folder`."""
    check_folder(out, own)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise bad_input(
            "lunar-mjx", "--out", str(out), f"cannot be made ({error.strerror})", "name another folder"
        ) from error
    return out


def check_finite(**options: float) -> None:
    """Refuses numbers such as nan and inf, which the command line takes for numbers."""
    for name, value in options.items():
        if not math.isfinite(value):
            raise bad_input("lunar-mjx", f"--{name.replace('_', '-')}", value, "is not finite", "give a finite number")


SpecArgument = Annotated[str, typer.Argument(help="Shipped terrain, flat, slope:10deg, DEM file or terrain.toml.")]
DemOption = Annotated[Path | None, typer.Option(help="DEM file that takes the place of the configuration's.")]
SeedOption = Annotated[
    int | None, typer.Option(min=0, max=MOST_SEED, help="Seed that takes the place of the configuration's.")
]


def open_terrain(spec: str, dem: Path | None, seed: int | None) -> Any:
    """Loads a terrain; refuses a DEM or seed for one that takes none."""
    from lunar_mjx.terrain import load_terrain

    # Slopes and plain DEM files have no configuration whose DEM or seed could be replaced.
    if spec.startswith("slope") or Path(spec).suffix not in ("", ".toml"):
        for option, value in (("--dem", dem), ("--seed", seed)):
            if value is not None:
                raise bad_input("lunar-mjx", option, value, f"does not go with {spec}", "name a configured terrain")
    return load_terrain(spec, dem=dem, seed=seed)
