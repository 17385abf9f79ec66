"""Drives read back from their folders."""

from __future__ import annotations

import dataclasses
import shutil

import numpy as np
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.visual.recorded import read_drive
from lunar_mjx.visual.video import frame_rows


@pytest.mark.parametrize("name", ["viper", "luvmi"])
def test_coordinates_come_back_with_closed_loops(name, request):
    """VIPER's four-bars: the log has the actuated angles only, and MuJoCo's soft pins open by micrometres."""
    folder, qpos = request.getfixturevalue(name)
    drive = read_drive(folder)
    assert drive.qpos.shape == qpos.shape
    tolerance = 2e-4 if drive.model.rover.loops else 1e-7
    np.testing.assert_allclose(drive.qpos[:, :7], qpos[:, :7], atol=1e-7)
    np.testing.assert_allclose(drive.qpos, qpos, atol=tolerance)
    if drive.model.rover.loops:
        assert np.abs(qpos[:, 7:]).max() > 0.01  # something to close


def test_channels_and_what_follows_from_them(luvmi):
    drive = read_drive(luvmi[0])
    assert drive.corners == ["lf", "rf", "lr", "rr"]
    assert drive.power.shape == drive.speed.shape == drive.time.shape
    # joule heat and motion: power is not zero, and not that of a car
    assert 0.1 < drive.power[-1] < 500.0
    assert drive.per_wheel("wheel_{}_slip_ratio").shape == (len(drive.time), 4)
    # 5 deg uphill along x; heading north, the ground falls to the left
    assert drive.slope[0] == pytest.approx([5.0, 0.0], abs=0.01)
    north = dataclasses.replace(drive, table=drive.table.assign(yaw_deg=90.0))
    assert north.slope[0] == pytest.approx([0.0, -5.0], abs=0.01)


def test_tracks_follow_the_wheels(luvmi):
    drive = read_drive(luvmi[0])
    tracks = drive.tracks()
    assert [len(t.places) for t in tracks] == [len(drive.time)] * 4
    left, right = tracks[0].places, tracks[1].places
    assert np.linalg.norm(left - right, axis=1) == pytest.approx(np.linalg.norm(left[0] - right[0]), abs=5e-3)
    assert (np.diff(tracks[2].places[5:, 0]) > 0).all()


def test_mistakes_are_one_sentence(luvmi, tmp_path):
    with pytest.raises(UserError, match="is not a folder; give the folder that lunar-mjx simulate wrote"):
        read_drive(tmp_path / "nowhere")
    with pytest.raises(UserError, match=r"holds no drive\.csv"):
        read_drive(tmp_path)
    (tmp_path / "model.toml").write_text((luvmi[0] / "model.toml").read_text())
    rows = (luvmi[0] / "drive.csv").read_text().splitlines()
    (tmp_path / "drive.csv").write_text("\n".join([rows[0], rows[2], rows[1]]))
    with pytest.raises(UserError, match="do not rise, or hold a gap"):
        read_drive(tmp_path)
    header = rows[0].replace("wheel_lf_slip_ratio", "wheel_lf_slide")
    (tmp_path / "drive.csv").write_text("\n".join([header, *rows[1:]]))
    with pytest.raises(UserError, match="lack wheel_lf_slip_ratio; write the drive anew"):
        read_drive(tmp_path).per_wheel("wheel_{}_slip_ratio")


def test_a_table_of_text_is_one_sentence(luvmi, tmp_path):
    drive = tmp_path / "drive"
    shutil.copytree(luvmi[0], drive)
    lines = (drive / "drive.csv").read_text().splitlines()
    lines[2] = lines[2].replace("0.", "x.", 3)
    (drive / "drive.csv").write_text("\n".join(lines))
    with pytest.raises(UserError, match=r"drive\.csv: holds what is no number \(.*x\..*\); write it anew"):
        read_drive(drive).tracks()


def test_a_video_of_endless_pictures_is_refused(luvmi):
    drive = read_drive(luvmi[0])
    with pytest.raises(UserError, match=r"speed = 1e-09 makes .* pictures"):
        frame_rows(drive, 20, 1e-9)
    assert len(frame_rows(drive, 20, 0.5)[0]) > 10
