"""The seed paper's figures and the slope check, made anew: a PNG and the numbers as JSON for each."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lunar_mjx.effects.presets import UNSAID
from lunar_mjx.files import replacing, write_text
from lunar_mjx.paper import hot_motor, slope_runs, soft_ground
from lunar_mjx.report.style import BLUE, GREEN, INK, MUTED, VERMILION, save_light_and_dark, styled

PRESET_NAMES = ("paper", "consistent")
SLOPES_DEG = (0.0, 5.0, 10.0, 12.5, 15.0, 17.5, 20.0, 20.5, 21.0, 21.5, 22.0, 22.5, 25.0)
"""Slopes that VIPER drives up, deg; closer where its slip rises fast, and closest about the stall.

A line from a slope that it climbs to one on which it slides back tells how fast it slides, and not where it stalls.
"""
STALL_SLIP = 0.95
"""Slip of the whole rover at which it is called stalled."""


def make_figures(names: Sequence[str], out: Path, trainings: Sequence[Path] = (), dark: bool = False) -> list[Path]:
    """Runs and draws figures; returns the files written (PNG and JSON for each name).

    Args:
      names: of `FIGURES`. out: folder. trainings: what Fig. 6 draws; see `training_figure.read_trainings`.
      dark: each also as `NAME_dark.png`, for dark pages.
    """
    written = []
    for name in names:
        image, data = out / f"{_FILES[name]}.png", out / f"{_FILES[name]}.json"
        with styled():
            figure, numbers = FIGURES[name](trainings) if name in NEED_TRAININGS else FIGURES[name]()
            # Titles and legends of several panels would else run into each other.
            figure.set_layout_engine("constrained")
            FigureCanvasAgg(figure)
            if dark:
                written += save_light_and_dark(figure, image, dpi=120)
            else:
                with replacing(image) as part:
                    figure.savefig(part, dpi=120)
                written.append(image)
        write_text(data, json.dumps(numbers, indent=1))
        written.append(data)
    return written


def _style(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title)


def figure_3() -> tuple[Figure, dict]:
    """15 N m asked of blocked wheels until the winding passes 150 degC."""
    figure = Figure(figsize=(9.0, 6.2))
    grid = figure.subplots(2, 2, sharex=True)
    numbers: dict = {"unsaid": dict(UNSAID), "runs": {}}
    for column, preset in enumerate(PRESET_NAMES):
        run = hot_motor(preset)
        above, below = grid[0][column], grid[1][column]
        above.plot(run.time, run.winding, color=VERMILION, label="winding")
        above.plot(run.time, run.housing, color=BLUE, linestyle="--", label="housing")
        # The temperature at which the paper cuts the motor off.
        above.axhline(150.0, color=MUTED, linewidth=0.8, linestyle=":")
        below.plot(run.time, run.torque, color=INK, label="actual")
        below.axhline(run.desired, color=MUTED, linestyle="--", label="desired")
        _style(above, "", "temperature, °C", f"preset {preset}")
        _style(below, "time, s", "torque at the wheel, N m", f"cut-off at {run.cutoff_time:.2f} s")
        above.legend()
        below.legend()
        numbers["runs"][preset] = {
            "cutoff_time_s": run.cutoff_time,
            "desired_torque_Nm": run.desired,
            "torque_before_cutoff_Nm": float(run.torque[run.torque > 0][0]),
            "last_torque_before_cutoff_Nm": float(run.torque[np.searchsorted(run.time, run.cutoff_time) - 1]),
            "housing_at_cutoff_degC": float(np.interp(run.cutoff_time, run.time, run.housing)),
            "housing_at_end_degC": float(run.housing[-1]),
        }
    return figure, numbers


def figure_5() -> tuple[Figure, dict]:
    """Constant torque on hard and soft ground, with the soft side on the left and on the right."""
    figure = Figure(figsize=(9.0, 4.2))
    panels = figure.subplots(1, 2)
    numbers: dict = {}
    for axes, preset in zip(panels, PRESET_NAMES, strict=True):
        runs = soft_ground(preset)
        for run in runs:
            hard = run.ground == "hard"
            colour = MUTED if hard else (BLUE if run.side > 0 else VERMILION)
            label = "hard" if hard else f"soft, softer to the {'left' if run.side > 0 else 'right'}"
            # The gradient does not act on hard ground: both of its sides would be one line.
            if hard and run.side < 0:
                continue
            line = "--" if hard else ("-" if run.side > 0 else "-.")
            axes.plot(run.x - run.x[0], run.y - run.y[0], color=colour, linestyle=line, label=label)
        _style(axes, "x, m", "y (left), m", f"preset {preset}")
        axes.legend()
        ends = {(r.ground, r.side): r.y[-1] - r.y[0] for r in runs}
        numbers[preset] = {
            "lateral_drift_m": {f"{g}_{'left' if s > 0 else 'right'}": float(v) for (g, s), v in ends.items()},
            "distance_m": {f"{r.ground}_{'left' if r.side > 0 else 'right'}": float(r.x[-1] - r.x[0]) for r in runs},
            "mirror_error_m": float(abs(ends["soft", 1] + ends["soft", -1])),
        }
    return figure, numbers


def figure_slope() -> tuple[Figure, dict]:
    """VIPER in lunar nominal soil: slip against slope, and where it stalls."""
    runs = slope_runs(SLOPES_DEG)
    slope = np.array([r.slope_deg for r in runs])
    slip = np.array([r.slip for r in runs])
    figure = Figure(figsize=(6.4, 4.2))
    axes = figure.subplots()
    axes.plot(slope, slip, "o-", color=BLUE, label="whole rover")
    axes.plot(slope, [r.wheel_slip[:2].mean() for r in runs], "^--", color=VERMILION, label="front wheels")
    axes.plot(slope, [r.wheel_slip[2:].mean() for r in runs], "v:", color=GREEN, label="rear wheels")
    # What one wheel's drawbar pull promises for a whole rover, as a mark to hold the curve against.
    axes.plot([15.1], [0.40], "*", color=INK, markersize=11, label="drawbar pull of one wheel: 15.1° at 40 %")
    _style(axes, "slope, °", "slip ratio", "VIPER climbing, lunar nominal soil, 0.2 m/s asked")
    axes.legend()
    numbers = {
        "slope_at_40_percent_slip_deg": _crossing(slope, slip, 0.40),
        "mean_wheel_slip_40_percent_at_deg": _crossing(slope, np.array([r.wheel_slip.mean() for r in runs]), 0.40),
        "stall_slope_deg": _crossing(slope, slip, STALL_SLIP),
        "stall_slip": STALL_SLIP,
        "runs": [
            {
                "slope_deg": r.slope_deg,
                "slip": r.slip,
                "speed_m_s": r.speed,
                "wheel_slip": r.wheel_slip.tolist(),
                "sinkage_m": r.sinkage.tolist(),
                "torque_Nm": r.torque.tolist(),
            }
            for r in runs
        ],
    }
    return figure, numbers


def _crossing(x: np.ndarray, y: np.ndarray, level: float) -> float | None:
    """Where y first rises through `level`, by linear interpolation; None if it does not."""
    above = np.flatnonzero(y >= level)
    if not above.size or above[0] == 0:
        return None
    # Between the last slope below and the first above: the slopes driven are few.
    i = above[0]
    return float(x[i - 1] + (level - y[i - 1]) / (y[i] - y[i - 1]) * (x[i] - x[i - 1]))


def _from_paper_figures(name: str) -> Callable[[], tuple[Figure, dict]]:
    def make() -> tuple[Figure, dict]:
        from lunar_mjx.paper import pictures as paper_figures

        return getattr(paper_figures, name)()

    return make


def figure_6(trainings: Sequence[Path]) -> tuple[Figure, dict]:
    """Learning curves of trainings that were made; of those that the checkout keeps if none are given."""
    from lunar_mjx.paper.training_figure import figure_6, kept_trainings  # which needs the extra rl

    kept = () if trainings else kept_trainings()
    if kept:
        print(
            f"Fig. 6 draws the trainings kept in {' and '.join(f'benchmarks/rl/{p.name}' for p in kept)}; others: "
            "--training.",
            file=sys.stderr,
        )
    return figure_6(trainings or kept)


FIGURES: dict[str, Callable[..., tuple[Figure, dict]]] = {
    "1": _from_paper_figures("figure_1"),
    "2": _from_paper_figures("figure_2"),
    "3": figure_3,
    "4": _from_paper_figures("figure_4"),
    "5": figure_5,
    "6": figure_6,
    "slope": figure_slope,
}
_FILES = {
    "1": "fig1_display",
    "2": "fig2_workflow",
    "3": "fig3_motor_heat",
    "4": "fig4_rovers_and_terrain",
    "5": "fig5_soft_ground",
    "6": "fig6_training",
    "slope": "slope_stall",
}
NEED_TRAININGS = ("6",)
"""Figures of trainings, which must have been made: nothing is trained or invented here."""


def available_figures(trainings: Sequence[Path] = ()) -> list[str]:
    """All figures that can be made here; says on standard error what is left out without trainings."""
    from lunar_mjx.paper.training_figure import kept_trainings

    names = list(FIGURES)
    if not (trainings or kept_trainings()):
        print("Fig. 6 is left out: it draws trainings; give the folder of one with --training.", file=sys.stderr)
        names = [name for name in names if name not in NEED_TRAININGS]
    return names
