"""`lunar-mjx bed`: what it refuses, and the table of runs that are already there."""

from __future__ import annotations

import importlib.util
import json

import pytest

from lunar_mjx.logs import read_log
from lunar_mjx.wheel_bed.particles import campaign
from lunar_mjx.wheel_bed.particles.settings import Numerics, ParticleWheel, Sand
from tests.wheel_bed.particles.fakes import fake_result

HERE = all(importlib.util.find_spec(name) for name in ("newton", "warp"))
WHEEL = ("--radius", 0.1, "--width", 0.1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--soil", "mud"), "--soil = 'mud' does not exist"),
        ((), "no wheel is named"),
        (WHEEL, "no points are named"),
        ((*WHEEL, "--slips", "0.1", "--loads", "10,x"), "--loads = 'x' is not a number"),
        ((*WHEEL, "--slips", "0.99", "--loads", "10"), "--slips = 0.99 has no steady state"),
        ((*WHEEL, "--slips", "0.1", "--loads", "10", "--gravity", "mars"), "--gravity = 'mars'"),
        ((*WHEEL, "--slips", "0.1", "--loads", "10", "--voxel", "0.05"), "too coarse"),
        (("--like", "cmu_smooth_wheel", "--slips", "0.1"), "--like brings its own points"),
        (("--like", "cmu_smooth_wheel", "--slip-angles", "7"), "are not in the table"),
        (("--like", "nowhere"), "does not ship"),
    ],
)
def test_mistakes(run, tmp_path, options, words):
    result = run("bed", "simulate", tmp_path / "out", "--controls", 0, *options)
    assert result.status == 2 and words in result.err
    assert result.err.count("\n") == 1 and not (tmp_path / "out").exists()


@pytest.mark.skipif(HERE, reason="the extra `particles` is installed")
def test_without_the_extra(run, tmp_path):
    result = run("bed", "simulate", tmp_path / "out", *WHEEL, "--slips", 0.1, "--loads", 10)
    assert result.status == 2 and "pip install 'lunar-mjx[particles]'" in result.err
    assert result.err.count("\n") == 1 and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--manoeuvre", "waltz"), "name = 'waltz' is neither canned nor a TOML file"),
        (("--terrain", "slope:95deg"), "is not a slope below 90 degrees"),
        (("--voxel", "0.03"), "--voxel = 0.03 is too coarse"),
        (("--gravity", "mars"), "--gravity = 'mars'"),
        (("--duration", "0"), "--duration = 0"),
        (("--friction-angle", "80"), "friction_angle = 80"),
        (("--contact", "Q9"), "contact = 'Q9' does not exist"),
        (("--device", "tpu"), "--device = 'tpu' does not exist"),
    ],
)
def test_mistakes_of_a_drive(run, tmp_path, options, words):
    result = run("bed", "drive", tmp_path / "out", *options)
    assert result.status == 2 and words in result.err
    assert result.err.count("\n") == 1 and not (tmp_path / "out").exists()


@pytest.mark.skipif(HERE, reason="the extra `particles` is installed")
def test_a_drive_without_the_extra(run, tmp_path):
    result = run("bed", "drive", tmp_path / "out", "--duration", 1)
    assert result.status == 2 and "pip install 'lunar-mjx[particles]'" in result.err
    assert result.err.count("\n") == 1 and not (tmp_path / "out").exists()


def test_runs_that_are_there_become_a_table(run, tmp_path):
    """The table of a GPU elsewhere is written without the extra, and stands on the command's own options."""
    from lunar_mjx.commands.bed import _points

    points = _points(None, "0.1,0.3", "0,20", "50", 1.0)
    runs = campaign.plan(ParticleWheel(0.1, 0.1), Sand(), 1.625, points, Numerics(0.0125), controls=1)
    lines = [json.dumps(fake_result(r, drawbar_pull=5.0 + r.point.slip_ratio)) for r in runs]
    (tmp_path / campaign.RUNS_FILE).write_text("\n".join(lines) + "\n")
    options = ("--slips", "0.1,0.3", "--slip-angles", "0,20", "--loads", 50, "--gravity", "moon", "--controls", 1)
    result = run("bed", "simulate", tmp_path, *WHEEL, *options)
    assert result.status == 0, result.err
    assert "4 of 4 points (4 usable) and 4 control runs" in result.out
    assert len(read_log(tmp_path / "table").table) == 4
