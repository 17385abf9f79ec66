"""The benchmark's table: every row with counts, Wilson 95 % intervals and its target; and a figure of the answers.

"Who was told" is told what is hidden and how the noise is correlated (`told`), but has no priors.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .judge import NAMES
from .noise import NOISES
from .separable import SEPARABLE

Row = Mapping[str, Any]
_Z = 1.959964


def wilson(hits: int, number: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    if number == 0:
        return 0.0, 1.0
    p, z2 = hits / number, _Z**2 / number
    middle = (p + 0.5 * z2) / (1.0 + z2)
    half = _Z * np.sqrt(p * (1.0 - p) / number + 0.25 * z2 / number) / (1.0 + z2)
    return float(max(0.0, middle - half)), float(min(1.0, middle + half))


def share(rows: Sequence[Row], hit: Callable[[Row], bool]) -> dict[str, Any]:
    """Count, share and interval."""
    hits = sum(bool(hit(r)) for r in rows)
    low, high = wilson(hits, len(rows))
    return {"hits": hits, "of": len(rows), "share": hits / len(rows) if rows else None, "low": low, "high": high}


def _spread(values: Sequence[float], *quantiles: float) -> dict[str, Any]:
    known = [v for v in values if v is not None and np.isfinite(v)]
    out: dict[str, Any] = {"of": len(known)}
    for q in quantiles:
        out[f"q{100 * q:g}"] = float(np.quantile(known, q)) if known else None
    return out


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Every figure of the benchmark, for all rows and by kind of log."""
    kinds = sorted({r["kind"] for r in rows})
    return {"all": _figures(rows), **{k: _figures([r for r in rows if r["kind"] == k]) for k in kinds}}


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    by = {g: [r for r in rows if r["group"] == g] for g in {r["group"] for r in rows}}

    def group(name: str) -> list[Row]:
        return by.get(name, [])

    right: Callable[[Row], bool] = lambda r: r["right"]  # noqa: E731
    wrong: Callable[[Row], bool] = lambda r: r["wrong_name"]  # noqa: E731
    nulls, outside = group("nulls"), group("outside")
    suggested = [r for r in outside if r.get("suggestions")]
    named = [r for r in rows if r["right"] and r["verdict"] in NAMES and r.get("over_floor")]
    values = [p for r in named if r["group"] == "singles" for p in r.get("parameters", ())]
    told = [r for r in named if r.get("told")]
    best = [p for r in told if r["group"] == "singles" for p in r["told"]["parameters"]]
    return {
        "singles": {"target": ">= 0.97", **share(group("singles"), right)},
        "singles, wrong name": share(group("singles"), wrong),
        "singles at 5 times the noise": {"target": ">= 0.80", **share(group("singles_x5"), right)},
        "singles at 5 times the noise, wrong name": {"target": "<= 0.02", **share(group("singles_x5"), wrong)},
        "singles at 5 times the noise, separable there": share(
            [r for r in group("singles_x5") if r["separable"] >= SEPARABLE * r["scale"]], right
        ),
        "nulls, false alarm": {"target": "<= 0.01", **share(nulls, lambda r: r["outcome"] == "false alarm")},
        "nulls, something named": share(nulls, wrong),
        "nulls, not answered": share(nulls, lambda r: r["outcome"] in ("refused", "crash")),
        "pairs, all named": {"target": ">= 0.85", **share(group("pairs"), right)},
        "pairs, wrong name": share(group("pairs"), wrong),
        "triples, all named": {"target": ">= 0.70", **share(group("triples"), right)},
        "outside the catalogue": {"target": ">= 0.90", **share(outside, right)},
        "outside, right port": {
            "target": ">= 0.85",
            **share(
                [r for r in outside if r["verdict"] == "UNKNOWN"], lambda r: r.get("port") in r.get("true_ports", ())
            ),
        },
        "outside, one of three formulas fits": {
            "target": ">= 0.80",
            **share(suggested, lambda r: any(s.get("at_noise") for s in r["suggestions"])),
        },
        "undecidable, called so": {"target": ">= 0.95", **share(group("undecidable"), right)},
        "sabotaged, BAD_DATA": {"target": ">= 0.95", **share(group("sabotaged"), right)},
        "dirt, wrong name": share(group("dirt"), wrong),
        "held-out error over the floor": {
            "target": "median <= 1.01, 95th percentile <= 1.03",
            **_spread([r["over_floor"] for r in named], 0.5, 0.95),
        },
        **{
            f"held-out error over the floor, {noise}": _spread(
                [r["over_floor"] for r in named if r.get("noise") == noise], 0.5, 0.95
            )
            for noise in NOISES
        },
        "the same, by who was told": _spread([r["told"]["over_floor"] for r in told], 0.5, 0.95),
        "held-out error over that of who was told": _spread(
            [r["over_floor"] / r["told"]["over_floor"] for r in told if r["told"]["over_floor"]], 0.5, 0.95
        ),
        "relative parameter error": {
            "target": "median <= 0.02, 90th percentile <= 0.10",
            **_spread([p["error"] for p in values], 0.5, 0.9),
        },
        "parameter error by who was told": _spread([p["error"] for p in best], 0.5, 0.9),
        "the same, where the stated error is below a tenth": _spread(
            [p["error"] for p in values if p["std"] < 0.1 * abs(p["value"])], 0.5, 0.9
        ),
        "95 % interval covers": {"target": "0.93 to 0.97", **share(values, lambda p: p["covered"])},
        "95 % interval of who was told covers": share(best, lambda p: p["covered"]),
        "seconds": _spread([r.get("seconds", 0.0) for r in rows], 0.5, 0.9),
        "crashes": share(rows, lambda r: r["verdict"] == "CRASH"),
        "by effect": _by_effect(group("singles")),
        "dirt by size": _by_dirt(group("dirt")),
        "by noise": {
            n: share([r for r in group("nulls") if r.get("noise") == n], lambda r: r["outcome"] == "false alarm")
            for n in sorted({str(r.get("noise")) for r in group("nulls")})
        },
    }


