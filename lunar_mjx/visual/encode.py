"""Writes pictures as a video: mp4 through PyAV, animated WebP and GIF through Pillow."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image

from lunar_mjx.errors import UserError
from lunar_mjx.files import replacing

QUALITY = "20"
"""Constant rate factor of H.264: 18 is visually lossless, 23 the encoder's own default."""


class Sink(Protocol):
    """Takes pictures, (height, width, 3) uint8 of even size."""

    def __call__(self, picture: np.ndarray) -> None: ...


@contextmanager
def writer(path: Path, fps: int) -> Iterator[Sink]:
    """Opens a video; the file is complete when the context ends.

    Raises:
      UserError: mp4 without PyAV.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".mp4":
        with replacing(path) as part:
            yield from _mp4(part, fps)
        return
    # All are kept, since Pillow writes an animation in one go.
    pictures: list[Image.Image] = []
    yield lambda picture: pictures.append(Image.fromarray(picture))
    if pictures:
        # Pillow takes a quality for WebP alone; GIF has a palette in its place.
        options: dict[str, Any] = {"quality": 80} if path.suffix.lower() == ".webp" else {}
        with replacing(path) as part:
            pictures[0].save(
                part, save_all=True, append_images=pictures[1:], loop=0, duration=round(1000 / fps), **options
            )


def require_encoder(path: Path) -> Any:
    """PyAV, where the file needs it.

    Raises:
      UserError: it is not installed.
    """
    if path.suffix.lower() != ".mp4":
        return None
    try:
        import av
    except ImportError:
        raise UserError(
            f"{path}: an mp4 needs the package av; install the extra lunar-mjx[video], or end the name in .webp, .gif."
        ) from None
    return av


def _mp4(path: Path, fps: int) -> Iterator[Sink]:
    av = require_encoder(path)
    with av.open(str(path), "w") as container:
        stream: Any = None

        def put(picture: np.ndarray) -> None:
            nonlocal stream
            # The first picture tells the size.
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps), options={"crf": QUALITY})
                stream.height, stream.width = picture.shape[:2]
                # The format of H.264 that browsers and players decode everywhere.
                stream.pix_fmt = "yuv420p"
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")):
                container.mux(packet)

        yield put
        if stream is not None:
            # An encoder holds pictures back until it is told that none follow.
            for packet in stream.encode():
                container.mux(packet)
