"""CUDA C of a kernel, its compiler and its launch from within a program of XLA's.

NVRTC, which comes with JAX for CUDA, makes PTX of the source, and XLA's custom call for PTX runs it on XLA's arrays.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import dataclasses
import functools
import importlib.util
import logging
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np


@dataclasses.dataclass(frozen=True)
class Threads:
    """How the work is shared out."""

    block: int = 128
    """Threads of a block, about: some rovers side by side, with all their wheels."""
    blocks: int = 8
    """Blocks that a multiprocessor should hold, at least, which leaves a thread 64 registers: on one H200 LUVMI-X'
    wheels take 289 us with four, 189 us with eight and 268 us with ten."""
    unrolled: int = 2
    """Rounds of a loop that are written out."""


THREADS = Threads()


class Uncompilable(Exception):
    """A part that cannot be one kernel."""


@dataclasses.dataclass(frozen=True)
class Kernel:
    """A kernel: lines of C that read operands s0, s1, ... and write results o0, o1, ..., and what they run over.

    Attributes:
      tables: numbers that all threads share. body: lines; `i` is the rover, `wheel` the row, `row` the place of both in
        an array (row, rover), and `inside` whether the thread has a rover of its own, so that it may write.
      given, made: types of operands and results in C.
      kept: operands (by number) that a result (by number) replaces.
      batch: rovers. rows: threads for each.
    """

    tables: str
    body: str
    given: tuple[str, ...]
    made: tuple[str, ...]
    kept: Mapping[int, int]
    batch: int
    rows: int

    @property
    def side(self) -> int:
        """Rovers of a block, a multiple of the 32 threads that go together."""
        return max(THREADS.block // self.rows // 32, 1) * 32

    @property
    def source(self) -> str:
        """The whole kernel, called `part`, with a pointer for each operand and then for each result."""
        pointers = [
            f"const {t}* {'' if n in self.kept else '__restrict__ '}{'old' if n in self.kept else 's'}{n}"
            for n, t in enumerate(self.given)
        ]
        own = set(self.kept.values())
        pointers += [f"{t}* {'' if n in own else '__restrict__ '}o{n}" for n, t in enumerate(self.made)]
        kept = [f"const {self.made[n]}* s{slot} = o{n};" for slot, n in self.kept.items()]
        return "\n".join(
            [
                _HEAD,
                self.tables,
                f'extern "C" __global__ void __launch_bounds__({self.side * self.rows}, {THREADS.blocks})',
                f"part({', '.join(pointers)}) {{",
                f"const int place = blockIdx.x * {self.side} + threadIdx.x, wheel = threadIdx.y;",
                f"const bool inside = place < {self.batch};",
                # threads beyond the last rover go along with it, since threads of a block wait for one another
                f"const int i = inside ? place : {self.batch - 1}, row = wheel * {self.batch} + i;",
                *kept,
                self.body,
                "}",
            ]
        )


Launch = Callable[[Kernel, list[Any], list[Any]], list[Any]]
"""Runs a kernel on its operands; gets the shapes and types of its results, and returns them."""

_LOG = logging.getLogger(__name__)
_HEAD = """
#if __CUDA_ARCH__ >= 800
#define LIKE(name, op) static __device__ float name(float a, float b) { \\
float c; asm(op " %0, %1, %2;" : "=f"(c) : "f"(a), "f"(b)); return c; }
LIKE(larger, "max.NaN.f32")
LIKE(smaller, "min.NaN.f32")
#else
static __device__ float larger(float a, float b) { return a > b || a != a ? a : b; }
static __device__ float smaller(float a, float b) { return a < b || a != a ? a : b; }
#endif
static __device__ int larger(int a, int b) { return a > b ? a : b; }
static __device__ int smaller(int a, int b) { return a < b ? a : b; }
"""
"""A maximum of NaN is NaN, as everywhere else."""
_TYPES = {"float32": "float", "int32": "int", "bool": "bool"}
_SYMBOLS = "add:+ sub:- mul:* div:/ and:& or:| xor:^ gt:> lt:< ge:>= le:<= eq:== ne:!="
_INFIX = {name: symbol for name, _, symbol in (pair.partition(":") for pair in _SYMBOLS.split())}
_REAL = "acos asin atan atan2 cbrt ceil cos exp exp2 expm1 floor log log1p pow rsqrt sin sqrt tan tanh"
DEAR = {*_REAL.split(), "div"}
"""Operations of many instructions."""
_CALLS = {name: f"{name}f" for name in _REAL.split()} | {"abs": "fabsf", "rem": "fmodf"}


def type_of(dtype: Any) -> str:
    """The name of a type in C.

    Raises:
      Uncompilable: a type that kernels do not have.
    """
    name = _TYPES.get(np.dtype(dtype).name)
    if name is None:
        raise Uncompilable
    return name


def number(value: np.generic) -> str:
    """A number in C, exactly."""
    if value.dtype == np.bool_:
        return "true" if value else "false"
    if value.dtype == np.int32:
        return f"({int(value)})"
    if value.dtype != np.float32:
        raise Uncompilable
    real = float(value)
    if math.isnan(real):
        return "(0.0f / 0.0f)"
    return f"({real.hex()}f)" if math.isfinite(real) else f"({'-' if real < 0.0 else ''}1.0f / 0.0f)"


def call(name: str, params: Any, dtype: np.dtype, kind: np.dtype, args: list[str]) -> str:
    """An elementwise operation in C.

    Args:
      name, params: of the primitive. dtype: of the result. kind: of the first operand. args: its operands.

    Raises:
      Uncompilable: an operation without a name here.
    """
    real = kind == np.float32
    if name in _INFIX:
        return f"{args[0]} {_INFIX[name]} {args[1]}"
    if name in ("max", "min"):
        if kind == np.bool_:
            return f"{args[0]} {'|' if name == 'max' else '&'} {args[1]}"
        return f"{'larger' if name == 'max' else 'smaller'}({args[0]}, {args[1]})"
    if name == "clamp":
        return f"smaller(larger({args[1]}, {args[0]}), {args[2]})"
    if name == "integer_pow" and real:
        return _power(args[0], params["y"])
    if name == "square":
        return f"{args[0]} * {args[0]}"
    if name == "neg":
        return f"-{args[0]}"
    if name == "not":
        return f"!{args[0]}" if kind == np.bool_ else f"~{args[0]}"
    if name == "sign" and real:
        return f"{args[0]} > 0.0f ? 1.0f : ({args[0]} < 0.0f ? -1.0f : {args[0]})"
    if name == "convert_element_type":
        return f"{args[0]} != 0" if dtype == np.bool_ else f"({type_of(dtype)}){args[0]}"
    if name == "rem" and kind == np.int32:
        return f"{args[0]} % {args[1]}"
    if name == "abs" and kind == np.int32:
        return f"abs({args[0]})"
    if real and name in _CALLS:
        return f"{_CALLS[name]}({', '.join(args)})"
    raise Uncompilable


def _power(base: str, exponent: int) -> str:
    """A whole power by squares, as XLA takes it."""
    if exponent < 0:
        return f"1.0f / ({_power(base, -exponent)})"
    if exponent < 2:
        return base if exponent else "1.0f"
    half = f"({_power(base, exponent // 2)})"
    return f"{half} * {half}" + (f" * {base}" if exponent % 2 else "")


def on_gpu(kernel: Kernel, given: list[Any], outs: list[Any]) -> list[Any]:
    """Runs a kernel on the GPU: the results, whose shapes and types are `outs`."""
    device = jax.local_devices(backend="gpu")[0]
    try:
        ptx = compiled(kernel.source, f"compute_{str(device.compute_capability).replace('.', '')}")
    except RuntimeError as error:
        _LOG.warning("%s; XLA computes what the ground does to wheels, in more time.", error)
        raise Uncompilable from error
    run = jax.ffi.ffi_call("__gpu$xla.gpu.ptx", outs, input_output_aliases=dict(kernel.kept), vmap_method="sequential")
    sizes = {"grid_x": math.ceil(kernel.batch / kernel.side), "grid_y": 1, "grid_z": 1}
    sizes |= {"block_x": kernel.side, "block_y": kernel.rows, "block_z": 1, "shared_mem_bytes": 0}
    told = {name: np.int32(size) for name, size in sizes.items()}
    return list(run(*given, name="part", kernel_type="ptx", kernel_data=ptx, **told))


@functools.cache
def compiler() -> Any:
    """NVRTC as a library of C functions; None where there is none."""
    spec = importlib.util.find_spec("nvidia")
    folders = list(spec.submodule_search_locations or ()) if spec is not None else []
    found = sorted(str(p) for f in folders for p in Path(f).rglob("libnvrtc.so.*") if "alt" not in p.name)
    for name in [*found, ctypes.util.find_library("nvrtc")]:
        if name:
            try:
                return ctypes.CDLL(name)
            except OSError:
                continue
    _LOG.info("no NVRTC found: XLA computes what the ground does to wheels, in more time.")
    return None


@functools.lru_cache(32)
def compiled(source: str, architecture: str) -> str:
    """PTX of a kernel's source for an architecture such as compute_90."""
    library, program = compiler(), ctypes.c_void_p()

    def checked(status: int, told: str) -> None:
        if status:
            raise RuntimeError(f"NVRTC: {told} failed with status {status}.")

    checked(
        library.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"part.cu", 0, None, None), "the program"
    )
    # Quotients and roots to within two units of the last place, as XLA's kernels have them.
    words = [f"--gpu-architecture={architecture}", "--prec-div=false", "--prec-sqrt=false"]
    options = (ctypes.c_char_p * len(words))(*(w.encode() for w in words))
    status = library.nvrtcCompileProgram(program, len(words), options)
    if status:
        size = ctypes.c_size_t()
        library.nvrtcGetProgramLogSize(program, ctypes.byref(size))
        log = ctypes.create_string_buffer(size.value)
        library.nvrtcGetProgramLog(program, log)
        raise RuntimeError(f"NVRTC: {log.value.decode()[:2000]}")
    size = ctypes.c_size_t()
    checked(library.nvrtcGetPTXSize(program, ctypes.byref(size)), "the size of the PTX")
    ptx = ctypes.create_string_buffer(size.value)
    checked(library.nvrtcGetPTX(program, ptx), "the PTX")
    library.nvrtcDestroyProgram(ctypes.byref(program))
    return ptx.value.decode()
