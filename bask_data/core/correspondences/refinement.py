"""The best depth of each pixel, from the fused surface and one image's own measurements."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from bask_data.core.depth import SIGMA_FROM_MAD

SIGNIFICANT = 2.5
"""Standard errors of the mean by which the measurements around must differ from the surface to correct it.
Chosen; its sensitivity is in docs/benchmarks.md."""

MIN_MEASUREMENTS = 3
"""Fewest measurements in the window of 25 pixels to estimate noise from. Chosen, sensitivity not measured."""

TINY = np.float32(1e-12)
"""Square metres; keeps a variance from being zero."""


def refined(
    measured: Float32[ndarray, "h w"], rendered: Float32[ndarray, "h w"], tolerance: tuple[float, float]
) -> tuple[Float32[ndarray, "h w"], Bool[ndarray, "h w"], float]:
    """The best depth of each pixel, from measurement and surface.

    It is the rendered depth plus the mean difference of the measurements around (5 x 5) where that is significant, plus
    a share of the pixel's own difference from that mean: the share of the local variance that noise does not explain,
    little on a noisy sensor and all on an exact one. Where the two contradict, and where nothing was rendered, it is
    the measured depth.

    Args:
        measured: z-depth, metres; 0 means no measurement.
        rendered: z-depth of the fused surface, metres; 0 where there is none or it was not asked for.
        tolerance: (a, b): the two contradict where they differ by more than a + b z metres.

    Returns:
        The depth, metres, 0 unknown; the pixels where measurement and surface contradict, or nothing is measured
        nearby; and the standard deviation of measurements as a share of the tolerance, 0 if there are too few.

    Source of the pixel's own share: Lee 1980, Digital image enhancement and noise filtering by use of local statistics.
    """
    both = (measured > 0) & (rendered > 0)
    difference = np.where(both, measured - rendered, np.float32(0))
    allowed = np.float32(tolerance[0]) + np.float32(tolerance[1]) * measured
    confirms = both & (np.abs(difference) <= allowed)
    difference[~confirms] = 0
    count = np.maximum(_sum_around(confirms.astype(np.float32)), np.float32(1))
    mean = _sum_around(difference) / count
    several = confirms & (count >= MIN_MEASUREMENTS)
    # Deviations from the local mean are noise, whereas the mean itself may be an error of the surface. With n
    # measurements they have n - 1 degrees of freedom. Noise grows with depth as the tolerance does.
    spread = (np.abs(difference - mean) * np.sqrt(count / np.maximum(count - 1, 1)) / allowed)[several]
    share = SIGMA_FROM_MAD * float(np.median(spread)) if len(spread) else 0.0
    noise = np.float32(share) * allowed
    significant = (count >= MIN_MEASUREMENTS) & (np.abs(mean) * np.sqrt(count) > SIGNIFICANT * noise)
    best = np.where(significant, rendered + mean, rendered)
    variance = np.maximum(_sum_around(difference**2) - count * mean**2, 0) / np.maximum(count - 1, 1)
    own = np.where(several, np.maximum(1 - SIGNIFICANT * noise**2 / np.maximum(variance, TINY), 0), np.float32(0))
    best = best + own * (measured - best)
    contradicted = both & ~confirms
    # A hand or gripper without depth hides the surface; a mere gap in the depth of a surface has measurements around.
    supported = (count >= MIN_MEASUREMENTS) & (count > _sum_around(contradicted.astype(np.float32)))
    unsupported = (measured <= 0) & (rendered > 0) & ~supported
    return np.where((rendered > 0) & ~contradicted, best, measured), contradicted | unsupported, share


def _sum_around(image: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    return cv2.boxFilter(image, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
