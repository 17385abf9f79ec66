"""`lunar-mjx parity` at the command line, with a fast engine in place of the compiled ones."""

from __future__ import annotations

import pytest
from backends_faults import FAULTS

from lunar_mjx.backends.parity import compare as parity
from lunar_mjx.backends.parity import study as parity_study


@pytest.mark.parametrize("fault", [None, "wheel radius"])
def test_writes_a_page_and_tells_by_its_status(run, tmp_path, monkeypatch, fault):
    hooks = [FAULTS[fault][0]] if fault else []
    monkeypatch.setattr(parity_study, "make_runner", lambda engine, model: parity.native_runner(model, hooks, engine))
    real = parity_study.cases
    monkeypatch.setattr(parity_study, "cases", lambda rover: real(rover, ("flat, soft",)))
    result = run(
        "parity",
        "--out",
        tmp_path,
        "--engines",
        "structured",
        "--preset",
        "consistent",
        "--duration",
        "1",
        "--samples",
        "4",
    )
    assert result.status == (1 if fault else 0)
    assert ("first in the stage slip" if fault else "agree in all 28 checks") in result.out
    assert (tmp_path / "parity.html").is_file() and (tmp_path / "parity.json").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--engines", "ode"), "parity: engine = 'ode' does not exist; use some of structured"),
        (("--samples", "0"), "--samples = 0 is outside [1, 1000]; give about 16"),
        (("--duration", "nan"), "--duration = nan is not finite"),
        (("--preset", "moon"), "preset = 'moon' does not exist"),
    ],
)
def test_mistakes_are_one_sentence(run, tmp_path, arguments, message):
    result = run("parity", "--out", tmp_path / "new", *arguments)
    assert result.status == 2 and message in result.err
    assert not (tmp_path / "new").exists()
