"""The house: which room may look into which, no circles, no crowded folder, no prefix where a folder is meant.

Imports are read from the source, those inside functions too: what is imported late is leant on all the same.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "lunar_mjx"

FLOORS: tuple[frozenset[str], ...] = tuple(
    frozenset(floor.split())
    for floor in (
        "errors",
        "files pytree spatial together trust _quiet _version",
        "report resources units toml_fields inference",
        "rover terrain",
        "effects cameras",
        "model",
        "dynamics",
        "simulate effect_contract wheel_bed",
        "manoeuvres backends envs visual",
        "logs agents viewer",
        "diagnosis",
        "criticism paper",
        "demo",
        "commands",
        "cli",
    )
)
"""Rooms from the ground up. A room looks down only: never up, and never into another room of its own floor."""

THIRD_PARTY: dict[str, frozenset[str]] = {
    "inference": frozenset({"numpy", "scipy", "jax"}),
    "errors": frozenset(),
    "files": frozenset(),
    "effects": frozenset({"numpy", "jax", "jaxtyping"}),
    "rover": frozenset({"numpy", "scipy", "mujoco", "trimesh", "tomli_w"}),
}
"""What rooms that others stand on may take from outside the standard library."""

ONLY_IN = {
    "typer": frozenset({"commands"}),
    "mujoco.mjx": frozenset({"_quiet"}),
    "newton": frozenset({"wheel_bed"}),
    "warp": frozenset({"wheel_bed"}),
}
"""Libraries that belong to one room."""

LATE_CIRCLES: dict[frozenset[str], str] = {}
"""Circles closed by an import inside a function that are borne, with the reason."""

WORDS = frozenset({"rover", "wheel", "port", "channel", "soil", "motor", "slip", "gear", "encoder", "imu"})
"""Words of rovers, ports and channels, in the singular: no name in `inference` holds one. (A joint is also what several
hypotheses have in common, so that word says nothing.)"""
WORDS_BORNE = {
    "observations.py": "channel",  # the name of a measured series, which inference never takes apart
    "held_out.py": "channel",  # groups residuals by the names of their series
}
"""To be worked off: names that hold a word of `WORDS`, by file."""

CROWDED = 15
"""Modules of one folder that a reader still takes in."""
REPEATED = 3
"""Modules of one folder with a first word in common from which that word is a folder."""


def modules(top: str = PACKAGE) -> dict[str, Path]:
    """Every module of the package, or of another top folder, by its dotted name."""
    found = {}
    for path in sorted((ROOT / top).rglob("*.py")):
        parts = list(path.relative_to(ROOT).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(path: Path, known: dict[str, Path]) -> tuple[set[str], set[str]]:
    """Modules of the package, and names outside it, that a file imports anywhere."""
    inside, outside = set(), set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: write the whole name of {node.module}"
            base = node.module or ""
            names = [full if (full := f"{base}.{a.name}") in known else base for a in node.names]
        else:
            continue
        for name in names:
            (inside if name.split(".")[0] == PACKAGE else outside).add(name)
    return inside, outside


def graph() -> dict[str, set[str]]:
    """Modules of the package that each module imports."""
    known = modules()
    return {name: imports(path, known)[0] - {name} for name, path in known.items()}


def room(module: str) -> str:
    """The part of the package that a module lies in."""
    return module.split(".")[1] if "." in module else PACKAGE


def circles(edges: dict[str, set[str]]) -> list[frozenset[str]]:
    """Groups of nodes that reach each other (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(edges.get(node, ())):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(group) > 1:
                found.append(frozenset(group))

    for node in sorted(edges):
        if node not in index:
            visit(node)
    return found


def test_every_room_has_its_floor() -> None:
    rooms = {room(m) for m in modules()} - {PACKAGE}
    floors = [r for floor in FLOORS for r in floor]
    assert rooms == set(floors) and len(floors) == len(set(floors))


def test_no_import_climbs() -> None:
    level = {r: k for k, floor in enumerate(FLOORS) for r in floor}
    climbing = sorted(
        f"{module} -> {other}"
        for module, others in graph().items()
        for other in others
        if room(other) != PACKAGE
        and room(module) != PACKAGE
        and room(module) != room(other)
        and level[room(other)] >= level[room(module)]
    )
    assert not climbing, climbing


def test_no_import_circles() -> None:
    assert [c for c in circles(graph()) if c not in LATE_CIRCLES] == []


def script_imports(name: str, path: Path, known: dict[str, Path]) -> set[str]:
    """Modules of `known` that a script imports anywhere: by whole names, from its package, or those beside it."""
    folder = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            wanted = [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(folder.split(".")[: 1 - node.level or None]) if node.level else ""
            base = ".".join(part for part in (base, node.module) if part)
            wanted = [base, *(f"{base}.{a.name}" for a in node.names)]
        else:
            continue
        # a script's own folder is on its path
        found |= {full for word in wanted for full in (word, f"{folder}.{word}") if full in known}
    return found - {name, *(m for m, p in known.items() if p.name == "__init__.py")}


def test_no_import_circles_among_scripts() -> None:
    for top in ("benchmarks", "train"):
        known = modules(top)
        edges = {name: script_imports(name, path, known) for name, path in known.items()}
        assert circles(edges) == []
        assert top == "train" or sum(map(len, edges.values())) > 100, "imports are found"


def test_script_imports_are_read_however_they_are_written() -> None:
    known = modules("benchmarks")
    scripts = ("foreign.sets", "rl.trials")
    found = {n: script_imports(f"benchmarks.{n}", known[f"benchmarks.{n}"], known) for n in scripts}
    assert {"benchmarks.foreign.bed", "benchmarks.foreign.work"} <= found["foreign.sets"]
    assert {"benchmarks.rl.harness", "benchmarks.rl.rates"} <= found["rl.trials"]


def test_rooms_take_only_what_belongs_to_them_from_outside() -> None:
    import sys

    known, wrong = modules(), []
    for name, path in known.items():
        for other in imports(path, known)[1]:
            top = other.split(".")[0]
            allowed = THIRD_PARTY.get(room(name))
            if allowed is not None and top not in allowed and top not in sys.stdlib_module_names:
                wrong.append(f"{name} -> {other}")
            for library, rooms in ONLY_IN.items():
                if (other == library or other.startswith(library + ".")) and room(name) not in rooms:
                    wrong.append(f"{name} -> {other}")
    assert not wrong, wrong


def test_inference_names_no_rover_port_or_channel() -> None:
    wrong = []
    for path in sorted((ROOT / PACKAGE / "inference").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for field in ("id", "attr", "arg", "name"):
                name = getattr(node, field, None)
                if not isinstance(name, str):
                    continue
                for word in WORDS & {w.removesuffix("s") for w in re.split(r"_+", name.lower())}:
                    if word != WORDS_BORNE.get(path.name):
                        wrong.append(f"{path.name}: {name}")
    assert not wrong, sorted(set(wrong))


def test_no_crowded_folder() -> None:
    crowd = Counter(path.parent for path in modules().values() if path.name != "__init__.py")
    assert {str(k.relative_to(ROOT)): n for k, n in crowd.items() if n > CROWDED} == {}


def test_a_repeated_prefix_is_a_folder() -> None:
    repeated = {}
    for top in (PACKAGE, "benchmarks", "train"):
        folders = {p.parent for p in (ROOT / top).rglob("*.py")}
        for folder in folders:
            first = Counter(p.stem.split("_")[0] for p in folder.glob("*.py") if not p.stem.startswith("_"))
            for word, count in first.items():
                if count >= REPEATED:
                    repeated[str(folder.relative_to(ROOT)), word] = count
    assert not repeated, repeated


def bound_names(path: Path) -> set[str]:
    """Names that a module binds anywhere: definitions, assignments, imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {(a.asname or a.name).split(".")[0] for a in node.names}
    return names


def test_what_scripts_import_exists() -> None:
    """Benchmarks and trainings import late, and some need what is not installed here: no run tells of a moved name."""
    known = modules()
    bound = {name: bound_names(path) for name, path in known.items()}
    bound[PACKAGE] |= set(public_names())
    missing = []
    for top in (PACKAGE, "benchmarks", "docs", "tests", "train"):
        for path in sorted((ROOT / top).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == PACKAGE:
                    base = str(node.module)
                    names = [a.name for a in node.names if f"{base}.{a.name}" not in known]
                    missing += [f"{path.relative_to(ROOT)}: {base}.{n}" for n in names if n not in bound.get(base, ())]
    assert not missing, missing


def public_names() -> list[str]:
    """Names that the package imports when they are first asked for."""
    import lunar_mjx

    return lunar_mjx.__all__


def test_tests_mirror_the_package() -> None:
    """A folder of tests is a room, or a top folder of the repository."""
    folders = {p.name for p in (ROOT / "tests").iterdir() if p.is_dir() and any(p.rglob("*.py"))}
    rooms = {room(m) for m in modules()}
    assert folders <= rooms | {"benchmarks", "docs"}, folders - rooms


def test_the_picture_shows_every_room() -> None:
    """`python docs/hooks/rooms.py` draws it anew."""
    picture = (ROOT / "docs" / "figures" / "rooms.svg").read_text(encoding="utf-8")
    shown = set(re.findall(r">([^<]+)</text>", picture))
    words = {word for text in shown for word in text.split()}
    assert {room(m) for m in modules()} - {PACKAGE, "cli"} <= words


def test_the_formatter_has_no_more_exceptions() -> None:
    """One table of names is kept from it; a new exception needs a reason, and this number."""
    mark = "# fmt: " + "skip"
    found = [
        str(path.relative_to(ROOT))
        for top in (PACKAGE, "tests", "benchmarks", "docs", "train")
        for path in sorted((ROOT / top).rglob("*.py"))
        for _ in range(path.read_text(encoding="utf-8").count(mark))
    ]
    assert found == ["lunar_mjx/dynamics/batching/batch_last.py"]


OPTIONAL = "an optional package, which need not be installed where types are checked"
SUMS = "sums of vectors: a NamedTuple is a tuple, whose + and * are of sequences"
UNCHECKED = {
    "backends/pybullet.py": (1, OPTIONAL),
    "diagnosis/drives/simulation/program.py": (1, "parameters without their ground"),
    "diagnosis/drives/windows/coordinates.py": (1, "MuJoCo's names, from before its stub"),
    "diagnosis/drives/windows/form.py": (1, "the problem of a form of windows is narrower than that of any form"),
    "dynamics/spatial_algebra.py": (6, SUMS),
    "envs/sb3.py": (1, OPTIONAL),
    "inference/coordinates.py": (1, "a sorted pair is a list to the type checker"),
    "logs/readers/bags.py": (4, OPTIONAL),
    "spatial.py": (2, SUMS),
    "terrain/sky/ephemeris.py": (4, OPTIONAL),
    "wheel_bed/particles/kernels.py": (2, "Warp compiles these functions, with types of its own"),
    "wheel_bed/particles/moving_bed.py": (1, OPTIONAL),
    "wheel_bed/particles/sand_box.py": (1, OPTIONAL),
    "wheel_bed/particles/slump.py": (1, OPTIONAL),
}
"""Lines and files that the type checker is told to pass over: how many, and why. It checks the package alone."""


def test_what_types_do_not_check_is_listed() -> None:
    """None more than these; whoever mends one takes it from the list."""
    mark = re.compile(r"# *(?:type: *ignore|pyright: *(?:ignore|basic|report))")
    found = {
        str(path.relative_to(ROOT / PACKAGE)): count
        for path in sorted((ROOT / PACKAGE).rglob("*.py"))
        if (count := len(mark.findall(path.read_text(encoding="utf-8"))))
    }
    more = {name: count for name, count in found.items() if count > UNCHECKED.get(name, (0, ""))[0]}
    assert not more, f"say it in types, or list it with its reason: {more}"
