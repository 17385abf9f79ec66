"""Learning curves: by environment step and wall time, and by episode on the axes of the paper's Fig. 6."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.files import replacing
from lunar_mjx.report.style import MUTED, save_light_and_dark, styled

EPISODES = 20
"""Episodes in the moving mean of curves by episode."""


def new_figure(columns: int, width: float = 5.0, height: float = 3.6) -> Any:
    """A figure with one row of axes, and those axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with styled():
        # Without pyplot, whose figures are global and not safe in threads.
        figure = Figure(figsize=(columns * width, height), layout="constrained")
        FigureCanvasAgg(figure)
        return figure, figure.subplots(1, columns, squeeze=False)[0]


def moving_mean(values: Sequence[float] | np.ndarray, width: int = EPISODES) -> np.ndarray:
    """Mean over the last `width` values, fewer at the beginning."""
    # Differences of a running sum: the width costs nothing.
    total = np.cumsum(np.insert(np.asarray(values, float), 0, 0.0))
    last = np.arange(1, len(values) + 1)
    first = np.maximum(last - width, 0)
    return (total[last] - total[first]) / (last - first)


def mean_interval(curves: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over seeds (first axis) and its 95 % interval by Student's t; no width for one seed."""
    from scipy import stats

    mean, count = curves.mean(axis=0), len(curves)
    if count < 2:
        return mean, mean, mean
    half = stats.t.ppf(0.975, count - 1) * curves.std(axis=0, ddof=1) / np.sqrt(count)
    return mean, mean - half, mean + half


@styled()
def plot_progress(records: Sequence[Mapping[str, Any]], path: Path, title: str = "", dark: bool = False) -> Path:
    """Return and success over environment steps, and success on unseen ground over wall time; a line per record.

    With `dark` it is written as `NAME_dark.png`, too, for dark pages. Returns `path`.
    """
    figure, (first, second, third) = new_figure(3)
    for record in records:
        rows = [r for r in record["rows"] if r.get("episode_return") is not None]
        steps, label = [r["steps"] for r in rows], f"seed {record['seed']}"
        first.plot(steps, [r["episode_return"] for r in rows], lw=1, label=label)
        second.plot(steps, [100 * r["success"] for r in rows], lw=1)
        third.plot(
            [s["elapsed_s"] for s in record["unseen"]], [100 * s["success"] for s in record["unseen"]], "o-", ms=3, lw=1
        )
    first.set(xlabel="environment steps", ylabel="return of ended episodes", title=title)
    second.set(xlabel="environment steps", ylabel="success in training, %", ylim=(-3, 103))
    third.set(xlabel="wall time of training, s", ylabel="success on unseen ground, %", ylim=(-3, 103))
    third.axhline(95, color=MUTED, lw=0.8, ls="--")
    first.legend(frameon=False, fontsize=8)
    if dark:
        save_light_and_dark(figure, path, dpi=120)
        return path
    with replacing(path) as part:
        figure.savefig(part, dpi=120)
    return path


def draw_mean(
    axes: Any, curves: Sequence[Sequence[float]], factor: float = 1.0, alpha: float = 0.2, **line: Any
) -> None:
    """Draws moving means by episode: mean over seeds and its 95 % interval, as far as every seed has episodes."""
    smooth = [factor * moving_mean(curve) for curve in curves]
    # Beyond the shortest seed the mean would be of other seeds, and jump.
    count = min(map(len, smooth))
    mean, low, high = mean_interval(np.stack([curve[:count] for curve in smooth]))
    at = np.arange(1, count + 1)
    (drawn,) = axes.plot(at, mean, **line)
    if len(smooth) > 1:
        axes.fill_between(at, low, high, alpha=alpha, lw=0, color=drawn.get_color())


@styled()
def plot_episodes(groups: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> Path:
    """Average return per episode over episodes, as the paper's Fig. 6: mean over seeds with its interval.

    Args:
      groups: by algorithm, records of its seeds.
      path: of the picture.
    """
    figure, (axes,) = new_figure(1, 6.0)
    for name, records in groups.items():
        draw_mean(axes, [r["episodes"]["episode_return"] for r in records], label=name)
    axes.set(xlabel="episode", ylabel=f"average return per episode (mean of {EPISODES})")
    axes.legend(frameon=False)
    with replacing(path) as part:
        figure.savefig(part, dpi=120)
    return path
