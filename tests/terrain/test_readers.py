"""Every format: right heights, right way up, right place, right units."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio import Affine
from rasterio.errors import NotGeoreferencedWarning

from lunar_mjx.terrain import read_dem

# The projection of the LOLA products: polar stereographic on a sphere, without an EPSG code.
POLAR = "+proj=stere +lat_0=-90 +lon_0=0 +k=1 +x_0=0 +y_0=0 +R=1737400 +units=m +no_defs"
# North-west corner high, so that any flip shows: rows go north to south, as files have them.
GRID = np.array([[9.0, 5.0, 4.0, 1.0], [8.0, 6.0, 3.0, 0.0], [7.0, 7.5, 2.0, -1.5]])


def write_tif(path, data=GRID, crs=POLAR, transform=None, nodata=None, dtype="float32", **tags):
    transform = Affine(5, 0, -45000, 0, -5, 23000) if transform is None else transform
    rows, cols = data.shape
    profile = {"height": rows, "width": cols, "count": 1, "dtype": dtype, "crs": crs, "nodata": nodata}
    with rasterio.open(path, "w", driver="GTiff", transform=transform, **profile) as raster:
        raster.write(data.astype(dtype), 1)
        for key, value in tags.items():
            setattr(raster, key, (value,))
    return path


def test_geotiff_like_lola(tmp_path):
    dem = read_dem(write_tif(tmp_path / "Site11_final_adj_5mpp_surf.tif"))
    np.testing.assert_allclose(dem.heights, GRID[::-1])
    # The centre of the south-western pixel.
    assert (dem.cell, dem.x0, dem.y0) == (5.0, -44997.5, 22987.5)


def test_geotiff_scale_offset_unit_and_nodata(tmp_path):
    data = np.round(GRID * 2).astype("int16")
    data[1, 1] = -32768
    path = write_tif(tmp_path / "a.tif", data, nodata=-32768, dtype="int16", scales=0.5e-3, offsets=0.1, units="km")
    dem = read_dem(path)
    expected = GRID[::-1] + 100.0
    known = np.ones((3, 4), bool)
    known[1, 1] = False
    np.testing.assert_allclose(dem.heights[known], expected[known], atol=1e-9)
    assert 103 < dem.heights[1, 1] < 108 and "1 of 12" in dem.notes[0]


def test_geotiff_crop_reads_the_same_as_reading_whole(tmp_path):
    data = np.random.default_rng(0).normal(size=(60, 50))
    path = write_tif(tmp_path / "a.tif", data)
    window = (-44900.0, 22850.0, 60.0, 100.0)
    part, whole = read_dem(path, crop=window), read_dem(path).crop(*window)
    np.testing.assert_array_equal(part.heights, whole.heights)
    assert part.bounds == whole.bounds and part.heights.shape == (20, 12)


def test_geotiff_without_georeference_takes_the_users_cell(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        path = write_tif(tmp_path / "a.tif", crs=None, transform=Affine.identity())
    assert read_dem(path, cell=2.0).cell == 2.0


def test_pds4(tmp_path):
    profile = {"height": 3, "width": 4, "count": 1, "dtype": "float32", "crs": POLAR}
    words = {"LATITUDE_TYPE": "Planetocentric", "TARGET": "Moon"}  # what GDAL asks of a new label
    transform = Affine(5, 0, -45000, 0, -5, 23000)
    with rasterio.open(tmp_path / "a.xml", "w", driver="PDS4", transform=transform, **profile, **words) as raster:
        raster.write(GRID.astype("float32"), 1)
    dem = read_dem(tmp_path / "a.xml")
    np.testing.assert_allclose(dem.heights, GRID[::-1])
    assert (dem.cell, dem.x0, dem.y0) == (5.0, -44997.5, 22987.5)


LABEL = """PDS_VERSION_ID            = "PDS3"
RECORD_TYPE               = FIXED_LENGTH
RECORD_BYTES              = {record}
{pointer}
OBJECT                    = IMAGE
  LINES                   = 3
  LINE_SAMPLES            = 4
  SAMPLE_TYPE             = {kind}
  SAMPLE_BITS             = {bits}
  UNIT                    = {unit}
  SCALING_FACTOR          = {scale}
  OFFSET                  = {offset}
  {extra}
END_OBJECT                = IMAGE
OBJECT                    = IMAGE_MAP_PROJECTION
  MAP_PROJECTION_TYPE     = "POLAR STEREOGRAPHIC"
  A_AXIS_RADIUS           = 1737.4 <KM>
  B_AXIS_RADIUS           = 1737.4 <KM>
  C_AXIS_RADIUS           = 1737.4 <KM>
  CENTER_LATITUDE         = -90 <DEG>
  CENTER_LONGITUDE        = 0 <DEG>
  MAP_SCALE               = {map_scale}
  LINE_PROJECTION_OFFSET  = 1.0
  SAMPLE_PROJECTION_OFFSET = 1.5
