"""The error falling, as a short animation: what was measured, and each model of a chain of runs in turn."""

from __future__ import annotations

import dataclasses
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lunar_mjx.diagnosis.report.explore import cells
from lunar_mjx.diagnosis.report.read import read_result
from lunar_mjx.diagnosis.report.steps import Step, chain, comparable, error, judged
from lunar_mjx.diagnosis.report.words import channel_label
from lunar_mjx.errors import UserError
from lunar_mjx.report.style import BLUE, DARK, INK, ORANGE, SKY, styled
from lunar_mjx.visual.encode import require_encoder, writer


@dataclasses.dataclass(frozen=True)
class FallingFilm:
    """Layout and pace of the film of a falling misfit."""

    fps: int = 12
    # Pictures for which a model stands still, and in which it passes into the next.
    hold: int = 14
    move: int = 12
    size: tuple[float, float] = (9.6, 4.1)
    """Inches, at 100 pixels each."""
    most_panels: int = 3
    least_points: int = 5
    """Fewer observations show no course."""
    many_points: int = 60
    """From so many on, points are drawn small and models without marks."""
    gap: float = 5.0
    """Lines break where two observations are so many times further apart than is usual."""
    title_width: int = 104
    """Characters of a line above the bar."""
    least_fall: float = 0.01
    """A proposal that takes a smaller share of the error away is left out: nothing would be seen to move."""


FILM = FallingFilm()


def require_kind(path: Path) -> Path:
    """Returns the path of an animation that can be written.

    Raises:
      UserError: it ends in no known kind, or nothing here writes that kind.
    """
    if path.suffix.lower() not in (".gif", ".webp", ".mp4"):
        raise UserError(f"{path}: is of no known kind; end it in .gif, .webp or .mp4.")
    require_encoder(path)
    return path


def write_falling(runs: str | Path | Sequence[str | Path], out: str | Path, dark: bool = False) -> Path:
    """Writes an animation of a chain of models: as given, refitted, with effects added, and as the last run proposes.

    Between two models the curves pass through means of both predictions; these pictures are no model's.

    Args:
      runs: a run folder, or several in the order in which effects were added. out: a .gif, .webp or .mp4 file.
      dark: for a dark page.

    Returns:
      The file's path.

    Raises:
      UserError: a folder is no run, holds no series yet, the runs are of other logs, or the file is of no known kind.
    """
    path = require_kind(Path(out))
    results = [read_result(Path(r)) for r in ([runs] if isinstance(runs, str | Path) else runs)]
    for result in results:
        if result.traces is None:
            raise UserError(
                f"{result.folder or result.name}: holds no series.npz yet; make it with lunar-mjx compare, then why."
            )
    steps = chain(results)
    if not comparable(steps):
        raise UserError("--animation: these runs are of other measurements; give runs of the same logs.")
    splits, measure = judged(steps)
    errors = [e.value for s in steps if (e := error(s, splits)) is not None]
    proposed = len(steps) > 2 and steps[-1].result is steps[-2].result
    if proposed and abs(errors[-1] / errors[-2] - 1.0) < FILM.least_fall:
        steps, errors = steps[:-1], errors[:-1]
    panels = _worst(steps, splits)
    course = _course(len(steps))
    with styled(dark):
        drawn = {place: _picture(steps, errors, panels, place, measure, dark) for place in sorted(set(course))}
    with writer(path, FILM.fps) as put:
        for place in course:
            put(drawn[place])
    return path


def _course(models: int) -> list[float]:
    """Where the animation is at each picture: 0 is the first model, 1 the second."""
    ease = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, FILM.move + 1) / (FILM.move + 1))
    course: list[float] = []
    for i in range(models):
        # The last stands twice as long: it is the result, and after it the film begins anew.
        course += [float(i)] * (FILM.hold if i < models - 1 else 2 * FILM.hold)
        if i < models - 1:
            course += [i + float(e) for e in ease]
    return course


