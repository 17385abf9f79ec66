"""A run folder of two or three channels and two manoeuvres, written without fitting anything."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from lunar_mjx.diagnosis.folder.refits import write_refits

HOSTILE = "</script><img src=x onerror='document.title=1'><b>"
POINTS = 24


def write_run(folder: Path, table: bool, hostile: str = "") -> Path:
    """A run of two manoeuvres, the second held out: an effect `drag` is refitted, `toe` is not.

    A table has two channels, a drive a third one. The last one bears the hostile text: positions would be none with it.
    """
    folder.mkdir()
    channels = (
        ["drawbar_pull_N", "sinkage_m"] if table else ["position_x_m", "position_y_m", "motor_lf_drive_current_A"]
    )
    n = 2 * POINTS * len(channels)
    rng = np.random.default_rng(0)
    unit = np.tile(np.repeat([0, 1], POINTS), len(channels))
    signal = 6.0 * np.sin(np.linspace(0, 9, n))
    residual = rng.standard_normal((3, n)) + np.array([[2.0], [1.0], [0.0]]) * signal
    time = np.tile(np.arange(POINTS) * 0.5, 2 * len(channels))
    np.savez_compressed(
        folder / "series.npz",
        measured=np.zeros(n),
        sigma=np.full(n, 0.1),
        time=np.full(n, np.nan) if table else time,
        place=np.column_stack([np.tile(np.linspace(0, 0.6, POINTS), 4), 15.0 * unit, np.full(n, 50.0)])
        if table
        else np.zeros((0, 3)),
        unit=unit,
        unit_names=np.array(["flat", "climb" + hostile]),
        split=np.array(["fit", "select"]),
        series_start=2 * POINTS * np.arange(len(channels)),
        series_channel=np.array([*channels[:-1], channels[-1] + hostile]),
        series_log=np.zeros(len(channels), int),
        logs=np.array(["a"]),
        labels=np.array(["as given", "refitted", "with drag"]),
        predicted=-0.1 * residual,
        residual=residual,
    )
    fitted = unit == 0
    np.savez_compressed(
        folder / "signatures.npz", names=np.array(["drag", "toe"]), signatures=np.array([signal[fitted], time[fitted]])
    )
    write_refits(folder, {("slip_sinkage",): (residual[1] - 0.5 * signal, None)})
    run = {"format": "lunar-mjx-run/1", "logs": ["gone" + hostile], "hashes": {}, "added": []}
    evidence = [
        {"effect": "drag", "status": "accepted", "separable_sigma": 40.0, "probability": 0.97},
        {
            "effect": "slip_sinkage",
            "status": "rejected",
            "separable_sigma": 30.0,
            "probability": 0.01,
            "nearest": ["drag", 0.95],
        },
        {"effect": "toe", "status": "confounded", "separable_sigma": 8.0, "probability": 0.02},
        {"effect": "faint" + hostile, "status": "not tested", "separable_sigma": 0.4, "probability": 0.0},
    ]
    verdict = {
        "verdict": "KNOWN",
        "sentence": "drag is missing" + hostile,
        "effects": ["drag"],
        "evidence": evidence,
        "probabilities": {"drag": 0.96, "drag + toe" + hostile: 0.02, "others": 0.02},
        "discrepancy": {"soil": {"size": 0.04, "low": 0.02, "high": 0.08, "text": "good to 4 %" + hostile}},
    }
    (folder / "run.json").write_text(json.dumps(run), encoding="utf-8")
    (folder / "verdict.json").write_text(json.dumps(verdict), encoding="utf-8")
    (folder / "next.json").write_text(json.dumps({"sentence": "Drive a slope" + hostile}), encoding="utf-8")
    return folder
