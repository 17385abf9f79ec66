"""PDS3 images: a raw array (.img) and the label that describes it, detached (.lbl) or at the head of the same file.

Keywords as in the PDS3 Standards Reference and the LOLA gridded products: `height = DN * SCALING_FACTOR + OFFSET` in
the label's UNIT. The OFFSET of LOLA products is the radius of the reference sphere; it is left out, so that heights are
above that sphere.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.terrain.dem import Dem, fill_holes, require_cell, require_size, undeclared_nodata
from lunar_mjx.terrain.readers.options import ReadOptions

_KINDS = {
    "LSB_INTEGER": "<i",
    "PC_INTEGER": "<i",
    "VAX_INTEGER": "<i",
    "MSB_INTEGER": ">i",
    "INTEGER": ">i",
    "SUN_INTEGER": ">i",
    "MAC_INTEGER": ">i",
    "LSB_UNSIGNED_INTEGER": "<u",
    "PC_UNSIGNED_INTEGER": "<u",
    "MSB_UNSIGNED_INTEGER": ">u",
    "UNSIGNED_INTEGER": ">u",
    "PC_REAL": "<f",
    "IEEE_REAL": ">f",
    "REAL": ">f",
    "SUN_REAL": ">f",
    "FLOAT": ">f",
}
_LENGTHS = {"M": 1.0, "METER": 1.0, "METERS": 1.0, "KM": 1e3, "KILOMETER": 1e3, "KILOMETERS": 1e3}
_PAIR = re.compile(r"^\s*(\^?[A-Z][A-Z0-9_:]*)\s*=\s*(.*)$")
_MOST_LABEL_BYTES = 1 << 20
"""Bytes of a label that are read: real ones have some kilobytes, and a hostile one must not fill the memory."""

Label = dict[str, str]


def read_pds(path: Path, options: ReadOptions) -> Dem:
    """Reads a PDS3 image of heights; see `read_dem`."""
    image, label_path, label = _find(path)
    rows, cols = (_integer(label_path, label, key) for key in ("LINES", "LINE_SAMPLES"))
    require_size(str(image), rows, cols)
    data = _samples(image, label_path, label, rows, cols)
    heights = data.astype(np.float64)
    heights[_missing(data, label_path, label)] = np.nan
    heights, undeclared = undeclared_nodata(heights, str(image))
    unit = _length(label_path, "UNIT", label.get("UNIT", "METER"))
    offset = _number(label_path, label, "OFFSET", 0.0) * unit
    radius = _number(label_path, label, "A_AXIS_RADIUS", 0.0) * 1e3
    reference = "as in the source"
    # Within a metre: labels round the sphere's radius.
    if radius > 0 and abs(offset - radius) < 1.0:
        offset, reference = 0.0, f"sphere of radius {radius:.0f} m"
    heights = heights * (_number(label_path, label, "SCALING_FACTOR", 1.0) * unit) + offset
    heights, notes = fill_holes(heights, str(image))
    notes = undeclared + notes
    cell = _cell(label_path, label, options)
    # The projection's centre lies at these pixel coordinates (1-based centres shifted by 1, PDS3 Standards Reference).
    column = _number(label_path, label, "SAMPLE_PROJECTION_OFFSET", 0.0)
    line = _number(label_path, label, "LINE_PROJECTION_OFFSET", float(rows - 1))
    # Lines count southward from the top, y northward from the bottom line.
    x0, y0 = -column * cell, (line - (rows - 1)) * cell
    return Dem(heights[::-1], cell, x0, y0, str(image), reference, notes)


def _find(path: Path) -> tuple[Path, Path, Label]:
    """The image, the file that holds its label, and the label."""
    if path.suffix.lower() == ".lbl":
        label = _parse(path)
        name = re.search(r'"?([^"(),\s]+\.[A-Za-z]+)"?', label.get("^IMAGE", ""))
        image = _beside(path, [name.group(1)] if name else [path.stem + s for s in (".IMG", ".img")])
        if image is None:
            raise bad_input(path, "^IMAGE", label.get("^IMAGE"), "is not beside the label", "put it there")
        return image, path, label
    with path.open("rb") as file:
        # By what the file begins with: the suffix .img says nothing about where the label is.
        attached = file.read(64).lstrip().startswith((b"PDS_VERSION_ID", b"ODL_VERSION_ID", b"CCSD"))
    if attached:
        return path, path, _parse(path)
    label_path = _beside(path, [path.stem + s for s in (".LBL", ".lbl", ".Lbl")])
    if label_path is None:
        raise UserError(f"{path}: the label {path.stem}.LBL is not beside the image; fetch it from the same place.")
    return path, label_path, _parse(label_path)


def _beside(path: Path, names: list[str]) -> Path | None:
    # Only the last part of a name from a label counts: a label shall not lead to files elsewhere.
    wanted = {Path(name.replace("\\", "/")).name.lower() for name in names}
    return next((p for p in sorted(path.parent.iterdir()) if p.name.lower() in wanted and p.is_file()), None)


def _parse(path: Path) -> Label:
    """Keywords of a label; those of the IMAGE object and the map projection are unique in the products read here."""
    with path.open("rb") as file:
        text = file.read(_MOST_LABEL_BYTES).decode("latin-1")
    label: Label = {}
    for line in text.splitlines():
        if line.strip() == "END":
            break
        pair = _PAIR.match(line)
        if pair:
            key, value = pair.groups()
            # The first of a key counts: later objects of a label repeat some.
            label.setdefault(key, value.split("/*")[0].strip().strip('"'))
    if "LINES" not in label:
        raise bad_input(path, "LINES", None, "is not in the label", "give the PDS3 label of an image")
    return label


def _samples(image: Path, label_path: Path, label: Label, rows: int, cols: int) -> np.ndarray:
    sample_type, bits = label.get("SAMPLE_TYPE", ""), _integer(label_path, label, "SAMPLE_BITS")
    kind = _KINDS.get(sample_type)
    if kind is None or bits not in (8, 16, 32, 64) or (kind[1] == "f" and bits < 32):
        raise bad_input(
            label_path,
            "SAMPLE_TYPE",
            f"{sample_type} of {bits} bits",
            "is not known",
            "use an integer or IEEE real image",
        )
    if _number(label_path, label, "BANDS", 1.0) != 1:
        raise bad_input(label_path, "BANDS", label["BANDS"], "is not 1", "give an image of heights alone")
    dtype = np.dtype(f"{kind}{bits // 8}")
    start = _start(label_path, label)
    present, needed = image.stat().st_size, start + rows * cols * dtype.itemsize
    if present < needed:
        raise bad_input(
            image,
            "size",
            f"{present} bytes",
            f"is less than the {needed} that {label_path.name} announces",
            "fetch the whole file again",
        )
    # So many samples and no more: images carry tails such as histograms.
    data = np.fromfile(image, dtype, rows * cols, offset=start)
    return data.reshape(rows, cols)


def _start(path: Path, label: Label) -> int:
    """Offset of the first sample in bytes, from a pointer such as `^IMAGE = 12`, `("X.IMG", 2)` or `2049 <BYTES>`."""
    pointer = re.sub(r'"[^"]*"|[A-Za-z0-9_]+\.[A-Za-z]+', "", label.get("^IMAGE", ""))
    number = re.search(r"(\d+)\s*(<\s*BYTES\s*>)?", pointer)
    if number is None:
        return 0
    # Pointers count from 1.
    first = int(number.group(1)) - 1
    return first if number.group(2) else first * _integer(path, label, "RECORD_BYTES")


def _missing(data: np.ndarray, path: Path, label: Label) -> np.ndarray:
    """Samples that carry no height."""
    missing = ~np.isfinite(data) if data.dtype.kind == "f" else np.zeros(data.shape, bool)
    for key in ("MISSING_CONSTANT", "MISSING", "NULL", "CORE_NULL"):
        if key not in label:
            continue
        text = label[key]
        # For reals the constant stands as a bit pattern: as a number it would be another value.
        bits = re.fullmatch(r"16#([0-9A-Fa-f]+)#", text)
        if bits and data.dtype.kind == "f":
            pattern = int(bits.group(1), 16).to_bytes(data.dtype.itemsize, "big")
            constant = np.frombuffer(pattern, data.dtype.newbyteorder(">"))[0]
        else:
            constant = int(bits.group(1), 16) if bits else _number(path, label, key)
        missing |= data == data.dtype.type(constant)
    return missing


def _cell(path: Path, label: Label, options: ReadOptions) -> float:
    if "MAP_SCALE" not in label:
        if options.cell is None:
            raise bad_input(path, "MAP_SCALE", None, "is not in the label", "give cell = <m>")
        return require_cell(str(path), "cell", options.cell)
    value = _number(path, label, "MAP_SCALE")
    unit = re.search(r"<\s*([A-Za-z]+)\s*/\s*PIX", label["MAP_SCALE"], re.IGNORECASE)
    if unit is not None and unit.group(1).upper().startswith("DEG"):
        raise bad_input(
            path,
            "MAP_SCALE",
            label["MAP_SCALE"],
            "is in degrees",
            "reproject it to metres, such as polar stereographic",
        )
    if label.get("MAP_PROJECTION_TYPE", "").upper() in ("SIMPLE CYLINDRICAL", "SIMPLE_CYLINDRICAL"):
        raise bad_input(
            path,
            "MAP_PROJECTION_TYPE",
            "SIMPLE CYLINDRICAL",
            "is a grid of degrees",
            "reproject it to metres, such as polar stereographic, with gdalwarp",
        )
    # The standard's own unit is km per pixel where a label says none.
    return require_cell(str(path), "MAP_SCALE", value * _length(path, "MAP_SCALE", unit.group(1) if unit else "KM"))


def _length(path: Path, field: str, unit: str) -> float:
    try:
        return _LENGTHS[unit.strip().upper()]
    except KeyError:
        raise bad_input(path, field, unit, "is not a unit of length that is known", "use m or km") from None


def _number(path: Path, label: Label, key: str, default: float | None = None) -> float:
    if key not in label and default is not None:
        return default
    match = re.match(r"[-+]?(\d+\.?\d*|\.\d+)([EeDd][-+]?\d+)?", label.get(key, ""))
    if match is None:
        raise bad_input(path, key, label.get(key), "is not a number", "repair the label")
    return float(match.group(0).upper().replace("D", "E"))


def _integer(path: Path, label: Label, key: str) -> int:
    value = _number(path, label, key)
    if value != int(value) or value < 1:
        raise bad_input(path, key, label[key], "is not a positive whole number", "repair the label")
    return int(value)
