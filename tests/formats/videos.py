"""Small videos with known content."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy import ndarray


def write_video(
    path: Path,
    images: Iterable[ndarray],
    *,
    rate: int = 30,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    options: dict[str, str] | None = None,
    rotation: float = 0.0,
    standard: str = "ITU709",
    full_range: bool = False,
    first: int = 0,
) -> None:
    """Write RGB images (h, w, 3) uint8 as a video.

    Args:
        rotation: degrees by which players are told to turn the picture.
        standard: colour standard, `ITU601` or `ITU709`, stated in the file.
        full_range: whether brightness takes all values, stated in the file.
        first: number of the first frame; players do not show those before 0.
    """
    range_name = "JPEG" if full_range else "MPEG"
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options={"avoid_negative_ts": "disabled"}) as container:
        stream = container.add_stream(codec, rate=rate, options=options or {"crf": "8", "g": "4", "bf": "2"})
        for i, image in enumerate(images):
            if i == 0:
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = pixels
                stream.codec_context.colorspace = {"ITU601": 6, "ITU709": 1}[standard]
                stream.codec_context.color_range = 2 if full_range else 1
                if rotation:
                    stream.set_display_rotation(rotation)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame = frame.reformat(format=pixels, dst_colorspace=standard, dst_color_range=range_name)
            frame.pts, frame.time_base = first + i, Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def plain(grey: int, size: tuple[int, int] = (48, 64)) -> ndarray:
    """An image of one brightness."""
    return np.full((*size, 3), grey, np.uint8)
