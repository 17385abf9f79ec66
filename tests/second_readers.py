"""What a file says, by readers that share no code with the package, which may refuse a file, but not read it otherwise.

Each takes the path of a file, broken or whole, and gives numbers by name. What it cannot tell is left out; where the
whole cannot be read it raises `Unreadable`, and where the file's own checksums say that it is damaged `Damaged`.
"""

from __future__ import annotations

import csv
import io
import json
import math
import struct
import tomllib
import warnings
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import rasterio
from PIL import Image
from rasterio.errors import NotGeoreferencedWarning

NODATA = (-9999.0, -99999.0, -32768.0, -32767.0, 32767.0, 9999.0, 99999.0)
"""Marks that a reader may take out without being told; heights of the tests' files are far from them."""
Said = dict[str, Any]


class Unreadable(Exception):
    """This reader cannot tell."""


class Damaged(Exception):
    """The file's own checksums are broken: nothing may be read from it."""


def _toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise Unreadable from error


def _numbers(value: Any) -> np.ndarray | None:
    """A number or a list of numbers (of one length) as an array; None for anything else."""
    flat = value if isinstance(value, list) else [value]
    rows = [r if isinstance(r, list) else [r] for r in flat]
    if not rows or len({len(r) for r in rows}) > 1:
        return None
    if any(isinstance(v, bool) or not isinstance(v, int | float) or abs(v) > 1e300 for r in rows for v in r):
        return None
    return np.asarray(value, float)


