"""Run folders that were damaged: one sentence."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lunar_mjx.diagnosis.folder.stored import read_stored
from lunar_mjx.diagnosis.report.read import _traces
from lunar_mjx.errors import UserError

N, MODELS = 6, 2
GOOD = {
    "measured": np.arange(6.0),
    "sigma": np.ones(6),
    "time": np.arange(6.0),
    "place": np.zeros((0, 3)),
    "unit": np.zeros(6, int),
    "unit_names": np.array(["a"]),
    "split": np.array(["fit"]),
    "series_start": np.array([0, 3]),
    "series_channel": np.array(["x", "y"]),
    "series_log": np.array([0, 0]),
    "logs": np.array(["a"]),
    "labels": np.array(["as given", "refitted"]),
    "predicted": np.zeros((2, 6)),
    "residual": np.zeros((2, 6)),
}
BAD = {
    "predicted": np.zeros((2, 5)),
    "residual": np.zeros((1, 6)),
    "sigma": np.array(["x"] * 6),
    "unit": np.full(6, 7),
    "series_start": np.array([0, 9]),
    "time": np.zeros((6, 6)),
    "series_log": np.array(["x", "y"]),
    "measured": np.array(3.0),
    "series_channel": np.array(["x"]),
}


@pytest.mark.parametrize("name", BAD)
def test_series_that_do_not_go_together_are_refused(name, tmp_path):
    path = tmp_path / "series.npz"
    np.savez(path, **GOOD)
    assert _traces(path).predicted.shape == (2, 6)
    np.savez(path, **{**GOOD, name: BAD[name]})
    with pytest.raises(UserError, match=r"series\.npz: is damaged .*; make it anew"):
        _traces(path)


def test_a_torn_archive_is_refused(tmp_path):
    path = tmp_path / "series.npz"
    np.savez_compressed(path, **GOOD)
    whole = path.read_bytes()
    for cut in range(0, len(whole), 97):
        path.write_bytes(whole[:cut])
        with pytest.raises(UserError, match=r"series\.npz: is damaged"):
            _traces(path)
    path.write_text("text")
    with pytest.raises(UserError, match=r"damaged \(it is no archive of arrays\)"):  # and no advice to run a pickle
        _traces(path)
    path.write_bytes(whole.replace(b"measured", b"mxasured"))
    with pytest.raises(UserError, match=r"lacks 'measured'|is damaged"):
        _traces(path)


def test_damaged_refits_are_refused(tmp_path):
    path = tmp_path / "hypotheses.json"
    for text in ("{", "[]", '{"the model": {"u": {"soil.n": "x"}}}', '{"the model": 3}', "\x00"):
        path.write_text(text)
        with pytest.raises(UserError, match=r"hypotheses\.json: is damaged"):
            read_stored(path)


def test_damaged_settings_of_a_run_are_refused(tmp_path):
    path = tmp_path / "run.json"
    good = {"format": "lunar-mjx-run/1", "logs": [], "hashes": {}}
    for settings in (5, [1], "effect_odds"):
        path.write_text(json.dumps({**good, "settings": settings}))
        with pytest.raises(UserError, match=r"run\.json: is damaged \(settings: .*\); make it anew"):
            read_stored(path)


COMPARISON = {"as_given": {}, "refitted": {}, "by_channel": []}
VERDICT = {"verdict": "KNOWN", "sentence": "it is known", "effects": []}
EVIDENCE = {"effect": "slip", "status": "accepted", "separable_sigma": 3.0}
GOOD_RESULTS = {
    "comparison.json": {**COMPARISON, "parameters": {"soil": {"value": {"n": 1.0}, "std": {"n": None}}}},
    "verdict.json": {
        **VERDICT,
        "evidence": [EVIDENCE],
        "probabilities": {"nothing": 1.0},
        "discrepancy": {"force": {"text": "within 1 %", "size": 0.01, "low": 0.005, "high": 0.02}},
        "details": {"held_out": {"manoeuvres": 0}},
    },
}
BAD_RESULTS = [
    ("comparison.json", {"parameters": 5}),
    ("comparison.json", {"parameters": {"soil": 5}}),
    ("comparison.json", {"parameters": {"soil": {"value": 5}}}),
    ("comparison.json", {"channel_errors": 5}),
    ("comparison.json", {"error_times_s": {"yaw_deg": None}}),
    ("verdict.json", {"evidence": [{}]}),
    ("verdict.json", {"evidence": [{**EVIDENCE, "separable_sigma": "x"}]}),
    ("verdict.json", {"details": {"held_out": 5}}),
    ("verdict.json", {"details": {"parameters": 5}}),
    ("verdict.json", {"details": {"taken_back": [{"law": "stress_integral"}]}}),
    ("verdict.json", {"probabilities": 5}),
    ("verdict.json", {"probabilities": {"nothing": "x"}}),
    ("verdict.json", {"forms": 5}),
    ("verdict.json", {"discrepancy": {"force": {}}}),
]


@pytest.mark.parametrize(("name", "change"), BAD_RESULTS)
def test_results_of_another_shape_are_refused_before_a_page_is_made_of_them(name, change, tmp_path):
    path = tmp_path / name
    path.write_text(json.dumps(GOOD_RESULTS[name]))
    assert read_stored(path) == GOOD_RESULTS[name]
    path.write_text(json.dumps({**GOOD_RESULTS[name], **change}))
    with pytest.raises(UserError, match=rf"{name}: is damaged \({next(iter(change))}.*\); make it anew"):
        read_stored(path)


def test_a_key_that_stands_twice_is_damage(tmp_path):
    """Else the last one would win without a word."""
    path = tmp_path / "verdict.json"
    path.write_text('{"verdict": "KNOWN", "verdict": "NOISE_ONLY", "sentence": "x", "effects": []}')
    with pytest.raises(UserError, match="the key 'verdict' stands there twice"):
        read_stored(path)
