"""Procedural textures: smooth noise in two colours with shapes, so that every spot is distinctive."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

Faces = UInt8[ndarray, "6 f f 3"]
"""The faces of a cube texture: +x, -x, +y, -y, +z, -z."""

FACE = 160
"""Edge of a face of an object's texture, pixels. Chosen."""

N_SHAPES = 14
"""Shapes painted on a face. Chosen."""


def colour(hue: float, saturation: float, value: float) -> Float[ndarray, "3"]:
    """RGB in [0, 255]."""
    return 255 * np.array(colorsys.hsv_to_rgb(hue % 1.0, min(saturation, 1.0), min(value, 1.0)))


def smooth_noise(rng: np.random.Generator, height: int, width: int, cells: tuple[int, ...]) -> Float[ndarray, "h w"]:
    """Noise in [0, 1] with several octaves, each half as strong as the one before.

    Args:
        cells: number of cells along the longer edge, for each octave.
    """
    noise = np.zeros((height, width))
    for i_octave, n_cells in enumerate(cells):
        shape = (max(2, n_cells * height // max(height, width)), max(2, n_cells * width // max(height, width)))
        noise += cv2.resize(rng.random(shape), (width, height), interpolation=cv2.INTER_CUBIC) / 2**i_octave
    low, high = noise.min(), noise.max()
    return (noise - low) / max(high - low, 1e-9)


def object_faces(rng: np.random.Generator, hue: float, saturation: float, value: float) -> UInt8[ndarray, "6 f f 3"]:
    """The six faces of an object's cube texture, around one main colour."""
    return np.stack([_face(rng, hue, saturation, value) for _ in range(6)])


def symmetric_faces(rng: np.random.Generator, hue: float, saturation: float, value: float) -> UInt8[ndarray, "6 f f 3"]:
    """Faces that are invariant to rotation about z: rings on top and bottom, plain sides."""
    middle = (FACE - 1) / 2
    radius = np.hypot(*(np.mgrid[:FACE, :FACE] - middle)) / middle
    profile = smooth_noise(rng, 2, FACE, (5, 14))[0]
    shade = np.interp(radius, np.linspace(0, 1.5, FACE), profile)[..., None]
    dark, light = colour(hue - 0.02, saturation * 1.1, value * 0.5), colour(hue + 0.02, saturation * 0.7, value * 1.05)
    rings = (dark * (1 - shade) + light * shade).clip(0, 255).astype(np.uint8)
    plain = np.broadcast_to(colour(hue, saturation, value * 0.8).astype(np.uint8), rings.shape)
    return np.stack([plain, plain, plain, plain, rings, rings])


def _face(rng: np.random.Generator, hue: float, saturation: float, value: float) -> UInt8[ndarray, "f f 3"]:
    noise = smooth_noise(rng, FACE, FACE, (4, 9, 20, 48))[..., None]
    dark = colour(hue + rng.uniform(-0.03, 0.03), saturation * 1.1, value * 0.55)
    light = colour(hue + rng.uniform(-0.03, 0.03), saturation * 0.8, value * 1.05)
    image = (dark * (1 - noise) + light * noise).clip(0, 255).astype(np.uint8)
    for _ in range(N_SHAPES):
        _add_shape(rng, image, hue, saturation, value)
    return image


def _add_shape(rng: np.random.Generator, image: UInt8[ndarray, "f f 3"], hue: float, s: float, v: float) -> None:
    """Draw a disc, a box, a stripe or a letter in a similar or a contrasting colour."""
    away = rng.uniform(0.2, 0.8) if rng.random() < 0.4 else rng.uniform(-0.12, 0.12)
    # Much darker or lighter than the surroundings: shapes make spots of dark objects distinctive.
    shade = rng.uniform(0.15, 0.5) * v if rng.random() < 0.5 else rng.uniform(0.8, 1.0)
    paint = tuple(colour(hue + away, max(s, 0.25) * rng.uniform(0.4, 1.2), shade).tolist())
    x, y = (int(value) for value in rng.integers(0, FACE, 2))
    extent = int(rng.integers(6, 26))
    kind = int(rng.integers(0, 4))
    if kind == 0:
        cv2.circle(image, (x, y), extent, paint, -1 if rng.random() < 0.5 else 4, cv2.LINE_AA)
    elif kind == 1:
        corners = cv2.boxPoints(((x, y), (2 * extent, extent), float(rng.uniform(0, 180))))
        cv2.fillPoly(image, [corners.astype(np.int32)], paint, cv2.LINE_AA)
    elif kind == 2:
        end = (x + int(rng.integers(-60, 60)), y + int(rng.integers(-60, 60)))
        cv2.line(image, (x, y), end, paint, int(rng.integers(2, 8)), cv2.LINE_AA)
    else:
        letter = chr(int(rng.integers(65, 91)))
        cv2.putText(
            image, letter, (x - extent, y + extent), cv2.FONT_HERSHEY_SIMPLEX, extent / 12, paint, 4, cv2.LINE_AA
        )


def wood(rng: np.random.Generator, size: int) -> UInt8[ndarray, "s s 3"]:
    """A table top of boards with grain along x."""
    hue, n_boards = rng.uniform(0.06, 0.11), 6
    grain = smooth_noise(rng, size, size // 8, (8, 24, 64, 200))
    grain = cv2.resize(grain, (size, size), interpolation=cv2.INTER_CUBIC)
    image = np.empty((size, size, 3))
    for i_board in range(n_boards):
        rows = slice(i_board * size // n_boards, (i_board + 1) * size // n_boards)
        value = rng.uniform(0.62, 0.78)
        dark, light = colour(hue, 0.52, value * 0.72), colour(hue + 0.01, 0.40, value * 1.12)
        moved = np.roll(grain, int(rng.integers(0, size)), axis=1)[rows, :, None]
        image[rows] = dark * (1 - moved) + light * moved
        image[rows.start : rows.start + 2] *= 0.6
    return image.clip(0, 255).astype(np.uint8)


def tiles(rng: np.random.Generator, size: int) -> UInt8[ndarray, "s s 3"]:
    """A floor of stone tiles."""
    noise = smooth_noise(rng, size, size, (8, 32, 96))[..., None]
    image = colour(0.58, 0.12, 0.42) * (1 - noise) + colour(0.56, 0.08, 0.62) * noise
    step = size // 8
    for i in range(8):
        image[i * step : i * step + 3] *= 0.7
        image[:, i * step : i * step + 3] *= 0.7
    return image.clip(0, 255).astype(np.uint8)


def covering(rng: np.random.Generator, size: int) -> UInt8[ndarray, "s s 3"]:
    """A texture for table or floor in random colours: mottled stone, a chequered cloth, or stripes."""
    hue, kind, n_stripes = rng.uniform(), int(rng.integers(0, 3)), int(rng.integers(7, 20))
    noise = smooth_noise(rng, size, size, (6, 20, 60, 160))[..., None]
    dark = colour(hue, rng.uniform(0.2, 0.7), rng.uniform(0.25, 0.5))
    light = colour(hue + rng.uniform(-0.1, 0.1), rng.uniform(0.1, 0.5), rng.uniform(0.65, 0.95))
    along = (np.arange(size) * n_stripes // size) % 2
    across = along[:, None] * np.ones(size) if kind == 1 else (along[:, None] + along) / 2
    share = noise if kind == 0 else 0.3 * noise + 0.7 * across[..., None]
    return (dark * (1 - share) + light * share).clip(0, 255).astype(np.uint8)
