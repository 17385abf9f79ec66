"""Grey images (PNG) of 8 or 16 bits, with the height of white and the pixel's size given by the user."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from lunar_mjx.errors import UserError, bad_input, require_finite
from lunar_mjx.terrain.dem import Dem, require_cell, require_size
from lunar_mjx.terrain.dequantise import dequantise
from lunar_mjx.terrain.readers.options import WHERE, ReadOptions

_WHITE = {"L": 255, "I;16": 65535, "I;16B": 65535, "I;16L": 65535, "I": 65535}


def read_image(path: Path, options: ReadOptions) -> Dem:
    """Reads a grey image of heights; see `read_dem`."""
    scale = _stated(path, "height_scale", options.height_scale, "the height of white above black in m")
    stated_cell = _stated(path, "cell", options.cell, "the pixel's size in m")
    scale = require_finite(path, "height_scale", scale)
    if scale <= 0:
        raise bad_input(path, "height_scale", scale, "is not positive", "give the height of white above black in m")
    cell = require_cell(str(path), "cell", stated_cell)
    levels, white = _levels(path)
    heights = levels * (scale / white)
    notes: tuple[str, ...] = ()
    if options.dequantise:
        heights = dequantise(heights, scale / white)
        notes = (f"grey levels of {scale / white:.3g} m smoothed within half a level",)
    return Dem(heights[::-1], cell, 0.0, 0.0, str(path), "black of the image", notes)


def _stated(path: Path, field: str, value: float | None, meaning: str) -> float:
    if value is None:
        raise bad_input(path, field, None, "leaves the image without a scale", f"{WHERE}, {meaning}")
    return value


def _levels(path: Path) -> tuple[np.ndarray, int]:
    try:
        with warnings.catch_warnings():
            # Pillow only warns of images that unpack to gigabytes; here that is refused.
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                require_size(str(path), image.height, image.width)
                image.verify()  # its checksums, which reading the pixels passes over; the file is then used up
            with Image.open(path) as image:
                mode = image.mode
                if mode not in _WHITE:
                    raise bad_input(
                        path,
                        "mode",
                        mode,
                        "is not grey of 8 or 16 bits",
                        "save it as a grey image without transparency",
                    )
                # Black is 0 whatever the darkest pixel: stretching would change the scale from image to image.
                return np.asarray(image, np.float64), _WHITE[mode]
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise UserError(f"{path}: the image cannot be read ({error}); fetch the file again.") from None
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise bad_input(path, "size", "huge", "is beyond what an image may be", "crop it") from None
