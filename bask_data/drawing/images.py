"""Images scaled and encoded, and depth in colours."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from bask_data.drawing.colours import INVALID


def jpeg_uri(rgb: np.ndarray, quality: int = 80) -> str:
    """The image (h, w, 3) uint8 as a data URI."""
    # Chroma subsampling, the default, blurs thin coloured lines and dots.
    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    done, data = cv2.imencode(".jpg", cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2BGR), options)
    assert done, "OpenCV encodes any 8-bit image"
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def resize(image: np.ndarray, width: int) -> np.ndarray:
    """The image scaled to `width` pixels. Labels and depth must not be averaged: use `resize_labels`."""
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    shrinks = width < image.shape[1]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def resize_labels(labels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Labels or depth resampled to `size` (height, width) by nearest neighbour."""
    return cv2.resize(labels, (size[1], size[0]), interpolation=cv2.INTER_NEAREST_EXACT)


def depth_picture(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth (metres) in colours from blue (near) to red (far); grey where nothing was measured."""
    level = np.clip((depth - near) / max(far - near, 1e-6), 0, 1)
    colours = cv2.cvtColor(cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    colours[depth <= 0] = INVALID
    return colours
