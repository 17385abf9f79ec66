"""CUDA C of a step's graph: one thread per rover, its state in registers over many steps."""

from __future__ import annotations

from typing import Any

import numpy as np

from lunar_mjx.dynamics.one_kernel.scalar_graph import Node, UnsupportedError, needed
from lunar_mjx.dynamics.one_kernel.step_graph import StepGraph

_SYMBOLS = "add:+ sub:- mul:* div:/ and:& or:| xor:^ gt:> lt:< ge:>= le:<= eq:== ne:!="
_INFIX = {name: symbol for name, _, symbol in (pair.partition(":") for pair in _SYMBOLS.split())}
_SAME_NAME = (
    "acos acosh asin asinh atan atan2 atanh cbrt ceil cos cosh exp exp2 expm1 floor log log1p pow rsqrt sin sinh"
)
_CALLS = {name: f"{name}f" for name in f"{_SAME_NAME} sqrt tan tanh".split()}
_CALLS |= {"abs": "fabsf", "erf": "erff", "max": "fmaxf", "min": "fminf", "rem": "fmodf"}
_INTEGER_CALLS = {"abs": "abs", "max": "max", "min": "min"}


def _type(dtype: Any) -> str:
    kinds = {"float32": "float", "int32": "int", "bool": "bool"}
    try:
        return kinds[np.dtype(dtype).name]
    except KeyError:
        raise UnsupportedError(f"values of type {np.dtype(dtype).name}: a kernel has float32, int32 and bool") from None


def _number(value: Any) -> str:
    if value.dtype == bool:
        return "true" if value else "false"
    if value.dtype.kind != "f":
        return str(int(value))
    if np.isfinite(value):
        return f"{float(np.float32(value)).hex()}f"
    return f"__int_as_float({hex(np.float32(value).view(np.uint32))})"


def _expression(node: Node, args: list[str]) -> str:
    op, real = node.op, np.dtype(node.dtype).kind == "f"
    if op in _INFIX:
        return f"{args[0]} {_INFIX[op]} {args[1]}"
    if op == "load":
        return f"__ldg(t{node.params} + {args[0]})"
    if op == "select_n" and len(args) == 3:
        return f"{args[0]} ? {args[2]} : {args[1]}"
    if op == "neg":
        return f"-{args[0]}"
    if op == "not":
        return f"!{args[0]}" if node.dtype == bool else f"~{args[0]}"
    if op == "sign" and real:
        return f"{args[0]} > 0.0f ? 1.0f : ({args[0]} < 0.0f ? -1.0f : {args[0]})"
    if op == "convert_element_type":
        return f"({_type(node.dtype)}){args[0]}"
    if op in (_CALLS if real else _INTEGER_CALLS):
        return f"{(_CALLS if real else _INTEGER_CALLS)[op]}({', '.join(args)})"
    raise UnsupportedError(f"{op}: has no name in CUDA C here")


def cuda_source(step: StepGraph, block: int, blocks: int = 1, name: str = "rollout") -> str:
    """The kernel: `name(const float* in, float* out, int rovers, int steps, tables...)`.

    Args:
      step: the graph. block: threads per block. blocks: of them that a multiprocessor should hold, at least.

    Rows of `in` are the inputs, rows of `out` the entries of the state, each over the rovers; whole numbers travel by
    their bits. Maxima and minima drop NaN, as CUDA's do.
    """
    kept = [(n, x) for n, x in zip(step.state, step.new, strict=True)]
    order = needed([x for _, x in kept])
    names = {id(n): f"s{n.params}" for n in order if n.op == "input"}
    read = {n.params for n in order if n.op == "input"}
    body = []
    for node in order:
        if node.op == "input":
            continue
        args = [names[id(a)] if isinstance(a, Node) else _number(a) for a in node.args]
        names[id(node)] = f"v{len(body)}"
        body.append(f"const {_type(node.dtype)} v{len(body)} = {_expression(node, args)};")
    tables = "".join(f", const {_type(t.values.dtype)}* __restrict__ t{t.number}" for t in step.graph.tables)
    lines = [
        f'extern "C" __global__ void __launch_bounds__({block}, {blocks})',
        f"{name}(const float* __restrict__ in, float* __restrict__ out, int rovers, int steps{tables}) {{",
        f"const int i = blockIdx.x * {block} + threadIdx.x;",
        "if (i >= rovers) return;",
    ]
    lines += [f"t{t.number} += (size_t)i * {int(np.prod(t.shape))};" for t in step.graph.tables if t.own]
    for n in sorted(read | set(step.state)):
        value = f"in[(size_t){n} * rovers + i]"
        kind = _type(step.dtypes[n])
        lines.append(f"{kind} s{n} = {value if kind == 'float' else f'__float_as_int({value})'};")
    lines += ["#pragma unroll 1", "for (int k = 0; k < steps; ++k) {", *body]
    result = [(n, names[id(x)] if isinstance(x, Node) else _number(x)) for n, x in kept]
    # all at once: an entry's new value may be another's old one
    lines += [f"const {_type(step.dtypes[n])} n{n} = {x};" for n, x in result if x.startswith("s") and x != f"s{n}"]
    changed = [(n, x) for n, x in result if x != f"s{n}"]
    lines += [f"s{n} = {f'n{n}' if x.startswith('s') else x};" for n, x in changed]
    lines.append("}")
    for row, (n, _) in enumerate(kept):
        value = f"s{n}" if _type(step.dtypes[n]) == "float" else f"__int_as_float(s{n})"
        lines.append(f"out[(size_t){row} * rovers + i] = {value};")
    return "\n".join([*lines, "}", ""])
