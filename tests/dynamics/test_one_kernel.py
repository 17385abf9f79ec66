"""What the ground does to wheels as one kernel: its source, as C++ on this processor, against XLA's arrays."""

import ctypes
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.batching import batch
from lunar_mjx.dynamics.batching.batch_last import batch_last
from lunar_mjx.dynamics.batching.cuda import number
from lunar_mjx.dynamics.batching.one_kernel import as_kernels
from lunar_mjx.effects.marks import by_wheel
from lunar_mjx.model import make_model

HEAD = """
#include <cmath>
#define __global__
#define __device__
#define __constant__ static const
#define __restrict__
#define __launch_bounds__(a, b)
#define __syncthreads()
#define rsqrtf(x) (1.0f / sqrtf(x))
static struct { int x, y; } blockIdx, threadIdx;
"""


class OnThisProcessor:
    """Runs kernels as C++, thread by thread; counts them."""

    def __init__(self, folder):
        self.folder, self.kernels = folder, []
        self.compiler = shutil.which("c++") or shutil.which("g++")
        if self.compiler is None:
            pytest.skip("no C++ compiler here")

    def __call__(self, kernel, given, outs):
        self.kernels.append(kernel)
        name = f"part{len(self.kernels)}"
        pointers = ", ".join(f"({t}*)p[{n}]" for n, t in enumerate([*kernel.given, *kernel.made]))
        tail = f"""
extern "C" void wheel(void** p, int y) {{
  threadIdx.y = y;
  for (blockIdx.x = 0; blockIdx.x * {kernel.side} < {kernel.batch}; ++blockIdx.x)
    for (threadIdx.x = 0; threadIdx.x < {kernel.side}; ++threadIdx.x) part({pointers});
}}"""
        source, library = self.folder / f"{name}.cpp", self.folder / f"{name}.so"
        source.write_text(HEAD + kernel.source + tail)
        subprocess.run([self.compiler, "-O0", "-w", "-shared", "-fPIC", "-o", library, source], check=True)
        run = ctypes.CDLL(str(library)).wheel

        def drive(*arrays):
            held = [np.ascontiguousarray(a) for a in arrays]
            made = [np.zeros(o.shape, o.dtype) for o in outs]
            for wheel in range(kernel.rows):
                # Wheels run one after another here and read each other's operands before any is replaced.
                now = [m.copy() for m in made]
                for slot, result in kernel.kept.items():
                    now[result] = held[slot].reshape(made[result].shape).copy()
                run((ctypes.c_void_p * (len(held) + len(now)))(*(a.ctypes.data for a in [*held, *now])), wheel)
                for whole, own in zip(made, now, strict=True):
                    whole[..., wheel, :] = own[..., wheel, :]
            return made

        return jax.pure_callback(drive, outs, *given)


@pytest.fixture
def on_this_processor(tmp_path):
    launch = OnThisProcessor(tmp_path)
    batch.PARTS[:] = [launch]
    yield launch
    batch.PARTS.clear()


@pytest.mark.parametrize(
    ("rover", "preset"), [("luvmi_x", "consistent"), pytest.param("viper", "field", marks=pytest.mark.slow)]
)
def test_the_kernel_drives_as_arrays_do(rover, preset, on_this_processor):
    model = make_model(rover, preset=preset)
    if preset == "consistent":
        # the part alone that makes the kernel worth it
        model = model.add("stress_integral")
    system = build(model, "structured")
    along = jnp.linspace(-5.0, 5.0, 5)
    state = jax.jit(jax.vmap(lambda x: system.reset(system.params, x, 0.6 * x)))(along)
    one = jnp.array([1.0 if g.name == "drive" else 0.05 for g in model.rover.groups for _ in g.joints])
    controls = jnp.broadcast_to(one, (30, len(one)))

    def driven():
        return jax.device_get(
            jax.jit(
                lambda s: system.rollout_batch(
                    system.params, s, controls, report=lambda t: (t.sinkage, t.wheel_force.z)
                )
            )(state)
        )

    found, seen = driven()
    kernels = [k.rows for k in on_this_processor.kernels]
    assert kernels == [4]
    batch.PARTS.clear()
    expected, wanted = driven()
    for name, base in (("qpos", 3), ("qvel", 6)):
        a, b, c = (np.asarray(getattr(s, name), float)[:, :base] for s in (expected, state, found))
        assert np.abs(a - c).max() < 1e-3 * np.abs(a - b).max()
    for a, b in zip(seen, wanted, strict=True):
        assert np.abs(a - b).max() < 1e-3 * np.abs(b).max()
    if preset == "field":
        places = [s.effects["multipass"]["place_x"] for s in (found, expected)]
        assert np.abs(places[0] - places[1]).max() <= 1e-5 * np.abs(places[1]).max()


