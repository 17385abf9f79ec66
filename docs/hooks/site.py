"""Hooks of mkdocs: tables of the physics from the catalogue at build time, and a navigation of the pages there are."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

from lunar_mjx.agents.evaluate import success_text
from lunar_mjx.effects.base import PORTS, Effect
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.joint.motor import WINDINGS
from lunar_mjx.effects.presets import FIELD_CHANGES, FLAWS, PRESETS, UNSAID
from lunar_mjx.effects.wheel.paper import REGULARISATIONS
from lunar_mjx.terrain.soil.named import SOILS


def on_config(config: Any) -> Any:
    """Leaves out pages that are not there."""
    config.nav = _present(config.nav, Path(config.docs_dir))
    return config


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Puts a table in place of each `<!-- table: name -->`."""
    return re.sub(r"<!-- table: (\w+) -->", lambda found: TABLES[found.group(1)](), markdown)


def _present(nav: Any, docs: Path) -> Any:
    if isinstance(nav, list):
        return [kept for entry in nav if (kept := _present(entry, docs)) is not None]
    if isinstance(nav, dict):
        kept = {title: inner for title, entry in nav.items() if (inner := _present(entry, docs))}
        return kept or None
    return nav if (docs / nav).is_file() else None


def effects() -> str:
    """Every effect of the catalogue, by the first port at which it acts."""
    out = []
    for port in PORTS:
        own = [e for e in CATALOGUE.values() if next(p for p in PORTS if p in e.ports) == port]
        if own:
            out.append(f"## Port `{port}`")
            out += [_effect(e) for e in own]
    return "\n\n".join(out)


def _effect(e: Effect) -> str:
    presets = [f"`{name}`" for name, names in PRESETS.items() if e.name in names]
    facts = [f"ports {', '.join(f'`{p}`' for p in e.ports)}"]
    facts.append(f"in the preset {' and '.join(presets)}" if presets else "in no preset")
    if e.replaces:
        facts.append(f"replaces {', '.join(f'`{r}`' for r in e.replaces)}")
    parts = [f"### {e.name}", cell(e.doc), f"*{'; '.join(facts)}*"]
    if e.parameters:
        rows = [
            [
                f"`{k}`",
                cell(p.meaning),
                f"{p.nominal:.6g}",
                "" if p.null is None else f"{p.null:.6g}",
                f"{p.bounds[0]:.4g} to {p.bounds[1]:.4g}",
                cell(p.unit),
                cell(p.source),
            ]
            for k, p in e.parameters.items()
        ]
        parts.append(table(["parameter", "meaning", "nominal", "null", "bounds", "unit", "source"], rows))
    if e.state:
        rows = [[f"`{k}`", cell(s.meaning), s.axis, cell(s.unit)] for k, s in e.state.items()]
        parts.append(table(["state", "meaning", "one per", "unit"], rows))
    return "\n\n".join(parts)


def presets() -> str:
    """Which effects each preset holds."""
    names = list(dict.fromkeys(name for listed in PRESETS.values() for name in listed))
    rows = [[f"`{n}`", *("yes" if n in listed else "" for listed in PRESETS.values())] for n in names]
    return table(["effect", *PRESETS], rows)


def flaws() -> str:
    """What the paper prints and what `consistent` computes."""
    rows = [[str(f.number), cell(f.where), cell(f.paper), cell(f.consistent), cell(f.mended_by)] for f in FLAWS]
    return table(["", "where", "`paper`", "`consistent`", "mended by"], rows)


def field() -> str:
    """What `consistent` leaves out and `field` computes."""
    rows = [[cell(text) for text in change] for change in FIELD_CHANGES]
    return table(["where", "`consistent`", "`field`", "mended by"], rows)


def field_measured() -> str:
    """What each effect of `field` does to VIPER, from the kept run."""
    kept = json.loads((Path(__file__).parents[2] / "benchmarks" / "field.json").read_text(encoding="utf-8"))
    columns = {
        "40 % slip at": ("slope_at_40_percent_slip_deg", "{:.1f}°"),
        "stalls at": ("stall_slope_deg", "{:.1f}°"),
        "stopping way, m": ("stopping_distance_m", "{:.3f}"),
        "dig-in, m": ("dig_in_m", "{:.3f}"),
        "drift": ("drift_across_10_deg", "{:.3f}"),
        "fastest, m/s": ("fastest_m_s", "{:.2f}"),
        "at, V": ("largest_voltage_V", "{:.0f}"),
        "housing warms, K": ("housing_rise_K", "{:.1f}"),
    }
    rows = [
        [cell(name), *("-" if row[k] is None else text.format(row[k]) for k, text in columns.values())]
        for name, row in kept["rows"].items()
    ]
    return table([f"at {kept['commit']}", *columns], rows)


RECORDS = Path(__file__).parents[2] / "benchmarks" / "rl"
LADDER = {
    1: {"PPO": "ladder-1-ppo", "SAC": "ladder-1-sac"},
    2: {"PPO": "ladder-2"},
    3: {"PPO": "ladder-3"},
    4: {"PPO, begun with rung 3's": "ladder-4", "PPO, begun anew": "ladder-4-scratch"},
}
"""Kept records of trainings on rungs of the ladder (`benchmarks/rl/kept.py`), by rung and by how was trained."""


