"""Whether edges of depth lie on edges of colour: if not, depth is not registered to colour.

Depth jumps where one object ends before another, and colour mostly changes there, too. The mean colour gradient under
the depth edges is computed for every shift of them; its peak shows where they fit.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

JUMP = 0.04
"""Share of the depth by which neighbours differ at an edge: above noise, below the height of small objects before a
wall. Sensitivity not measured."""

LEAST_EDGES = 200
"""Pixels on depth edges below which a frame says nothing. Sensitivity not measured."""

LARGEST_RATIO = 4.0
"""Colour gradients count at most this many times their neighbourhood's mean, so that a few do not decide."""


def depth_edges(depth: Float32[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Pixels of the nearer side where depth jumps, between measured neighbours. Depth in metres, 0 = none."""
    edges = np.zeros(depth.shape, dtype=bool)
    for first, second in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        a, b = depth[first], depth[second]
        jumps = (a > 0) & (b > 0) & (np.abs(a - b) > JUMP * np.minimum(a, b))
        edges[first] |= jumps & (a < b)
        edges[second] |= jumps & (b < a)
    return edges


def edge_match(
    rgb: UInt8[ndarray, "h w 3"], depth: Float32[ndarray, "h w"], reach: int
) -> Float32[ndarray, "n n"] | None:
    """How well the depth edges fit colour's when shifted by (u, v) in -reach..reach pixels, indexed [v, u].

    Returns:
        The score in robust standard deviations above the median shift; None if there are too few edges.
    """
    inner = (slice(reach, -reach), slice(reach, -reach))
    edges = depth_edges(depth)[inner]
    if edges.sum() < LEAST_EDGES:
        return None
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (0, 0), 1.0).astype(np.float32)
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)).astype(np.float32)
    side = 2 * reach + 1
    relative = np.minimum(gradient / (cv2.blur(gradient, (side, side)) + 1e-3), LARGEST_RATIO)
    scores = cv2.matchTemplate(relative, edges.astype(np.float32), cv2.TM_CCORR) / np.float32(edges.sum())
    spread = 1.4826 * float(np.median(np.abs(scores - np.median(scores))))
    return ((scores - np.median(scores)) / (spread + 1e-9)).astype(np.float32)
