"""What an object looks like, as a vector: features of a network trained on ImageNet, pooled over its pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from bask_data.nn.backbones import named
from bask_data.nn.efficientnet import LEVELS, DenseEfficientNet
from bask_data.nn.weights import load_weights, read_weights

CROP = 128
"""Edge of the square that an object is resized to, pixels. Sensitivity not measured."""
MARGIN = 0.1
"""Share of the object's size left around it. Chosen, sensitivity not measured."""
OFF_OBJECT = 127
"""Value of the pixels off the object, the mean that the weights were trained with: the surroundings differ between
scans."""
POOLED = (1, 2, 3, 4)
"""Levels of the encoder that are pooled: strides 4 to 16. Chosen, sensitivity not measured."""
BATCH = 32
"""Crops that the network computes at once. Does not change the result."""


class Appearance:
    """Vectors of the appearance of crops."""

    def __init__(self) -> None:
        backbone = named("efficientnet-lite0")
        assert backbone.weights is not None
        encoder = DenseEfficientNet(1)
        load_weights(encoder, backbone.renamed(read_weights(backbone.weights())), backbone.ignored)
        self._encoder = encoder.eval()
        self._mean, self._std = torch.tensor(backbone.mean) * 255.0, torch.tensor(backbone.std) * 255.0

    @torch.inference_mode()
    def __call__(self, crops: Sequence[tuple[UInt8[ndarray, "h w 3"], Bool[ndarray, "h w"]]]) -> Float[ndarray, "n d"]:
        """One vector of unit norm for each crop and its mask, of `squared`'s size."""
        vectors = [
            self._vectors(
                np.stack([rgb for rgb, _ in crops[first : first + BATCH]]),
                np.stack([mask for _, mask in crops[first : first + BATCH]]),
            )
            for first in range(0, len(crops), BATCH)
        ]
        return np.concatenate(vectors)

    def _vectors(self, rgb: UInt8[ndarray, "n h w 3"], mask: Bool[ndarray, "n h w"]) -> Float[ndarray, "n d"]:
        images = ((torch.from_numpy(rgb).float() - self._mean) / self._std).permute(0, 3, 1, 2)
        weights = torch.from_numpy(mask).float()[:, None]
        outputs, pooled = self._encoder.features(images), []
        for level in POOLED:
            x = outputs[LEVELS[level][0]]
            share = F.adaptive_avg_pool2d(weights, (x.shape[-2], x.shape[-1]))
            total = share.sum((2, 3)).clamp_min(1e-6)
            mean = (x * share).sum((2, 3)) / total
            spread = ((x - mean[:, :, None, None]) ** 2 * share).sum((2, 3)) / total
            # Each level has the same weight, whatever its number of channels and the scale of its activations.
            pooled += [F.normalize(mean, dim=1), F.normalize(spread.sqrt(), dim=1)]
        return F.normalize(torch.cat(pooled, dim=1), dim=1).numpy().astype(np.float64)


def squared(
    rgb: UInt8[ndarray, "h w 3"], mask: Bool[ndarray, "h w"], size: int = CROP
) -> tuple[UInt8[ndarray, "s s 3"], Bool[ndarray, "s s"]]:
    """An object cut out with its surroundings in grey, in a square, and its mask there.

    Raises:
        ValueError: the mask is empty.
    """
    import cv2

    if not mask.any():
        raise ValueError("expected a mask with pixels, got an empty one")
    v, u = np.nonzero(mask)
    edge = (1 + 2 * MARGIN) * max(np.ptp(v) + 1, np.ptp(u) + 1)
    scale = size / edge
    offset = (size - 1) / 2 - scale * np.array([(u.min() + u.max()) / 2, (v.min() + v.max()) / 2])
    crop_from_image = np.array([[scale, 0, offset[0]], [0, scale, offset[1]]])
    alone = np.where(mask[:, :, None], rgb, np.uint8(OFF_OBJECT))
    crop = cv2.warpAffine(alone, crop_from_image, (size, size), flags=cv2.INTER_LINEAR, borderValue=(OFF_OBJECT,) * 3)
    shown = cv2.warpAffine(mask.astype(np.uint8), crop_from_image, (size, size), flags=cv2.INTER_NEAREST)
    return crop, shown > 0
