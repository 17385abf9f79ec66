"""The kept lines of the figures of real drives, and what the page says of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import real_drives

PAGE = " ".join((Path(__file__).parents[2] / "docs" / "real_drives.md").read_text(encoding="utf-8").split())


def error(lines: dict[str, np.ndarray], label: str, channels: tuple[str, ...]) -> float:
    left = np.concatenate([lines[f"{c}/{label}"] - lines[f"{c}/measured"] for c in channels])
    return float(np.sqrt(np.nanmean(left**2)))


CURRENTS, YAW_RATE = ("motor_left_drive_current_A", "motor_right_drive_current_A"), ("gyro_z_rad_s",)


def test_the_page_quotes_the_errors_of_the_lines_that_it_shows() -> None:
    snow = real_drives.kept_lines("real_snow")
    given, refitted, soft = (error(snow, k, YAW_RATE) for k in ("as given", "refitted", "with soft_ground"))
    assert f"falls from {given:.3f} over {refitted:.3f} (refitted) to {soft:.3f} rad/s" in PAGE
    given, soft = (error(snow, k, CURRENTS) for k in ("as given", "with soft_ground"))
    assert f"the currents' from {given:.2f} to {soft:.2f} A" in PAGE
    slopes = real_drives.kept_lines("real_cuadriga")
    before, after = (error(slopes, k, CURRENTS) for k in ("as given", "refitted"))
    assert f"currents' error from {before:.1f} to {after:.1f} A" in PAGE
    before, after = (error(slopes, k, YAW_RATE) for k in ("as given", "refitted"))
    assert f"yaw rate's from {before:.3f} to {after:.3f} rad/s" in PAGE


def test_pictures_are_drawn_from_lines_and_lines_are_kept_beside_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = {f"gyro_z_rad_s/{k}": np.array([0.1, np.nan, 0.2]) for k in ("as given", "measured")}
    monkeypatch.setattr(real_drives, "DRAWN", tmp_path / "drawn.npz")
    for name in ("a", "b", "a"):
        real_drives.keep_lines(name, lines)
    assert list(real_drives.kept_lines("a")) == list(real_drives.kept_lines("b")) == list(lines)
    real_drives.picture(real_drives.kept_lines("a"), tmp_path / "a.png")
    assert {p.name for p in tmp_path.iterdir()} == {"a.png", "a_dark.png", "drawn.npz"}
