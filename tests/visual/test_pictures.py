"""Plots and videos of drives, looked at by numbers."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from lunar_mjx.cameras import Sun
from lunar_mjx.cameras.relief import relief
from lunar_mjx.errors import UserError
from lunar_mjx.terrain import load_terrain
from lunar_mjx.visual import encode, plots
from lunar_mjx.visual.overlay import MapInset, Overlay, dashes
from lunar_mjx.visual.plots import drive_summary, terrain_preview
from lunar_mjx.visual.recorded import read_drive
from lunar_mjx.visual.video import brightest_side, frame_rows, render_video


def decoded(path) -> list[np.ndarray]:
    av = pytest.importorskip("av")
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.slow
def test_summary_plot(run, luvmi, tmp_path):
    result = run("plot", luvmi[0], "--out", tmp_path / "summary.png")
    assert result.status == 0 and result.out.strip() == str(tmp_path / "summary.png")
    picture = np.asarray(Image.open(tmp_path / "summary.png").convert("RGB"))
    assert picture.shape[1] > 1000
    assert (picture[:, : picture.shape[1] // 2].std(axis=-1) < 1).mean() > 0.8  # relief is grey
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 500


def test_legends_hide_no_line(luvmi):
    """Each stands above its axes, and below what stands above them."""
    figure = drive_summary(read_drive(luvmi[0]))
    FigureCanvasAgg(figure).draw()
    drawn = [axes for axes in figure.axes if axes.get_legend() is not None]
    assert len(drawn) == 4
    for axes in drawn:
        legend = axes.get_legend().get_window_extent()
        assert legend.y0 >= axes.bbox.y1 - 1.0
        assert not any(legend.overlaps(other.bbox) for other in figure.axes)


def test_level_ground_is_not_stretched_to_fill_its_axes(luvmi):
    drive = read_drive(luvmi[0])
    level = dataclasses.replace(drive, model=dataclasses.replace(drive.model, terrain=load_terrain("flat")))
    figure = Figure()
    for draw, least in ((plots._profile, plots.LAYOUT.least_rise), (plots._slope, plots.LAYOUT.least_slope)):
        axes = figure.add_subplot()
        draw(axes, level)
        assert np.ptp(axes.get_ylim()) > 0.999 * least


def test_terrain_preview(run, tmp_path):
    figure = terrain_preview(load_terrain("slope:5deg"))
    maps = figure.axes[1].images[0].get_array()
    assert np.asarray(maps) == pytest.approx(5.0, abs=0.01)
    result = run("terrain", "preview", "flat", "--out", tmp_path / "flat.png")
    assert result.status == 0 and (tmp_path / "flat.png").is_file()


def test_relief_is_lit_from_the_north_west():
    """A plane that faces south-east lies in the shade of the map's light."""
    towards, away = (
        relief(load_terrain(f"slope:{deg}deg"), np.array([-5.0, -5]), np.array([5.0, 5])) for deg in (10, -10)
    )
    assert towards.grey.mean() > away.grey.mean() + 0.05  # falling towards the west: lit
    assert towards.west <= -5.0 and towards.east >= 5.0


def test_video_from_above_needs_no_opengl(run, luvmi, tmp_path):
    out = tmp_path / "drive.mp4"
    result = run("render", luvmi[0], "--out", out, "--view", "top", "--size", "320x241", "--fps", "4", "--speed", "1")
    assert result.status == 0 and result.out.strip().endswith(str(out))
    pictures = decoded(out)
    assert len(pictures) == 6 and pictures[0].shape == (240, 320, 3)
    change = np.abs(pictures[0].astype(int) - pictures[-1]).sum(-1)
    assert (change > 60).sum() > 20  # rover, path and cursors moved


def test_video_follows_the_rover(luvmi, tmp_path, opengl):
    """The rover stays in the middle, and the view is not empty."""
    drive = read_drive(luvmi[0])
    render_video(drive, tmp_path / "drive.webp", "follow", (320, 180), 2, 1.0, Sun(200.0, 25.0))
    with Image.open(tmp_path / "drive.webp") as film:
        assert film.n_frames == 3 and film.size == (320, 180)
        film.seek(2)
        last = np.asarray(film.convert("RGB")).astype(int)
    middle = last[60:130, 110:210]
    # the foil of the body has four times as much red as blue, whatever its exposure; ground is grey
    golden = (middle[..., 0] > 60) & (2 * middle[..., 0] > 3 * middle[..., 2])
    assert golden.sum() > 30
    aside = last[:, :60]
    elsewhere = (aside[..., 0] > 60) & (2 * aside[..., 0] > 3 * aside[..., 2])
    assert golden.mean() > 3.0 * elsewhere.mean()