def _by_effect(rows: Sequence[Row]) -> dict[str, Any]:
    names = sorted({n for r in rows for n in r["truth"]["effects"]})
    return {n: share([r for r in rows if n in r["truth"]["effects"]], lambda r: r["right"]) for n in names}


def _by_dirt(rows: Sequence[Row]) -> dict[str, Any]:
    out = {}
    for size in sorted({r["dirt"] for r in rows}):
        here = [r for r in rows if r["dirt"] == size]
        verdicts = sorted({r["verdict"] for r in here})
        out[f"{size:g}"] = {
            "wrong name": share(here, lambda r: r["wrong_name"]),
            **{v: sum(r["verdict"] == v for r in here) for v in verdicts},
        }
    return out


def text(figures: Mapping[str, Any]) -> str:
    """The table as plain text."""
    lines = []
    for name, f in figures.items():
        if "hits" in f and f["of"]:
            value = f"{f['hits']}/{f['of']} = {100 * f['share']:.1f} % ({100 * f['low']:.1f} to {100 * f['high']:.1f})"
        elif "q50" in f and f["of"]:
            value = ", ".join(f"{k} {v:.4g}" for k, v in f.items() if k.startswith("q")) + f" (of {f['of']})"
        else:
            continue
        lines.append(f"{name:<42} {value:<42} {f.get('target', '')}")
    return "\n".join(lines)


GROUPS = {
    "nulls": "nothing hidden",
    "singles": "one effect",
    "singles_x5": "one, at five times the noise",
    "pairs": "two effects",
    "triples": "three effects",
    "outside": "one that is not listed",
    "undecidable": "one that a refit takes in",
    "dirt": "a growing disturbance",
    "sabotaged": "a sabotaged log",
}
"""What was hidden, by the first part of a case's name."""


def answers(cases: Sequence[Row]) -> dict[str, tuple[int, int, int]]:
    """Right answers, those short of it that name nothing wrong, and wrong names, by what was hidden."""
    found = {}
    for group, title in GROUPS.items():
        here = [c for c in cases if str(c["case"]).rsplit("-", 1)[0] == group]
        if here:
            wrong = sum(bool(c["wrong_name"]) for c in here)
            right = sum(bool(c["right"]) and not c["wrong_name"] for c in here)
            found[title] = right, len(here) - right - wrong, wrong
    return found


def plot(counts: Mapping[str, Sequence[int]], path: Path) -> None:
    """Draws bars of right and wrong answers by what was hidden.

    Args:
      counts: of right answers, those short of it and wrong names, by what was hidden (`answers`). path: of the picture.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from lunar_mjx.report.style import BLUE, PAPER, SKY, VERMILION, save_light_and_dark, styled

    shares = np.array([np.array(c) / sum(c) for c in counts.values()])
    kinds = (
        ("right", BLUE, ""),
        ("short of it, nothing wrong named", SKY, "////"),
        ("a wrong name", VERMILION, "xxxx"),
    )
    with styled():
        figure, axes = plt.subplots(figsize=(7.2, 1.2 + 0.32 * len(counts)), layout="constrained")
        left, places = np.zeros(len(counts)), np.arange(len(counts))
        for (label, colour, hatch), part in zip(kinds, 100 * shares.T, strict=True):
            axes.barh(places, part, 0.62, left, color=colour, hatch=hatch, edgecolor=PAPER, linewidth=0, label=label)
            left += part
        for place, (right, short, wrong) in enumerate(counts.values()):
            axes.text(101, place, f"{right} of {right + short + wrong}", va="center", fontsize=8)
        axes.set_yticks(places, list(counts))
        axes.invert_yaxis()
        axes.set_xlim(0, 114)
        axes.set_xticks(range(0, 101, 20))
        axes.grid(axis="y", visible=False)
        axes.set_xlabel("share of the cases, %")
        figure.legend(loc="outside upper left", ncols=3)
        save_light_and_dark(figure, path, dpi=150)
        plt.close(figure)


def write(rows: Sequence[Row], out: Path, seeds: Sequence[Mapping[str, Any]]) -> str:
    """Writes `OUT.json` and `OUT.png`; returns the table as text.

    The record keeps the figures, the counts of answers and the cases that were not answered rightly; the seed of the
    campaign makes any of the others anew.
    """
    figures = summarise(rows)
    out.parent.mkdir(parents=True, exist_ok=True)
    counts = answers(rows)
    shown = ("case", "kind", "verdict", "named", "outcome", "right", "wrong_name")
    missed = [{k: r.get(k) for k in shown} for r in rows if not r.get("right") or r.get("wrong_name")]
    content = {"figures": figures, "campaigns": list(seeds), "answers": counts, "missed": missed}
    out.with_suffix(".json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    plot(counts, out.with_suffix(".png"))
    return "\n\n".join(f"{kind}\n{text(f)}" for kind, f in figures.items())
