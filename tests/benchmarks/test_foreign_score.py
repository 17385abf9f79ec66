"""Scores of the foreign worlds say what an answer is worth."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.foreign import score

TRUTH = {
    "case": "tune-000",
    "kind": "table",
    "group": "single",
    "hidden": ["grousers"],
    "ports": ["wheel_shear"],
    "holds": ["exit_angle"],
    "law": "integral",
    "separable": {"grousers": {"sigma": 20.0, "sigma_blind": 9.0}},
}
NULL = {**TRUTH, "group": "null", "hidden": [], "ports": [], "separable": {}}
OUTSIDE = {
    **TRUTH,
    "group": "outside",
    "hidden": ["peak_shear"],
    "separable": {"peak_shear": {"sigma": 9.0, "sigma_blind": 4.0}},
}


def ask(truth, verdict, effects=(), port=None, **more):
    answer = {"verdict": verdict, "effects": list(effects)}
    return score.judge(truth, score.said(answer, {**answer, "port": port, **more}))


@pytest.mark.parametrize(
    ("verdict", "effects", "found", "wrong"),
    [
        ("KNOWN", ["grousers"], True, False),
        ("KNOWN", ["bulldozing"], False, True),
        ("KNOWN", ["exit_angle"], False, False),
        ("KNOWN_CLASS", ["grousers", "bulldozing"], True, False),
        ("KNOWN_CLASS", ["grousers", "bulldozing", "side_wall", "side_entry"], False, False),
        ("KNOWN_CLASS", ["bulldozing", "side_wall"], False, True),
        ("KNOWN_CLASS", ["bulldozing", "unlisted at wheel_shear"], False, False),
        ("MULTIPLE", ["grousers", "exit_angle"], True, False),
        ("MULTIPLE", ["grousers", "bulldozing"], False, True),
        ("UNKNOWN", ["bulldozing"], False, False),
        ("NOISE_ONLY", [], False, False),
        ("BAD_FIT", [], False, False),
    ],
)
def test_a_single_effect(verdict, effects, found, wrong) -> None:
    row = ask(TRUTH, verdict, effects)
    assert (row["found"], row["wrong_name"]) == (found, wrong)


def test_a_null_is_wronged_by_any_name_that_its_law_does_not_earn() -> None:
    assert ask(NULL, "KNOWN", ["grousers"])["wrong_name"]
    assert not ask(NULL, "KNOWN", ["exit_angle"])["wrong_name"]
    assert ask(NULL, "KNOWN", ["exit_angle"])["wrong_strict"]
    assert not ask(NULL, "KNOWN", ["channel_scale"])["wrong_name"]
    assert not ask(NULL, "UNKNOWN", ["grousers"])["wrong_name"]


def test_calibration_is_neutral_but_of_the_wheel_and_names_what_is_hidden() -> None:
    assert not ask(NULL, "KNOWN", ["calibration: load"])["wrong_name"]
    assert ask(NULL, "KNOWN", ["calibration: wheel radius"])["wrong_name"]
    scale = {**TRUTH, "hidden": ["channel_scale"], "ports": ["sensor"]}
    assert ask(scale, "KNOWN", ["calibration: driving_torque_Nm"])["found"]
    assert ask({**TRUTH, "hidden": ["wheel_radius_error"]}, "KNOWN", ["calibration: wheel radius"])["found"]


def test_outside_needs_the_port_or_a_class_with_unlisted() -> None:
    assert ask(OUTSIDE, "UNKNOWN", port="wheel_shear")["outside_right"]
    assert not ask(OUTSIDE, "UNKNOWN", port="geometry")["outside_right"]
    assert ask(OUTSIDE, "KNOWN_CLASS", ["grousers"], port="wheel_shear")["outside_right"]
    assert not ask(OUTSIDE, "KNOWN_CLASS", ["grousers", "bulldozing"], port="wheel_shear")["outside_right"]
    assert ask(OUTSIDE, "KNOWN", ["grousers"])["wrong_name"]
    assert ask(OUTSIDE, "KNOWN", ["exit_angle"], port="wheel_shear", unlisted=True)["outside_right"]
    assert not ask(OUTSIDE, "KNOWN", ["exit_angle"], unlisted=False)["outside_right"]
    assert not ask(OUTSIDE, "KNOWN_CLASS", ["grousers"], port="wheel_shear", unlisted=False)["outside_right"]


def test_something_unlisted_at_the_port_of_the_hidden_effect_is_told_apart() -> None:
    assert ask(TRUTH, "UNKNOWN", ["bulldozing"], port="wheel_shear")["at_port"]
    assert ask(TRUTH, "KNOWN", ["exit_angle"], port="wheel_shear: lateral force", unlisted=True)["at_port"]
    assert not ask(TRUTH, "KNOWN", ["bulldozing"], port="wheel_shear", unlisted=True)["at_port"]
    assert not ask(TRUTH, "UNKNOWN", port="soil")["at_port"]


def test_wilson_and_reliability() -> None:
    low, high = score.wilson(0, 10)
    assert low == 0.0 and high == pytest.approx(0.2775, abs=1e-3)
    pairs = [(0.9, True)] * 9 + [(0.9, False)] + [(0.05, False)] * 20
    table = score.reliability(pairs)
    assert table["brier"] == pytest.approx((9 * 0.01 + 0.81 + 20 * 0.0025) / 30, abs=1e-5)
    assert [t["frequency"] for t in table["tenths"]] == [0.0, 0.9]


@pytest.mark.parametrize(
    "shape",
    [
        {"grousers": 0.7, "grousers + unlisted at soil": 0.2},
        [
            {"effects": ["grousers"], "probability": 0.7},
            {"hypothesis": "grousers + unlisted at soil", "probability": 0.2},
        ],
        {"grousers": {"probability": 0.7}, "grousers + unlisted at soil": {"p": 0.2}},
    ],
)
def test_probabilities_are_read_in_any_shape(shape) -> None:
    found = score.said({"verdict": "KNOWN", "effects": ["grousers"]}, {"probabilities": shape, "inclusion": None})
    assert found["probabilities"] == {"grousers": 0.7, "grousers + unlisted at soil": 0.2}
    assert found["inclusion"] == {}
    assert score.names_of("grousers + unlisted at soil") == {"grousers", "unlisted at soil"}


def test_a_folder_is_scored_with_whatever_is_missing(tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    (tmp_path / "campaign.json").write_text(json.dumps({"set": "tune", "seed": "1"}), encoding="utf-8")
    for name, truth in (("tune-000", TRUTH), ("tune-001", NULL), ("tune-002", OUTSIDE), ("tune-003", NULL)):
        twins = [f"{name}-loud"] if name == "tune-000" else []
        (tmp_path / "truth" / f"{name}.json").write_text(
            json.dumps({**truth, "case": name, "twins": twins}), encoding="utf-8"
        )
    for name, verdict, effects in (
        ("tune-000", "KNOWN", ["grousers"]),
        ("tune-000-loud", "UNKNOWN", []),
        ("tune-001", "TIME_OUT", []),
        ("tune-002", "KNOWN", ["grousers"]),
    ):
        out = tmp_path / "runs" / name
        (out / "run").mkdir(parents=True)
        row = {"verdict": verdict, "effects": effects, "seconds": {"all": 2.0}, "commit": "abc"}
        (out / "result.json").write_text(json.dumps(row), encoding="utf-8")
        if verdict == "KNOWN":
            full = row | {"port": None, "inclusion": {"grousers": 0.97, "bulldozing": 0.01}}
            (out / "run" / "verdict.json").write_text(json.dumps(full), encoding="utf-8")
    found = score.report(tmp_path)
    assert (found["cases_made"], found["cases_answered"]) == (4, 3)
    assert found["separable_singles_found"]["hits"] == 1
    assert found["verdict_changes_with_stated_noise"] == {"hits": 1, "of": 1, "interval": [0.2065, 1.0]}
    assert found["crash_or_time_out"]["hits"] == 1
    assert found["wrong_name_outside"]["hits"] == 1
    assert found["reliability_of_inclusion"]["number"] == 4
    json.dumps(found, allow_nan=False)
    assert "3 of 4 cases" in score.text(found)


def test_what_acts_beside_a_neutral_name_counts_as_a_class() -> None:
    assert ask(TRUTH, "KNOWN", ["exit_angle"], further=["grousers", "bulldozing"])["found"]
    assert not ask(TRUTH, "KNOWN", ["exit_angle"], further=["side_wall", "bulldozing"])["found"]
    assert ask(TRUTH, "KNOWN", ["exit_angle"], further=["side_wall", "bulldozing"])["wrong_name"]
    assert not ask(TRUTH, "KNOWN", ["exit_angle"], further=["side_wall"], unlisted=True)["wrong_name"]
    assert not ask(TRUTH, "KNOWN", ["bulldozing"], further=["grousers"])["found"]


def test_two_ports_are_told_where_something_unlisted_is_probable_at_each():
    row = {
        "truth": {"hidden": ["soft_tyre", "hard_layer"]},
        "inclusion": {
            "unlisted at geometry: radius": 0.3,
            "unlisted at geometry: radius with load": 0.4,
            "grousers": 0.9,
        },
    }
    assert score.ports_told(row) == [True, False]
    row["inclusion"]["unlisted at soil: stiffness"] = 0.8
    assert score.ports_told(row) == [True, True]
