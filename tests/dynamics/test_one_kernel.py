"""The step as one kernel: its source, compiled as C++ for this processor, against the rollout that XLA compiles."""

import ctypes
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.one_kernel import Graph, KernelRollout, UnsupportedError
from lunar_mjx.dynamics.one_kernel.scalar_graph import needed, traced
from lunar_mjx.model import make_model

HEAD = """
#include <algorithm>
#include <cmath>
#include <cstring>
using std::max; using std::min;
#define __global__
#define __restrict__
#define __launch_bounds__(a, b)
#define __ldg(p) (*(p))
static struct { int x; } blockIdx, threadIdx;
static inline float __int_as_float(int i) { float f; std::memcpy(&f, &i, 4); return f; }
static inline int __float_as_int(float f) { int i; std::memcpy(&i, &f, 4); return i; }
"""


def on_this_processor(kernel, folder):
    """A function from rows, steps to rows: the kernel's source, thread by thread."""
    compiler = shutil.which("c++") or shutil.which("g++")
    if compiler is None:
        pytest.skip("no C++ compiler here")
    kinds = ["float" if t.values.dtype == np.float32 else "int" for t in kernel.step.graph.tables]
    tables = "".join(f", (const {kind}*)t[{i}]" for i, kind in enumerate(kinds))
    call = f"rollout(in, out, n, steps{tables});"
    tail = (
        'extern "C" void drive(const float* in, float* out, int n, int steps, const void** t)'
        f" {{ for (int i = 0; i < n; ++i) {{ threadIdx.x = i; {call} }} }}"
    )
    source, library = folder / "kernel.cpp", folder / "kernel.so"
    source.write_text(HEAD + kernel.source + tail)
    subprocess.run([compiler, "-O0", "-ffp-contract=off", "-shared", "-fPIC", "-o", library, source], check=True)
    drive = ctypes.CDLL(str(library)).drive

    def run(rows, steps):
        rows = np.ascontiguousarray(rows)
        out = np.zeros((len(kernel.step.state), rows.shape[1]), np.float32)
        held = [np.ascontiguousarray(np.asarray(t.values).reshape(-1)) for t in kernel.step.graph.tables]
        pointers = (ctypes.c_void_p * len(held))(*(a.ctypes.data for a in held))
        drive(ctypes.c_void_p(rows.ctypes.data), ctypes.c_void_p(out.ctypes.data), rows.shape[1], steps, pointers)
        return out

    return run


@pytest.mark.parametrize(
    ("rover", "preset"), [("luvmi_x", "consistent"), pytest.param("viper", "field", marks=pytest.mark.slow)]
)
def test_the_kernel_drives_as_the_rollout_does(rover, preset, tmp_path):
    model = make_model(rover, preset=preset)
    system = build(model, "structured")
    along = jnp.linspace(-5.0, 5.0, 4)
    state = jax.jit(jax.vmap(lambda x: system.reset(system.params, x, 0.6 * x)))(along)
    one = jnp.array([1.0 if g.name == "drive" else 0.05 for g in model.rover.groups for _ in g.joints])
    steps = 40
    kernel = KernelRollout(system, system.params)
    rows = kernel.rows(state, jnp.broadcast_to(one, (4, len(one))))
    found = kernel.state(jnp.asarray(on_this_processor(kernel, tmp_path)(rows, steps)))
    controls = jnp.broadcast_to(one, (steps, len(one)))
    expected, _ = jax.jit(lambda s: system.rollout_batch(system.params, s, controls, report=lambda t: None))(state)
    assert np.array_equal(found.step, expected.step)
    for name, base in (("qpos", 3), ("qvel", 6)):
        a, b, c = (np.asarray(getattr(s, name), float)[:, :base] for s in (expected, state, found))
        assert np.abs(a - c).max() < 1e-3 * np.abs(a - b).max()
    heat = found.temperature.winding - expected.temperature.winding
    assert np.abs(heat).max() < 1e-3 * np.abs(expected.temperature.winding - state.temperature.winding).max()


def test_equal_numbers_are_made_once_and_unneeded_ones_never():
    def function(x):
        y = jnp.sin(x) * 2.0
        unused = jnp.exp(x)
        return jnp.sum(y[1:]) + jnp.sin(x)[1] * 2.0 + 0.0 * jnp.ones(3)[0], unused

    graph, results, _, _ = traced(lambda x: function(x)[0], np.zeros(3, np.float32), ["input"])
    assert isinstance(graph, Graph)
    ops = sorted(node.op for node in needed(list(results[0].reshape(-1))))
    assert ops == ["add", "add", "input", "input", "mul", "mul", "sin", "sin"]


def test_what_a_thread_cannot_do_is_named():
    with pytest.raises(UnsupportedError, match="gather from a state"):
        traced(
            lambda x: x.at[x[:2].astype(jnp.int32)].get(mode="promise_in_bounds"), np.zeros(20, np.float32), ["input"]
        )
    with pytest.raises(UnsupportedError, match="sort"):
        traced(jnp.sort, np.zeros(3, np.float32), ["input"])