def _seeds(name: str) -> list[dict[str, Any]]:
    return json.loads((RECORDS / f"{name}.json").read_text(encoding="utf-8"))["seeds"]


def _ladder(number: int) -> str:
    """Who arrives on a rung: each trained policy, and those that learn nothing, on the same unseen episodes."""
    finals = {
        f"{how}, seed {run['seed']}": run["final"]["rows"]
        for how, name in LADDER[number].items()
        for run in _seeds(name)
    }
    rows = [(how, rows["policy"]) for how, rows in finals.items()]
    rows += [(f"{how}, its scans blanked", rows["policy, scans blanked"]) for how, rows in finals.items()]
    # records of rungs on which the rule was never tuned call it so all the same
    tuned = str(number) in json.loads((RECORDS / "ladder.json").read_text(encoding="utf-8"))["tuned"]
    reactive = "reactive, tuned" if tuned else "reactive, not tuned"
    rules = {"mapper": "`mapper`", "reactive, tuned": reactive, "reactive": reactive, "scripted": "straight ahead"}
    # the newest run's, since the map by which a rule finds its way has changed
    newest = _seeds(next(iter(LADDER[number].values())))[-1]["final"]["rows"]
    rows += [(text, newest[name]) for name, text in rules.items() if name in newest]
    numbers = {"spl": "{:.2f}", "collisions_per_km": "{:.0f}", "wh_per_km": "{:.0f}", "slip": "{:.2f}"}
    header = [f"{rows[0][1]['episodes']} episodes", "success", "SPL", "collisions/km", "W h/km", "mean slip"]
    return table(header, [[n, success_text(r), *(text.format(r[k]) for k, text in numbers.items())] for n, r in rows])


def depth() -> str:
    """Who arrives with a depth picture in place of the height scan, on two tasks (`benchmarks/rl/kept.py`)."""
    kept = {"`large`": "large-depth", "rung 3": "ladder-3-depth"}
    agents = {
        "teacher": "teacher, sees the height scan",
        "student": "student, sees the picture",
        "blanked": "the same student, its picture blanked",
        "straight": "straight ahead",
    }
    rows = []
    for task, name in kept.items():
        found = json.loads((RECORDS / f"{name}.json").read_text(encoding="utf-8"))["final"]["rows"]
        for agent, text in agents.items():
            r = found[agent]
            costs = ["", ""] if r["spl"] is None else [f"{r['spl']:.2f}", f"{r['collisions_per_km']:.0f}"]
            rows.append([task, text, success_text(r), *costs, f"{r['episode_time']:.0f} s"])
    return table(["task", "256 episodes", "success", "SPL", "collisions/km", "mean episode"], rows)


def ladder_trainings() -> str:
    """What the trainings on rungs took."""
    header = [
        "rung",
        "learner",
        "seed",
        "device",
        "commit",
        "worlds made in",
        "compiled in",
        "steps",
        "training",
        "steps/s",
    ]
    rows = [
        [
            str(number),
            how,
            str(run["seed"]),
            cell(run["device"]),
            run["commit"],
            f"{run['worlds_s']:.0f} s",
            f"{max(run['compile_s']):.0f} s",
            f"{run['final']['steps'] / 1e6:.0f} M",
            f"{run['final']['elapsed_s']:.0f} s",
            f"{run['final']['steps'] / run['final']['elapsed_s'] / 1e6:.2f} M",
        ]
        for number, trained in LADDER.items()
        for how, name in trained.items()
        for run in _seeds(name)
    ]
    return table(header, rows)


def unsaid() -> str:
    """What the paper leaves unsaid, and where it needs regularising."""
    rows = [[cell(k), cell(str(v)), "unsaid"] for k, v in UNSAID.items()]
    rows += [[cell(k), cell(str(v)), "undefined"] for k, v in REGULARISATIONS.items()]
    return table(["what", "taken here", "in the paper"], rows)


def soils() -> str:
    """The soils by name."""
    keys = list(next(iter(SOILS.values())))
    return table(["soil", *keys], [[f"`{n}`", *(f"{s[k]:.6g}" for k in keys)] for n, s in SOILS.items()])


def windings() -> str:
    """The windings of the motor."""
    keys = list(next(iter(WINDINGS.values())))
    return table(["winding, V", *keys], [[str(n), *(f"{w[k]:.6g}" for k in keys)] for n, w in WINDINGS.items()])


TABLES = {
    "effects": effects,
    "presets": presets,
    "flaws": flaws,
    "field": field,
    "field_measured": field_measured,
    "depth": depth,
    **{f"ladder_{number}": partial(_ladder, number) for number in LADDER},
    "ladder_trainings": ladder_trainings,
    "unsaid": unsaid,
    "soils": soils,
    "windings": windings,
}
"""What a page may ask for by name."""


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def cell(text: str) -> str:
    """Text of a docstring as one line that Markdown takes literally."""
    return re.sub(r"([\\|*_<>\[\]`#])", r"\\\1", " ".join(text.split()))
