"""What the demonstration's page says, in words and tables."""

from __future__ import annotations

import functools
import platform
from collections.abc import Callable, Sequence
from importlib import metadata

import numpy as np

from lunar_mjx._version import __version__
from lunar_mjx.criticism import SteadyStateTable
from lunar_mjx.demo.drive import Drive
from lunar_mjx.demo.figures import (
    CASE_LABELS,
    ROVERS,
    headline_figure,
    history_figure,
    husky_figure,
    paths_figure,
    wheel_figure,
)
from lunar_mjx.demo.husky import HuskyCase
from lunar_mjx.demo.wheel import Case
from lunar_mjx.report.page import Facts, Figure, Lead, Pair, Section, Table, Text
from lunar_mjx.terrain import Terrain
from lunar_mjx.wheel_bed.comparison import as_bed
from lunar_mjx.wheel_bed.soil_fit import SOIL_FIT, held_out_rms
from lunar_mjx.wheel_bed.table import QUANTITIES

LEAD = Lead(
    "",
    "good",
    "Thirty-two simulated rovers drive over lunar soil; then the wheel model inside them is held against a real wheel.",
    [
        "lunar-mjx view  (drive a rover yourself)",
        "lunar-mjx log new runs/mine --steady  (a template for your own measurements, to be criticised likewise)",
    ],
)
"""What the page says first."""

_UPSET = 60.0
"""Roll or pitch beyond which a rover counts as rolled over, deg."""


def verdict(drives: Sequence[Drive], cases: Sequence[Case]) -> list[str]:
    """What was found, a sentence each."""
    count = sum(d.x.shape[1] for d in drives)
    # A state that is not finite never comes back, so that its place tells of the whole rover.
    bad = sum(int((~np.isfinite(d.x)).any(axis=0).sum()) for d in drives)
    upset = sum(
        int((np.degrees(np.maximum(np.abs(d.roll), np.abs(d.pitch))).max(axis=0) > _UPSET).sum()) for d in drives
    )
    drove = ", ".join(_drove(d) for d in drives)
    named = {c.name: c for c in cases}
    plain, paper, fitted = named["consistent"], named["paper"], named["consistent, refitted"]
    assert fitted.fit is not None
    # The worst quantity where nothing was fitted: there missing physics shows, and not a bad compromise.
    quantity = max(QUANTITIES.keys() & fitted.comparison.rms.keys(), key=lambda q: held_out_rms(fitted.comparison, q))
    return [
        f"{count} rovers drove {drives[0].time[-1]:.0f} s on true-scale terrain: {drove}. "
        f"{bad or 'None'} failed numerically, {upset or 'none'} rolled over.",
        "Errors of the wheel are counted in the scatter of single runs: 1 is as good as measuring twice. The equations "
        f"of the paper that this simulator began from (the seed paper) are off by {paper.comparison.overall:.0f}, the "
        f"same with its flaws corrected by {plain.comparison.overall:.0f}.",
        f"With the soil fitted to wheels that point {_angles(SOIL_FIT.fit_angles)} away from where they go (the slip "
        f"angle), {fitted.fit.held_out:.1f} is left at angles that the fit did not see, most of it in the "
        f"{QUANTITIES[quantity][2]}: physics is missing, not only parameters.",
    ]


def headline_section(cases: Sequence[Case]) -> Section:
    """The figure that the page begins with."""
    caption = (
        "Four wheel models against a measured wheel, at slip angles that no fit saw. Left is better; the line is how "
        "well a repeated run agrees. Refitting the soil helps and does not suffice: lunar-mjx why says what is missing."
    )
    figure = Figure(headline_figure(cases), caption, least=440)
    return Section("How far the wheel models are from the measurements", [figure])


def husky_section(case: HuskyCase) -> Section:
    """A real drive: measured against the model before and after an effect was added."""
    caption = (
        "The current of a Husky's left motor on sandy loam. The wheels turn as measured; the model was fitted on a "
        "hard floor, and then soft ground took the floor's place."
        + (" Gaps lie between windows of two seconds." if np.isnan(case.time).any() else "")
    )
    split_words = {"fit": "fitted windows", "held_out": "held-out windows"}
    steps = (case.error_before, case.error_refitted, case.error_after)
    # A short drive may hold no window back.
    rows = [[split_words[k], *(f"{s[k]:.2f}" for s in steps)] for k in split_words if k in case.error_before]
    header = ["", "as fitted on the floor", "refitted", "with soft ground"]
    table = Table("Error in standard deviations of the noise, all channels", header, rows)
    credit = "; ".join(case.source[k] for k in ("who", "citation", "licence") if k in case.source)
    words = (
        f"Measurements: {credit}. Your own rover's log takes the same way: lunar-mjx log import, compare, why, add "
        "(docs/tutorials/your_rovers_log.md)."
    )
    return Section(
        "A real rover's drive, before and after", [Figure(husky_figure(case), caption), table, Text([words])]
    )


