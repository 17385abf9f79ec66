"""Plain grids of numbers: NumPy arrays (.npy) and ESRI ASCII grids (.asc)."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from lunar_mjx.errors import UserError, bad_input, plain_digits, require_finite, require_within
from lunar_mjx.terrain.dem import DEM_LIMITS, Dem, fill_holes, require_cell, require_size, undeclared_nodata
from lunar_mjx.terrain.readers.options import WHERE, ReadOptions


def read_npy(path: Path, options: ReadOptions) -> Dem:
    """Reads a two-dimensional array of heights in m; as in all readers, its first row is the north. See `read_dem`."""
    if options.cell is None:
        raise bad_input(path, "cell", None, "leaves the array without a scale", f"{WHERE}, the spacing in m")
    cell = require_cell(str(path), "cell", options.cell)
    try:
        # A pickle runs code of its writer's.
        data = np.load(path, allow_pickle=False)
    except Exception as error:  # NumPy parses the header as Python: anything from SyntaxError to TokenError
        reason = "it holds pickled objects" if "ickle" in str(error) else " ".join(str(error).split())[:200]
        raise UserError(f"{path}: the array cannot be read ({reason}); save plain numbers with numpy.save.") from None
    if not isinstance(data, np.ndarray) or data.ndim != 2:
        shape = getattr(data, "shape", type(data).__name__)
        raise bad_input(path, "shape", shape, "is not two-dimensional", "save an array of rows x columns")
    if data.dtype.kind not in "iuf":
        raise bad_input(path, "dtype", data.dtype, "is not a real number", "save heights in m")
    require_size(str(path), *data.shape)
    heights, undeclared = undeclared_nodata(data.astype(np.float64), str(path))
    return grid(heights, cell, 0.0, 0.0, str(path), undeclared, options)


def grid(
    heights: np.ndarray, cell: float, x0: float, y0: float, source: str, notes: tuple[str, ...], options: ReadOptions
) -> Dem:
    """The grid of numbers whose first row is the north and which are NaN in holes; (x0, y0) is its south-west."""
    if options.fill:
        heights, filled = fill_holes(heights, source)
        notes = notes + filled
    return Dem(
        # Files begin in the north, fields in the south.
        heights[::-1],
        cell,
        x0,
        y0,
        source,
        notes=notes,
        highest=DEM_LIMITS.highest if options.heights else DEM_LIMITS.largest,
    )


def read_asc(path: Path, options: ReadOptions) -> Dem:
    """Reads an ESRI ASCII grid; see `read_dem`."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except UnicodeDecodeError:
        raise UserError(f"{path}: the file is not text; give an ESRI ASCII grid.") from None
    header, body = _header(path, lines)
    rows, cols = (_count(path, header, key) for key in ("nrows", "ncols"))
    require_size(str(path), rows, cols)
    try:
        # Line breaks mean nothing: writers wrap rows at any width.
        numbers = np.array(plain_digits(" ".join(body)).split(), np.float64)
    except ValueError as error:
        raise UserError(f"{path}: heights hold something else than numbers ({error}); repair the file.") from None
    if np.isinf(numbers).any():  # NaN is a hole; what is too large for a number is a slip
        raise bad_input(path, "heights", f"{numbers[np.isinf(numbers)][0]}", "is not finite", "repair the file")
    if numbers.size != rows * cols:
        raise bad_input(
            path, "heights", f"{numbers.size} numbers", f"are not nrows x ncols = {rows} x {cols}", "repair the file"
        )
    heights = numbers.reshape(rows, cols)
    heights[heights == header.get("nodata_value", -9999.0)] = np.nan
    heights, undeclared = undeclared_nodata(heights, str(path))
    cell = _asc_cell(path, header)
    # A corner lies half a cell outside the first node's centre.
    x0 = header.get("xllcenter", header.get("xllcorner", 0.0) + cell / 2)
    y0 = header.get("yllcenter", header.get("yllcorner", 0.0) + cell / 2)
    return grid(heights, cell, x0, y0, str(path), undeclared, options)


def _header(path: Path, lines: list[str]) -> tuple[dict[str, float], list[str]]:
    header: dict[str, float] = {}
    for k, line in enumerate(lines):
        words = line.split()
        if len(words) != 2 or not words[0][0].isalpha() or words[0].lower() in ("nan", "inf"):
            return header, lines[k:]
        key = words[0].lower()
        if key in header:
            raise bad_input(path, key, words[1], "stands twice in the header", "keep one of them")
        # NaN is a legal mark of nodata and of nothing else.
        if key == "nodata_value":
            header[key] = math.nan if words[1].lower() == "nan" else require_finite(path, words[0], words[1])
        else:
            header[key] = require_within(path, words[0], words[1], -DEM_LIMITS.farthest, DEM_LIMITS.farthest)
    return header, []


def _count(path: Path, header: dict[str, float], key: str) -> int:
    value = header.get(key)
    if value is None or not math.isfinite(value) or value < 1 or value != int(value):
        raise bad_input(path, key, value, "is not a positive whole number", "repair the header")
    return int(value)


def _asc_cell(path: Path, header: dict[str, float]) -> float:
    if "cellsize" in header:
        return require_cell(str(path), "cellsize", header["cellsize"])
    dx, dy = header.get("dx"), header.get("dy")
    if dx is None or dy is None:
        raise bad_input(path, "cellsize", None, "is not in the header", "repair the header")
    if abs(dx - dy) > 1e-6 * abs(dx):
        raise bad_input(path, "dx, dy", f"{dx:g}, {dy:g}", "are not equal", "resample it to square cells")
    return require_cell(str(path), "dx", dx)
