"""A run folder of two or three channels and two manoeuvres, written without fitting anything."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from lunar_mjx.diagnosis.folder.refits import write_refits

HOSTILE = "</script><img src=x onerror='document.title=1'><b>"
POINTS = 24


def complete(folder: Path) -> Path:
    """The run with the other files that a comparison writes, as far as a report asks for them."""
    (folder / "comparison.json").write_text('{"as_given": {}, "refitted": {}, "by_channel": []}', encoding="utf-8")
    (folder / "model.toml").write_text("", encoding="utf-8")
    return folder


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


CORNERS = ("lf", "rf", "lr", "rr")
MANY = [
    *(
        f"{q}_{x}_{u}"
        for q, u in (("position", "m"), ("world_velocity", "m_s"), ("body_velocity", "m_s"))
        for x in "xyz"
    ),
    *(f"{q}_{x}_{u}" for q, u in (("gyro", "rad_s"), ("accelerometer", "m_s2")) for x in "xyz"),
    *(f"quaternion_{q}" for q in "wxyz"),
    *(
        q.format(c=c, j=j)
        for q in (
            "joint_{c}_{j}_angle_rad",
            "joint_{c}_{j}_speed_rad_s",
            "motor_{c}_{j}_current_A",
            "motor_{c}_{j}_torque_Nm",
            "winding_{c}_{j}_temperature_degC",
        )
        for j in ("drive", "steer", "sus")
        for c in CORNERS
    ),
    *(
        q.format(c=c)
        for q in ("wheel_{c}_sinkage_m", "wheel_{c}_slip_ratio", "wheel_{c}_slip_angle_deg")
        for c in CORNERS
    ),
    *("bus_voltage_V", "bus_load_W", "battery_charge_ratio", "chassis_temperature_degC"),
]
"""Channels as a rover with four steered wheels on suspension arms logs them: 95."""
DRIVES = ("flat_straight", "flat_arc", "crab", "point_turn", "climb_10_deg", "climb_15_deg", "descent", "rock_field")
REFITS = (
    "toe",
    "motor_friction",
    "slip_sinkage",
    "thermal_drag",
    "wheel_radius",
    "cable_torque",
    "gyro_bias",
    "caster",
)


def write_many(folder: Path, samples: int) -> Path:
    """A run of 95 channels in eight drives of so many samples, the last two held out, with eight effects refitted.

    Errors are the largest in motors of the drive and in sinkages, on both climbs; one reading of `gyro_x_rad_s` in the
    fourth drive is off by 80 sigma.
    """
    folder.mkdir()
    rng = np.random.default_rng(0)
    names = [c for _ in DRIVES for c in MANY]
    # Temperatures and the bus are read ten times less often.
    counts = [max(samples // 10, 4) if "temperature" in c or c.startswith("b") else samples for c in names]
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    log = np.repeat(np.arange(len(DRIVES)), len(MANY))
    measured, shape, time = [], [], []
    for c, m, d in zip(names, counts, log, strict=True):
        t = np.linspace(0.0, 60.0, m)
        time.append(t)
        phase = 0.3 * MANY.index(c) + d
        measured.append(np.sin(0.2 * t + phase) + 0.3 * np.sin(1.7 * t + phase) + 0.01 * rng.standard_normal(m))
        size = 8.0 * (c.startswith("motor") and "drive" in c) + 4.0 * ("sinkage" in c) + 0.5
        shape.append(size * (1.0 + 2.0 * (d in (4, 5))) * np.sin(0.5 * t + phase))
    value, signal, unit = np.concatenate(measured), np.concatenate(shape), np.repeat(log, counts)
    noise = rng.standard_normal(len(value))
    spiked = start[3 * len(MANY) + MANY.index("gyro_x_rad_s")] + samples // 3
    noise[spiked] = 80.0
    left = np.array([2.0, 1.0, 0.1, *np.linspace(0.5, 0.95, len(REFITS))])
    residual = noise + left[:, None] * signal
    split = np.array(["fit"] * 6 + ["select", "test"])
    np.savez(
        folder / "series.npz",
        measured=value,
        sigma=np.full(len(value), 0.01),
        time=np.concatenate(time),
        place=np.zeros((0, 3)),
        unit=unit,
        unit_names=np.array(DRIVES),
        split=split,
        series_start=start,
        series_channel=np.array(names),
        series_log=log,
        logs=np.array(DRIVES),
        labels=np.array(["as given", "refitted", "with drag"]),
        predicted=value - 0.01 * residual[:3],
        residual=residual[:3],
    )
    write_refits(folder, {(e,): (r, value - 0.01 * r) for e, r in zip(REFITS, residual[3:], strict=True)})
    (folder / "run.json").write_text(
        json.dumps({"format": "lunar-mjx-run/1", "logs": [*DRIVES], "hashes": {}, "added": []}), encoding="utf-8"
    )
    evidence = [{"effect": "drag", "status": "accepted", "separable_sigma": 40.0, "probability": 0.93}]
    evidence += [{"effect": e, "status": "rejected", "separable_sigma": 9.0, "probability": 0.01} for e in REFITS]
    verdict = {
        "verdict": "KNOWN",
        "sentence": "drag is missing",
        "effects": ["drag"],
        "evidence": evidence,
        "probabilities": {"drag": 0.93, "others": 0.07},
    }
    (folder / "verdict.json").write_text(json.dumps(verdict), encoding="utf-8")
    return folder
