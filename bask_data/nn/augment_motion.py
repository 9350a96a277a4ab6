"""Augmentation in the image plane: scale, rotation, flip and crop, of images, masks and match coordinates together."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from numpy.random import Generator

from bask_data.nn.augment import AugmentSettings


def random_linear(
    size: tuple[int, int], out_size: tuple[int, int], flipped: bool, settings: AugmentSettings, rng: Generator
) -> Float[ndarray, "2 2"]:
    """Magnification, rotation and mirroring of an image of `size` in a frame of `out_size`, both (height, width)."""
    magnification = np.exp(rng.uniform(*np.log(settings.zoom)))
    if settings.crop == "padded":
        magnification = min(magnification, 1.0)
    fit = magnification * min(out_size[0] / size[0], out_size[1] / size[1])
    angle = rng.uniform(-settings.rotation, settings.rotation)
    cosine, sine = np.cos(angle), np.sin(angle)
    return fit * np.array([[cosine, -sine], [sine, cosine]]) @ np.diag([-1.0 if flipped else 1.0, 1.0])


def random_affine(
    size: tuple[int, int],
    out_size: tuple[int, int],
    anchor: Float[ndarray, "2"],
    flipped: bool,
    settings: AugmentSettings,
    rng: Generator,
) -> Float[ndarray, "2 3"]:
    """A random transform of pixel coordinates from an image to its augmented version, `out_from_in`.

    Args:
        size, out_size: (height, width) of both.
        anchor: pixel (u, v) of the image that stays in view; at zoom 1 without rotation the whole image does.
    """
    linear = random_linear(size, out_size, flipped, settings, rng)
    centre_in = (np.array(size[::-1]) - 1) / 2
    centre_out = (np.array(out_size[::-1]) - 1) / 2
    offset = linear @ (anchor - centre_in)
    # How far the picture may be shifted and still cover the view; a picture smaller than the view is padded.
    spare = np.maximum(np.abs(linear) @ (np.array(size[::-1]) / 2) - np.array(out_size[::-1]) / 2, 0.0)
    lowest, highest = -spare, spare
    # The anchor must land inside: centre + offset + move in [margin, size - 1 - margin].
    margin = 0.1 * np.array(out_size[::-1])
    lowest = np.maximum(lowest, margin - centre_out - offset)
    highest = np.minimum(highest, centre_out - margin - offset)
    middle = np.clip(0.0, np.minimum(lowest, highest), np.maximum(lowest, highest))
    low, high = np.where(lowest <= highest, lowest, middle), np.where(lowest <= highest, highest, middle)
    # If covering the view and showing the anchor conflict, the anchor wins.
    move = np.clip(rng.uniform(low, high), -centre_out - offset + 1, centre_out - offset - 1)
    return np.column_stack([linear, centre_out + move - linear @ centre_in])


def pasting_affine(
    mask: Bool[ndarray, "h w"], out_size: tuple[int, int], flipped: bool, settings: AugmentSettings, rng: Generator
) -> Float[ndarray, "2 3"]:
    """A random transform that takes the centre of a mask anywhere into the view; zoom and rotation as for images."""
    linear = random_linear(mask.shape, out_size, flipped, settings, rng)
    moments = cv2.moments(mask.view(np.uint8), binaryImage=True)
    centre = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    target = rng.uniform(0, np.array(out_size[::-1]) - 1)
    return np.column_stack([linear, target - linear @ centre])


def random_window(
    size: tuple[int, int], anchor: Float[ndarray, "2"], settings: AugmentSettings, rng: Generator
) -> tuple[slice, slice]:
    """Rows and columns of a `padded` crop of random size that contains the anchor (u, v)."""
    smallest = 1 / max(settings.zoom[1], 1.0)
    window = []
    for length, position in zip(size, anchor[::-1], strict=True):
        kept = min(max(round(length * np.exp(rng.uniform(np.log(smallest), 0))), 1), length)
        pixel = min(max(round(float(position)), 0), length - 1)
        first = int(rng.integers(max(0, pixel - kept + 1), min(pixel, length - kept) + 1))
        window.append(slice(first, first + kept))
    return window[0], window[1]


def moved(out_from_in: Float[ndarray, "2 3"], uv: Float[ndarray, "m 2"]) -> Float[ndarray, "m 2"]:
    """Pixels (u, v) of the image in coordinates of the warped image."""
    return (uv @ out_from_in[:, :2].T + out_from_in[:, 2]).astype(uv.dtype)


def warped_labels(
    labels: UInt8[ndarray, "h w"], out_from_in: Float[ndarray, "2 3"], size: tuple[int, int]
) -> UInt8[ndarray, "h2 w2"]:
    """Labels warped by `out_from_in` with nearest neighbour; zero outside the source."""
    return cv2.warpAffine(labels, out_from_in, (size[1], size[0]), flags=cv2.INTER_NEAREST)


def covered(
    in_size: tuple[int, int], out_from_in: Float[ndarray, "2 3"], size: tuple[int, int]
) -> Bool[ndarray, "h2 w2"] | None:
    """Pixels of a view that lie inside the image; None: all."""
    in_from_out = np.linalg.inv(np.vstack([out_from_in, [0, 0, 1]]))[:2]
    corners = moved(
        in_from_out, np.array([[0.0, 0.0], [0.0, size[0] - 1], [size[1] - 1, 0.0], [size[1] - 1, size[0] - 1]])
    )
    if (corners >= -0.5).all() and (corners <= np.array(in_size[::-1]) - 0.5).all():
        return None
    return warped_labels(np.full(in_size, 1, np.uint8), out_from_in, size) > 0
