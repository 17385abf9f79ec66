"""A marked part of a step as one kernel of a GPU, a thread for each wheel, in place of dozens of XLA's.

XLA stores what one kernel hands to the next: the stress at 18 nodes of every wheel, in six arrays, took more time than
the arithmetic. Here every entry of every array is a variable of its thread. A wheel's part is small enough for the
registers of a thread; a whole step is not (docs/structured_engine.md).

The part is traced for one rover (see `marks`) and written in CUDA C, entry by entry. Its operations must treat wheels
alike; where one does not, or has no name in C here, the part stays with XLA. Derivatives are those of XLA's version.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import core

from lunar_mjx.dynamics.batching.batch_last import INLINE, Inline, at_end, bind, wanted
from lunar_mjx.dynamics.batching.cuda import DEAR, THREADS, Kernel, Launch, Uncompilable, call, number, type_of
from lunar_mjx.effects.marks import BY_WHEEL

_SAME = {"copy", "copy_p", "stop_gradient"}
_SUMS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_and": "and", "reduce_or": "or"}
_OPENED = INLINE | {"custom_jvp_call": "call_jaxpr"}
_KINDS = {"float": np.float32, "int": np.int32, "bool": np.bool_}
ROLLED = 10
"""Entries of an array from which on it is computed in a loop: code that does not fit in the cache is slow."""
_LARGEST = 2**31
"""Addresses are 32-bit integers."""


def as_kernels(launch: Launch) -> Callable[..., list[Any] | None]:
    """How `batch_last` computes marked parts by kernels.

    Args:
      launch: runs a kernel.

    Returns:
      A function of the equation, its operands with their batch axes, which results are wanted, and how to compute the
      equation without a kernel. It returns the results, batch last, or None for a part that cannot be a kernel.
    """

    def part(eqn: Any, arrays: list[Any], axes: list[int | None], live: list[bool], inline: Inline) -> list[Any] | None:
        wheels = int(eqn.params["name"].removeprefix(BY_WHEEL))
        # What is known already stays a number of the program; derivatives need only the rest.
        moving = [i for i, a in enumerate(arrays) if isinstance(a, Tracer)]
        batch: int = next((a.shape[x] for a, x in zip(arrays, axes, strict=True) if x is not None), 0)
        if not batch:
            return None

        def filled(some: Sequence[Any]) -> list[Any]:
            whole = list(arrays)
            for i, a in zip(moving, some, strict=True):
                whole[i] = a
            return whole

        def plain(*some: Any) -> list[Any]:
            results = inline(eqn, filled(some), axes, live)
            return [at_end(a, x, batch) for (a, x), wants in zip(results, live, strict=True) if wants]

        @jax.custom_jvp
        def kernel(*some: Any) -> list[Any]:
            made = _Part(launch, wheels, batch)
            return made.results(eqn, filled(some), axes, live)

        @kernel.defjvp
        def _(primals: Any, tangents: Any) -> Any:
            return jax.jvp(plain, primals, tangents)

        try:
            found = iter(kernel(*(arrays[i] for i in moving)))
        except Uncompilable:
            return None
        return [next(found) if wants else None for wants in live]

    return part


class _Outer:
    """A value that is there before the kernel runs; `axis` is its batch axis, -1, or None."""

    __slots__ = ("array", "axis")

    def __init__(self, array: Any, axis: int | None):
        self.array, self.axis = array, axis


class _Inner:
    """A value of the kernel: its shape and type for one rover."""

    __slots__ = ("dtype", "shape")

    def __init__(self, aval: Any):
        self.shape, self.dtype = aval.shape, np.dtype(aval.dtype)


@dataclasses.dataclass(frozen=True, eq=False)
class _Entries:
    """Entries of an array for one thread: without its axis of wheels, `axis`, of which each thread has one.

    An entry is a number, the name of a variable, a `_Load` or a `_Choice`.
    """

    of: np.ndarray
    axis: int | None


@dataclasses.dataclass(frozen=True)
class _Rolled:
    """An array whose entries a loop computes one by one: its variable there, its level, its shape without wheels."""

    name: str
    level: int
    shape: tuple[int, ...]
    axis: int | None
    dtype: np.dtype
    again: Callable[[int], str] | None
    """Computes it in a loop of a later level instead of storing it, for the name there; None where that is dear."""


@dataclasses.dataclass
class _Loop:
    """A loop over the entries of arrays: lines before it and in it, and variables whose every value is stored."""

    before: list[str] = dataclasses.field(default_factory=list)
    body: list[str] = dataclasses.field(default_factory=list)
    stored: list[str] = dataclasses.field(default_factory=list)

    def lines(self, count: int) -> list[str]:
        """The whole loop, of so many rounds."""
        kept = [f"a{name}[k] = {name};" for name in self.stored]
        head = [f"#pragma unroll {THREADS.unrolled}", f"for (int k = 0; k < {count}; ++k) {{"]
        return [*self.before, *head, *self.body, *kept, "}"]


@dataclasses.dataclass(frozen=True)
class _Load:
    """An entry of an operand that has not been read yet: of this thread's wheel (`kind` lane), of the rover, of what
    all rovers share for a wheel, or for all."""

    slot: int
    at: int
    kind: str


@dataclasses.dataclass(frozen=True)
class _Stored:
    """An entry that a loop has stored."""

    name: str
    at: int
    level: int
    dtype: np.dtype


@dataclasses.dataclass(frozen=True)
class _Choice:
    """One of two entries, of which at least one has not been read yet."""

    where: Any
    no: Any
    yes: Any
    dtype: Any


class _Part:
    """A part on its way to a kernel."""

    def __init__(self, launch: Launch, wheels: int, batch: int):
        self.run, self.wheels, self.batch = launch, wheels, batch
        self.steps: list[tuple[Any, list[Any], list[Any]]] = []

    def results(self, eqn: Any, arrays: list[Any], axes: list[int | None], live: list[bool]) -> list[Any]:
        """The wanted results, batch last."""
        inner = eqn.params["jaxpr"]
        refs = self._divide(inner.jaxpr, inner.consts, [_Outer(a, x) for a, x in zip(arrays, axes, strict=True)], live)
        wants = [r for r, wants in zip(refs, live, strict=True) if wants]
        made = list(dict.fromkeys(r for r in wants if isinstance(r, _Inner)))
        computed = dict(zip(made, _Writer(self, made).run(), strict=True)) if made else {}
        return [computed[r] if isinstance(r, _Inner) else at_end(r.array, r.axis, self.batch) for r in wants]

    def _divide(self, jaxpr: Any, consts: Any, args: list[Any], live: list[bool]) -> list[Any]:
        """Computes what is the same for all rovers and notes the rest; returns the results."""
        env: dict[Any, Any] = dict(zip(jaxpr.constvars, (_Outer(c, None) for c in consts), strict=True))
        env.update(zip(jaxpr.invars, args, strict=True))

        def read(atom: Any) -> Any:
            known = isinstance(atom, core.Literal)
            # a literal may be a number of Python's, which has no type of its own
            return _Outer(np.asarray(atom.val, _type_of(atom)), None) if known else env.get(atom)

        needed = wanted(jaxpr, live)
        for eqn in jaxpr.eqns:
            wants = [v in needed for v in eqn.outvars]
            if any(wants):
                env.update(zip(eqn.outvars, self._place(eqn, [read(v) for v in eqn.invars], wants), strict=True))
        return [read(v) for v in jaxpr.outvars]

    def _place(self, eqn: Any, operands: list[Any], live: list[bool]) -> list[Any]:
        name = eqn.primitive.name
        outer = all(isinstance(o, _Outer) for o in operands)
        if name in _OPENED:
            inner = eqn.params[_OPENED[name]]
            return self._divide(inner.jaxpr, inner.consts, operands, live)
        if outer and all(o.axis is None for o in operands):
            arrays = [o.array for o in operands]
            if any(isinstance(a, Tracer) for a in arrays):
                return [_Outer(a, None) for a in bind(eqn, arrays)]
            with jax.ensure_compile_time_eval():
                return [_Outer(a, None) for a in bind(eqn, arrays)]
        results = [_Inner(v.aval) for v in eqn.outvars]
        if any(r.dtype not in (np.float32, np.int32, np.bool_) for r in results):
            raise Uncompilable
        self.steps.append((eqn, operands, results))
        return results


class _Writer:
    """Writes a part's operations in C, entry by entry, as far as its results need them.

    Arrays of many entries are computed in loops, whose code a multiprocessor keeps at hand; what they read must be
    there before. So every value has a level: loops of level n come after all other lines of level n, and what they make
    is of level n + 1 outside them.
    """

    def __init__(self, part: _Part, made: list[_Inner]):
        self.part, self.made, self.wheels, self.batch = part, made, part.wheels, part.batch
        self.threads = max(part.wheels, 1)
        self.slots: dict[tuple[int, int], int] = {}
        self.sources: list[tuple[Any, int]] = []
        self.kinds: set[tuple[int, str]] = set()
        self.values: dict[Any, _Entries | _Rolled] = {}
        self.lines: dict[int, list[str]] = {}
        self.loops: dict[tuple[int, int], _Loop] = {}
        self.tables: dict[tuple[bytes, str], str] = {}
        self.names: dict[Any, str] = {}
        self.levels: dict[str, int] = {}
        self.local: list[str] = []
        self.types: dict[str, np.dtype] = {}

    def run(self) -> list[Any]:
        """The results."""
        for eqn, operands, results in self.part.steps:
            self.values[results[0]] = self._apply(eqn, operands, results[0])
        # Without arrays of many entries XLA stores little, and is as fast: of `consistent` on one H200 it makes 356 M
        # steps/s with LUVMI-X, and 334 M with this kernel.
        if not self.loops:
            raise Uncompilable
        found = [self._opened(self.values[r]) for r in self.made]
        kept = self._kept_in_place(found)
        writes = self._writes(found, kept)
        given = [jnp.moveaxis(jnp.asarray(a), axis, -1) if np.ndim(a) else a for a, axis in self.sources]
        shapes = [
            (*e.of.shape, self.batch) if e.axis is None else (*e.of.shape, self.wheels, self.batch) for e in found
        ]
        if max(math.prod(s) for s in [*shapes, *(a.shape for a in given)]) >= _LARGEST:
            raise Uncompilable
        levels = sorted({*self.lines, *(level for level, _ in self.loops)})
        body = [*self.local]
        for level in levels:
            body += self.lines.get(level, [])
            body += [line for (of, n), loop in self.loops.items() if of == level for line in loop.lines(n)]
        # What a wheel replaces, the others may still have to read.
        meets = any((slot, "rover") in self.kinds for slot in kept)
        kernel = Kernel(
            tables="\n".join(
                f"__constant__ {kind} {name}[] = {{{', '.join(map(number, np.frombuffer(held, _KINDS[kind])))}}};"
                for (held, kind), name in self.tables.items()
            ),
            body="\n".join([*body, *(["__syncthreads();"] if meets else []), "if (inside) {", *writes, "}"]),
            given=tuple(type_of(a.dtype) for a in given),
            made=tuple(type_of(r.dtype) for r in self.made),
            kept=kept,
            batch=self.batch,
            rows=self.threads,
        )
        outs = [jax.ShapeDtypeStruct(s, r.dtype) for s, r in zip(shapes, self.made, strict=True)]
        results = self.part.run(kernel, given, outs)
        # the axis of wheels goes back to where it is outside
        return [
            a if e.axis is None or e.axis == a.ndim - 2 else jnp.moveaxis(a, -2, e.axis)
            for a, e in zip(results, found, strict=True)
        ]

    def _kept_in_place(self, found: list[_Entries]) -> dict[int, int]:
        """Operands (by slot) that a result (by number) replaces, some of whose entries stay as they are."""
        kept: dict[int, int] = {}
        for result, entries in enumerate(found):
            for k, entry in enumerate(entries.of.flat):
                old = entry.no if isinstance(entry, _Choice) else entry
                if not isinstance(old, _Load) or old.kind != "lane" or old.at != k or old.slot in kept:
                    continue
                array, _ = self.sources[old.slot]
                made = self.made[result]
                if array.shape == (*made.shape, self.batch) and array.dtype == made.dtype:
                    kept[old.slot] = result
                    break
        return kept

    def _writes(self, found: list[_Entries], kept: dict[int, int]) -> list[str]:
        """Lines that store the results; what changes an operand in places is stored in those alone."""
        own = {result: slot for slot, result in kept.items()}
        sometimes: dict[str, tuple[list[str], list[str]]] = {}
        changes, always = [], []
        for result, entries in enumerate(found):
            for k, entry in enumerate(entries.of.flat):
                place = f"o{result}[{self._address(str(k), 'rover' if entries.axis is None else 'lane')}]"
                old = None if result not in own else _Load(own[result], k, "lane")
                if old is not None and isinstance(entry, _Load) and entry == old:
                    continue
                if old is not None and isinstance(entry, _Choice) and isinstance(entry.no, _Load) and entry.no == old:
                    changes.append((place, self.read(entry.where)[0], entry.yes, self.made[result].dtype))
                else:
                    always.append(f"{place} = {self.read(entry)[0]};")
        several = len({where for _, where, _, _ in changes}) > 1
        for place, where, yes, dtype in changes:
            before, after = sometimes.setdefault(where, ([], []))
            # With one condition its operands are read under it; with several, one could read what another wrote.
            if isinstance(yes, _Load) and not several:
                before.append(f"const {type_of(dtype)} w{len(before)} = {self._memory(yes)};")
                after.append(f"{place} = w{len(before) - 1};")
            else:
                after.append(f"{place} = {self.read(yes)[0]};")
        return [*(f"if ({w}) {{ {' '.join([*b, *a])} }}" for w, (b, a) in sometimes.items()), *always]

    def slot(self, array: Any, axis: int = -1) -> int:
        """The number of an operand of the kernel, whose axis of wheels is `axis`."""
        key = (id(array), axis)
        if key not in self.slots:
            type_of(np.dtype(array.dtype))
            self.slots[key] = len(self.sources)
            self.sources.append((array, axis))
        return self.slots[key]

    # --- entries ---

    def _axis(self, ref: Any) -> int | None:
        """The axis of wheels of an operand; None where all wheels share it."""
        if isinstance(ref, _Inner):
            return self.values[ref].axis
        shape = np.shape(ref.array)[:-1]
        return len(shape) - 1 if ref.axis == -1 and shape and shape[-1] == self.wheels else None

    def _value(self, ref: Any, axis: int | None) -> Any:
        """Entries of an operand, or a rolled value, beside others whose axis of wheels is `axis`."""
        own = self._axis(ref)
        if (isinstance(ref, _Outer) and ref.axis == 0) or own not in (None, axis):
            raise Uncompilable
        if isinstance(ref, _Inner):
            value = self.values[ref]
            if isinstance(value, _Rolled) and value.axis == axis:
                return value
            value = self._opened(value)
            return value.of if own is not None else _alike(value.of, axis)
        if own is not None:
            return self._loads(ref.array, ref.array.shape[:-2], "lane")
        if ref.axis == -1:
            return _alike(self._loads(ref.array, ref.array.shape[:-1], "rover"), axis)
        return self._shared(ref.array, axis)

    def _shared(self, array: Any, axis: int | None) -> np.ndarray:
        """Entries of what all rovers share: numbers of the program where they are known."""
        shape = np.shape(array)
        known = None if isinstance(array, Tracer) else np.asarray(array)
        if axis is None or not shape:
            if known is not None:
                return _filled(shape, lambda k: known.reshape(-1)[k])
            return self._loads(array, shape, "shared")
        inner = (*shape[:axis], *shape[axis + 1 :])
        if known is not None:
            rows = np.moveaxis(known, axis, 0).reshape(shape[axis], -1)
            alike = np.all(rows == rows[:1], axis=0)
            if alike.all():
                return _filled(inner, lambda k: rows[0, k])
            if shape[axis] == self.wheels and math.prod(inner) < ROLLED:
                slot = self.slot(array, axis)
                return _filled(inner, lambda k: rows[0, k] if alike[k] else _Load(slot, k, "wheel"))
        if shape[axis] != self.wheels:
            raise Uncompilable
        slot = self.slot(array, axis)
        return _filled(inner, lambda k: _Load(slot, k, "wheel"))

    def _loads(self, array: Any, shape: tuple[int, ...], kind: str) -> np.ndarray:
        slot = self.slot(array)
        return _filled(shape, lambda k: _Load(slot, k, kind))

    def _opened(self, value: _Entries | _Rolled) -> _Entries:
        """The entries of a value one by one."""
        if isinstance(value, _Entries):
            return value
        name = self._stored(value)
        return _Entries(_filled(value.shape, lambda k: _Stored(name, k, value.level + 1, value.dtype)), value.axis)

    def _stored(self, value: _Rolled) -> str:
        """The name of the array that keeps what a loop makes."""
        loop = self.loops[value.level, math.prod(value.shape)]
        if value.name not in loop.stored:
            loop.stored.append(value.name)
            self.local.append(f"{type_of(value.dtype)} a{value.name}[{math.prod(value.shape)}];")
        return f"a{value.name}"

    # --- C ---

    def _address(self, at: str, kind: str) -> str:
        lane, wheel = f"{at} * {self.threads * self.batch} + row", f"{at} * {self.threads} + wheel"
        return {"lane": lane, "rover": f"{at} * {self.batch} + i", "wheel": wheel, "shared": at}[kind]

    def _memory(self, load: _Load, at: str = "") -> str:
        self.kinds.add((load.slot, load.kind))
        return f"s{load.slot}[{self._address(at or str(load.at), load.kind)}]"

    def read(self, entry: Any) -> tuple[str, int]:
        """The expression of an entry, which is computed before, and its level."""
        if isinstance(entry, np.generic):
            return number(entry), 0
        if isinstance(entry, _Load):
            name = self._named(np.dtype(self.sources[entry.slot][0].dtype), self._memory(entry), 0)
        elif isinstance(entry, _Stored):
            return f"{entry.name}[{entry.at}]", entry.level
        elif isinstance(entry, _Choice):
            (where, a), (no, b), (yes, c) = (self.read(e) for e in (entry.where, entry.no, entry.yes))
            name = self._named(entry.dtype, f"{where} ? {yes} : {no}", max(a, b, c))
        else:
            name = entry
        return name, self.levels[name]

    def _named(self, dtype: np.dtype, expression: str, level: int) -> str:
        """The variable that holds an expression; an equal one is not computed again."""
        key = (expression, dtype)
        if key not in self.names:
            self.names[key] = name = self._new(level, dtype)
            self.lines.setdefault(level, []).append(f"const {type_of(dtype)} {name} = {expression};")
        return self.names[key]

    def _new(self, level: int, dtype: np.dtype) -> str:
        name = f"v{len(self.levels)}"
        self.levels[name], self.types[name] = level, dtype
        return name

    def _done(self, name: str, params: Any, dtype: np.dtype, kind: np.dtype, entries: list[Any]) -> Any:
        """An operation on entries of type `kind`."""
        if name == "select_n":
            where, no, yes = entries
            return _Choice(where, no, yes, dtype)
        found = [self.read(e) for e in entries]
        return self._named(dtype, call(name, params, dtype, kind, [x for x, _ in found]), max(n for _, n in found))

    # --- loops ---

    def _loop(self, level: int, count: int) -> _Loop:
        return self.loops.setdefault((level, count), _Loop())

    def _in_loop(self, value: Any, count: int) -> tuple[Callable[[int], str], int]:
        """How a loop of so many rounds at a level reads a value, and the least such level."""
        if isinstance(value, _Rolled):

            def rolled(level: int) -> str:
                if level == value.level:
                    return value.name
                return f"{self._stored(value)}[k]" if value.again is None else value.again(level)

            return rolled, value.level
        entries = list(value.flat)
        first = entries[0]
        if all(e is first or (type(e) is type(first) and e == first) for e in entries):
            name, level = self.read(first)
            return lambda _: name, level
        if all(isinstance(e, np.generic) for e in entries):
            known = np.array(entries, first.dtype)
            table = self.tables.setdefault((known.tobytes(), type_of(known.dtype)), f"c{len(self.tables)}")
            return lambda _: f"{table}[k]", 0
        if isinstance(first, _Load | _Stored) and entries == [
            dataclasses.replace(first, at=first.at + k) for k in range(count)
        ]:
            if isinstance(first, _Stored):
                return lambda _: f"{first.name}[k + {first.at}]", first.level
            return lambda _: self._memory(first, f"(k + {first.at})"), 0
        found, dtype = [self.read(e) for e in entries], self._dtype(next(e for e in entries if not _known(e)))
        level = max(n for _, n in found)
        key = (tuple(x for x, _ in found), "array")
        if key not in self.names:
            self.names[key] = name = "a" + self._new(level, dtype)
            self.local.append(f"{type_of(dtype)} {name}[{count}];")
            self.lines.setdefault(level, []).extend(f"{name}[{k}] = {x};" for k, (x, _) in enumerate(found))
        held = self.names[key]
        return lambda _: f"{held}[k]", level

    def _dtype(self, entry: Any) -> np.dtype:
        if isinstance(entry, _Load):
            return np.dtype(self.sources[entry.slot][0].dtype)
        return self.types[entry] if isinstance(entry, str) else np.dtype(entry.dtype)

    def _roll(
        self, result: _Inner, shape: tuple[int, ...], axis: int | None, parts: list[Any], make: Any, dear: bool
    ) -> _Rolled:
        """An operation on arrays, in a loop; `make` makes its expression from those of its operands."""
        count = math.prod(shape)
        found = [self._in_loop(p, count) for p in parts]

        def at(level: int) -> str:
            expression = make([x(level) for x, _ in found])
            key = (expression, result.dtype, level, count)
            if key not in self.names:
                self.names[key] = name = self._new(level, result.dtype)
                self._loop(level, count).body.append(f"const {type_of(result.dtype)} {name} = {expression};")
            return self.names[key]

        level = max(n for _, n in found)
        return _Rolled(at(level), level, shape, axis, result.dtype, None if dear else at)

    # --- operations ---

    def _apply(self, eqn: Any, operands: list[Any], result: _Inner) -> _Entries | _Rolled:
        name, shape, params = eqn.primitive.name, result.shape, eqn.params
        if len(eqn.outvars) != 1:
            raise Uncompilable
        if name == "gather":
            return self._gather(operands, params, result)
        if name in ("reshape", "squeeze", "broadcast_in_dim", "slice") or name in _SUMS:
            return self._reshaped(name, operands[0], params, result)
        axes = {a for a in map(self._axis, operands) if a is not None}
        if len(axes) > 1:
            raise Uncompilable
        axis = axes.pop() if axes else None
        parts = [self._value(o, axis) for o in operands]
        inner = shape if axis is None else (*shape[:axis], *shape[axis + 1 :])
        if name in _SAME:
            return parts[0] if isinstance(parts[0], _Rolled) else _Entries(parts[0], axis)
        kind = _type(operands[0])
        if name == "select_n" and (len(operands) != 3 or kind != np.bool_):
            raise Uncompilable
        if math.prod(inner) >= ROLLED and name != "concatenate" and not self._is_push(name, parts):
            wide = [p if isinstance(p, _Rolled) else np.broadcast_to(p, inner) for p in parts]
            if name == "select_n":
                return self._roll(result, inner, axis, wide, lambda x: f"{x[0]} ? {x[2]} : {x[1]}", False)
            return self._roll(
                result, inner, axis, wide, lambda x: call(name, params, result.dtype, kind, x), name in DEAR
            )
        parts = [self._opened(p).of if isinstance(p, _Rolled) else p for p in parts]
        if name == "concatenate":
            if params["dimension"] == axis:
                raise Uncompilable
            along = params["dimension"] - (axis is not None and params["dimension"] > axis)
            return _Entries(np.concatenate(parts, along), axis)
        flat = [list(np.broadcast_to(p, inner).flat) for p in parts]
        out = [self._done(name, params, result.dtype, kind, list(e)) for e in zip(*flat, strict=True)]
        return _Entries(_filled(inner, lambda k: out[k]), axis)

    def _is_push(self, name: str, parts: list[Any]) -> bool:
        """Whether an operation only chooses between entries that have not been read yet."""
        return name == "select_n" and any(
            not isinstance(p, _Rolled) and p.size and isinstance(p.flat[-1], _Load) and p.flat[-1].kind == "lane"
            for p in parts[1:]
        )

    def _reshaped(self, name: str, operand: Any, params: Any, result: _Inner) -> _Entries | _Rolled:
        """Operations that only rearrange entries, and sums."""
        axis, shape, old = self._axis(operand), result.shape, _shape_of(operand)
        if name in ("broadcast_in_dim", "reshape") and isinstance(operand, _Outer) and axis is not None:
            # An operand whose wheels are no longer the last axis: every thread reads those of all wheels.
            new = params["broadcast_dimensions"][axis] if name == "broadcast_in_dim" else None
            if (new is not None and new != len(shape) - 1) or (new is None and shape[-1] != self.wheels):
                axis, value = None, self._loads(operand.array, old, "rover")
            else:
                value = self._value(operand, axis)
        else:
            value = self._value(operand, axis)
        if name in _SUMS:
            return self._summed(_SUMS[name], value, params["axes"], axis, result)
        if name == "slice":
            entries = self._opened(value).of if isinstance(value, _Rolled) else value
            strides = params["strides"] or (1,) * len(old)
            bounds = list(zip(params["start_indices"], params["limit_indices"], strides, strict=True))
            if axis is not None and bounds.pop(axis) != (0, old[axis], 1):
                raise Uncompilable
            return _Entries(entries[tuple(slice(*b) for b in bounds)], axis)
        if name == "broadcast_in_dim":
            dims = params["broadcast_dimensions"]
            new = None if axis is None else dims[axis]
            full = [old[dims.index(d)] if d in dims else 1 for d in range(len(shape)) if d != new]
        else:
            new = None if axis is None else _moved(old, axis, shape)
            full = [n for d, n in enumerate(shape) if d != new]
        inner = tuple(n for d, n in enumerate(shape) if d != new)
        if isinstance(value, _Rolled):
            if math.prod(inner) == math.prod(value.shape):
                return dataclasses.replace(value, shape=inner, axis=new)
            value = self._opened(value).of
        return _Entries(np.broadcast_to(value.reshape(full), inner), new)

    def _summed(self, name: str, value: Any, along: Sequence[int], axis: int | None, result: _Inner) -> _Entries:
        if axis in along:
            raise Uncompilable
        inner = tuple(a - (axis is not None and a > axis) for a in along)
        new = None if axis is None else axis - sum(a < axis for a in along)
        if isinstance(value, _Rolled) and name == "add" and len(inner) == len(value.shape):
            loop = self._loop(value.level, math.prod(value.shape))
            total = self._new(value.level + 1, result.dtype)
            loop.before.append(f"{type_of(result.dtype)} {total} = 0;")
            loop.body.append(f"{total} += {value.name};")
            return _Entries(_filled((), lambda _: total), new)
        entries = self._opened(value).of if isinstance(value, _Rolled) else value
        moved = np.moveaxis(entries, inner, range(len(inner)))
        rest = moved.shape[len(inner) :]
        rows = list(moved.reshape(-1, math.prod(rest)))
        sums = list(rows[0])
        for row in rows[1:]:
            sums = [self._done(name, {}, result.dtype, result.dtype, [a, b]) for a, b in zip(sums, row, strict=True)]
        return _Entries(_filled(rest, lambda k: sums[k]), new)

    def _gather(self, operands: list[Any], params: Any, result: _Inner) -> _Entries | _Rolled:
        """Look-up of single entries of a list that all rovers share."""
        table, index = operands
        numbers = params["dimension_numbers"]
        flat = isinstance(table, _Outer) and table.axis is None and np.ndim(table.array) == 1
        if not flat or numbers.offset_dims or numbers.operand_batching_dims:
            raise Uncompilable
        axis = self._axis(index)
        places, slot = self._value(index, axis), self.slot(table.array)
        if isinstance(places, _Rolled):
            return self._roll(result, places.shape[:-1], axis, [places], lambda x: f"s{slot}[{x[0]}]", True)
        found = [self.read(p) for p in places[..., 0].flat]
        read = [self._named(result.dtype, f"s{slot}[{x}]", n) for x, n in found]
        return _Entries(_filled(places.shape[:-1], lambda k: read[k]), axis)


def _known(entry: Any) -> bool:
    return isinstance(entry, np.generic)


def _alike(entries: np.ndarray, axis: int | None) -> np.ndarray:
    """Entries that all wheels share, without an axis of wheels."""
    if axis is None or entries.ndim == 0:
        return entries
    first = np.take(entries, 0, axis)
    for k in range(1, entries.shape[axis]):
        if any(a is not b and a != b for a, b in zip(first.flat, np.take(entries, k, axis).flat, strict=True)):
            raise Uncompilable
    return first


def _type_of(atom: Any) -> np.dtype:
    return np.dtype(atom.aval.dtype)


def _type(ref: Any) -> np.dtype:
    return ref.dtype if isinstance(ref, _Inner) else np.dtype(ref.array.dtype)


def _shape_of(ref: Any) -> tuple[int, ...]:
    if isinstance(ref, _Inner):
        return ref.shape
    shape = np.shape(ref.array)
    return shape if ref.axis is None else shape[:-1]


def _filled(shape: tuple[int, ...], entry: Callable[[int], Any]) -> np.ndarray:
    out = np.empty(math.prod(shape), object)
    for k in range(out.size):
        out[k] = entry(k)
    return out.reshape(shape)


def _moved(old: tuple[int, ...], axis: int, new: tuple[int, ...]) -> int:
    """Where a reshape puts an axis."""
    before = math.prod(old[:axis])
    for at, size in enumerate(new):
        if size == old[axis] and math.prod(new[:at]) == before:
            return at
    raise Uncompilable
