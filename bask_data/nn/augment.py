"""Random changes to training images that their matches follow exactly.

All geometry of an image, resizing included, is one affine transform `out_from_in` of pixel coordinates: the image is
warped once and match coordinates are multiplied by the same matrix. What is drawn at random is an `AugmentedView`, a
description of the augmented image; `nn.rendering` makes the pixels of it, with OpenCV or on a GPU.
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
"""Numbers in the table that all noise is cut from: drawing them anew would cost more than the rest of a view. Two
million are ten times an image of 256x256 with its three channels; changes which noise is drawn, and with it the
weights."""


@dataclass(frozen=True)
class AugmentSettings:
    """How far images are changed; zero leaves that property alone.

    Args:
        zoom: smallest and largest magnification, drawn evenly in its logarithm. 2 shows a crop of half the image's
            height and width; below 1, the image is smaller and what it leaves free is painted over.
        crop: `resized` crops fill the frame, so that objects grow. `padded` crops stay as large as they are and the
            rest of the frame is painted over: context goes, scale stays. Their height and width are drawn each on its
            own, and `zoom` says how small they get.
        rotation: largest angle either way, radians; each image of a pair is turned on its own.
        flip: probability that both images of a pair are mirrored. Mirrored alone, an image would show another object.
        background: probability that everything off the objects is painted over.
        composition: probability that another object is pasted over the images of a pair.
        brightness, contrast, saturation: largest relative change, as a logarithm.
        hue: largest turn of the colour wheel, radians.
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
    """A picture placed in a view, mirrored at its edges where it ends."""

    picture: UInt8[ndarray, "h w 3"]
    out_from_picture: Float[ndarray, "2 3"]
    shown: Bool[ndarray, "h2 w2"] | None = None
    """Pixels of the view where it covers the layers below; None: everywhere."""


@dataclass(frozen=True)
class Look:
    """Light and camera of a view, applied in this order.

    Args:
        matrix: changed = matrix @ (r, g, b, 1), clipped to 0..255.
        blur: standard deviation of a Gaussian, pixels; 0 for none.
        noise: standard deviation, grey levels.
        grain: where in the table of noise the view's begins.
    """

    matrix: Float[ndarray, "3 4"]
    blur: float
    noise: float
    grain: int


@dataclass(frozen=True)
class AugmentedView:
    """An augmented image before its pixels are made: layers, the lowest first and everywhere, and a look."""

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
    """A transform of pixel coordinates from an image to its augmented version.

    Args:
        size, out_size: (height, width) of both.
        anchor: pixel that stays in view; at zoom 1 without rotation the whole image is in view in any case.
    """
    linear = random_linear(size, out_size, flipped, settings, rng)
    centre_in = (np.array(size[::-1]) - 1) / 2
    centre_out = (np.array(out_size[::-1]) - 1) / 2
    offset = linear @ (anchor - centre_in)
    # How far the picture may be moved and still cover the view; what it lacks to do so is left to padding.
    spare = np.maximum(np.abs(linear) @ (np.array(size[::-1]) / 2) - np.array(out_size[::-1]) / 2, 0.0)
    lowest, highest = -spare, spare
    # The anchor shall land inside: centre + offset + move in [margin, size - 1 - margin].
    margin = 0.1 * np.array(out_size[::-1])
    lowest = np.maximum(lowest, margin - centre_out - offset)
    highest = np.minimum(highest, centre_out - margin - offset)
    middle = np.clip(0.0, np.minimum(lowest, highest), np.maximum(lowest, highest))
    low, high = np.where(lowest <= highest, lowest, middle), np.where(lowest <= highest, highest, middle)
    # Where covering the view and showing the anchor exclude each other, the anchor wins.
    move = np.clip(rng.uniform(low, high), -centre_out - offset + 1, centre_out - offset - 1)
    return np.column_stack([linear, centre_out + move - linear @ centre_in])


def pasting_affine(
    mask: Bool[ndarray, "h w"], out_size: tuple[int, int], flipped: bool, settings: AugmentSettings, rng: Generator
) -> Float[ndarray, "2 3"]:
    """A transform that brings the middle of a mask anywhere into the view, magnified and turned as images are."""
    linear = random_linear(mask.shape, out_size, flipped, settings, rng)
    moments = cv2.moments(mask.view(np.uint8), binaryImage=True)
    middle = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    target = rng.uniform(0, np.array(out_size[::-1]) - 1)
    return np.column_stack([linear, target - linear @ middle])


