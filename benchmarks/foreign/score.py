"""Scores answers against sealed truths: wrong names, found names, ports, reliability, with Wilson intervals."""

from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from . import kinds
from .work import RESULT, commit

NAMES = ("KNOWN", "KNOWN_CLASS", "MULTIPLE")
"""Verdicts that name an effect."""
SEPARABLE = 8.0
"""Sigma beyond which an effect counts as separable to who is told."""
CLASS = 3
"""Largest class of effects that still counts as an answer."""
CALIBRATION = re.compile(r"calibration: (?!wheel)|^(channel_scale|cross_talk|slip_offset|load_cell)$")
"""Every bed here has errors of calibration (not of the wheel's size): naming them is no mistake, and no find either."""
ALIASES = {
    "channel_scale": re.compile(r"calibration: (drawbar_pull|side_force|driving_torque|force|torque)"),
    "wheel_radius_error": re.compile(r"calibration: wheel.radius"),
}
"""Further names under which a hidden effect is right."""
UNLISTED = re.compile(r"unlisted|something else|discrepancy|unknown", re.IGNORECASE)

QUIET = ("none", "nothing", "noise", "noise_only", "null", "base", "baseline")
"""What a hypothesis without any effect may be called."""

Row = dict[str, Any]


def wilson(hits: int, of: int) -> list[float]:
    """A share's 95 % interval (Wilson 1927)."""
    if not of:
        return [0.0, 1.0]
    z, p = 1.959964, hits / of
    middle, spread = p + z * z / (2 * of), z * math.sqrt(p * (1 - p) / of + z * z / (4 * of * of))
    return [max(0.0, (middle - spread) / (1 + z * z / of)), min(1.0, (middle + spread) / (1 + z * z / of))]


def share(flags: Iterable[bool]) -> Row:
    """Hits, number and interval of a list of flags."""
    flags = [bool(f) for f in flags]
    return {"hits": sum(flags), "of": len(flags), "interval": [round(b, 4) for b in wilson(sum(flags), len(flags))]}


def names_of(hypothesis: str) -> set[str]:
    """Effects of a hypothesis such as "slip_sinkage + unlisted at wheel_normal"."""
    return {part for part in re.split(r"\s*(?:\+|&|,|;|\band\b)\s*", hypothesis.strip()) if part}


def said(answer: Mapping[str, Any], verdict: Mapping[str, Any]) -> Row:
    """What a run says, whatever the shape of `verdict.json`: verdict, effects, port, unlisted, probabilities.

    Args:
      answer: `result.json` of a case. verdict: its `verdict.json`, {} where there is none.
    """
    label = str(answer.get("verdict") or "CRASH")
    raw = [str(e) for e in verdict.get("effects") or answer.get("effects") or []]
    effects = [e for e in raw if not UNLISTED.search(e)]
    # Before verdicts said so themselves, a class of one effect meant that effect or something unlisted.
    said_so = verdict.get("unlisted", label == "KNOWN_CLASS" and len(effects) == 1)
    unlisted = len(effects) < len(raw) or bool(said_so)
    port = verdict.get("port")
    ports = [str(p).partition(":")[0] for p in (port if isinstance(port, list) else [port]) if p]
    return {
        "verdict": label,
        "effects": effects,
        "unlisted": unlisted,
        "ports": ports,
        "further": [str(e) for e in verdict.get("further") or ()],
        "probabilities": _numbers(verdict.get("probabilities")),
        "inclusion": _numbers(verdict.get("inclusion")),
    }


def _numbers(value: Any) -> dict[str, float]:
    """A mapping of names to probabilities, from a mapping or a list of {hypothesis|name|effects, probability}."""
    found: dict[str, float] = {}
    if isinstance(value, Mapping):
        pairs = list(value.items())
    elif isinstance(value, list):
        pairs = [
            (v.get("hypothesis") or v.get("name") or v.get("effects") or v.get("effect") or "", v.get("probability"))
            for v in value
            if isinstance(v, Mapping)
        ]
    else:
        pairs = []
    for name, number in pairs:
        if isinstance(number, Mapping):
            number = number.get("probability", number.get("p"))
        if isinstance(name, list | tuple):
            name = " + ".join(map(str, name))
        if isinstance(number, int | float) and math.isfinite(number):
            found[str(name)] = float(number)
    return found