def _drove(d: Drive) -> str:
    slip = 100 * of_finite(np.median, d.mean_slip)
    return (
        f"{d.x.shape[1]} {_name(d)}s {np.median(d.distance):.1f} m at {slip:.0f} % slip and "
        f"{1e3 * np.median(d.sinkage):.0f} mm sinkage (medians)"
    )


def of_finite(statistic: Callable[[np.ndarray], float], values: np.ndarray) -> float:
    """The statistic of the finite values; not a number where there is none."""
    finite = values[np.isfinite(values)]
    return float(statistic(finite)) if finite.size else float("nan")


def _name(d: Drive) -> str:
    """Name of the rover, as text whose lines do not break it; figures draw names in one line."""
    return ROVERS.get(d.rover, (d.rover, ""))[0].replace("-", "\N{NON-BREAKING HYPHEN}")


def _angles(angles: Sequence[float]) -> str:
    return ", ".join(f"{a:g}" for a in angles) + " deg"


def driving_section(drives: Sequence[Drive], terrain: Terrain) -> Section:
    """Paths, histories and a table of the batch."""
    rows = []
    for d in drives:
        # Over the wheels that roll: a wheel at rest has no slip, and its zero would flatter the mean.
        slip = d.rover_slip
        for label, statistic in (("median", np.median), ("least", np.min), ("most", np.max)):
            pick = functools.partial(of_finite, statistic)
            rows.append(
                [
                    f"{_name(d)}, {d.mass:.0f} kg, {label}",
                    f"{pick(d.command_speed):.2f}",
                    f"{pick(d.distance):.2f}",
                    f"{pick(slip):.2f}",
                    f"{1e3 * pick(d.sinkage.mean(axis=(0, 2))):.1f}",
                    f"{1e3 * pick(d.sinkage.max(axis=(0, 2))):.1f}",
                    f"{pick(d.winding_degC.max(axis=0)):.1f}",
                    f"{pick(d.energy) / 1e3:.2f}",
                    f"{np.degrees(pick(np.abs(d.roll).max(axis=0))):.1f}",
                ]
            )
    header = [
        "rover",
        "commanded rim speed, m/s",
        "distance, m",
        "mean slip",
        "mean sinkage, mm",
        "largest sinkage, mm",
        "hottest winding, °C",
        "electrical energy, kJ",
        "largest roll, deg",
    ]
    about = (
        "All rovers share the model preset consistent and the soil of the Lunar Sourcebook, and differ in place, "
        f"heading, speed and steering. The ground is the shipped terrain {terrain.name} at true scale. Each rover "
        "drives alone: rovers do not see each other. Motors start at 25 °C."
    )
    paths = "Paths on the shaded relief, lit from the north-west at 20 deg; dark discs are rocks."
    history = (
        "Slip by eq. 8 in the wheel's frame, mean over the wheels that turn; sinkage of the deepest wheel; temperature "
        "of the hottest of the twelve motors. Peaks are craters and rocks."
    )
    note = "Sinkage is measured from the undisturbed ground. Energy counts voltage times current of all motors."
    title = "What the batch did: median, least and most over the rovers of each kind, column by column"
    blocks = [
        Text([about]),
        Pair(Figure(paths_figure(drives, terrain), paths, 480), Figure(history_figure(drives), history, 480)),
        Table(title, header, rows, note, folded=True),
    ]
    return Section("Rovers on the Moon", blocks)


def wheel_section(cases: Sequence[Case]) -> Section:
    """The wheel against the test bed: panels, errors, where they are worst, and the fitted values."""
    table = cases[0].comparison.table
    # Rounded, since measured angles differ in their last digits.
    angles = sorted({round(float(a), 2) for a in table.test["slip_angle_deg"]})
    beds = [case.fit.bed if case.fit else as_bed(case.name) for case in cases]
    caption = (
        "Columns are slip angles; slip compares the rim speed with the travel speed. Each curve follows the measured "
        f"load from point to point. Fitted at {_angles(SOIL_FIT.fit_angles)}; held out at "
        f"{_angles(SOIL_FIT.inside_angles + SOIL_FIT.beyond_angles)}; {_angles(SOIL_FIT.apart_angles)} set apart, "
        "because the wheel sinks to its axle there. What no fit saw stands on a tinted ground."
    )
    sigma = ", ".join(f"{QUANTITIES[q][2]} {_scatter(q, s)}" for q, s in table.sigma.items())
    about = (
        f"The same wheel-soil functions that drive the rovers above, in the test bed of the {table.name}: imposed "
        f"slip, slip angle and load. Errors are in units of the scatter of single runs about their mean: {sigma}."
    )
    figure = Figure(wheel_figure(cases, table, angles, beds), caption, least=130 + 120 * len(angles))
    blocks = [Text([about]), figure, _error_table(cases), _worst_table(cases), _fit_table(cases)]
    return Section("The wheel against measurements", blocks)