def _named(table: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Leaves of a document by dotted names; lists of tables by the number of each."""
    if isinstance(table, Mapping):
        for key, value in table.items():
            yield from _named(value, f"{prefix}.{key}" if prefix else key)
    elif isinstance(table, list) and table and all(isinstance(v, Mapping) for v in table):
        for number, value in enumerate(table):
            yield from _named(value, f"{prefix}.{number}")
    else:
        yield prefix, table


def model(path: Path) -> Said:
    """Numbers of a `model.toml` by its own names; a temperature in degC as K, a quantity in its unit."""
    document, out = _toml(path), {}
    for name, value in _named(document):
        numbers = _numbers(value)
        if numbers is None:
            continue
        name = name.removesuffix(".value")
        out[name] = numbers + 273.15 if name.endswith("temperature_degC") else numbers
    return out


def table(path: Path) -> Said:
    """Numbers of any other TOML file by their names."""
    return {name: numbers for name, value in _named(_toml(path)) if (numbers := _numbers(value)) is not None}


def mjcf(path: Path) -> Said:
    """The mass of an MJCF, by MuJoCo itself."""
    try:
        return {"mass": float(mujoco.MjSpec.from_file(str(path)).compile().body_mass.sum())}
    except ValueError as error:
        raise Unreadable from error


def urdf(path: Path) -> Said:
    """The mass of a URDF's links that hang on joints (or are the root), and the radii of its cylinders of wheels."""
    try:
        root = ET.fromstring(path.read_bytes())
        links = root.findall("link")
        radii = [float(c.get("radius", "nan")) for c in root.findall("link/collision/geometry/cylinder")]
        return {
            "mass": sum(float(m.get("value", "nan")) for k in links for m in k.findall("inertial/mass")),
            "radii": sorted(radii),
        }
    except (ET.ParseError, ValueError, LookupError) as error:
        raise Unreadable from error


def ascii_grid(path: Path) -> Said:
    """Heights (first row in the south), spacing and south-western node of an ESRI ASCII grid."""
    try:
        lines = path.read_text(encoding="ascii").split("\n")
        words = [line.split() for line in lines if line.strip()]
        header = {w[0].lower(): float(w[1]) for w in words if w[0][0].isalpha() and len(w) == 2}
        numbers = [float(v) for w in words if not w[0][0].isalpha() for v in w]
        shape = int(header["nrows"]), int(header["ncols"])
        heights = np.array(numbers).reshape(shape)[::-1]
        heights = np.where(heights == header.get("nodata_value", math.nan), np.nan, heights)
        half = header["cellsize"] / 2
        return {
            "heights": _without_marks(heights),
            "cell": header["cellsize"],
            "x0": header["xllcorner"] + half,
            "y0": header["yllcorner"] + half,
        }
    except (ValueError, KeyError, IndexError, OverflowError) as error:
        raise Unreadable from error


def _without_marks(heights: np.ndarray) -> np.ndarray:
    return np.where(np.isin(heights, NODATA), np.nan, heights)


def array(path: Path) -> Said:
    """An `.npy` file of float64 by its header's length alone."""
    data = path.read_bytes()
    if (
        not data.startswith(b"\x93NUMPY\x01\x00")
        or b"'descr': '<f8', 'fortran_order': False, 'shape': (3, 4), " not in data
    ):
        raise Unreadable
    begin = 10 + struct.unpack("<H", data[8:10])[0]
    if len(data) < begin + 96:
        raise Damaged
    return {"heights": _without_marks(np.frombuffer(data[begin : begin + 96]).reshape(3, 4)[::-1])}


def geotiff(path: Path) -> Said:
    """Heights, spacing and south-western node of a GeoTIFF, by Pillow."""
    try:
        with warnings.catch_warnings(), Image.open(path) as image:
            warnings.simplefilter("ignore")
            if image.format != "TIFF" or image.mode != "F" or image.n_frames != 1:
                raise Unreadable
            scale, tie = image.tag_v2[33550], image.tag_v2[33922]
            heights = np.asarray(image, float)[::-1]
            if tie[:3] != (0.0, 0.0, 0.0) or set(image.tag_v2) & {339, 34264, 42112} != {339}:
                raise Unreadable  # tied to another pixel, a matrix, or a scale of its numbers
            mark = float(image.tag_v2[42113].strip("\0 ")) if 42113 in image.tag_v2 else math.nan
    except Unreadable:
        raise
    except Exception as error:  # Pillow raises a dozen kinds
        raise Unreadable from error
    heights = np.where(heights == mark, np.nan, heights)
    return {
        "heights": _without_marks(heights),
        "cell": scale[0],
        "x0": tie[3] + scale[0] / 2,
        "y0": tie[4] - (len(heights) - 0.5) * scale[0],
    }


def png(scale: float) -> Callable[[Path], Said]:
    """Heights of a grey PNG, whose white is at a height, by libpng; its checksums by zlib."""

    def read(path: Path) -> Said:
        data = path.read_bytes()
        at = 8
        while data[:8] == b"\x89PNG\r\n\x1a\n" and at + 12 <= len(data):
            size, kind = struct.unpack(">I4s", data[at : at + 8])
            if at + 12 + size > len(data):
                break
            if kind == b"IEND":
                break
            body, (check,) = data[at + 4 : at + 8 + size], struct.unpack(">I", data[at + 8 + size : at + 12 + size])
            if zlib.crc32(body) != check and kind[0] < 97:  # a capital: nothing can be read without it
                raise Damaged
            at += 12 + size
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                with rasterio.open(path, driver="PNG") as raster:
                    white = {"uint8": 255, "uint16": 65535}[raster.dtypes[0]]
                    return {"heights": raster.read(1)[::-1] * (scale / white)}
        except Exception as error:  # rasterio raises GDAL's errors
            raise Unreadable from error

    return read


def commands(path: Path) -> Said:
    """Columns of a CSV table of numbers, by name."""
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig"))))
        rows = [r for r in rows if r]
        columns = list(zip(*rows[1:], strict=True))
        if any(len(r) != len(rows[0]) for r in rows) or len(set(rows[0])) < len(rows[0]):
            raise Unreadable
        return {name: np.array([float(v) for v in column]) for name, column in zip(rows[0], columns, strict=True)}
    except (ValueError, IndexError, csv.Error) as error:
        raise Unreadable from error


def document(path: Path) -> Said:
    """Numbers of a JSON document by their names."""
    try:
        return {k: n for k, v in _named(json.loads(path.read_bytes())) if (n := _numbers(v)) is not None}
    except (ValueError, RecursionError) as error:
        raise Unreadable from error


def plain_columns(good: bytes, columns: Mapping[str, np.ndarray]) -> Callable[[Path], Said]:
    """A reader of files that hold columns of float64 one after the other, of which all else is as in a whole one."""
    places = {name: good.find(values.tobytes()) for name, values in columns.items()}
    assert min(places.values()) > 0, "columns are written as they are"

    def read(path: Path) -> Said:
        data, rest = bytearray(path.read_bytes()), bytearray(good)
        if len(data) != len(good):
            raise Unreadable
        out = {}
        for name, begin in places.items():
            end = begin + columns[name].nbytes
            out[name] = np.frombuffer(bytes(data[begin:end]))
            rest[begin:end] = data[begin:end]
        if data != rest:
            raise Unreadable
        return out

    return read