def right(name: str, truth: Mapping[str, Any]) -> str:
    """The hidden effect that a name stands for, or ""."""
    if name in truth["hidden"]:
        return name
    return next((h for h in truth["hidden"] if h in ALIASES and ALIASES[h].match(name)), "")


def neutral(name: str, truth: Mapping[str, Any]) -> bool:
    """Whether naming an effect is neither right nor wrong: the base law or the bed's calibration earns the name."""
    return not right(name, truth) and (name in truth["holds"] or bool(CALIBRATION.search(name)))


def judge(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> Row:
    """What an answer is worth.

    Args:
      truth: sealed truth of a case. answer: as `said` returns.

    Returns:
      `wrong_name`: something is named with confidence that is not there. `wrong_strict`: the same where names that the
      base law earns count as wrong, too. `found`: the hidden effects are named, or in a class of at most three.
      `at_port`: something unlisted is said to act where the hidden effect does, and nothing wrong beside it.
      `outside_right`: of a case outside the catalogue, its port or its class with "unlisted" is given.
    """
    hidden, effects, label = set(truth["hidden"]), list(answer["effects"]), answer["verdict"]
    confident = label in NAMES
    good = [e for e in effects if right(e, truth)]
    excused = [e for e in effects if neutral(e, truth)]
    bad = [e for e in effects if e not in good and e not in excused]
    if label == "KNOWN_CLASS":
        # A class says "one of these": it is wrong where none of them is there and nothing unlisted is offered.
        wrong = bool(bad) and not good and not excused and not answer["unlisted"]
        strict = bool(effects) and not good and not answer["unlisted"]
    else:
        wrong, strict = confident and bool(bad), confident and len(good) < len(effects)
    number = len([e for e in effects if not neutral(e, truth)])
    # Beside what is named, a verdict may say that one of a class acts, too.
    further = list(answer.get("further", ()))
    nearby = [e for e in further if right(e, truth)]
    if further and not nearby and not answer["unlisted"]:
        wrong = wrong or not any(neutral(e, truth) for e in further)
        strict = True
    if label == "KNOWN_CLASS":
        found = bool(good) and number <= CLASS
    else:
        small = len([e for e in further if not neutral(e, truth)]) <= CLASS
        told = {right(e, truth) for e in [*good, *(nearby if small else [])]}
        found = confident and bool(told) and not bad and hidden <= told
    right_port = bool(set(answer["ports"]) & set(truth["ports"]))
    by_port = label == "UNKNOWN" and right_port
    by_more = label in ("KNOWN", "MULTIPLE") and answer["unlisted"] and right_port and not bad and not wrong
    # What UNKNOWN lists beside its port helps only; it is no name.
    at_port = right_port and (label == "UNKNOWN" or (answer["unlisted"] and not bad))
    by_class = label == "KNOWN_CLASS" and answer["unlisted"] and (right_port or bool(good))
    return {
        "wrong_name": wrong,
        "wrong_strict": strict,
        "found": found,
        "partly": confident and bool(good) and not bad,
        "port_right": right_port,
        "at_port": at_port,
        "outside_right": by_port or by_class or by_more,
    }


def ports_told(row: Mapping[str, Any]) -> list[bool]:
    """For each hidden effect that the catalogue lacks whether something unlisted is more probable than not at its port.

    Probabilities at a port are added: "stiffness" and "stiffness with load" of one soil exclude each other.
    """
    at: dict[str, float] = defaultdict(float)
    for name, p in row["inclusion"].items():
        if name.startswith("unlisted at "):
            at[name.removeprefix("unlisted at ").partition(":")[0]] += p
    return [any(at[port] > 0.5 for port in kinds.OUTSIDE[h].ports) for h in row["truth"]["hidden"]]


def read(folder: Path) -> list[Row]:
    """Rows of all cases that were answered; twins with other stated noise have `twin_of`."""
    rows: list[Row] = []
    for sealed in sorted((folder / "truth").glob("*.json")):
        truth = json.loads(sealed.read_text(encoding="utf-8"))
        for name in [truth["case"], *truth.get("twins", [])]:
            out = folder / "runs" / name
            if not (out / RESULT).is_file():
                continue
            answer = json.loads((out / RESULT).read_text(encoding="utf-8"))
            path = out / "run" / "verdict.json"
            fresh = answer["verdict"] not in ("TIME_OUT", "CRASH", "BAD_DATA") and path.is_file()
            verdict = json.loads(path.read_text(encoding="utf-8")) if fresh else {}
            what = said(answer, verdict)
            rows.append(
                {
                    "case": name,
                    "twin_of": truth["case"] if name != truth["case"] else None,
                    "truth": truth,
                    **what,
                    **judge(truth, what),
                    "seconds": answer.get("seconds", {}).get("all"),
                    "first": bool(answer.get("first_of_its_worker")),
                    "commit": answer.get("commit", ""),
                    "uncommitted_changes": answer.get("uncommitted_changes", False),
                    "sentence": str(verdict.get("sentence", "")),
                }
            )
    return rows


def reliability(pairs: Sequence[tuple[float, bool]]) -> Row:
    """Stated probability against frequency in tenths, and the Brier score.

    Args:
      pairs: stated probability, and whether it came true.
    """
    tenths = []
    for k in range(10):
        inside = [(p, t) for p, t in pairs if (k / 10 <= p < (k + 1) / 10) or (k == 9 and p >= 1.0)]
        if inside:
            hits = sum(t for _, t in inside)
            tenths.append(
                {
                    "from": k / 10,
                    "number": len(inside),
                    "stated": round(sum(p for p, _ in inside) / len(inside), 4),
                    "frequency": round(hits / len(inside), 4),
                    "interval": [round(b, 4) for b in wilson(hits, len(inside))],
                }
            )
    brier = sum((p - t) ** 2 for p, t in pairs) / len(pairs) if pairs else None
    within = [
        abs(t["stated"] - t["frequency"]) <= 0.05 or t["interval"][0] <= t["stated"] <= t["interval"][1] for t in tenths
    ]
    return {
        "number": len(pairs),
        "brier": None if brier is None else round(brier, 5),
        "tenths": tenths,
        "tenths_within_5_points_or_interval": sum(within),
    }


def _inclusion_pairs(rows: Sequence[Row]) -> list[tuple[float, bool]]:
    """Probability of each effect being there against whether it is, names that are neither right nor wrong left out."""
    return [
        (min(max(p, 0.0), 1.0), bool(right(name, row["truth"])))
        for row in rows
        for name, p in row["inclusion"].items()
        if not neutral(name, row["truth"]) and not UNLISTED.search(name)
    ]


def _best_pairs(rows: Sequence[Row]) -> list[tuple[float, bool]]:
    """Probability of each case's most probable hypothesis against whether its effects are the hidden ones."""
    pairs = []
    for row in rows:
        if not set(row["probabilities"]) - {"others"}:
            continue
        told = {h: p for h, p in row["probabilities"].items() if h != "others"}
        best, p = max(told.items(), key=lambda item: item[1])
        listed = {n for n in names_of(best) if re.fullmatch(r"\w+", n) and not UNLISTED.search(n)}
        listed = {n for n in listed if n not in QUIET and not neutral(n, row["truth"])}
        hidden = set(row["truth"]["hidden"]) if row["truth"]["group"] != "outside" else set()
        pairs.append((min(max(p, 0.0), 1.0), listed == hidden))
    return pairs


def _median(values: Sequence[float]) -> float | None:
    ordered = sorted(values)
    return round(ordered[len(ordered) // 2], 2) if ordered else None


def report(folder: Path) -> Row:
    """All figures of a folder: of its tables on top, of its drives under `drives`."""
    everything = read(folder)
    head, dirty = commit()
    tables = [r for r in everything if r["truth"]["kind"] == "table"]
    drives = [r for r in everything if r["truth"]["kind"] == "drive"]
    about = {
        "campaign": json.loads((folder / "campaign.json").read_text(encoding="utf-8")),
        "scored_at_commit": head,
        "uncommitted_changes": dirty,
        "asked_at_commits": sorted({r["commit"] for r in everything}),
        "asked_with_uncommitted_changes": any(r["uncommitted_changes"] for r in everything),
        "cases_made": len(list((folder / "truth").glob("*.json"))),
        "cases_answered": sum(r["twin_of"] is None for r in everything),
    }
    return about | figures(tables) | ({"drives": figures(drives)} if drives else {})


def _sigma(row: Row, key: str = "sigma") -> float:
    """Sigma of the hidden effect that is told worst; 0 where nothing is hidden or nothing is known."""
    return min((v.get(key, 0.0) for v in row["truth"]["separable"].values()), default=0.0)


def _by_kind(rows: Sequence[Row]) -> Row:
    found = {}
    for kind in sorted({r["truth"]["hidden"][0] for r in rows}):
        mine = [r for r in rows if r["truth"]["hidden"][0] == kind]
        clear = [r for r in mine if _sigma(r) > SEPARABLE]
        found[kind] = {
            "cases": len(mine),
            "separable": len(clear),
            "right": sum(r["found"] or (r["truth"]["group"] == "outside" and r["outside_right"]) for r in clear),
            "wrong_name": sum(r["wrong_name"] for r in mine),
        }
    return found


def figures(everything: Sequence[Row]) -> Row:
    """The figures of tables or of drives."""
    rows = [r for r in everything if r["twin_of"] is None]
    groups: dict[str, list[Row]] = defaultdict(list)
    verdicts: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for row in rows:
        groups[row["truth"]["group"]].append(row)
        verdicts[row["truth"]["group"]][row["verdict"]] += 1
    nulls, singles, outside, pairs = (groups[g] for g in ("null", "single", "outside", "pair"))
    both = [r for r in groups["two_outside"] if _sigma(r) > SEPARABLE]
    told = [r for r in singles if _sigma(r) > SEPARABLE]
    clear = [r for r in outside if _sigma(r) > SEPARABLE]
    twins = [(r, next((o for o in rows if o["case"] == r["twin_of"]), None)) for r in everything if r["twin_of"]]
    changed = [(t["verdict"], sorted(t["effects"])) != (o["verdict"], sorted(o["effects"])) for t, o in twins if o]
    times = [r["seconds"] for r in rows if r["seconds"] is not None and not r["first"]]
    tuned = {*kinds.TUNE_KNOWN, *DRIVES_TUNED}
    shares = {
        "wrong_name_nulls": [r["wrong_name"] for r in nulls],
        "wrong_name_singles": [r["wrong_name"] for r in singles],
        "wrong_name_pairs": [r["wrong_name"] for r in pairs],
        "wrong_name_outside": [r["wrong_name"] for r in outside],
        "wrong_name_nulls_strict": [r["wrong_strict"] for r in nulls],
        "wrong_name_singles_strict": [r["wrong_strict"] for r in singles],
        "separable_singles_found": [r["found"] for r in told],
        "separable_singles_found_or_partly": [r["found"] or r["partly"] for r in told],
        "separable_singles_found_or_unlisted_at_port": [r["found"] or r["at_port"] for r in told],
        "blind_separable_singles_found": [r["found"] for r in told if _sigma(r, "sigma_blind") > SEPARABLE],
        "separable_singles_never_tuned_on_found": [r["found"] for r in told if r["truth"]["hidden"][0] not in tuned],
        "all_singles_found": [r["found"] for r in singles],
        "outside_right": [r["outside_right"] for r in outside],
        "separable_outside_right": [r["outside_right"] for r in clear],
        "separable_outside_unknown_or_unlisted": [
            r["verdict"] == "UNKNOWN" or (r["verdict"] == "KNOWN_CLASS" and r["unlisted"]) for r in clear
        ],
        "separable_two_outside_both_ports": [all(ports_told(r)) for r in both],
        "separable_two_outside_one_port": [any(ports_told(r)) for r in both],
        "wrong_name_two_outside": [r["wrong_name"] for r in groups["two_outside"]],
        "separable_pairs_found": [r["found"] for r in pairs if _sigma(r) > SEPARABLE],
        "bad_fit": [r["verdict"] == "BAD_FIT" for r in rows],
        "bad_data": [r["verdict"] == "BAD_DATA" for r in rows],
        "crash_or_time_out": [r["verdict"] in ("CRASH", "TIME_OUT") for r in rows],
        "verdict_changes_with_stated_noise": changed,
    }
    return {
        **{name: share(flags) for name, flags in shares.items()},
        "reliability_of_inclusion": reliability(_inclusion_pairs(rows)),
        "reliability_of_best_hypothesis": reliability(_best_pairs(rows)),
        "seconds": {"median": _median(times), "largest": max(times, default=None), "number": len(times)},
        "verdicts": {g: dict(v) for g, v in verdicts.items()},
        "by_kind": _by_kind(singles + outside),
        "cases": [_case(r) for r in everything],
    }


def _case(row: Row) -> Row:
    """A row for the record."""
    truth = row["truth"]
    kept = (
        "case",
        "verdict",
        "effects",
        "unlisted",
        "ports",
        "wrong_name",
        "found",
        "outside_right",
        "seconds",
        "twin_of",
    )
    return {
        "group": truth["group"],
        "law": truth["law"],
        "rover": truth.get("rover"),
        "hidden": truth["hidden"],
        "true_ports": truth["ports"],
        "holds": truth["holds"],
        "sigma": round(_sigma(row), 1),
        "sigma_blind": round(_sigma(row, "sigma_blind"), 1),
        **{k: row[k] for k in kept},
    }


DRIVES_TUNED = ("coulomb_friction", "actuator_delay", "slip_sinkage", "com_offset", "wheel_radius_error", "imu_bias")
"""Kinds of the tuning set's drives."""

TARGETS = {
    "wrong_name_nulls": "<= 2 %",
    "wrong_name_singles": "<= 2 %",
    "separable_singles_found": ">= 80 %, drives 70 %",
    "separable_outside_right": ">= 75 %",
    "bad_fit": "<= 2 %",
    "verdict_changes_with_stated_noise": "< 2 %",
}


def text(found: Mapping[str, Any]) -> str:
    """The figures for a reader."""
    campaign = found["campaign"]
    asked = ", ".join(c[:9] for c in found["asked_at_commits"])
    answered = f"{found['cases_answered']} of {found['cases_made']} cases answered at {asked}"
    lines = [f"set {campaign['set']}, seed {campaign['seed']}: {answered}", "tables", *_lines(found)]
    if "drives" in found:
        lines += ["drives", *_lines(found["drives"])]
    return "\n".join(lines)


def _lines(found: Mapping[str, Any]) -> list[str]:
    lines = []
    for key, value in found.items():
        if isinstance(value, Mapping) and set(value) == {"hits", "of", "interval"} and value["of"]:
            low, high = (100.0 * b for b in value["interval"])
            part = f"{value['hits']:>4} of {value['of']:<4} {100.0 * value['hits'] / value['of']:5.1f} %"
            lines.append(f"  {key:<42} {part}  ({low:.0f} to {high:.0f} %)  {TARGETS.get(key, '')}")
    for key in ("reliability_of_inclusion", "reliability_of_best_hypothesis"):
        table = found[key]
        lines.append(f"  {key}: {table['number']} statements, Brier {table['brier']}")
        lines += [
            f"      stated {t['stated']:.3f}  frequency {t['frequency']:.3f}  ({t['number']})" for t in table["tenths"]
        ]
    lines.append(f"  seconds: median {found['seconds']['median']}, largest {found['seconds']['largest']}")
    groups = found["verdicts"].items()
    return lines + [f"  {group}: " + ", ".join(f"{k} {v}" for k, v in sorted(v.items())) for group, v in groups]
