"""Random augmentation of training images, with matches transformed exactly.

All geometry of an image, resizing included, is one affine transform `out_from_in` of pixel coordinates: the image is
warped once and match coordinates are multiplied by the same matrix. The random draw is an `AugmentedView`, a
description of the augmented image; `nn.rendering` computes its pixels, with OpenCV or on a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray
from numpy.random import Generator

GRAIN = 1 << 21
"""Size of the table of normal numbers that all noise is read from: drawing new numbers for each view would cost more
than the rest of it. Two million are ten images of 256x256 pixels and three channels. Another size gives other noise and
thus other weights."""


@dataclass(frozen=True)
class AugmentSettings:
    """Ranges of the augmentation; zero leaves a property unchanged.

    Args:
        zoom: smallest and largest magnification, log-uniform. 2 shows a crop of half the image's height and width;
            below 1, the image is smaller than the view and the rest is filled.
        crop: `resized` crops fill the view, so that objects are magnified. `padded` crops keep their scale and the
            rest of the view is filled: they remove context only. Their height and width are drawn independently, with
            `zoom` as the limit.
        rotation: largest angle in either direction, radians; drawn independently for each image of a pair.
        flip: probability that both images of a pair are mirrored. Mirroring only one would show a different object.
        background: probability that the background is replaced.
        composition: probability that another object is pasted over the images of a pair.
        brightness, contrast, saturation: largest relative change, as a logarithm.
        hue: largest rotation of the hue, radians.
        noise: largest standard deviation of pixel noise, grey levels.
        blur: largest standard deviation of a Gaussian blur, pixels.
    """

    zoom: tuple[float, float] = (1.0, 2.0)
    crop: Literal["resized", "padded"] = "resized"
    rotation: float = np.pi
    flip: float = 0.5
    background: float = 0.5
    composition: float = 0.0
    brightness: float = 0.3
    contrast: float = 0.3
    saturation: float = 0.3
    hue: float = 0.1
    noise: float = 4.0
    blur: float = 0.0


@dataclass(frozen=True)
class Layer:
    """A picture placed in a view, extended by reflection beyond its edges."""

    picture: UInt8[ndarray, "h w 3"]
    out_from_picture: Float[ndarray, "2 3"]
    shown: Bool[ndarray, "h2 w2"] | None = None
    """Pixels of the view in which the layer covers those below; None: all."""


@dataclass(frozen=True)
class Look:
    """Photometric changes of a view, applied in this order.

    Args:
        matrix: changed = matrix @ (r, g, b, 1), clipped to 0..255.
        blur: standard deviation of a Gaussian, pixels; 0 for none.
        noise: standard deviation, grey levels.
        grain: index in the noise table at which the view's noise starts.
    """

    matrix: Float[ndarray, "3 4"]
    blur: float
    noise: float
    grain: int


@dataclass(frozen=True)
class AugmentedView:
    """An augmented image before rendering: layers, bottom first (the bottom one covers the whole view), and a look."""

    size: tuple[int, int]
    layers: tuple[Layer, ...]
    look: Look


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


def layer(
    picture: UInt8[ndarray, "h w 3"],
    out_from_picture: Float[ndarray, "2 3"],
    shown: Bool[ndarray, "h2 w2"] | None = None,
) -> Layer:
    """A placed picture, halved repeatedly first if it is shown at half its size or less.

    Bilinear interpolation alone would skip pixels, and fine texture would alias.
    """
    while np.sqrt(abs(np.linalg.det(out_from_picture[:, :2]))) < 0.51 and min(picture.shape[:2]) > 1:
        rows, columns = picture.shape[0] // 2, picture.shape[1] // 2
        picture = cv2.resize(picture[: 2 * rows, : 2 * columns], (columns, rows), interpolation=cv2.INTER_AREA)
        linear = out_from_picture[:, :2]
        # Pixel i of the halved image covers pixels 2 i and 2 i + 1: its centre is at 2 i + 0.5.
        out_from_picture = np.column_stack([2 * linear, out_from_picture[:, 2] + linear.sum(axis=1) / 2])
    return Layer(picture, out_from_picture, shown)


def random_look(rgb: UInt8[ndarray, "h w 3"], settings: AugmentSettings, rng: Generator) -> Look:
    """Random brightness, contrast, colour, blur and noise for an image."""
    saturation, brightness, contrast = np.exp(
        rng.uniform(-1, 1, 3) * [settings.saturation, settings.brightness, settings.contrast]
    )
    angle = rng.uniform(-settings.hue, settings.hue)
    # Rotation about the grey axis changes the hue, mixing with the grey value the saturation.
    axis = np.full(3, 1 / np.sqrt(3))
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    mix = saturation * turn + (1 - saturation) / 3
    gain = brightness * np.exp(rng.uniform(-1, 1, 3) * 0.2 * settings.brightness)
    # Contrast pivots on the image's own mean, or dark images would turn black; computed from every fourth pixel.
    mean = float(rgb[::4, ::4].mean()) * brightness
    blur, noise = rng.uniform(0, [settings.blur, settings.noise])
    return Look(
        matrix=np.column_stack([contrast * gain[:, None] * mix, np.full(3, mean * (1 - contrast))]),
        blur=blur if blur > 0.3 else 0.0,
        noise=noise,
        grain=int(rng.integers(GRAIN)),
    )


def random_ground(
    size: tuple[int, int], picture: UInt8[ndarray, "h w 3"], labels: UInt8[ndarray, "h w"], rng: Generator
) -> Layer:
    """A random background for a view: one colour, clouds, checks, or tiles of a picture; rotated, and often noisy.

    Args:
        labels: instances in the picture. No tile contains any of them: filled pixels count as background.
    """
    height, width = size
    style = rng.integers(4)
    if style == 0:
        ground = np.broadcast_to(rng.integers(0, 256, 3, dtype=np.uint8), (*size, 3))
    elif style == 3:
        ground = _pieced(
            cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA),
            cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST) > 0,
            rng,
        )
    else:
        coarse = rng.integers(0, 256, (*rng.integers(2, 12 if style == 1 else 40, 2), 3), dtype=np.uint8)
        interpolation = cv2.INTER_CUBIC if style == 1 else cv2.INTER_NEAREST
        ground = cv2.resize(coarse, (width, height), interpolation=interpolation)
    if style < 3 and rng.random() < 0.5:
        noise = rng.uniform(0, 40) * grain_of(ground.shape, int(rng.integers(GRAIN)))
        ground = np.clip(ground + noise, 0, 255).astype(np.uint8)
    angle, magnification = rng.uniform(-np.pi, np.pi), rng.uniform(1.0, 1.5)
    centre = (np.array([width, height]) - 1) / 2
    linear = magnification * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return Layer(np.ascontiguousarray(ground), np.column_stack([linear, centre - linear @ centre]))


@cache
def grain() -> Float32[ndarray, "n"]:
    """The noise table: standard normal numbers, the same in every process."""
    table = np.random.default_rng(0).standard_normal(GRAIN, dtype=np.float32)
    table.setflags(write=False)
    return table


def grain_of(shape: tuple[int, ...], first: int) -> Float32[ndarray, "*shape"]:
    """Noise of a shape, read from the table starting at index `first` and wrapping around at its end."""
    n = int(np.prod(shape))
    if first + n <= GRAIN:
        return grain()[first : first + n].reshape(shape)
    return np.take(grain(), np.arange(first, first + n), mode="wrap").reshape(shape)


def _pieced(picture: UInt8[ndarray, "h w 3"], objects: Bool[ndarray, "h w"], rng: Generator) -> UInt8[ndarray, "h w 3"]:
    """A picture assembled from random tiles without objects of another picture; grey if no such tile exists."""
    n = int(rng.integers(4, 13))
    shape = picture.shape
    height, width = -(-shape[0] // n), -(-shape[1] // n)
    occupied = _tiles(objects, n, height, width).reshape(n * n, -1).any(axis=1)
    tiles = _tiles(picture, n, height, width)[~occupied]
    if len(tiles) == 0:
        return np.full(shape, 128, np.uint8)
    placed = tiles[rng.integers(len(tiles), size=n * n)].reshape(n, n, height, width, 3)
    return placed.swapaxes(1, 2).reshape(n * height, n * width, 3)[: shape[0], : shape[1]]


def _tiles(image: ndarray, n: int, height: int, width: int) -> ndarray:
    """n x n tiles that cover an image, row by row; the last of each row and column overlap their neighbours."""
    rows = np.minimum(np.arange(n) * height, image.shape[0] - height)
    columns = np.minimum(np.arange(n) * width, image.shape[1] - width)
    return np.stack([image[v : v + height, u : u + width] for v in rows for u in columns])