def _worst(steps: Sequence[Step], splits: Sequence[str]) -> list[tuple[str, str, np.ndarray]]:
    """Channel, manoeuvre and observations where the first model is worst, one of each channel, of the judged splits."""
    o, residual = steps[0].observations, steps[0].residual
    judges = o.in_split(*splits)
    judged = [(channel, unit, at[judges[at] & np.isfinite(residual[at])]) for channel, unit, at in cells(o)]
    ranked = sorted(
        (c for c in judged if len(c[2]) >= FILM.least_points),
        key=lambda c: -float(np.sqrt(np.mean(residual[c[2]] ** 2))),
    )
    worst: dict[str, tuple[str, str, np.ndarray]] = {}
    for channel, unit, at in ranked:
        worst.setdefault(channel, (channel, o.unit_names[unit], at))
    return list(worst.values())[: FILM.most_panels]


def _broken(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places and values of a line that breaks where measurements pause."""
    steps = np.diff(x)
    # Stamps that repeat would make the usual step zero, and every step a pause.
    pauses = np.flatnonzero(steps > FILM.gap * max(float(np.median(steps)), 1e-12)) + 1 if len(x) > 2 else []
    return np.insert(x.astype(float), pauses, np.nan), np.insert(y.astype(float), pauses, np.nan)


def _picture(
    steps: Sequence[Step],
    errors: Sequence[float],
    panels: Sequence[tuple[str, str, np.ndarray]],
    place: float,
    measure: str,
    dark: bool,
) -> np.ndarray:
    """One picture, (height, width, 3) uint8."""
    ink = DARK[INK] if dark else INK
    low = min(int(place), len(steps) - 1)
    high, share = min(low + 1, len(steps) - 1), place - low
    figure = Figure(FILM.size, dpi=100)
    grid = figure.add_gridspec(
        2, len(panels), height_ratios=(3, 1), left=0.075, right=0.985, top=0.83, bottom=0.07, hspace=0.72, wspace=0.3
    )
    traces = steps[0].result.traces
    assert traces is not None
    for k, (channel, manoeuvre, at) in enumerate(panels):
        axes = figure.add_subplot(grid[0, k])
        x = traces.observations.place[at, 0] if traces.observations.place is not None else traces.time[at]
        order = np.argsort(x, kind="stable")
        x, at = x[order], at[order]
        measured = traces.observations.value[at]
        predicted = (1.0 - share) * steps[low].predicted[at] + share * steps[high].predicted[at]
        # Over all models, so that the axis stands still while the curve moves.
        all_values = np.concatenate([measured, *(s.predicted[at] for s in steps)])
        margin = 0.06 * max(float(np.nanmax(all_values) - np.nanmin(all_values)), 1e-12)
        axes.set_ylim(float(np.nanmin(all_values)) - margin, float(np.nanmax(all_values)) + margin)
        as_density = len(x) > FILM.many_points
        axes.plot(
            *_broken(x, predicted),
            color=SKY if dark else BLUE,
            marker="" if as_density else "s",
            markersize=5,
            linewidth=2,
            label="model",
        )
        axes.plot(
            x, measured, color=ink, marker="o", markersize=2 if as_density else 4.5, linestyle="none", label="measured"
        )
        axes.set_title(f"{channel_label(channel)}\n{manoeuvre.replace('_', ' ')[:34]}", fontsize=9)
        axes.set_xlabel("slip ratio" if traces.is_table else "time, s", fontsize=8)
    marks, words = figure.axes[0].get_legend_handles_labels()
    figure.legend(marks, words, loc="upper right", ncols=2, fontsize=9, bbox_to_anchor=(0.99, 1.01))
    bar = figure.add_subplot(grid[1, :])
    shown_error = (1.0 - share) * errors[low] + share * errors[high]
    bar.barh([0], [shown_error], color=ORANGE, height=0.6)
    bar.axvline(1.0, color=ink, linestyle="--", linewidth=1.5)
    bar.set(xlim=(0.0, 1.25 * max(errors)), ylim=(-0.5, 0.5), yticks=[])
    # As many digits in all pictures, so that the number does not jump: three of the smallest error.
    digits = max(0, 2 - math.floor(math.log10(max(min(errors), 1e-3))))
    bar.text(
        shown_error + 0.012 * max(errors), 0, f"{shown_error:.{digits}f} sigma", va="center", fontsize=12, weight="bold"
    )
    name = steps[low if share < 0.5 else high].label
    title = f"{name}: error on {measure} points (dashed: the noise)"
    bar.set_title(textwrap.fill(title, FILM.title_width))
    bar.grid(False)
    for spine in bar.spines.values():
        spine.set_visible(False)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
