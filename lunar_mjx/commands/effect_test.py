"""`lunar-mjx effect test`: the contract of an effect, checked."""

from __future__ import annotations

from typing import Annotated

import typer

from lunar_mjx.commands.options import MOST_SEED


def register(app: typer.Typer) -> None:
    """Adds the command to the group `effect`."""
    app.command("test")(effect_test)


def effect_test(
    spec: Annotated[str, typer.Argument(help="my_effects.py, my_effects.py:name, or a name of the catalogue.")],
    overhead: Annotated[
        bool, typer.Option(help="Measure the cost too (half the time that this command takes).")
    ] = True,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Of the random rovers.")] = 0,
) -> None:
    """Check an effect's contract: null value, derivatives, units, cost. Exit status 1 where it is broken."""
    from lunar_mjx.effect_contract.promises import check_effect
    from lunar_mjx.effects.catalogue import get, load_file

    # A file may hold several effects; all are tested, so that none is forgotten.
    effects = list(load_file(spec).values()) if spec.endswith(".py") else [get(spec)]
    broken = []
    for effect in effects:
        print(f"{effect.name} ({', '.join(effect.ports)})")
        checks = check_effect(effect, overhead=overhead, seed=seed)
        for check in checks:
            # None is what cannot be judged, and must not fail an effect.
            word = {True: "ok", False: "FAILED", None: "note"}[check.passed]
            print(f"  {word:6} {check.name}: {check.detail}")
        if any(check.passed is False for check in checks):
            broken.append(effect.name)
    if broken:
        print(f"broken: {', '.join(broken)}")
        raise typer.Exit(1)
    print("the contract is kept")
