"""The counterpart of the seed paper's Fig. 6: how the return of an episode grows while a policy learns."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lunar_mjx.agents.curves import EPISODES, draw_mean
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.report.style import BLUE, GREEN, ORANGE, PAPER, PURPLE, SKY, VERMILION

CURVE = "curve.json"
_LOOKS = ((BLUE, "-"), (VERMILION, "--"), (GREEN, "-."), (ORANGE, ":"), (PURPLE, (0, (6, 2, 1, 2))), (SKY, (0, (1, 1))))
RECORDS = Path(__file__).resolve().parents[2] / "benchmarks" / "rl"
"""Where a checkout keeps records of trainings."""


def kept_trainings() -> list[Path]:
    """Records that the checkout keeps: of the paper's own task, else of thousands of rovers; none when installed."""
    return sorted(RECORDS.glob("paper*.json")) or sorted(RECORDS.glob("large_*.json"))


def read_trainings(paths: Sequence[str | Path]) -> dict[str, list[dict[str, Any]]]:
    """Records of trainings by name, one per seed.

    Args:
      paths: folders that `lunar-mjx train` wrote, or JSON files: their `curve.json`, or what `benchmarks/rl/measure.py`
        wrote.

    Raises:
      UserError: no training is given, or a file holds none.
    """
    if not paths:
        raise UserError(
            "figures: Fig. 6 needs trainings; make one with lunar-mjx train, and give its folder with --training."
        )
    trainings: dict[str, list[dict[str, Any]]] = {}
    for path in map(Path, paths):
        file = path / CURVE if path.is_dir() else path
        try:
            data = json.loads(file.read_text(encoding="utf-8"))
            named = list(_records(data))
            if not named or not all(_is_training(r) for _, r in named):
                raise KeyError
        except FileNotFoundError:
            raise bad_input(
                "figures",
                "--training",
                str(path),
                f"has no {CURVE}" if path.is_dir() else "is not there",
                "give a folder that lunar-mjx train has finished",
            ) from None
        except (ValueError, KeyError, TypeError, AttributeError):
            raise bad_input(
                "figures",
                "--training",
                str(path),
                "holds no record of a training",
                "give a folder that lunar-mjx train wrote",
            ) from None
        for name, record in named:
            trainings.setdefault(name, []).append(record)
    return trainings


def _is_training(record: dict[str, Any]) -> bool:
    return record.get("seed") is not None and (record.get("rows") is not None or _has_episodes(record))


def _has_episodes(record: dict[str, Any]) -> bool:
    return bool((record.get("episodes") or {}).get("episode_return"))


def _records(data: dict[str, Any]) -> Iterable[tuple[str, dict[str, Any]]]:
    """Name and record of every run in a file of one of the kinds."""
    if "seeds" in data:  # many rovers, several seeds
        # Kept records of many rovers name no training each: what they have alike is said once.
        yield from ((f"TD3, {data['rover']}, {data['train']['envs']:,} at once", r) for r in data["seeds"])
    elif "runs" in data:  # the paper's own task
        yield from ((name, record) for name, runs in data["runs"].items() for record in runs)
    else:
        yield data["training"], data


def figure_6(paths: Sequence[str | Path]) -> tuple[Figure, dict[str, Any]]:
    """Return of an episode and success in training, by episode as in the paper where all trainings kept them, else by
    step, with success on unseen ground as dots."""
    groups = read_trainings(paths)
    records = [r for runs in groups.values() for r in runs]
    # By episode only if all can be drawn so: two axes in one figure cannot be compared.
    episodes = all(_has_episodes(r) for r in records)
    figure = Figure(figsize=(9.5, 3.8))
    left, right = figure.subplots(1, 2)
    draw = _by_episode if episodes else _by_step
    for (colour, line), (name, runs) in zip(_LOOKS * len(groups), groups.items(), strict=False):
        draw((left, right), runs, f"{name} ({len(runs)} seed{'s' if len(runs) > 1 else ''})", colour, line)
    x, mean = ("episode", f" (mean of {EPISODES})") if episodes else ("environment steps", "")
    _finish(left, x, f"average return per episode{mean}")
    _finish(right, x, f"success, %{mean}" if episodes else "success, %   (dots: on unseen ground)")
    right.set_ylim(-3.0, 103.0)
    left.legend()
    return figure, {
        "axis": "episode" if episodes else "steps",
        "trainings": {name: [_numbers(r) for r in runs] for name, runs in groups.items()},
    }


def _by_step(panels: Sequence[Axes], runs: Sequence[dict[str, Any]], label: str, colour: str, line: Any) -> None:
    """A line for every seed."""
    left, right = panels
    for i, run in enumerate(runs):
        rows = [r for r in run["rows"] if r.get("episode_return") is not None]
        steps = [r["steps"] for r in rows]
        left.plot(
            steps,
            [r["episode_return"] for r in rows],
            color=colour,
            linestyle=line,
            linewidth=1.1,
            label=label if i == 0 else None,
        )
        right.plot(steps, [100.0 * r["success"] for r in rows], color=colour, linestyle=line, linewidth=1.0)
        # Scores are made every few seconds and not in every epoch, so that they are dots and no line.
        unseen = run.get("unseen") or []
        right.plot(
            [s["steps"] for s in unseen],
            [100.0 * s["success"] for s in unseen],
            "o",
            color=colour,
            markersize=4,
            markeredgecolor=PAPER,
            markeredgewidth=0.6,
        )


def _by_episode(panels: Sequence[Axes], runs: Sequence[dict[str, Any]], label: str, colour: str, line: Any) -> None:
    """Mean over seeds with its 95 % interval, as far as every seed has episodes."""
    for axes, quantity, factor in zip(panels, ("episode_return", "success"), (1.0, 100.0), strict=True):
        curves = [r["episodes"][quantity] for r in runs if quantity in r["episodes"]]
        if curves:
            draw_mean(axes, curves, factor, 0.15, color=colour, linestyle=line, label=label)


def _finish(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.xaxis.set_major_formatter(lambda v, _: f"{v / 1e6:g} M" if v >= 1e6 else f"{v:g}")


def _numbers(record: dict[str, Any]) -> dict[str, Any]:
    rows = [r for r in record.get("rows") or [] if r.get("episode_return") is not None]
    out = {
        "seed": record["seed"],
        "steps": record.get("steps") or (rows[-1]["steps"] if rows else 0),
        "last_return": rows[-1]["episode_return"] if rows else None,
        "last_success_in_training": rows[-1]["success"] if rows else None,
        "final_on_unseen_ground": record.get("final"),
    }
    if _has_episodes(record):
        kept = record["episodes"]
        out["episodes"] = len(kept["episode_return"])
        out["mean_of_last_50_episodes"] = {
            k: float(np.mean(v[-50:])) for k, v in kept.items() if k in ("episode_return", "success")
        }
    return out
