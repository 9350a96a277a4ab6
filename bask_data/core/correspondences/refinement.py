"""The best depth of each pixel, from the fused surface and one image's own measurements."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from bask_data.core.depth import SIGMA_FROM_MAD

SIGNIFICANT = 2.5
"""The surface is corrected where the measurements around differ from it by so many standard errors of their mean."""

MIN_MEASUREMENTS = 3
"""Measurements in the window of 25 pixels; the spread of fewer says nothing. Sensitivity not measured."""

TINY = np.float32(1e-12)


def refined(
    measured: Float32[ndarray, "h w"], rendered: Float32[ndarray, "h w"], tolerance: tuple[float, float]
) -> tuple[Float32[ndarray, "h w"], Bool[ndarray, "h w"], float]:
    """The best depth of each pixel, metres, 0 unknown; the pixels where measurement and surface contradict, or none is
    measured near; and the standard deviation of measurements, as a share of the tolerance, 0 where there are too few.

    The rendered depth, moved by the mean difference of the measurements around (5 x 5) where that is significant
    against the noise of the frame, and by as much of the pixel's own difference from that mean as its surroundings
    differ more than noise explains: little where the sensor is noisy, all where it is exact. Where the two contradict,
    and where nothing was rendered, the measured one.

    Args:
        rendered: z-depth of the fused surface, metres; 0 where there is none or it was not asked for.

    Source of the second step: Lee 1980, digital image enhancement and noise filtering by use of local statistics.
    """
    both = (measured > 0) & (rendered > 0)
    difference = np.where(both, measured - rendered, np.float32(0))
    allowed = np.float32(tolerance[0]) + np.float32(tolerance[1]) * measured
    confirms = both & (np.abs(difference) <= allowed)
    difference[~confirms] = 0
    count = np.maximum(_sum_around(confirms.astype(np.float32)), np.float32(1))
    mean = _sum_around(difference) / count
    several = confirms & (count >= MIN_MEASUREMENTS)
    # The spread about the local mean is noise; that of the mean itself may be a surface that is off. Of n values a mean
    # leaves only n - 1 free to spread. Noise grows with depth as the tolerance does.
    spread = (np.abs(difference - mean) * np.sqrt(count / np.maximum(count - 1, 1)) / allowed)[several]
    share = SIGMA_FROM_MAD * float(np.median(spread)) if len(spread) else 0.0
    noise = np.float32(share) * allowed
    significant = (count >= MIN_MEASUREMENTS) & (np.abs(mean) * np.sqrt(count) > SIGNIFICANT * noise)
    best = np.where(significant, rendered + mean, rendered)
    variance = np.maximum(_sum_around(difference**2) - count * mean**2, 0) / np.maximum(count - 1, 1)
    own = np.where(several, np.maximum(1 - SIGNIFICANT * noise**2 / np.maximum(variance, TINY), 0), np.float32(0))
    best = best + own * (measured - best)
    contradicted = both & ~confirms
    # What hands and grippers that give no depth hide is not known; a gap in the depth of a surface has it around.
    supported = (count >= MIN_MEASUREMENTS) & (count > _sum_around(contradicted.astype(np.float32)))
    unsupported = (measured <= 0) & (rendered > 0) & ~supported
    return np.where((rendered > 0) & ~contradicted, best, measured), contradicted | unsupported, share


def _sum_around(image: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    return cv2.boxFilter(image, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
