"""Logs recorded from the simulator: what is written, what is sealed, and that nothing leaks."""

from __future__ import annotations

import dataclasses
import datetime
import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, Recording, check, commands, log_model, read_log, simulate_log, unseal
from lunar_mjx.logs.recorder import simulate as module
from lunar_mjx.logs.recorder.instruments import RATES, parse_noise, record
from lunar_mjx.logs.seal import LABELS, Answer, answer_path, read_answer, read_verdict, score, write_answer
from lunar_mjx.manoeuvres import commands as manoeuvre_commands
from lunar_mjx.manoeuvres import load_manoeuvre
from lunar_mjx.model import make_model

SECONDS = 12.0
CLEAN = Recording(scale=0.0)


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """A short drive without noise, really simulated."""
    out = tmp_path_factory.mktemp("simulated") / "clean"
    log = read_log(simulate_log(out, "luvmi_x", "speed_staircase", seconds=SECONDS, seed=0, recording=CLEAN))
    assert isinstance(log, Log)
    return log


@pytest.fixture
def fast(clean: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same drive without simulating it again, whatever is hidden."""
    time = np.arange(0.0, SECONDS, 0.01)
    signals = {}
    for name in clean.channel_names:
        t, v = clean.channel(name)
        signals[name] = np.interp(time, t, v)
    monkeypatch.setattr(module, "_drive", lambda *_: (time, signals))


def test_a_simulated_log_is_what_its_model_commands_and_does(clean: Log) -> None:
    assert {n: t.rate_hz for n, t in clean.tables.items()} == RATES
    assert check(clean) == [] and clean.noise == {} and "bus_current_A" not in clean.channel_names
    base = make_model("luvmi_x", "flat")
    model = log_model(clean, base)
    plan = load_manoeuvre("speed_staircase")
    found, start = commands(clean, model)
    wanted = manoeuvre_commands(plan, model, SECONDS / plan.duration_s)
    assert start == 0.0 and found.interval == pytest.approx(wanted.interval)
    rows = min(len(found.values), len(wanted.values))
    assert rows >= len(wanted.values) - 1
    np.testing.assert_allclose(found.values[:rows], wanted.values[:rows], atol=1e-7)
    # what is moved: forward and back again by the same commands
    x = clean.channel("position_x_m")[1]
    assert x.max() > 0.2 and abs(x[-1]) < 0.5 * x.max()
    speed, angle = (clean.channel(f"joint_lf_drive_{q}")[1] for q in ("speed_rad_s", "angle_rad"))
    assert speed.max() == pytest.approx(2.0, rel=0.1), "0.2 m/s on wheels of 0.1 m"
    assert np.abs(np.cumsum(speed) * 0.05 - angle).max() < 0.2
    assert clean.channel("accelerometer_z_m_s2")[1].mean() == pytest.approx(1.625, abs=0.05)


def test_noise_is_as_stated(fast: None, clean: Log, tmp_path: Path) -> None:
    out = simulate_log(tmp_path / "a", "luvmi_x", effects=(), seconds=SECONDS, seed=3, recording=Recording(scale=5.0))
    log = read_log(out)
    assert check(log) == []
    for name in ("position_y_m", "gyro_y_rad_s", "winding_lf_drive_temperature_degC", "motor_lr_drive_current_A"):
        difference = log.channel(name)[1] - np.interp(log.channel(name)[0], *clean.channel(name))
        assert difference.std() == pytest.approx(log.noise[name].std, rel=0.5 if "winding" in name else 0.2), name
    assert log.noise["winding_lf_drive_temperature_degC"].std == 1.5


def test_coloured_quantised_and_lossy() -> None:
    time = np.arange(0.0, 400.0, 0.01)
    signals = {"winding_lf_drive_temperature_degC": np.zeros_like(time), "command_lf_drive_speed_rad_s": time}
    recording = Recording(coloured=True, quantise=True, dropouts=0.2)
    tables = record(time, signals, recording, np.random.default_rng(0))
    values = tables["thermal"]["winding_lf_drive_temperature_degC"].to_numpy()
    there = values[np.isfinite(values)]
    assert there.std() == pytest.approx(0.3, rel=0.25), "the whole noise has the stated size"
    assert np.corrcoef(there[1:], there[:-1])[0, 1] > 0.3, "and is coloured"
    np.testing.assert_allclose(there / 0.1, np.round(there / 0.1), atol=1e-9)
    lost = 1.0 - len(there) / 400.0
    assert 0.1 < lost < 0.3
    assert np.isfinite(tables["drive"]).all(axis=None), "commands are not measured, so they are not lost"


@pytest.mark.parametrize(("text", "factor"), [("datasheet", 1.0), ("none", 0.0), ("scale:5", 5.0)])
def test_parse_noise(text: str, factor: float) -> None:
    assert parse_noise(text) == factor


HIDDEN = [("com_offset", {"x": 0.123456}), ("rotor_stator_path", {"share": 0.7531})]


def sealed(folder: Path, name: str = "sealed", effects: object = HIDDEN, **settings: object) -> Path:
    return simulate_log(folder / name, "luvmi_x", effects=effects, seconds=SECONDS, seal=True, **settings)


def test_a_seal_opens_with_its_answer_only(fast: None, tmp_path: Path) -> None:
    log, other = sealed(tmp_path), sealed(tmp_path, "other", [])
    result = unseal(answer_path(log), log)
    assert result["hidden"] == ["com_offset"], "a changed parameter of the model's own is no hidden effect"
    assert [e["name"] for e in result["effects"]] == ["com_offset", "rotor_stator_path"]
    assert result["effects"][0]["parameters"]["x"] == 0.123456
    with pytest.raises(UserError, match="is not the answer that"):
        unseal(answer_path(other), log)
    text = answer_path(log).read_text()
    answer_path(log).write_text(text.replace("0.123456", "0.123457"))
    with pytest.raises(UserError, match="is not the answer that"):
        unseal(answer_path(log), log)
    answer_path(log).write_text(text)
    table = log / "thermal.csv"
    kept = table.read_text()
    table.write_text(kept.replace("25.", "26.", 1))
    with pytest.raises(UserError, match="tables were changed"):
        unseal(answer_path(log), log)
    table.write_text(kept)
    said = log / "log.toml"
    text = said.read_text()
    assert "gravity_m_s2 = 1.62" in text
    for old, new in (("gravity_m_s2 = 1.62", "gravity_m_s2 = 1.63"), ('rover = "luvmi_x"', 'rover = "viper"')):
        said.write_text(text.replace(old, new))
        with pytest.raises(UserError, match=r"log\.toml: was changed after the log was sealed; ask its sender"):
            unseal(answer_path(log), log)
    # written anew with the same content, such as by another editor
    said.write_text("# looked at\n" + text)
    assert unseal(answer_path(log), log)["sealed"]


def test_a_sealed_folder_tells_nothing(fast: None, tmp_path: Path) -> None:
    hidden, null = sealed(tmp_path, "a"), sealed(tmp_path, "b", [])
    assert sorted(p.name for p in hidden.iterdir()) == sorted(p.name for p in null.iterdir())
    with (hidden / "log.toml").open("rb") as a, (null / "log.toml").open("rb") as b:
        one, two = tomllib.load(a), tomllib.load(b)
    assert one.pop("commitment") != two.pop("commitment") and one == two, "only the commitment differs"
    for file in ("drive.csv", "imu.csv", "thermal.csv", "camera.csv"):
        header = [(f / file).read_text().splitlines()[0] for f in (hidden, null)]
        assert header[0] == header[1]
    everything = "".join(p.read_text() for p in hidden.iterdir())
    answer = read_answer(answer_path(hidden))
    for secret in ("com_offset", "0.123456", "0.7531", answer.nonce, str(answer.seed), "consistent"):
        # as a number of its own: digits of noise may hold any four by chance
        assert not re.search(rf"(?<![\d.]){re.escape(secret)}(?!\d)", everything)


def test_equal_answers_have_unlike_commitments_and_noise(fast: None, tmp_path: Path) -> None:
    a, b = sealed(tmp_path, "a", seed=5), sealed(tmp_path, "b", seed=5)
    commitments = [tomllib.loads((f / "log.toml").read_text())["commitment"] for f in (a, b)]
    assert commitments[0] != commitments[1], "a nonce keeps answers from being tried out"
    drives = [read_log(f).channel("position_x_m")[1] for f in (a, b)]
    assert np.abs(drives[0] - drives[1]).max() > 1e-3, "and a seed from being guessed and its noise taken off"


def test_an_unsealed_log_repeats_by_its_seed(fast: None, tmp_path: Path) -> None:
    for name in ("a", "b"):
        simulate_log(tmp_path / name, "luvmi_x", seconds=SECONDS, seed=7)
    assert (tmp_path / "a" / "drive.csv").read_bytes() == (tmp_path / "b" / "drive.csv").read_bytes()
    assert "commitment" not in (tmp_path / "a" / "log.toml").read_text()


SCORES = [
    (["com_offset"], "KNOWN", ["com_offset"], "right"),
    (["com_offset"], "KNOWN", ["payload"], "wrong"),
    (["com_offset"], "KNOWN_CLASS", ["com_offset", "gravity_error"], "class"),
    (["com_offset"], "KNOWN_CLASS", ["payload", "gravity_error"], "wrong"),
    (["com_offset"], "NOISE_ONLY", [], "missed"),
    (["com_offset"], "UNKNOWN", [], "missed"),
    (["mine"], "UNKNOWN", [], "right"),
    (["mine"], "KNOWN", ["com_offset"], "wrong"),
    (["com_offset", "steering_toe"], "MULTIPLE", ["steering_toe", "com_offset"], "right"),
    (["com_offset", "steering_toe"], "MULTIPLE", ["steering_toe"], "wrong"),
    ([], "NOISE_ONLY", [], "right"),
    ([], "KNOWN", ["com_offset"], "false alarm"),
    ([], "UNKNOWN", [], "false alarm"),
    ([], "BAD_DATA", [], "wrong"),
]


@pytest.mark.parametrize(("hidden", "label", "named", "wanted"), SCORES)
def test_scores(hidden: list[str], label: str, named: list[str], wanted: str, fast: None, tmp_path: Path) -> None:
    log = sealed(tmp_path, effects=[])
    answer = read_answer(answer_path(log))
    entries = [{"name": n, "added": True, "parameters": {}} for n in hidden]
    from dataclasses import replace

    assert score(replace(answer, effects=entries), label, named) == wanted


def test_a_verdict_is_compared(fast: None, tmp_path: Path) -> None:
    log = sealed(tmp_path, effects=[("com_offset", {"x": 0.05})])
    run = tmp_path / "run"
    run.mkdir()
    (run / "verdict.json").write_text(json.dumps({"verdict": "KNOWN", "effects": ["com_offset"]}))
    assert unseal(answer_path(log), log, run)["score"] == "right"
    (run / "verdict.json").write_text("[]")
    with pytest.raises(UserError, match="verdict"):
        unseal(answer_path(log), log, run)


@pytest.mark.parametrize(
    "text",
    [
        '{"verdict": "KNOWN_CLASS", "effects": "com_offset"}',
        '{"verdict": 5, "effects": []}',
        '{"verdict": "KNOWN", "effects": {"com_offset": 1}}',
        '{"verdict": "KNOWN", "effects": [1]}',
        '{"effects": []}',
        "[" * 100_000,
    ],
)
def test_a_verdict_of_another_kind_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "verdict.json").write_text(text)
    with pytest.raises(UserError, match=r'verdict\.json: is no verdict \(.+\); give a JSON file with "verdict"'):
        read_verdict(tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"verdict": "BANANA", "effects": []}', "verdict = 'BANANA' is no verdict; give one of NOISE_ONLY"),
        ('{"verdict": "", "effects": []}', "verdict = '' is no verdict"),
        ('{"verdict": "KNOWN", "effects": []}', "KNOWN names some"),
        ('{"verdict": "KNOWN", "verdict": "NOISE_ONLY", "effects": []}', "the key 'verdict' stands there twice"),
        ("", "Expecting value"),
    ],
)
def test_a_verdict_that_says_nothing_is_not_scored(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "verdict.json").write_text(text)
    with pytest.raises(UserError, match=said):
        read_verdict(tmp_path)


def test_a_verdict_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "verdict.json").write_text('{"verdict": "NOISE_ONLY"}', encoding="utf-8-sig")
    assert read_verdict(tmp_path) == ("NOISE_ONLY", [])


def test_every_verdict_can_be_scored() -> None:
    naming = {Verdict.KNOWN, Verdict.KNOWN_CLASS, Verdict.MULTIPLE}
    assert {v.label: v in naming for v in Verdict} == LABELS


ANSWER = Answer("a", "0" * 64, 3, "consistent", "slope", 1.0, [], {"dropouts": 0.0}, "0" * 64, "0" * 64)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("effects", 5, "effects = 5 is not what an answer holds there"),
        ("effects", "com_offset", "effects = 'com_offset' is not"),
        ("effects", [{}], "effects.0.name = {} is not"),
        ("effects", [{"name": "x", "added": "yes", "parameters": {}}], "effects.0.added = 'yes' is not"),
        ("seed", "3", "seed = '3' is not"),
        ("scale", "long", "scale = 'long' is not"),
        ("recording", 5, "recording = 5 is not"),
        ("recording", {"day": datetime.date(2027, 1, 1)}, "not JSON serializable"),
    ],
)
def test_an_answer_of_another_kind_is_refused(field: str, value: object, said: str, tmp_path: Path) -> None:
    path = tmp_path / "a.answer.toml"
    write_answer(ANSWER, path)
    assert read_answer(path) == ANSWER
    write_answer(dataclasses.replace(ANSWER, **{field: value}), path)
    with pytest.raises(UserError, match=re.escape(said)) as caught:
        read_answer(path)
    assert str(caught.value).startswith(f"{path}: ") and "; give the answer as" in str(caught.value)


def test_answers_come_back(fast: None, tmp_path: Path) -> None:
    log = sealed(tmp_path, recording=Recording(bias={"gyro_z_rad_s": 0.01}, dropouts=0.02))
    answer = read_answer(answer_path(log))
    write_answer(answer, tmp_path / "again.toml")
    again = read_answer(tmp_path / "again.toml")
    assert again == answer and again.commitment() == answer.commitment()
    assert unseal(tmp_path / "again.toml", log)["hidden"] == ["com_offset"]


REFUSED = {
    "manoeuvre": ({"manoeuvre": "moonwalk"}, ["moonwalk", "speed_staircase"]),
    "effect": ({"effects": ["no_such_effect"]}, ["no_such_effect"]),
    "effect in the model": ({"effects": ["motor"]}, ["motor", "in the model already"]),
    "parameter": ({"effects": [("com_offset", {"w": 1.0})]}, ["com_offset.w", "unknown"]),
    "seconds": ({"seconds": -1.0}, ["scale", "positive"]),
    "bias": ({"recording": Recording(bias={"gyro_q": 1.0})}, ["gyro_q", "is no channel"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case: str, fast: None, tmp_path: Path) -> None:
    settings, words = REFUSED[case]
    with pytest.raises(UserError) as caught:
        simulate_log(tmp_path / "a", "luvmi_x", **{"seconds": SECONDS, **settings})
    for word in words:
        assert word in str(caught.value), str(caught.value)


def test_nothing_is_overwritten(fast: None, tmp_path: Path) -> None:
    simulate_log(tmp_path / "a", "luvmi_x", seconds=SECONDS)
    with pytest.raises(UserError, match="exists already"):
        simulate_log(tmp_path / "a", "luvmi_x", seconds=SECONDS)


@pytest.mark.parametrize("settings", [{"scale": -1.0}, {"dropouts": 0.9}, {"scale": float("nan")}])
def test_refused_recordings(settings: dict[str, float]) -> None:
    with pytest.raises(UserError):
        Recording(**settings)
