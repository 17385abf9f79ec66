"""Measures the house: `python -m tests.house` prints what docs/architecture.md quotes, as JSON.

Everything is counted from the source, without running it; `--root` measures another checkout. Counted are:

- lines and files: of Python, per room (a top folder or module of `lunar_mjx`).
- circles: groups of modules that import each other, imports inside functions too.
- files to open: modules that hold a function or class which the code of some entries reaches by name; methods where one
  class in reach alone has a method of that name. `within_3` stops after three such steps.
- documented, annotated: of public functions and methods of the package (no leading underscore, none nested), the
  share with a docstring; of their parameters (without self and cls), the share with an annotation.
- numeric constants: names in capitals at module level whose value is a number, or a tuple or list of numbers.
- comments: lines that hold a comment, over lines that are not blank. Strings below a constant or an attribute, which
  say why as comments do elsewhere, are counted apart, as `noted`.
- vague names: parameters and assigned names of the list `VAGUE`, over all such names, each counted once a function.
- one-word: functions, methods and classes whose name is one word.
- formatter exceptions: comments that keep the formatter off.
"""

from __future__ import annotations

import argparse
import ast
import io
import itertools
import json
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
PACKAGE = "lunar_mjx"

_VAGUE_WORDS = """
all_ already another any_ back best both data each else_ end ends every first found given got half here hold holds
in_ it item items kept last left like made many most names_ new next_ nothing now obj old one only other others out
own part parts place places rest result results said same seen several single some something stuff taken that them
then there thing things this those told tmp together two val what when where which whole with_ without
"""
VAGUE = frozenset(_VAGUE_WORDS.split())
"""Words that say nothing of what a variable holds: pronouns, adverbs, participles and stand-ins such as `data`."""

ENTRIES = {
    "simulate": ("lunar_mjx.simulate:simulate",),
    "why, table": ("lunar_mjx.diagnosis.tables.loop:build_tables", "lunar_mjx.diagnosis.weighed.answer:diagnose"),
    "why, drive": ("lunar_mjx.diagnosis.drives.loop:build_drives", "lunar_mjx.diagnosis.weighed.answer:diagnose"),
    "training step": (
        "lunar_mjx.agents.learner:Learner",
        "lunar_mjx.agents.td3:TD3",
        "lunar_mjx.envs.navigation.env:NavigationEnv",
    ),
}
"""Where reading begins, as module and name: what the program picks while it runs stands beside what picks it."""

ORDER = re.compile(r"# *(type|fmt|pyright|noqa)")
"""Comments that speak to a tool."""

FunctionNode = ast.FunctionDef | ast.AsyncFunctionDef
Definition = tuple[str, str]
"""A module's name, and the name of a function or class at its top, or `Class.method`."""


