"""Colours of an object's pixels, compared so that another light changes them little."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from scipy.ndimage import gaussian_filter

CHROMA_BINS = 24
"""Bins of the chromaticity histogram per axis. Chosen, sensitivity not measured."""
CHROMA_RANGE = 0.6
"""Opponent colours beyond which pixels fall into the outermost bins; those of a pure primary are 1 and 0.5."""
LIGHTNESS_BINS = 16
"""Bins of the histogram of grey levels. Chosen, sensitivity not measured."""
BLURS = (1.0, 1.5)
"""Standard deviation of the blur of either histogram, bins: that of chromaticity is the shift by a change of 10 %
between two channels. Chosen, sensitivity not measured."""
DIM_PIXEL = 60.0
"""Mean grey level below which a pixel's chromaticity counts less, in proportion: it is noise and quantisation. Chosen,
sensitivity not measured."""
LIGHT_DISCOUNT = 2.0
"""How much a difference in lightness lessens one in chromaticity: the light that changes the one changes the other, as
do pixels that are saturated. Of 0, 1 and 2, the best on simulated scans that others were left out for."""


def colour_histogram(pixels: UInt8[ndarray, "n 3"]) -> Float[ndarray, "b"]:
    """Square roots of blurred histograms of chromaticity and of lightness, each of unit norm, one after the other.

    Args:
        pixels: red, green, blue.

    Raises:
        ValueError: there is no pixel.
    """
    if len(pixels) == 0:
        raise ValueError("expected pixels, got none")
    levels = pixels.astype(np.float64)
    red, green, blue = levels.T
    total = np.maximum(levels.sum(axis=1), 1.0)
    opponents = np.stack([(red - green) / total, (red + green - 2 * blue) / (2 * total)], axis=1)
    edges = np.linspace(-CHROMA_RANGE, CHROMA_RANGE, CHROMA_BINS + 1)
    inside = np.clip(opponents, edges[0], edges[-1])
    weights = np.clip(total / 3 / DIM_PIXEL, 0.05, 1.0)
    chroma = np.histogram2d(inside[:, 0], inside[:, 1], bins=(edges, edges), weights=weights)[0]
    lightness = np.histogram(total / 3, bins=LIGHTNESS_BINS, range=(0, 256))[0].astype(np.float64)
    chroma, lightness = (
        gaussian_filter(counts, width, mode="nearest") for counts, width in zip((chroma, lightness), BLURS, strict=True)
    )
    return np.concatenate([np.sqrt(chroma / chroma.sum()).ravel(), np.sqrt(lightness / lightness.sum())])


def chroma_distances(a: Float[ndarray, "v b"], b: Float[ndarray, "w b"]) -> Float[ndarray, "v w"]:
    """Hellinger distances of the chromaticities of histograms, from 0 for equal to 1 for disjoint."""
    return _hellinger(a[:, : CHROMA_BINS**2], b[:, : CHROMA_BINS**2])


def lightness_distances(a: Float[ndarray, "v b"], b: Float[ndarray, "w b"]) -> Float[ndarray, "v w"]:
    """Hellinger distances of the lightnesses of histograms, from 0 for equal to 1 for disjoint."""
    return _hellinger(a[:, CHROMA_BINS**2 :], b[:, CHROMA_BINS**2 :])


def _hellinger(a: Float[ndarray, "v b"], b: Float[ndarray, "w b"]) -> Float[ndarray, "v w"]:
    return np.sqrt(np.maximum(1.0 - a @ b.T, 0.0))