def random_window(
    size: tuple[int, int], anchor: Float[ndarray, "2"], settings: AugmentSettings, rng: Generator
) -> tuple[slice, slice]:
    """Rows and columns of a crop of random size that shows the anchor, for crops that are not resized."""
    smallest = 1 / max(settings.zoom[1], 1.0)
    window = []
    for length, at in zip(size, anchor[::-1], strict=True):
        kept = min(max(round(length * np.exp(rng.uniform(np.log(smallest), 0))), 1), length)
        pixel = min(max(round(float(at)), 0), length - 1)
        first = int(rng.integers(max(0, pixel - kept + 1), min(pixel, length - kept) + 1))
        window.append(slice(first, first + kept))
    return window[0], window[1]


def moved(out_from_in: Float[ndarray, "2 3"], uv: Float[ndarray, "m 2"]) -> Float[ndarray, "m 2"]:
    """Pixels of the image as pixels of the warped image."""
    return (uv @ out_from_in[:, :2].T + out_from_in[:, 2]).astype(uv.dtype)


def warped_labels(
    labels: UInt8[ndarray, "h w"], out_from_in: Float[ndarray, "2 3"], size: tuple[int, int]
) -> UInt8[ndarray, "h2 w2"]:
    """Labels moved by `out_from_in`, never mixed; zero where they have no source."""
    return cv2.warpAffine(labels, out_from_in, (size[1], size[0]), flags=cv2.INTER_NEAREST)


def covered(
    in_size: tuple[int, int], out_from_in: Float[ndarray, "2 3"], size: tuple[int, int]
) -> Bool[ndarray, "h2 w2"] | None:
    """Pixels of a view that the image has a source for; None: all."""
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
    """A picture in its place, halved first as often as it is shown at half its size or less.

    Bilinear look-ups alone would skip pixels, and fine texture would turn into grain that no camera sees.
    """
    while np.sqrt(abs(np.linalg.det(out_from_picture[:, :2]))) < 0.51 and min(picture.shape[:2]) > 1:
        rows, columns = picture.shape[0] // 2, picture.shape[1] // 2
        picture = cv2.resize(picture[: 2 * rows, : 2 * columns], (columns, rows), interpolation=cv2.INTER_AREA)
        linear = out_from_picture[:, :2]
        # Pixel i of the half image stands for 2 i and 2 i + 1: its centre is at 2 i + 0.5.
        out_from_picture = np.column_stack([2 * linear, out_from_picture[:, 2] + linear.sum(axis=1) / 2])
    return Layer(picture, out_from_picture, shown)


def random_look(rgb: UInt8[ndarray, "h w 3"], settings: AugmentSettings, rng: Generator) -> Look:
    """Another light for an image: brightness, contrast, colour, blur and noise."""
    saturation, brightness, contrast = np.exp(
        rng.uniform(-1, 1, 3) * [settings.saturation, settings.brightness, settings.contrast]
    )
    angle = rng.uniform(-settings.hue, settings.hue)
    # Rotation about the grey axis turns the hue, mixing with the grey value changes the saturation.
    axis = np.full(3, 1 / np.sqrt(3))
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    mix = saturation * turn + (1 - saturation) / 3
    gain = brightness * np.exp(rng.uniform(-1, 1, 3) * 0.2 * settings.brightness)
    # Contrast pivots on the image's own mean, so that dark images do not just turn black. Every fourth pixel tells it.
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
    """Something to paint over with: one colour, clouds, checks, or pieces of a picture; turned, and often grainy.

    Args:
        labels: instances in the picture. None of them is in a piece: what is painted over counts as background.
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
    """The table of noise: standard normal numbers, the same in every process."""
    table = np.random.default_rng(0).standard_normal(GRAIN, dtype=np.float32)
    table.setflags(write=False)
    return table


def grain_of(shape: tuple[int, ...], first: int) -> Float32[ndarray, "*shape"]:
    """Noise of a shape, read from the table at `first` and from its beginning where it ends."""
    n = int(np.prod(shape))
    if first + n <= GRAIN:
        return grain()[first : first + n].reshape(shape)
    return np.take(grain(), np.arange(first, first + n), mode="wrap").reshape(shape)


def _pieced(picture: UInt8[ndarray, "h w 3"], objects: Bool[ndarray, "h w"], rng: Generator) -> UInt8[ndarray, "h w 3"]:
    """A picture of tiles of another that show no objects; grey if there are none."""
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
    """n x n tiles that cover an image, one after the other; the last ones overlap their neighbours."""
    rows = np.minimum(np.arange(n) * height, image.shape[0] - height)
    columns = np.minimum(np.arange(n) * width, image.shape[1] - width)
    return np.stack([image[v : v + height, u : u + width] for v in rows for u in columns])
