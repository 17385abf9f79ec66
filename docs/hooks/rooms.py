"""Draws the rooms of the package from its imports: `python docs/hooks/rooms.py` writes docs/figures/rooms.svg.

A room stands one floor above the highest room that it leans on. Arrows that follow from others are left out.
"""

from __future__ import annotations

import ast
import html
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "lunar_mjx"
PICTURE = ROOT / "docs" / "figures" / "rooms.svg"

FOUNDATION = (
    "errors",
    "files",
    "pytree",
    "spatial",
    "together",
    "trust",
    "units",
    "resources",
    "toml_fields",
    "_quiet",
    "_version",
    "report",
)
"""Small helpers that half of the house leans on: drawn as one slab, without arrows."""
WORDS: Mapping[str, str] = {
    "agents": "DDPG, TD3, training",
    "backends": "MuJoCo, Bullet; parity",
    "cameras": "colour, depth, labels",
    "commands": "all that is printed",
    "criticism": "the public face of the verbs",
    "demo": "the main job at once",
    "diagnosis": "verbs on run folders",
    "dynamics": "one step, many rovers",
    "effect_contract": "what every effect promises",
    "effects": "physics at ports",
    "envs": "tasks for learning",
    "inference": "fits; knows no rover",
    "logs": "read, check, record",
    "manoeuvres": "canned commands",
    "model": "rover + terrain + effects",
    "paper": "the seed paper's figures",
    "rover": "URDF to MJCF, motors",
    "simulate": "one drive as a table",
    "terrain": "heights, rocks, soil maps",
    "viewer": "drive it yourself",
    "visual": "plots and videos",
    "wheel_bed": "the single-wheel test bed",
}
DARK = (
    '<style>@media (prefers-color-scheme: dark) { text { fill: #e6edf3 } [fill="#fff"] { fill: #0d1117 } '
    '[fill="#eaf2f8"] { fill: #15202b } [fill="#f4f4f4"] { fill: #161d25 } [stroke="#0072b2"] { stroke: #56b4e9 } }'
    "</style>"
)
"""Colours on a dark page, which a browser asks a picture for as it asks a page."""
COLUMN: Mapping[str, float] = {
    "commands": 2,
    "demo": 4,
    "criticism": 4,
    "diagnosis": 4,
    "paper": 0,
    "viewer": 1,
    "logs": 4,
    "agents": 0,
    "backends": 1,
    "manoeuvres": 3,
    "envs": 0,
    "simulate": 2,
    "effect_contract": 3,
    "visual": 2,
    "dynamics": 2,
    "wheel_bed": 4,
    "model": 2,
    "cameras": 1,
    "effects": 3,
    "inference": 5,
    "rover": 2,
    "terrain": 3,
}
"""Where rooms stand on their floors, from the left: learning, seeing, the model, measuring, inferring."""
RAISED = {"visual": 2}
"""Floors by which a room stands higher than it must, so that no arrow runs behind it."""
WIDTH, BOX, GAP, HEIGHT, FLOOR = 1120, 172, 12, 52, 92


def rooms() -> dict[str, set[str]]:
    """Rooms that each room imports from."""
    found: dict[str, set[str]] = {}
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if len(parts) == 2 and parts[1] in ("__init__", "cli"):
            continue
        own = found.setdefault(parts[1], set())
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == PACKAGE:
                names = node.module.split(".")[1:2] or [a.name for a in node.names]
                own |= {n for n in names if n != parts[1] and not n.startswith("__")}
    return found


def floors(leans: Mapping[str, set[str]]) -> dict[str, int]:
    """Floor of every room, 0 at the bottom."""
    level: dict[str, int] = {}

    def of(room: str) -> int:
        if room not in level:
            level[room] = 1 + max((of(r) for r in leans[room] if r in leans), default=-1)
        return level[room]

    for room in leans:
        of(room)
    return level


def reduced(leans: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """What each room leans on, but for what those rooms lean on themselves."""

    def below(room: str) -> set[str]:
        return set().union(*({r} | below(r) for r in leans[room]))

    return {room: own - set().union(*(below(r) for r in own)) for room, own in leans.items()}


def draw() -> str:
    """The picture as SVG."""
    leans = {r: {o for o in own if o not in FOUNDATION} for r, own in rooms().items() if r not in FOUNDATION}
    leans = {r: {o for o in own if o in leans} for r, own in leans.items()}
    level = floors(leans)
    top = max(level.values())
    left = 0.5 * (WIDTH - 6 * BOX - 5 * GAP)
    place = {
        room: (left + COLUMN[room] * (BOX + GAP), 20 + (top - level[room] - RAISED.get(room, 0)) * FLOOR)
        for room in leans
    }
    bottom = 20 + (top + 1) * FLOOR
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {bottom + 60}" font-family="sans-serif" '
        'font-size="11">',
        DARK,
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#888"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{bottom + 60}" fill="#fff"/>',
    ]
    for room, own in reduced(leans).items():
        x, y = place[room]
        for other in sorted(own):
            a, b = place[other]
            out.append(
                f'<path d="M{x + BOX / 2:.0f} {y + HEIGHT} C{x + BOX / 2:.0f} {y + HEIGHT + 30:.0f} '
                f'{a + BOX / 2:.0f} {b - 30:.0f} {a + BOX / 2:.0f} {b - 1:.0f}" fill="none" stroke="#888" '
                'marker-end="url(#tip)"/>'
            )
    for room, (x, y) in place.items():
        out.append(
            f'<rect x="{x:.0f}" y="{y}" width="{BOX}" height="{HEIGHT}" rx="5" fill="#eaf2f8" stroke="#0072b2"/>'
        )
        middle = x + BOX / 2
        out.append(
            f'<text x="{middle:.0f}" y="{y + 22}" text-anchor="middle" font-weight="bold" font-size="14">{room}</text>'
            f'<text x="{middle:.0f}" y="{y + 40}" text-anchor="middle">{html.escape(WORDS[room])}</text>'
        )
    out.append(f'<rect x="20" y="{bottom}" width="{WIDTH - 40}" height="36" rx="5" fill="#f4f4f4" stroke="#888"/>')
    names = "   ".join(FOUNDATION)
    out.append(f'<text x="{WIDTH / 2:.0f}" y="{bottom + 23}" text-anchor="middle">{names}</text></svg>')
    return "\n".join(out) + "\n"


if __name__ == "__main__":
    PICTURE.write_text(draw(), encoding="utf-8")
    print(PICTURE.relative_to(ROOT))
