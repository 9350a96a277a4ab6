"""Augmentation of colours and backgrounds."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray
from numpy.random import Generator

from bask_data.nn.augment import AugmentSettings, Layer, Look

GRAIN = 1 << 21
"""Size of the table of normal numbers that all noise is read from: drawing new numbers for each view would cost more
than the rest of it. Two million are ten images of 256x256 pixels and three channels. Another size gives other noise and
thus other weights."""


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
