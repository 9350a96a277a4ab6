"""Random changes to training images that their matches follow exactly.

All geometry of an image, resizing included, is one affine transform `out_from_in` of pixel coordinates: the image is
warped once and match coordinates are multiplied by the same matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from numpy.random import Generator


@dataclass(frozen=True)
class AugmentSettings:
    """How far images are changed; zero leaves that property alone.

    Args:
        zoom: smallest and largest magnification, drawn evenly in its logarithm. 2 shows a crop of half the image's
            height and width; below 1, the image is smaller and padded.
        rotation: largest angle either way, radians; each image of a pair is turned on its own.
        flip: probability that both images of a pair are mirrored. Mirrored alone, an image would show another object.
        background: probability that everything off the objects is painted over.
        brightness, contrast, saturation: largest relative change, as a logarithm.
        hue: largest turn of the colour wheel, radians.
        noise: largest standard deviation of pixel noise, grey levels.
        blur: largest standard deviation of a Gaussian blur, pixels.
    """

    zoom: tuple[float, float] = (1.0, 2.0)
    rotation: float = np.pi
    flip: float = 0.5
    background: float = 0.5
    brightness: float = 0.3
    contrast: float = 0.3
    saturation: float = 0.3
    hue: float = 0.1
    noise: float = 4.0
    blur: float = 0.0


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
    magnification = np.exp(rng.uniform(*np.log(settings.zoom)))
    fit = magnification * min(out_size[0] / size[0], out_size[1] / size[1])
    angle = rng.uniform(-settings.rotation, settings.rotation)
    cosine, sine = np.cos(angle), np.sin(angle)
    linear = fit * np.array([[cosine, -sine], [sine, cosine]]) @ np.diag([-1.0 if flipped else 1.0, 1.0])
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


def fitting_affine(size: tuple[int, int], out_size: tuple[int, int]) -> Float[ndarray, "2 3"]:
    """Mere resizing from `size` to `out_size`, edge to edge, as a transform of pixel coordinates."""
    factor = np.array([out_size[1] / size[1], out_size[0] / size[0]])
    return np.column_stack([np.diag(factor), 0.5 * factor - 0.5])


def moved(out_from_in: Float[ndarray, "2 3"], uv: Float[ndarray, "m 2"]) -> Float[ndarray, "m 2"]:
    """Pixels of the image as pixels of the warped image."""
    return (uv @ out_from_in[:, :2].T + out_from_in[:, 2]).astype(uv.dtype)


def warped(
    image: UInt8[ndarray, "h w *c"], out_from_in: Float[ndarray, "2 3"], size: tuple[int, int], smooth: bool
) -> UInt8[ndarray, "h2 w2 *c"]:
    """The image moved by `out_from_in`; zero where it has no source.

    Args:
        smooth: bilinear; labels need the nearest pixel instead.
    """
    interpolation = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
    return cv2.warpAffine(image, out_from_in, (size[1], size[0]), flags=interpolation)


def recoloured(rgb: UInt8[ndarray, "h w 3"], settings: AugmentSettings, rng: Generator) -> UInt8[ndarray, "h w 3"]:
    """The image in another light: brightness, contrast, colour, blur and noise."""
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
    # Contrast pivots on the image's own mean, so that dark images do not just turn black.
    mean = float(rgb.mean()) * brightness
    matrix = np.column_stack([contrast * gain[:, None] * mix, np.full(3, mean * (1 - contrast))])
    changed = cv2.transform(rgb, matrix)
    sigma = rng.uniform(0, settings.blur) if settings.blur else 0.0
    if sigma > 0.3:
        changed = cv2.GaussianBlur(changed, (0, 0), sigma)
    if settings.noise:
        deviation = rng.uniform(0, settings.noise)
        grain = rng.standard_normal(changed.shape, dtype=np.float32) * np.float32(deviation)
        changed = np.clip(np.rint(changed + grain), 0, 255).astype(np.uint8)
    return changed


def painted_over(
    rgb: UInt8[ndarray, "h w 3"],
    kept: Bool[ndarray, "h w"],
    other: UInt8[ndarray, "h w 3"],
    rng: Generator,
) -> UInt8[ndarray, "h w 3"]:
    """The image with everything off `kept` replaced: clouds of colour, stripes, noise, or another image.

    Args:
        other: an image to take the background from; its parts are shuffled, so that no object stays whole in it.
    """
    height, width = kept.shape
    style = rng.integers(4)
    if style == 0:
        ground = np.broadcast_to(rng.integers(0, 256, 3), rgb.shape).astype(np.uint8)
    elif style == 1:
        coarse = rng.integers(0, 256, (*rng.integers(2, 12, 2), 3), dtype=np.uint8)
        ground = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    elif style == 2:
        coarse = rng.integers(0, 256, (*rng.integers(2, 40, 2), 3), dtype=np.uint8)
        ground = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)
    else:
        shift = (int(rng.integers(height)), int(rng.integers(width)))
        ground = np.roll(other, shift, axis=(0, 1))[:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
    if style < 3 and rng.random() < 0.5:
        grain = rng.standard_normal(rgb.shape, dtype=np.float32) * np.float32(rng.uniform(0, 40))
        ground = np.clip(ground + grain, 0, 255).astype(np.uint8)
    return np.where(kept[..., None], rgb, ground)
