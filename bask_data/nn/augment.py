"""Random augmentation of training images, with matches transformed exactly.

All geometry of an image, resizing included, is one affine transform `out_from_in` of pixel coordinates: the image is
warped once and match coordinates are multiplied by the same matrix. The random draw is an `AugmentedView`, a
description of the augmented image; `nn.rendering` computes its pixels, with OpenCV or on a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray


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
