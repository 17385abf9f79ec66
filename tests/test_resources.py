"""What ships with the package is found by name, in a checkout and in an installed wheel."""

from __future__ import annotations

from pathlib import Path

import pytest

from lunar_mjx import resources
from lunar_mjx.errors import UserError


def test_shipped_rovers_and_terrains() -> None:
    assert (resources.find("models", "viper", "rover.toml") / "viper.xml").is_file()
    assert resources.find("terrain", "flat", "terrain.toml") == resources.shipped("terrain") / "flat"


def test_a_path_is_found_too(tmp_path: Path) -> None:
    (tmp_path / "rover.toml").write_text("")
    assert resources.find("models", tmp_path, "rover.toml") == tmp_path


@pytest.mark.parametrize("name", ["moonbuggy", "", "viper/viper.xml"])
def test_unknown_name_lists_what_ships(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        UserError, match=r"rover\.toml; shipped with the package: .*luvmi_x, rocker_bogie, viper, warthog\.$"
    ):
        resources.find("models", name, "rover.toml")


def test_a_folder_without_the_marker_is_not_found(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"holds rover\.toml"):
        resources.find("models", tmp_path, "rover.toml")


def test_layouts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "site-packages" / "lunar_mjx"
    package.mkdir(parents=True)
    monkeypatch.setattr(resources, "_PACKAGE", package)
    with pytest.raises(UserError, match="'models' that ships with lunar-mjx is missing; reinstall"):
        resources.shipped("models")
    checkout = package.parent / "models"
    checkout.mkdir()
    assert resources.shipped("models") == checkout
    wheel = package / "_data" / "models"
    wheel.mkdir(parents=True)
    assert resources.shipped("models") == wheel