class House:
    """A checkout, read."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.paths = {}
        for path in sorted((root / PACKAGE).rglob("*.py")):
            parts = list(path.relative_to(root).with_suffix("").parts)
            self.paths[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
        self.texts = {name: path.read_text(encoding="utf-8") for name, path in self.paths.items()}
        self.trees = {name: ast.parse(text) for name, text in self.texts.items()}

    # ---- sizes

    def rooms(self) -> dict[str, dict[str, int]]:
        """Files and lines of each room."""
        out: dict[str, dict[str, int]] = defaultdict(lambda: {"files": 0, "lines": 0})
        for name, text in self.texts.items():
            room = name.split(".")[1] if "." in name else "__init__"
            out[room]["files"] += 1
            out[room]["lines"] += text.count("\n")
        return dict(out)

    def lines(self, top: str) -> int:
        """Lines of Python below a folder of the checkout."""
        return sum(path.read_text(encoding="utf-8").count("\n") for path in (self.root / top).rglob("*.py"))

    # ---- names

    @cached_property
    def definitions(self) -> dict[Definition, ast.AST]:
        """Functions, classes and methods at the top of modules."""
        found: dict[Definition, ast.AST] = {}
        for module, tree in self.trees.items():
            for node in tree.body:
                if isinstance(node, FunctionNode | ast.ClassDef):
                    found[module, node.name] = node
                if isinstance(node, ast.ClassDef):
                    for inner in node.body:
                        if isinstance(inner, FunctionNode):
                            found[module, f"{node.name}.{inner.name}"] = inner
        return found

    @cached_property
    def names(self) -> dict[str, dict[str, tuple[str, str | None]]]:
        """For each module, what its imports bind: (module, name in it or None for the module itself)."""
        out: dict[str, dict[str, tuple[str, str | None]]] = {}
        for module, tree in self.trees.items():
            bound: dict[str, tuple[str, str | None]] = {}
            for node in ast.walk(tree):
                if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == PACKAGE:
                    for alias in node.names:
                        whole = f"{node.module}.{alias.name}"
                        target = (whole, None) if whole in self.trees else (node.module, alias.name)
                        bound[alias.asname or alias.name] = target
            out[module] = bound
        return out

    def resolve(self, module: str, name: str) -> Definition | None:
        """Where a name of a module is defined, through as many re-exports as it takes."""
        for _ in range(8):
            if (module, name) in self.definitions:
                return module, name
            target = self.names.get(module, {}).get(name)
            if target is None or target[1] is None:
                return None
            module, name = target
        return None

    def reached_from(self, here: Definition) -> Iterator[Definition]:
        """Definitions that the code of one refers to by name."""
        module = here[0]
        for node in ast.walk(self.definitions[here]):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                if (found := self.resolve(module, node.id)) is not None:
                    yield found
            elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                base = node.value
                if isinstance(base, ast.Name):
                    target = self.names[module].get(base.id)
                    if target is not None and target[1] is None and (found := self.resolve(target[0], node.attr)):
                        yield found
                        continue
                    if (
                        base.id == "self"
                        and (own := (module, f"{here[1].split('.')[0]}.{node.attr}")) in self.definitions
                    ):
                        yield own

    @cached_property
    def methods(self) -> dict[str, list[Definition]]:
        """Methods by their bare names."""
        out: dict[str, list[Definition]] = defaultdict(list)
        for module, name in self.definitions:
            if "." in name:
                out[name.split(".")[1]].append((module, name))
        return out

    def called_methods(self, here: Definition, classes: set[Definition]) -> Iterator[Definition]:
        """Methods called on objects, where one class in reach alone has a method of that name."""
        for node in ast.walk(self.definitions[here]):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                owners = [d for d in self.methods.get(node.func.attr, ()) if (d[0], d[1].split(".")[0]) in classes]
                if len(owners) == 1:
                    yield owners[0]

    def has(self, entries: Sequence[str]) -> bool:
        """Whether all entries are functions or classes of the checkout."""
        return all((e.split(":")[0], e.split(":")[1]) in self.definitions for e in entries)

    def files_from(self, entries: Sequence[str], steps: int = 10_000) -> set[str]:
        """Modules that hold what the code of some entries reaches in so many steps.

        Raises:
          KeyError: an entry is no function or class of the checkout.
        """
        queue: list[Definition] = [(e.split(":")[0], e.split(":")[1]) for e in entries]
        depth = dict.fromkeys(queue, 0)
        classes: set[Definition] = set()
        while queue:
            here = queue.pop(0)
            if isinstance(self.definitions[here], ast.ClassDef):
                classes.add(here)
            if depth[here] >= steps:
                continue
            for other in [*self.reached_from(here), *self.called_methods(here, classes)]:
                if other not in depth:
                    depth[other] = depth[here] + 1
                    queue.append(other)
        return {module for module, _ in depth}

    # ---- shares

    def public_functions(self) -> Iterator[FunctionNode]:
        """Functions and methods that carry no leading underscore, in classes that carry none."""
        for tree in self.trees.values():
            for node in tree.body:
                if isinstance(node, FunctionNode) and not node.name.startswith("_"):
                    yield node
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    for inner in node.body:
                        if isinstance(inner, FunctionNode) and not inner.name.startswith("_"):
                            yield inner

    def documented(self) -> float:
        """Share of public functions with a docstring."""
        functions = list(self.public_functions())
        return sum(ast.get_docstring(f) is not None for f in functions) / len(functions)

    def annotated(self) -> float:
        """Share of their parameters with an annotation."""
        known = []
        for function in self.public_functions():
            a = function.args
            args = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
            known += [arg.annotation is not None for arg in args if arg.arg not in ("self", "cls")]
        return sum(known) / len(known)

    def numeric_constants(self) -> list[str]:
        """`module:NAME` of all numeric constants of modules."""
        found = []
        for module, tree in self.trees.items():
            for node in tree.body:
                if isinstance(node, ast.Assign) and len(node.targets) == 1:
                    target, value = node.targets[0], node.value
                elif isinstance(node, ast.AnnAssign) and node.value is not None:
                    target, value = node.target, node.value
                else:
                    continue
                pairs = [(target, value)]
                if (
                    isinstance(target, ast.Tuple)
                    and isinstance(value, ast.Tuple)
                    and len(target.elts) == len(value.elts)
                ):
                    pairs = list(zip(target.elts, value.elts, strict=True))
                for left, right in pairs:
                    if isinstance(left, ast.Name) and re.fullmatch(r"_*[A-Z][A-Z0-9_]*", left.id) and _numeric(right):
                        found.append(f"{module}:{left.id}")
        return found

    def comments(self) -> float:
        """Share of lines, blank ones left out, that hold a comment; orders to tools are none."""
        marked = 0
        for text in self.texts.values():
            tokens = tokenize.generate_tokens(io.StringIO(text).readline)
            lines = {t.start[0] for t in tokens if t.type == tokenize.COMMENT and not ORDER.match(t.string)}
            marked += len(lines)
        return marked / self.filled_lines()

    def noted(self) -> float:
        """Share of lines, blank ones left out, of strings below assignments of modules and classes."""
        count = 0
        for tree in self.trees.values():
            for body in [tree.body, *(n.body for n in ast.walk(tree) if isinstance(n, ast.ClassDef))]:
                for before, node in itertools.pairwise(body):
                    string = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
                    if string and isinstance(before, ast.Assign | ast.AnnAssign):
                        count += (node.end_lineno or node.lineno) - node.lineno + 1
        return count / self.filled_lines()

    def filled_lines(self) -> int:
        """Lines of the package that are not blank."""
        return sum(bool(line.strip()) for text in self.texts.values() for line in text.splitlines())

    def vague(self) -> tuple[float, dict[str, int]]:
        """Share of variables' names that are vague, and how often which."""
        count, total = defaultdict(int), 0
        for tree in self.trees.values():
            for function in ast.walk(tree):
                if not isinstance(function, FunctionNode):
                    continue
                names = {a.arg for a in ast.walk(function.args) if isinstance(a, ast.arg)} - {"self", "cls"}
                for statement in function.body:
                    names |= {
                        n.id for n in ast.walk(statement) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
                    }
                total += len(names)
                for name in names & VAGUE:
                    count[name] += 1
        return sum(count.values()) / total, dict(sorted(count.items(), key=lambda kv: -kv[1]))

    def one_word(self) -> float:
        """Share of functions, methods and classes with a name of one word."""
        names = [name.split(".")[-1] for _, name in self.definitions if not name.split(".")[-1].startswith("__")]
        return sum(bool(re.fullmatch(r"_?([A-Z]?[a-z0-9]+)", n)) for n in names) / len(names)

    def formatter_exceptions(self) -> int:
        """Comments that keep the formatter off a line."""
        folders = [PACKAGE, "tests", "benchmarks", "docs", "train"]
        marks = [p.read_text(encoding="utf-8") for f in folders for p in (self.root / f).rglob("*.py")]
        return sum(text.count("# fmt: " + "skip") + text.count("# fmt: " + "off") for text in marks)

    def crowded(self) -> int:
        """Files of the largest folder of the package, without __init__.py."""
        count: dict[Path, int] = defaultdict(int)
        for path in self.paths.values():
            count[path.parent] += path.name != "__init__.py"
        return max(count.values())

    def circles(self) -> int:
        """Groups of modules that import each other."""
        from tests.test_architecture import circles

        edges = {}
        for module, tree in self.trees.items():
            edges[module] = set()
            for node in ast.walk(tree):
                if isinstance(node, ast.Import):
                    edges[module] |= {a.name for a in node.names if a.name in self.trees}
                elif isinstance(node, ast.ImportFrom) and node.module:
                    for alias in node.names:
                        whole = f"{node.module}.{alias.name}"
                        target = whole if whole in self.trees else node.module
                        if target in self.trees and target != module:
                            edges[module].add(target)
        return len(circles(edges))