def mapped(function, launch, *arrays):
    """A marked function of one rover, mapped over the last axis of arrays (..., wheel, rover)."""
    wheels = arrays[0].shape[-2]
    marked = batch_last(
        lambda *a: by_wheel(lambda: function(*a), wheels), (-1,) * len(arrays), launch and as_kernels(launch)
    )
    return jax.jit(marked)(*arrays)


def test_loops_sums_and_lists_that_move_give_what_arrays_give(tmp_path):
    launch = OnThisProcessor(tmp_path)
    random = np.random.default_rng(0)
    x, old = random.normal(size=(3, 40)).astype(np.float32), random.normal(size=(12, 3, 40)).astype(np.float32)

    def function(x, old):
        nodes = jnp.linspace(0.0, 1.0, 16)[:, None] * x
        total = jnp.sum(jnp.sin(nodes), axis=0)
        moved = jnp.where(x > 0.0, jnp.concatenate([x[None], old[:-1]]), old)
        # every wheel reads the places of all
        near = jnp.sum((old[:, :, None] - x[None, None, :]) ** 2, axis=(0, 1))
        return total + jnp.sum(nodes * jnp.exp(nodes) * total, axis=0), moved, near

    found, expected = mapped(function, launch, x, old), mapped(function, None, x, old)
    assert len(launch.kernels) == 1 and launch.kernels[0].kept == {1: 1}
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-6)


def test_derivatives_are_those_of_the_arrays(tmp_path):
    launch = OnThisProcessor(tmp_path)
    x = np.linspace(0.1, 2.0, 12, dtype=np.float32).reshape(3, 4)
    share = np.linspace(0.0, 1.0, 16, dtype=np.float32)

    def function(x):
        return jnp.sum(jnp.sin(share[:, None] * x), axis=0)

    assert np.asarray(mapped(function, launch, x)).shape == (3, 4) and len(launch.kernels) == 1
    slope = jax.grad(lambda x: jnp.sum(mapped(function, launch, x)))(x)
    np.testing.assert_allclose(slope, (share * np.cos(share * x[..., None])).sum(-1), rtol=1e-5)


def test_a_part_without_loops_stays_with_xla(tmp_path):
    launch = OnThisProcessor(tmp_path)
    x = np.linspace(0.1, 2.0, 12, dtype=np.float32).reshape(3, 4)
    np.testing.assert_allclose(mapped(jnp.sin, launch, x), np.sin(x), rtol=1e-6)
    assert not launch.kernels


@pytest.mark.parametrize(
    "function", [lambda x: x[::-1], lambda x: x + jnp.sum(x), jnp.sort], ids=["reverse", "sum", "sort"]
)
def test_what_does_not_treat_wheels_alike_stays_with_xla(function, tmp_path):
    launch = OnThisProcessor(tmp_path)
    x = np.arange(12.0, dtype=np.float32).reshape(3, 4)
    np.testing.assert_array_equal(mapped(function, launch, x), mapped(function, None, x))
    assert not launch.kernels


def test_numbers_are_exact_in_c():
    assert number(np.float32(0.1)) == f"({float(np.float32(0.1)).hex()}f)"
    assert number(np.bool_(True)) == "true"
    assert number(np.int32(-3)) == "(-3)"