def _scatter(quantity: str, sigma: float) -> str:
    unit = QUANTITIES[quantity][1]
    return f"{1e3 * sigma:.2f} mm" if unit == "m" else f"{sigma:.2f} {unit}"


def _error_table(cases: Sequence[Case]) -> Table:
    # All cases are held against one table, so that they have these quantities in common.
    quantities = list(cases[0].comparison.rms)
    rows = []
    for case in cases:
        c = case.comparison
        rows.append(
            [
                _label(case),
                *(f"{c.rms[q]:.1f}" for q in quantities),
                f"{c.overall:.1f}",
                *(f"{v:.1f}" for v in case.scores().values()),
            ]
        )
    header = [
        "model",
        *(QUANTITIES[q][2] for q in quantities),
        "all",
        f"fitted ({_angles(SOIL_FIT.fit_angles)})",
        f"held out inside ({_angles(SOIL_FIT.inside_angles)})",
        f"beyond ({_angles(SOIL_FIT.beyond_angles)})",
        f"apart ({_angles(SOIL_FIT.apart_angles)})",
    ]
    note = (
        "A model as good as a repeated run would score about 1. Nominal soils are never fitted to these measurements."
    )
    return Table("Root mean square error, in scatter of single runs", header, rows, note)


def _worst_table(cases: Sequence[Case]) -> Table:
    rows = []
    for case in cases:
        for quantity, w in case.comparison.worst.items():
            _, unit, name = QUANTITIES[quantity]
            scale, shown = (1e3, "mm") if unit == "m" else (1.0, unit)
            there = (f"{scale * v:.1f} {shown}" for v in (w.measured, w.predicted))
            place = (f"{w.slip_ratio:.2f}", f"{w.slip_angle_deg:g}")
            rows.append([_label(case), name, *place, *there, f"{w.residual:+.0f}"])
    header = ["model", "quantity", "slip ratio", "slip angle, deg", "measured", "model", "error, scatter"]
    return Table("Where each model is worst", header, rows, texts=2, folded=True)


def _fit_table(cases: Sequence[Case]) -> Table:
    rows = []
    for case in cases:
        if case.fit is None:
            continue
        for effect, values in case.fit.values.items():
            for name, value in values.items():
                edge = "at the edge of its range" if f"{effect}.{name}" in case.fit.at_bound else ""
                # Meaning and unit stand where the parameter is declared, so that page and catalogue cannot differ.
                known = next(e.parameters[name] for e in case.fit.bed.effects if e.name == effect)
                # a value that its range's width dwarfs is zero: a fit ends at 1e-30 where it would end at 0
                low, high = known.bounds
                value = 0.0 if abs(value) < 1e-9 * (high - low) else value
                unit = "" if known.unit == "1" else known.unit
                rows.append(
                    [_label(case), known.meaning or name, f"{effect}.{name}", f"{value:.4g} {unit}".rstrip(), edge]
                )
    starts = "; ".join(f"{_label(c)}: {c.fit.agreeing} of {len(c.fit.starts)}" for c in cases if c.fit)
    note = (
        "k_c and k_phi act only through k_c/b + k_phi on one wheel width: k_c is held at 0, and k_phi is that "
        "sum: six of the seven soil parameters are left. "
        f"Starts that agree with the best: {starts}. Values are those that these equations need, not the sand's own."
    )
    header = ["model", "what", "parameter", "value", ""]
    return Table("Refitted values", header, rows, note, texts=3, folded=True)


def _label(case: Case) -> str:
    return CASE_LABELS.get(case.name, case.name)


def versions() -> dict[str, str]:
    """Versions of what made the report."""
    # What rounding and compilation depend on; a run can be made again with these.
    packages = ("jax", "mujoco", "mujoco-mjx", "numpy", "scipy")
    return {"lunar-mjx": __version__, "python": platform.python_version(), **{p: metadata.version(p) for p in packages}}


def provenance_section(table: SteadyStateTable, terrain: str, seed: int) -> Section:
    """Where everything came from."""
    pairs = [
        ("Measurements", table.source.get("citation", "")),
        ("Measured by", table.source.get("who", "")),
        ("Licence of the measurements", table.source.get("licence", "")),
        (
            "Wheel",
            f"smooth, radius {1e3 * table.radius:g} mm, width {1e3 * table.width:g} mm (the radius is given "
            "as 58 mm in another publication of the group)",
        ),
        ("Points", f"{len(table)}, each the mean of {int(table.replicates.min())} or more runs"),
        (
            "Slip definition",
            "rim speed against travel speed in the table; the model is given both speeds and forms "
            "the slip of the wheel's frame (eq. 8) itself",
        ),
        ("Drive", f"preset consistent, terrain {terrain}, time step 2 ms, float32, seed {seed}"),
        ("Versions", ", ".join(f"{k} {v}" for k, v in versions().items())),
    ]
    return Section("Where this comes from", [Facts(pairs)])
