"""The loop of criticism on a real wheel: name the effect that is missing, add it, refit, and see the error fall.

    python benchmarks/real_wheel.py [--seconds 600] [--anew]

CMU's smooth wheel. Slip angles 0, 30, 60 deg are fitted; 15 and 45 (inside) and 75 (extrapolated) are never fitted and
choose nothing; 90 is apart. Errors are root mean squares in pooled standard deviations of single runs. The soil is held
to dry sand. One compiled wheel holds every effect, at its null until it is added. All effects together are fitted from
several starts. Where no effect pays any more, every formula that `lunar-mjx unknown` knows at the wheel's ports is
scored, and the best are refitted. Every step is written to `real_wheel.json` at once, and a run that was stopped goes
on from there; the waterfall is `docs/figures/real_wheel.svg`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import least_squares

from lunar_mjx.criticism import WheelBed, WheelTest, load_figures
from lunar_mjx.diagnosis.formulas.terms import effect_of, terms
from lunar_mjx.effects.base import Effect
from lunar_mjx.inference.score import project

ROOT = Path(__file__).resolve().parents[1]
RESULT, FIGURE = ROOT / "benchmarks" / "real_wheel.json", ROOT / "docs" / "figures" / "real_wheel.svg"
PARTS = {"fitted": (0, 30, 60), "inside": (15, 45), "extrapolated": (75,), "held_out": (15, 45, 75)}
FORMULA_PORTS = ("soil", "wheel_normal", "wheel_shear")
"""Ports of a wheel where formulas are sought."""
LEAST = 25.0
"""Least drop of chi-square by an effect that is added."""
BATCH = 24
"""Models that run side by side."""
STARTS, SPREAD, AGREE = 6, 1.5, 3.0
"""Starts of the fit of all effects, their spread in scales, and the chi-square within which two agree."""


class Free(NamedTuple):
    """A parameter that a fit moves: start and bounds of its value, its scale, and whether its logarithm moves."""

    effect: str
    name: str
    start: float
    low: float
    high: float
    scale: float
    log: bool = False


SOIL_FREE = (
    Free("soil", "k_phi", 3.0e6, 1e4, 1e9, 0.5, True),
    Free("soil", "n", 1.1, 0.5, 1.6, 0.2),
    Free("soil", "friction_angle", 0.56, 0.489, 0.663, 0.05),
    Free("soil", "cohesion", 50.0, 0.0, 500.0, 100.0),
    Free("soil", "shear_modulus_x", 0.015, 1e-3, 0.1, 0.3, True),
    Free("soil", "shear_modulus_y", 0.015, 1e-3, 0.1, 0.3, True),
)
"""Bounds are those of dry sand: 28 to 38 deg of friction, no more than 0.5 kPa of (apparent) cohesion."""
EFFECTS: Mapping[str, tuple[Free, ...]] = {
    "friction_circle": (Free("friction_circle", "share", 0.0, 0.0, 1.0, 0.5),),
    "exit_angle": (
        Free("exit_angle", "c1", 0.5, 0.05, 0.95, 0.1),
        Free("exit_angle", "c2", 0.0, -0.5, 0.5, 0.1),
        Free("exit_angle", "c3", 0.0, 0.0, 0.9, 0.2),
        Free("exit_angle", "c4", 0.0, -0.9, 0.9, 0.2),
    ),
    "slide_softening": (Free("slide_softening", "softening", 0.0, 0.0, 20.0, 0.5),),
    "side_entry": (Free("side_entry", "kept", 1.0, 0.0, 1.0, 0.3),),
    "side_exit": (Free("side_exit", "lost", 0.0, 0.0, 1.0, 0.3),),
    "shear_softening": (Free("shear_softening", "loss", 0.0, 0.0, 0.98, 0.3),),
    "skid_shear": (Free("skid_shear", "share", 0.0, 0.0, 0.99, 0.5),),
    "side_wall": (
        Free("side_wall", "pressure", 0.0, 0.0, 2.0, 0.5),
        Free("side_wall", "build_up", 4.0, 0.1, 20.0, 0.5, True),
    ),
}
"""Candidates and what they free, from their nulls. The order is that of adding to the wheel, and means nothing else."""
TOGETHER = {
    "soil.n": 1.2,
    "soil.k_phi": 1e7,
    "soil.friction_angle": 0.6,
    "soil.cohesion": 200.0,
    "soil.shear_modulus_x": 0.02,
    "soil.shear_modulus_y": 0.03,
    "friction_circle.share": 0.7,
    "exit_angle.c1": 0.8,
    "exit_angle.c3": 0.8,
    "exit_angle.c4": 0.4,
    "slide_softening.softening": 0.7,
    "side_entry.kept": 0.3,
    "shear_softening.loss": 0.6,
    "skid_shear.share": 0.7,
    "side_exit.lost": 0.7,
    "side_wall.pressure": 1.4,
}
"""First start of the fit of all effects together: they help only jointly, and one by one may lead elsewhere."""


class Bench:
    """The measured wheel, and one compiled wheel bed with every candidate in it."""

    def __init__(self, formulas: Sequence[Effect] = ()) -> None:
        self.table = load_figures()
        bed = WheelBed(["soil", "pressure_sinkage", "closed_form_shear"]).with_effect("stress_integral")
        for name in EFFECTS:
            bed = bed.with_effect(name)
        self.bed = bed.with_values({e: {f.name: f.start for f in free} for e, free in EFFECTS.items()})
        self.bed = self.bed.with_values({"soil": {"k_c": 0.0}})
        for formula in formulas:
            self.bed = self.bed.with_effect(formula, **formula.null())
        with jax.enable_x64(True):
            self.test = self.table.wheel_test()
        self.angle = np.round(self.table.test["slip_angle_deg"])
        self.keep = np.isin(self.angle, PARTS["fitted"])
        self._fitted_test = WheelTest(*(np.asarray(v)[self.keep] for v in dataclasses.astuple(self.test)))
        self._batch = jax.jit(jax.vmap(self.bed, in_axes=(0, None)))

    def fitted(self, rows: Sequence[Mapping[str, Mapping[str, float]]]) -> np.ndarray:
        """(rows, points x quantities) residuals of many sets of values at the fitted angles, in sigma."""
        done = []
        for at in range(0, len(rows), BATCH):
            part = [self.bed.merged(values) for values in rows[at : at + BATCH]]
            full = part + [part[-1]] * (BATCH - len(part))
            with jax.enable_x64(True):
                stacked = jax.tree.map(lambda *v: np.array(v, float), *full)
                result = jax.device_get(self._batch(stacked, self._fitted_test))
            columns = [
                (getattr(result, q) - v[self.keep]) / self.table.sigma[q] for q, v in self.table.measured.items()
            ]
            done.append(np.stack(columns, axis=-1).reshape(BATCH, -1)[: len(part)])
        return np.concatenate(done)

    def residuals(self, values: Mapping[str, Mapping[str, float]]) -> np.ndarray:
        """(points, quantities) model less measurement, in sigma of single runs."""
        result = self.bed.with_values(values).run(self.test)
        return np.column_stack([(getattr(result, q) - v) / self.table.sigma[q] for q, v in self.table.measured.items()])

    def errors(self, residual: np.ndarray) -> dict[str, Any]:
        """Errors by part, and by quantity."""
        out: dict[str, Any] = {}
        for part, angles in PARTS.items():
            keep = np.isin(self.angle, angles)
            out[part] = float(np.sqrt(np.mean(residual[keep] ** 2)))
            rms = np.sqrt(np.mean(residual[keep] ** 2, axis=0))
            out[f"{part}_by_quantity"] = dict(zip(self.table.measured, rms.tolist(), strict=True))
        return out


class Model:
    """Parameters that move, with their places as scaled numbers."""

    def __init__(self, bench: Bench, free: Sequence[Free]):
        self.bench, self.free = bench, tuple(free)

    def values(self, u: np.ndarray) -> dict[str, dict[str, float]]:
        out: dict[str, dict[str, float]] = {}
        for f, x in zip(self.free, u, strict=True):
            out.setdefault(f.effect, {})[f.name] = float(
                f.start * np.exp(f.scale * x) if f.log else f.start + f.scale * x
            )
        return out

    def place(self, values: Mapping[str, float]) -> np.ndarray:
        """Coordinates of values by "effect.name"; the start where none is given."""
        out = []
        for f in self.free:
            v = values.get(f"{f.effect}.{f.name}", f.start)
            out.append(np.log(v / f.start) / f.scale if f.log else (v - f.start) / f.scale)
        return np.array(out)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        low = [np.log(f.low / f.start) / f.scale if f.log else (f.low - f.start) / f.scale for f in self.free]
        high = [np.log(f.high / f.start) / f.scale if f.log else (f.high - f.start) / f.scale for f in self.free]
        return np.array(low), np.array(high)

    def fitted(self, u: np.ndarray) -> np.ndarray:
        return self.bench.fitted([self.values(u)])[0]

    def jacobian(self, u: np.ndarray, first: int = 0) -> np.ndarray:
        """Columns of derivatives from the coordinate `first` on."""
        return self.linear(u, first)[1]

    def linear(self, u: np.ndarray, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and one-sided differences, inward at a bound: the sinkage is exact to rounding, without noise."""
        _, high = self.bounds()
        step = np.where(u + 1e-5 < high, 1e-5, -1e-5)
        moved = [u, *(u + step[i] * np.eye(len(u))[i] for i in range(first, len(u)))]
        found = self.bench.fitted([self.values(v) for v in moved])
        return found[0], np.nan_to_num(((found[1:] - found[0]) / step[first:, None]).T)

    def fit(self, start: np.ndarray, evaluations: int = 40) -> tuple[np.ndarray, float, int]:
        """Least squares from a start; place, chi-square and number of evaluations."""
        low, high = self.bounds()
        start = np.clip(start, low + 1e-6, high - 1e-6)
        last: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

        def both(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            if u.tobytes() not in last:
                last.clear()
                last[u.tobytes()] = self.linear(u)
            return last[u.tobytes()]

        found = least_squares(
            lambda u: both(u)[0], start, lambda u: both(u)[1], (low, high), x_scale=1.0, max_nfev=evaluations, ftol=1e-4
        )
        return found.x, float(2.0 * found.cost), int(found.nfev)


def flat(values: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    return {f"{e}.{k}": v for e, row in values.items() for k, v in row.items()}


def free_of(effects: Sequence[str]) -> list[Free]:
    return [*SOIL_FREE, *(f for e in effects for f in EFFECTS[e])]


def row(bench: Bench, name: str, effects: Sequence[str], model: Model, u: np.ndarray, **more: Any) -> dict[str, Any]:
    values = model.values(u)
    low, high = model.bounds()
    at = [
        f"{f.effect}.{f.name}"
        for f, x, a, b in zip(model.free, u, low, high, strict=True)
        if x < a + 1e-3 or x > b - 1e-3
    ]
    found = {
        "model": name,
        "effects": list(effects),
        "free_parameters": len(u),
        "values": flat(values),
        "at_bound": at,
        **bench.errors(bench.residuals(values)),
        **more,
    }
    print(
        f"{name:44} fitted {found['fitted']:6.2f}  inside {found['inside']:6.2f}  75 deg {found['extrapolated']:6.2f}"
        f"  together {found['held_out']:6.2f}",
        flush=True,
    )
    return found


def presets() -> list[dict[str, Any]]:
    """The presets as they are and refitted with the closed form, as `wheel_fits.py` measured them."""
    kept = json.loads((ROOT / "benchmarks" / "wheel_fits.json").read_text())
    rows = []
    for preset, case in (("paper", "paper, soil and contact"), ("consistent", "consistent, soil")):
        r = next(r for r in kept if r["name"] == case)
        for name, e in ((preset, r["nominal"]), (f"{preset}, refitted", r)):
            rows.append(
                {
                    "model": name,
                    "effects": [],
                    "fitted": e["fitted"],
                    "inside": e["inside"],
                    "held_out": e["held_out"],
                    "extrapolated": e.get("beyond", float("nan")),
                }
            )
            print(f"{name:44} fitted {e['fitted']:6.2f}  together {e['held_out']:6.2f}", flush=True)
    return rows


def scores(model: Model, u: np.ndarray, rest: Mapping[str, Sequence[Free]]) -> dict[str, float]:
    """Drop of chi-square that each candidate promises in linear approximation, a refit of the present model counted."""
    residual, now = model.linear(u)
    out = {}
    for effect, free in rest.items():
        columns = Model(model.bench, [*model.free, *free]).jacobian(np.concatenate([u, np.zeros(len(free))]), len(u))
        left = project(columns, now, np.full(now.shape[1], 1e-3))[: len(residual)]
        amount = np.linalg.lstsq(left, residual, rcond=1e-6)[0]
        out[effect] = float(residual @ left @ amount)
    return out


def together(bench: Bench, result: dict[str, Any], late: Callable[[], bool], save: Callable[[], None]) -> None:
    """Fits all effects from several starts; the held-out angles are looked at for the best on the fitted ones alone."""
    model, fits = Model(bench, free_of(list(EFFECTS))), result.setdefault("starts", [])
    rng = np.random.default_rng(0)
    ways = [np.zeros(len(model.free)), *rng.normal(0.0, SPREAD, (STARTS - 1, len(model.free)))]
    for way in ways[len(fits) :]:
        if late():
            return
        u, chi2, count = model.fit(model.place(TOGETHER) + way)
        fits.append({"chi2": chi2, "evaluations": count, "values": flat(model.values(u))})
        print(f"start {len(fits)}: chi-square {chi2:.1f}", flush=True)
        save()
    best = min(fits, key=lambda f: f["chi2"])
    near = sum(f["chi2"] < best["chi2"] + AGREE for f in fits)
    result["together"] = row(
        bench,
        "all together",
        list(EFFECTS),
        model,
        model.place(best["values"]),
        chi2=best["chi2"],
        starts=len(fits),
        agreeing=near,
    )
    save()


def climb(bench: Bench, result: dict[str, Any], late: Callable[[], bool], save: Callable[[], None]) -> None:
    """Adds the best-scored effect, refits, and goes on while one pays and time is left."""
    ladder = result["ladder"]
    if not ladder:
        model = Model(bench, SOIL_FREE)
        u, chi2, count = model.fit(model.place({}))
        ladder.append(row(bench, "stress integral, refitted", (), model, u, chi2=chi2, evaluations=count))
        save()
    while not late() and "finished" not in result:
        added = ladder[-1]["effects"]
        model = Model(bench, free_of(added))
        u = model.place(ladder[-1]["values"])
        ranked = scores(model, u, {e: f for e, f in EFFECTS.items() if e not in added})
        for best in sorted(ranked, key=lambda e: -ranked[e])[:2]:
            grown = Model(bench, free_of([*added, best]))
            place, chi2, count = grown.fit(grown.place(ladder[-1]["values"]))
            if ladder[-1]["chi2"] - chi2 >= LEAST:
                ladder.append(
                    row(bench, f"+ {best}", [*added, best], grown, place, chi2=chi2, evaluations=count, why=ranked)
                )
                break
        else:
            result["finished"] = ranked
        save()


def unknown(result: Mapping[str, Any], most: int = 5) -> dict[str, Any]:
    """What `unknown` suggests for the remainder of the last model: every formula scored, the best refitted.

    Only the fitted angles score and refit. The model itself is refitted once more, too, so that a formula gets no
    credit for another round of the same descent.
    """
    last = result["ladder"][-1]
    library = {t.name: t for port in FORMULA_PORTS for t in terms(port)}
    effects = {name: effect_of(t) for name, t in library.items()}
    bench = Bench(list(effects.values()))
    model = Model(bench, free_of(last["effects"]))
    u, chi2, _ = model.fit(model.place(last["values"]))
    base = row(bench, f"{last['model']}, refitted once more", last["effects"], model, u, chi2=chi2)
    free = {n: (Free(n, "amount", 0.0, *effects[n].parameters["amount"].bounds, t.size),) for n, t in library.items()}
    ranked = scores(model, u, free)
    suggestions = []
    for name in sorted(ranked, key=lambda n: -ranked[n])[:most]:
        t, grown = library[name], Model(bench, [*model.free, *free[name]])
        place, better, _ = grown.fit(grown.place(flat(model.values(u))))
        found = row(bench, f"+ {t.target}: {t.formula}", [*last["effects"], name], grown, place, chi2=better)
        suggestions.append(
            {
                "port": t.port,
                "target": t.target,
                "formula": t.formula,
                "unit": t.unit,
                "amount": found["values"][f"{name}.amount"],
                "score": ranked[name],
                **{k: v for k, v in found.items() if k not in ("effects", "model")},
            }
        )
    listed = {f"{library[n].target}: {library[n].formula}": v for n, v in ranked.items()}
    return {
        "of": base,
        "suggestions": sorted(suggestions, key=lambda r: r["chi2"]),
        "scored": dict(sorted(listed.items(), key=lambda r: -r[1])),
    }


def draw(result: Mapping[str, Any]) -> None:
    """The waterfall of the error."""
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    rows = [*result.get("presets", []), *result["ladder"], *([result["together"]] if "together" in result else [])]
    fig, ax = plt.subplots(figsize=(9.0, 4.2), layout="constrained")
    for part, mark in (("fitted", "o"), ("inside", "s"), ("extrapolated", "^")):
        angles = ", ".join(str(a) for a in PARTS[part])
        ax.plot([r[part] for r in rows], mark + "-", label=f"{part}: {angles} deg", linewidth=1.2, markersize=5)
    for level, label in ((2.5, "target inside"), (5.0, "target extrapolated"), (1.0, "replicates")):
        ax.axhline(level, color="0.6", linewidth=0.8, linestyle=":")
        ax.annotate(label, (0, level), fontsize=7, color="0.4", va="bottom")
    ax.set_yscale("log")
    ax.set_yticks([1, 2, 5, 10, 20, 40], ["1", "2", "5", "10", "20", "40"])
    ax.set_ylabel("error, sigma of single runs")
    ax.set_xticks(range(len(rows)), [r["model"] for r in rows], rotation=35, ha="right", fontsize=8)
    ax.legend(frameon=False, fontsize=8)
    fig.savefig(FIGURE, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1e9, help="no new step is begun after this time")
    parser.add_argument("--anew", action="store_true", help="forget what is on disk")
    chosen = parser.parse_args()
    start = time.perf_counter()
    result = json.loads(RESULT.read_text()) if RESULT.is_file() and not chosen.anew else {}
    result = {"unit": "pooled standard deviation of single runs", "ladder": [], **result}

    def save() -> None:
        RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")

    bench = Bench()

    def late() -> bool:
        return time.perf_counter() - start > chosen.seconds

    if "together" not in result:
        together(bench, result, late, save)
    if "presets" not in result:
        result["presets"] = presets()
        save()
    climb(bench, result, late, save)
    if "finished" in result and "unknown" not in result and not late():
        result["unknown"] = unknown(result)
        save()
    draw(result)


if __name__ == "__main__":
    main()
