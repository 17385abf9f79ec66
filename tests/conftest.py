"""The command as a fixture, and how tests compile."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from chromium import ABSENT, CHROMIUM, Browser
from hypothesis import settings

from lunar_mjx import cli
from lunar_mjx.cameras.gl import BACKENDS, context_class
from lunar_mjx.errors import UserError
from tests.cli_harness import Result, Run
from tests.memory import give_back

FAST_COMPILE = os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS", "0").lower() in ("1", "true", "yes", "on")
EMITTERS = "--xla_cpu_use_fusion_emitters=false"
if FAST_COMPILE and jax.__version_info__ < (0, 11) and EMITTERS not in os.environ.get("XLA_FLAGS", ""):
    # Before the first program is compiled. JAX 0.11 does not know this option, and would end the process.
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {EMITTERS}".strip()

# A busy machine is no error, and the examples are the same in every run.
settings.register_profile("any machine", deadline=None, derandomize=True)
settings.load_profile("any machine")


LONGEST = (
    "test_drive_form.py",
    "test_hidden_subset.py",
    "test_effect_contract.py",
    "test_windows.py",
    "test_verbs_table.py",
    "test_dust_in_jax.py",
    "test_drive.py",
    "test_bus_current.py",
    "test_pybullet.py",
)
"""Files of twenty seconds of the processor or more. They go first, or one of two processes would wait for the other at
the end."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first; all else stays in its random order."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


def pytest_collection_finish() -> None:
    """Modules and tests stay to the end, and no search for garbage goes through them again."""
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """`make test` compiles with few optimisations, which takes half the time; tests marked `optimised` do not."""
    jax.config.update("jax_disable_most_optimizations", FAST_COMPILE and not item.get_closest_marker("optimised"))


@pytest.fixture(scope="module", autouse=True)
def memory() -> Iterator[None]:
    """Gives memory back between files."""
    yield
    give_back()


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Runs the command in this process, on a wide terminal without colours."""
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.setenv("NO_COLOR", "1")

    def call(*arguments: object) -> Result:
        monkeypatch.setattr(sys, "argv", ["lunar-mjx", *map(str, arguments)])
        capfd.readouterr()
        status = 0
        try:
            cli.main()
        except SystemExit as error:
            status = error.code if isinstance(error.code, int) else int(error.code is not None)
        out, err = capfd.readouterr()
        return Result(status, out, err)

    return call


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    """A page of a real browser; skips where there is none."""
    if CHROMIUM is None:
        pytest.skip(ABSENT)
    opened = Browser(tmp_path / "profile")
    yield opened
    opened.close()


@pytest.fixture
def opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets cameras use OpenGL, which the tests' settings turn off."""
    try:
        context_class(BACKENDS)
    except UserError as missing:
        pytest.skip(str(missing))
    monkeypatch.delenv("MUJOCO_GL", raising=False)