END_OBJECT                = IMAGE_MAP_PROJECTION
END
"""


def write_pds(folder, dtype, kind, bits, data, **words):
    settings = {"unit": "METER", "scale": 0.5, "offset": "1737400.", "map_scale": "5 <METERS/PIXEL>", "extra": ""}
    settings |= words
    (folder / "LDEM.IMG").write_bytes(np.asarray(data).astype(dtype).tobytes())
    pointer = '^IMAGE                    = "LDEM.IMG"'
    label = LABEL.format(record=4 * bits // 8, pointer=pointer, kind=kind, bits=bits, **settings)
    (folder / "LDEM.LBL").write_text(label)
    return folder / "LDEM.IMG"


@pytest.mark.parametrize(
    ("dtype", "kind", "bits", "words"),
    [
        ("<i2", "LSB_INTEGER", 16, {}),
        (">i2", "MSB_INTEGER", 16, {}),
        ("<i4", "LSB_INTEGER", 32, {}),
        ("<f4", "PC_REAL", 32, {"scale": 0.0005, "unit": "KILOMETER", "offset": 1737.4}),
        (">f4", "IEEE_REAL", 32, {"map_scale": "0.005 <KM/PIXEL>"}),
        ("<i2", "LSB_INTEGER", 16, {"map_scale": "0.005"}),
    ],
)
def test_pds3_types_and_units(tmp_path, dtype, kind, bits, words):
    dem = read_dem(write_pds(tmp_path, dtype, kind, bits, GRID * 2, **words))
    np.testing.assert_allclose(dem.heights, GRID[::-1], atol=1e-5)
    assert dem.cell == 5.0 and (dem.x0, dem.y0) == (-7.5, -5.0) and "1737400" in dem.reference
    np.testing.assert_array_equal(read_dem(tmp_path / "LDEM.LBL").heights, dem.heights)


def test_pds3_agrees_with_gdal(tmp_path):
    path = write_pds(tmp_path, "<i2", "LSB_INTEGER", 16, GRID * 2)
    dem = read_dem(path)
    with rasterio.open(tmp_path / "LDEM.LBL") as raster:
        assert raster.driver == "PDS"
        theirs = raster.read(1) * raster.scales[0]
        west, cell = raster.transform.c, raster.transform.a
    np.testing.assert_allclose(dem.heights[::-1], theirs)
    assert dem.cell == cell and abs(dem.x0 - (west + cell / 2)) <= cell  # conventions differ by up to a pixel


def test_pds3_missing_constant_and_attached_label(tmp_path):
    data = (GRID * 2).astype("<f4")
    data[0, 1] = np.frombuffer(bytes.fromhex("FF7FFFFB"), ">f4")[0]
    label = LABEL.format(
        record=512,
        pointer="^IMAGE = 5",
        kind="PC_REAL",
        bits=32,
        unit="METER",
        scale=0.5,
        offset=0,
        map_scale="5 <METERS/PIXEL>",
        extra="MISSING_CONSTANT = 16#FF7FFFFB#",
    )
    path = tmp_path / "NAC_DTM.IMG"
    path.write_bytes(label.encode().ljust(4 * 512) + data.tobytes())
    dem = read_dem(path)
    assert "1 of 12" in dem.notes[0] and 4 < dem.heights[2, 1] < 9.1
    np.testing.assert_allclose(dem.heights[:2], GRID[::-1][:2], atol=1e-6)


@pytest.mark.parametrize(("dtype", "white"), [(np.uint8, 255), (np.uint16, 65535)])
def test_png(tmp_path, dtype, white):
    levels = np.array([[white, 0], [0, 0], [white // 3, 0]], dtype)
    Image.fromarray(levels).save(tmp_path / "a.png")
    dem = read_dem(tmp_path / "a.png", cell=2.0, height_scale=30.0, dequantise=False)
    np.testing.assert_allclose(dem.heights, [[10, 0], [0, 0], [30, 0]], atol=1e-3)


def test_npy(tmp_path):
    np.save(tmp_path / "a.npy", GRID.astype(np.float32))
    np.testing.assert_allclose(read_dem(tmp_path / "a.npy", cell=1.0).heights, GRID[::-1])


@pytest.mark.parametrize("origin", ["xllcorner 100\nyllcorner 200", "XLLCENTER 105\nYLLCENTER 205"])
def test_asc(tmp_path, origin):
    body = "\n".join(" ".join(f"{v:g}" for v in row) for row in GRID).replace("7.5", "-9999")
    (tmp_path / "a.asc").write_text(f"ncols 4\nnrows 3\n{origin}\ncellsize 10\nNODATA_value -9999\n{body}\n")
    dem = read_dem(tmp_path / "a.asc")
    assert dem.bounds == (105.0, 205.0, 135.0, 225.0)
    known = GRID[::-1] != 7.5
    np.testing.assert_allclose(dem.heights[known], GRID[::-1][known])
    assert np.isfinite(dem.heights).all()