def test_without_opengl_auto_falls_back_and_follow_says_so(luvmi, tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    drive = read_drive(luvmi[0])
    render_video(drive, tmp_path / "drive.gif", "auto", (160, 120), 1, 1.0)
    with Image.open(tmp_path / "drive.gif") as film:
        assert film.n_frames == 2
    with pytest.raises(UserError, match="turns OpenGL off"):
        render_video(drive, tmp_path / "drive.gif", "follow", (160, 120), 1)


def test_rows_and_speed_of_a_video(luvmi):
    drive = read_drive(luvmi[0])
    rows, speed = frame_rows(drive, 20, 0.0)
    assert speed == 1.0 and (rows == np.arange(len(drive.time))).all()
    assert frame_rows(drive, 10, 1.5)[0].tolist() == [0, 3, 6, 9, 12, 15, 18, 21, 24, 27]


def test_camera_stands_where_the_sun_lights_the_rover():
    east, sun_in_west = 0.0, np.array([-0.8, 0.3, 0.5])
    assert abs(brightest_side(east, sun_in_west)) == pytest.approx(np.pi - 0.6)  # behind, and to the left
    assert brightest_side(east, np.array([0.9, 0.1, 0.4])) == pytest.approx(0.7)
    # light from the right and a little ahead: from behind one sees the lit side, and the tracks
    assert brightest_side(east, np.array([0.65, -0.7, 0.26])) == pytest.approx(np.pi + 0.6)


def test_numbers_lie_within_their_pane(luvmi):
    """Over a white picture: what is brighter than the pane's glass within it is text, and outside of it is white."""
    drive = read_drive(luvmi[0])
    overlay = Overlay(drive, (960, 540), with_map=False)
    overlay._sinkage = np.full_like(overlay._sinkage, 139.3)
    shown = overlay.draw(np.full((540, 960, 3), 255, np.uint8), 0).astype(int).sum(axis=-1)
    glass = shown[:140] < 500
    edge = int(np.nonzero(glass.any(axis=0))[0].max())
    text = (shown[10:140, : edge + 1] > 620) & glass[10:140, [100]]
    rightmost = int(np.nonzero(text.any(axis=0))[0].max())
    assert rightmost < edge - 4
    # A rock behind the glass stood as "-" before a number: over white it is a fifth as bright as a screen at most.
    assert shown[12, edge - 3] < 0.2 * 3 * 255


def test_rear_wheels_are_broken_lines():
    """Told apart without colour, as in the plots."""
    ends = dashes(10.0, 100.0, 12.0)
    assert ends[0] == (10.0, 22.0) and ends[1][0] == 28.0 and ends[-1][1] <= 100.0
    assert sum(b - a for a, b in ends) == pytest.approx(60.0, abs=12.0)


def test_map_has_north_up(luvmi):
    drive = read_drive(luvmi[0])
    inset = MapInset(drive, 200)
    image = np.asarray(inset.draw(len(drive.time) - 1).convert("RGB")).astype(int)
    gold = np.argwhere((image[..., 0] > 230) & (image[..., 2] < 100) & (image[..., 1] > 150))
    start, end = drive.position[0, :2], drive.position[-1, :2]
    middle = gold.mean(axis=0)
    u, v = inset.ground.pixel(end)
    assert middle == pytest.approx([v, u], abs=4)
    assert inset.ground.pixel(start)[0] < u and (inset.ground.pixel(start)[1] > v) == (end[1] > start[1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--view", "side"), "view = 'side' does not exist; use one of auto, follow, front, top"),
        (("--size", "big"), "--size = 'big' is not two numbers; write it as 960x540"),
        (("--size", "90x50"), "size = '90x50' is outside 160x120 to 3840x2160"),
        (("--out", "film.avi"), "--out = 'film.avi' is of no known kind; end it in .mp4, .webp, .gif"),
        (("--speed", "-2"), "--speed = -2.0 is negative"),
        (("--sun", "90,-5"), "elevation_deg = -5.0 is outside"),
    ],
)
def test_mistakes_are_one_sentence(run, luvmi, arguments, message):
    result = run("render", luvmi[0], *arguments)
    assert result.status == 2 and message in result.err


def test_mp4_without_encoder_is_one_sentence(luvmi, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UserError, match=r"an mp4 needs the package av; install the extra lunar-mjx\[video\]"):
        encode.require_encoder(tmp_path / "drive.mp4")
    assert encode.require_encoder(tmp_path / "drive.gif") is None