def _numeric(node: ast.expr) -> bool:
    """Whether an expression is a number written down, or a tuple or list of such."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return _numeric(node.operand)
    if isinstance(node, ast.BinOp):
        return _numeric(node.left) and _numeric(node.right)
    if isinstance(node, ast.Tuple | ast.List):
        return bool(node.elts) and all(_numeric(e) for e in node.elts)
    return False


def measure(root: Path = HERE) -> dict:
    """All counts of a checkout, as plain data; shares as percentages with one digit."""
    house = House(root)
    rooms = house.rooms()
    source = sum(r["lines"] for r in rooms.values())

    def percent(share: float) -> float:
        return round(100.0 * share, 1)

    return {
        "lines": source,
        "files": sum(r["files"] for r in rooms.values()),
        "largest_folder": house.crowded(),
        "circles": house.circles(),
        "documented_percent": percent(house.documented()),
        "annotated_percent": percent(house.annotated()),
        "comment_percent": percent(house.comments()),
        "noted_percent": percent(house.noted()),
        "numeric_constants": len(house.numeric_constants()),
        "vague_names_percent": percent(house.vague()[0]),
        "one_word_percent": percent(house.one_word()),
        "formatter_exceptions": house.formatter_exceptions(),
        "tests_over_source": round(house.lines("tests") / source, 2),
        "benchmarks_lines": house.lines("benchmarks"),
        "files_to_open": {
            way: {"all": len(house.files_from(entries)), "within_3": len(house.files_from(entries, 3))}
            for way, entries in ENTRIES.items()
            if house.has(entries)
        },
        "rooms": dict(sorted(rooms.items(), key=lambda kv: -kv[1]["lines"])),
    }


def markdown(before: dict, now: dict) -> str:
    """Two checkouts' counts as the tables of docs/architecture.md."""
    names = {
        "lines": "lines of `lunar_mjx`",
        "files": "files",
        "largest_folder": "files of the largest folder",
        "circles": "circles of imports",
        "documented_percent": "public functions with a docstring, %",
        "annotated_percent": "their parameters with a type, %",
        "comment_percent": "lines with a comment, %",
        "noted_percent": "lines of strings below constants and fields, which say why, %",
        "numeric_constants": "numeric constants of modules",
        "vague_names_percent": "vague names of variables, %",
        "one_word_percent": "functions and classes named by one word, %",
        "formatter_exceptions": "exceptions from the formatter",
        "tests_over_source": "lines of tests over lines of source",
    }
    rows = [f"| {label} | {before[key]} | {now[key]} |" for key, label in names.items()]
    for way, count in now["files_to_open"].items():
        old = before["files_to_open"].get(way)
        cells = "" if old is None else f"{old['within_3']}, {old['all']}"
        reached = f"{count['within_3']}, {count['all']}"
        rows.append(f"| files that {way} reaches in three steps, in all | {cells} | {reached} |")
    rooms = [f"| `{room}` | {n['files']} | {n['lines']:,} |" for room, n in now["rooms"].items() if n["files"] > 1]
    head = ["| | before | now |", "|---|---|---|"]
    return "\n".join([*head, *rows, "", "| room | files | lines |", "|---|---|---|", *rooms])


def main() -> None:
    """Prints the counts as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, default=HERE, help="checkout to measure")
    parser.add_argument("--before", type=Path, help="checkout to compare with: prints tables of both")
    parser.add_argument("--names", action="store_true", help="list numeric constants and vague names instead")
    options = parser.parse_args()
    if options.before is not None:
        print(markdown(measure(options.before), measure(options.root)))
    elif options.names:
        house = House(options.root)
        print("\n".join(house.numeric_constants()))
        print(house.vague())
    else:
        print(json.dumps(measure(options.root), indent=1))


if __name__ == "__main__":
    main()
