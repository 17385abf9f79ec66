"""Every mistake gets one sentence that names the file, the field, the value and the remedy."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio import Affine
from rasterio.errors import NotGeoreferencedWarning

from lunar_mjx.errors import UserError
from lunar_mjx.terrain import (
    Craters,
    RockField,
    Roughness,
    add_detail,
    build_rocks,
    export_mesh,
    flat,
    inclined,
    load_terrain,
    make_surface,
    read_dem,
    stack,
)

SURFACE = {"width": 10.0, "height": 10.0, "cell": 0.5}
POLAR = "+proj=stere +lat_0=-90 +lon_0=0 +k=1 +x_0=0 +y_0=0 +R=1737400 +units=m +no_defs"
MOON_DEGREES = "+proj=longlat +R=1737400 +no_defs"
LABEL = (
    'PDS_VERSION_ID = PDS3\n^IMAGE = "A.IMG"\nRECORD_BYTES = 8\nLINES = 3\nLINE_SAMPLES = 4\n'
    "SAMPLE_TYPE = LSB_INTEGER\nSAMPLE_BITS = 16\nMAP_SCALE = 5 <METERS/PIXEL>\nEND\n"
)


def refused(call, *parts):
    with pytest.raises(UserError) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text and text.endswith(".") and ";" in text
    for part in parts:
        assert part in text, text


def tif(path, data, crs=POLAR, transform=None, nodata=None):
    transform = Affine(5, 0, 0, 0, -5, 0) if transform is None else transform
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            height=data.shape[0],
            width=data.shape[1],
            count=1,
            dtype="float32",
            crs=crs,
            transform=transform,
            nodata=nodata,
        ) as raster:
            raster.write(data.astype("float32"), 1)
    return path


@pytest.fixture
def some(tmp_path):
    return np.arange(12.0).reshape(3, 4), tmp_path


def test_missing_file_and_folder(some):
    _, folder = some
    refused(lambda: read_dem(folder / "no.tif"), "no.tif", "not there")
    (folder / "dir.tif").mkdir()
    refused(lambda: read_dem(folder / "dir.tif"), "is a folder")
    refused(lambda: load_terrain("no_such_terrain"), "no_such_terrain", "lunar_plain")
    refused(lambda: load_terrain("de_gerlache_rim", dem=folder / "no.tif"), "no.tif", "given by dem")


def test_missing_file_in_the_environment(monkeypatch):
    monkeypatch.setenv("LUNAR_MJX_DEM_DE_GERLACHE_RIM", "gone.tif")
    refused(lambda: load_terrain("de_gerlache_rim"), "gone.tif", "LUNAR_MJX_DEM_DE_GERLACHE_RIM")


def test_unknown_suffix(some):
    (some[1] / "a.jpg").write_bytes(b"x")
    refused(lambda: read_dem(some[1] / "a.jpg"), ".jpg", ".tif")


def test_geotiff(some):
    data, folder = some
    nodata = np.full((3, 4), -9999.0)
    refused(lambda: read_dem(tif(folder / "n.tif", nodata, nodata=-9999)), "n.tif", "only nodata")
    half = np.where(np.arange(12).reshape(3, 4) < 7, -9999.0, 1.0)
    refused(lambda: read_dem(tif(folder / "h.tif", half, nodata=-9999)), "7 of 12", "more than half")
    refused(lambda: read_dem(tif(folder / "d.tif", data, crs=MOON_DEGREES)), "degrees", "gdalwarp")
    refused(lambda: read_dem(tif(folder / "p.tif", data, transform=Affine(5, 0, 0, 0, -6, 0))), "5 x 6", "not square")
    refused(lambda: read_dem(tif(folder / "r.tif", data, transform=Affine(5, 1, 0, 1, -5, 0))), "rotated")
    refused(lambda: read_dem(tif(folder / "s.tif", data, transform=Affine(5, 0, 0, 0, 5, 0))), "mirrored")
    refused(lambda: read_dem(tif(folder / "g.tif", data, crs=None, transform=Affine.identity())), "georeference")
    refused(lambda: read_dem(tif(folder / "b.tif", data), band=2), "band = 2")
    refused(lambda: read_dem(folder / "b.tif", crop=(1e6, 0, 10, 10)), "crop", "leaves the DEM")
    (folder / "broken.tif").write_bytes(b"II*\0 this is no raster")
    refused(lambda: read_dem(folder / "broken.tif"), "broken.tif", "cannot be read")
    (folder / "trick.xml").write_text(f"<VRTDataset><SourceFilename>{folder / 'b.tif'}</SourceFilename></VRTDataset>")
    refused(lambda: read_dem(folder / "trick.xml"), "trick.xml", "cannot be read")
    whole = tif(folder / "t.tif", np.zeros((300, 300))).read_bytes()
    (folder / "t.tif").write_bytes(whole[: len(whole) // 2])
    refused(lambda: read_dem(folder / "t.tif"), "t.tif", "cannot be read")


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("LINES = 3\n", "", ["LINES"]),
        ("LINES = 3\n", "LINES = -3\n", ["LINES = '-3'"]),
        ("LINES = 3\n", "LINES = many\n", ["LINES", "many"]),
        ("LSB_INTEGER", "CHARACTER", ["SAMPLE_TYPE", "CHARACTER"]),
        ("<METERS/PIXEL>", "<DEG/PIXEL>", ["MAP_SCALE", "degrees"]),
        ("MAP_SCALE = 5 <METERS/PIXEL>\n", "", ["MAP_SCALE", "cell"]),
        ("MAP_SCALE = 5", "MAP_SCALE = 0", ["MAP_SCALE = 0.0", "not positive"]),
        ('"A.IMG"', '"OTHER.IMG"', ["OTHER.IMG", "not beside"]),
        ("LINES = 3\n", "LINES = 300\n", ["A.IMG", "2400", "24 bytes"]),
        ("LINES = 3\n", "LINES = 3\nUNIT = FATHOM\n", ["UNIT", "FATHOM"]),
        ("LINES = 3\n", "LINES = 3\nBANDS = 3\n", ["BANDS"]),
        ("LINES = 3\n", "LINES = 3\nMAP_PROJECTION_TYPE = SIMPLE_CYLINDRICAL\n", ["degrees", "gdalwarp"]),
    ],
)
def test_pds_label(tmp_path, old, new, parts):
    (tmp_path / "A.IMG").write_bytes(np.zeros(12, "<i2").tobytes())
    (tmp_path / "A.LBL").write_text(LABEL.replace(old, new))
    refused(lambda: read_dem(tmp_path / "A.LBL"), *parts)


def test_image_without_label_or_truncated(tmp_path):
    (tmp_path / "A.IMG").write_bytes(np.zeros(5, "<i2").tobytes())
    refused(lambda: read_dem(tmp_path / "A.IMG"), "A.IMG", "A.LBL")
    (tmp_path / "A.LBL").write_text(LABEL)
    refused(lambda: read_dem(tmp_path / "A.IMG"), "10 bytes", "24")


def test_png(some):
    data, folder = some
    path = folder / "a.png"
    Image.fromarray(data.astype(np.uint8)).save(path)
    refused(lambda: read_dem(path, cell=1.0), "height_scale", "without a scale")
    refused(lambda: read_dem(path, height_scale=1.0), "cell", "without a scale")
    refused(lambda: read_dem(path, cell=0.0, height_scale=1.0), "cell = 0.0", "not positive")
    refused(lambda: read_dem(path, cell=-1.0, height_scale=1.0), "cell = -1.0")
    refused(lambda: read_dem(path, cell=1.0, height_scale=-5.0), "height_scale = -5.0")
    Image.fromarray(np.zeros((3, 4, 3), np.uint8)).save(folder / "c.png")
    refused(lambda: read_dem(folder / "c.png", cell=1.0, height_scale=1.0), "RGB", "grey")
    (folder / "b.png").write_bytes(path.read_bytes()[:40])
    refused(lambda: read_dem(folder / "b.png", cell=1.0, height_scale=1.0), "b.png", "cannot be read")


def test_npy(some):
    data, folder = some

    def saved(array, **options):
        np.save(folder / "a.npy", array, **options)
        return folder / "a.npy"

    refused(lambda: read_dem(saved(np.array([{}, 1], object), allow_pickle=True), cell=1.0), "pickled")
    refused(lambda: read_dem(saved(data[0]), cell=1.0), "shape = (4,)", "two-dimensional")
    refused(lambda: read_dem(saved(data.astype(str)), cell=1.0), "dtype", "not a real number")
    refused(lambda: read_dem(saved(data * 1j), cell=1.0), "complex128")
    refused(lambda: read_dem(saved(data * np.nan), cell=1.0), "only nodata")
    refused(lambda: read_dem(saved(data[:1]), cell=1.0), "2 x 2")
    refused(lambda: read_dem(saved(data)), "cell", "without a scale")
    (folder / "a.npy").write_bytes(b"not numpy")
    refused(lambda: read_dem(folder / "a.npy", cell=1.0), "cannot be read")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("ncols 2\nnrows 2\ncellsize 1\n1 2 3\n", ["3 numbers", "2 x 2"]),
        ("ncols 2\nnrows 2\ncellsize 0\n1 2 3 4\n", ["cellsize = 0.0"]),
        ("ncols 2\nnrows 2\n1 2 3 4\n", ["cellsize", "None"]),
        ("ncols 2\nnrows 2\ndx 1\ndy 2\n1 2 3 4\n", ["dx, dy", "not equal"]),
        ("ncols two\nnrows 2\ncellsize 1\n1 2 3 4\n", ["ncols", "two"]),
        ("nrows 2\ncellsize 1\n1 2 3 4\n", ["ncols", "whole number"]),
        ("ncols 2\nnrows 2\ncellsize 1\n1 2 x 4\n", ["something else than numbers"]),
        ("ncols 2\nnrows 2\ncellsize 1\n" + "-9999 " * 4, ["only nodata"]),
        ("", ["nrows"]),
    ],
)
def test_asc(tmp_path, text, parts):
    (tmp_path / "a.asc").write_text(text)
    refused(lambda: read_dem(tmp_path / "a.asc"), "a.asc", *parts)


@pytest.mark.parametrize("spec", ["slope:95deg", "slope:-90deg", "slope:steep", "slope:10", "slope:1.2.3deg", "slope"])
def test_slopes(spec):
    refused(lambda: load_terrain(spec), spec, "slope:10deg")


@pytest.mark.parametrize(
    ("table", "parts"),
    [
        ({}, ["[plane], [dem], [surface]"]),
        ({"surfaces": {}}, ["surfaces", "not a known key"]),
        ({"surface": SURFACE | {"cells": 1}}, ["surface.cells", "not a known key"]),
        ({"surface": {"width": 1.0, "height": 1.0}}, ["surface.cell", "missing"]),
        ({"surface": SURFACE | {"cell": "wide"}}, ["surface.cell", "'wide'", "number"]),
        ({"surface": SURFACE | {"cell": True}}, ["surface.cell", "number"]),
        ({"surface": SURFACE | {"cell": float("nan")}}, ["surface.cell", "not finite"]),
        ({"surface": SURFACE | {"cell": -0.5}}, ["cell = -0.5", "not positive"]),
        ({"surface": SURFACE | {"width": 0.1}}, ["width = 0.1"]),
        ({"surface": SURFACE | {"cell": 1e-5}}, ["nodes", "larger cell"]),
        ({"surface": 3}, ["surface", "not a table"]),
        ({"seed": 1.5, "surface": SURFACE}, ["seed", "whole number"]),
        ({"seed": -1, "surface": SURFACE, "rocks": {}}, ["seed = -1"]),
        ({"plane": {}, "rocks": {}}, ["rocks", "does not go with [plane]"]),
        ({"plane": {"slope_deg": 120}}, ["120 deg"]),
        ({"surface": SURFACE, "rocks": {"cell": 1e-5}}, ["rocks: grid = '100000", "larger cell"]),
        ({"surface": SURFACE, "rocks": {"cell": 1e-9}}, ["rocks: cell = 1e-09", "no spacing"]),
        ({"surface": SURFACE | {"x": 1e300}}, ["terrain: x = 1e+300", "out of range"]),
        ({"plane": {"slope_deg": 89.99999}}, ["angle = '90 deg'", "makes heights of 5.73e+08 m on 200 m"]),
        ({"plane": {"direction_deg": 1e300}}, ["direction = 1.7", "out of range"]),
        ({"plane": {"extent": -1.0}}, ["extent = -1.0"]),
        ({"plane": {"extent": 1e9}}, ["grid = '1000000001 x 1000000001'", "larger cell"]),
        ({"plane": {"extent": 1e300, "cell": 1e-300}}, ["cell = 1e-300", "no spacing of heights"]),
        ({"dem": {"cell": 1.0}}, ["dem.file", "leaves no ground"]),
        ({"dem": {"file": "no.tif"}}, ["no.tif", "not there"]),
        ({"surface": SURFACE, "crop": {"x": 99, "y": 0, "width": 2, "height": 2}}, ["crop x", "leaves the DEM"]),
        ({"surface": SURFACE, "detail": {"cell": 0.5}}, ["detail cell = 0.5", "not finer"]),
        ({"surface": SURFACE | {"roughness": {"hurst": 1.2}}}, ["[surface.roughness]", "hurst = 1.2"]),
        ({"surface": SURFACE | {"craters": {"density": -1}}}, ["[surface.craters]", "density = -1"]),
        ({"surface": SURFACE, "rocks": {"abundance": -0.1}}, ["[rocks]", "abundance = -0.1"]),
        ({"surface": SURFACE, "soil": {"rock_fraction": 1.5}}, ["rock_fraction = 1.5"]),
        ({"surface": SURFACE, "soil": {"rock_fraction": 0.5, "patch": 0}}, ["patch = 0.0"]),
    ],
)
def test_tables(table, parts):
    refused(lambda: load_terrain(table), *parts)


def test_broken_toml(tmp_path):
    (tmp_path / "terrain.toml").write_text("[surface\n")
    refused(lambda: load_terrain(tmp_path), "terrain.toml", "not valid TOML")
    refused(lambda: load_terrain(tmp_path / "other.toml"), "other.toml", "not there")
    refused(lambda: load_terrain("lunar_plain", seed=-3), "seed = -3")
    refused(lambda: load_terrain("flat", dem="x.tif"), "does not go with a plane")


@pytest.mark.parametrize(
    ("make", "part"),
    [
        (lambda: Roughness(hurst=0.0), "hurst = 0.0"),
        (lambda: Roughness(hurst=float("nan")), "hurst"),
        (lambda: Roughness(deviation=-1.0), "deviation = -1.0"),
        (lambda: Roughness(baseline=0.0), "baseline = 0.0"),
        (lambda: Craters(smallest=0.0), "smallest = 0.0"),
        (lambda: Craters(smallest=30.0), "smallest = 30.0"),
        (lambda: Craters(deepest=0.9), "deepest = 0.9"),
        (lambda: RockField(abundance=-0.01), "abundance = -0.01"),
        (lambda: RockField(abundance=0.9), "abundance = 0.9"),
        (lambda: RockField(burial=1.0), "burial = 1.0"),
        (lambda: RockField(smallest=2.0), "smallest = 2.0"),
        (lambda: RockField(cell=0.0), "cell = 0.0"),
        (lambda: RockField(abundance=0.4, smallest=0.01).draw_diameters(1e4, np.random.default_rng(0)), "rocks"),
        (lambda: make_surface(500, 500, 1.0, 1, craters=Craters(smallest=0.05)), "craters"),
        (lambda: build_rocks(np.zeros((1, 3)), np.array([-0.1]), (0, 0, 1, 1)), "radii = -0.1"),
        (lambda: build_rocks(np.zeros((2, 3)), np.ones(1), (0, 0, 1, 1)), "radii"),
        (lambda: build_rocks(np.full((1, 3), np.nan), np.ones(1), (0, 0, 1, 1)), "not finite"),
        (lambda: inclined(1.6), "right angle"),
        (lambda: flat(cell=0.0), "cell = 0.0"),
        (lambda: add_detail(make_surface(9, 9, 1, 1), 0.0, 1), "cell = 0.0"),
        (lambda: make_surface(9, 9, 1, 1).resample(100.0), "fewer than 2 x 2"),
        (lambda: export_mesh(flat(4.0), "a.dae"), ".dae"),
        (lambda: export_mesh(flat(4.0), "no/such/folder/a.stl"), "folder is not there"),
        (lambda: export_mesh(stack([flat(4.0)]), "a.stl"), "are a batch"),
    ],
)
def test_parameters(make, part):
    refused(make, part)


@pytest.mark.parametrize(
    ("options", "part"),
    [({"band": 2}, "band = 2 does not exist"), ({"band": -1}, "band = -1"), ({"height_scale": 5.0}, "is for PNG")],
)
def test_options_that_a_format_does_not_read_are_refused(options, part, tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((3, 3)))
    refused(lambda: read_dem(tmp_path / "a.npy", cell=1.0, **options), str(tmp_path / "a.npy"), part)
