"""Measures of single frames: what is kept of colour and depth to judge a sensor by, some hundred kilobytes a frame."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.depth import SIGMA_FROM_MAD

COLUMNS = 128
"""Blocks across an image that points are taken from. Sensitivity not measured."""

LEAST_FILLED = 0.15
"""Least share of a block's pixels that must have depth; depth registered to colour covers a quarter to a third of the
pixels. Sensitivity not measured."""

EDGE_SPREAD = 0.03
"""Largest standard deviation of depth in a block, relative to depth: more is an edge. Sensitivity not measured."""

NORMAL_REACH = 2
"""Blocks to either side that a normal is taken from, so that noise hardly tilts it. Sensitivity not measured."""

SAME_GREY = 3
"""Grey levels, of 255, within which pixels count as of one colour: less than the noise of any lit scene."""


@dataclass(frozen=True)
class BlockPoints:
    """A depth image by blocks of pixels: a point of the surface in each, and its normal.

    Args:
        points: camera frame, metres; NaN in blocks without a surface.
        normals: unit, towards the camera; NaN where there is none.
        grey: mean grey level of each block.
        step: pixels across a block.
        K: of the full image, pixels.
    """

    points: Float32[ndarray, "rows columns 3"]
    normals: Float32[ndarray, "rows columns 3"]
    grey: Float32[ndarray, "rows columns"]
    step: int
    K: Float[ndarray, "3 3"]


@dataclass(frozen=True)
class FrameMeasures:
    """Measures of one frame.

    Args:
        index: number of the frame.
        colour_hash, depth_hash: checksums of every other row of the images.
        one_colour: share of the pixels whose grey level is that of the median.
        grey: median grey level, of 255.
        sharpness: variance of the Laplacian of the grey image.
        measured: share of the pixels that have depth.
        typical_depth: median, metres; NaN without depth.
        nearest, farthest: metres; NaN without depth.
        at_nearest, at_farthest: shares of the measured pixels that have exactly these values.
        next_farthest: the largest value below `farthest`, metres; -1 if there is none.
        step: distance of neighbouring values of depth near the median, relative to it; NaN without depth.
        noise: standard deviation of pixels about their neighbours, relative to depth; NaN without neighbours.
    """

    index: int
    colour_hash: int
    depth_hash: int
    one_colour: float
    grey: float
    sharpness: float
    measured: float
    typical_depth: float
    nearest: float
    farthest: float
    at_nearest: float
    at_farthest: float
    next_farthest: float
    step: float
    noise: float
    blocks: BlockPoints


def measures_of(
    index: int, rgb: UInt8[ndarray, "h w 3"], depth: Float32[ndarray, "h w"], K: Float[ndarray, "3 3"]
) -> FrameMeasures:
    """Measures of a frame.

    Args:
        depth: metres; 0 means no measurement.
    """
    grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
    coarse = grey[::4, ::4]
    middle = float(np.median(coarse))
    values = depth[depth > 0]
    n = len(values)
    nearest, farthest = (float(values.min()), float(values.max())) if n else (np.nan, np.nan)
    typical = float(np.median(values[:: max(1, n // 10_000)])) if n else np.nan
    return FrameMeasures(
        index=index,
        colour_hash=zlib.crc32(rgb[::2].tobytes()),
        depth_hash=zlib.crc32(depth[::2].tobytes()),
        one_colour=float((np.abs(coarse.astype(np.int16) - middle) <= SAME_GREY).mean()),
        grey=middle,
        sharpness=float(cv2.Laplacian(grey, cv2.CV_16S).var()),
        measured=n / depth.size,
        typical_depth=typical,
        nearest=nearest,
        farthest=farthest,
        at_nearest=float((values == np.float32(nearest)).mean()) if n else 0.0,
        at_farthest=float((values == np.float32(farthest)).mean()) if n else 0.0,
        next_farthest=float(np.max(values, initial=-1.0, where=values < np.float32(farthest))) if n else np.nan,
        step=_step(values, typical),
        noise=_noise(depth),
        blocks=block_points(grey, depth, K),
    )


def block_points(grey: UInt8[ndarray, "h w"], depth: Float32[ndarray, "h w"], K: Float[ndarray, "3 3"]) -> BlockPoints:
    """A frame by blocks of pixels.

    Inverse depth is linear over a plane's image, so the mean of a block's inverse depths, at the mean of their pixels,
    lies exactly on the plane, whichever of the pixels have depth.
    """
    height, width = depth.shape
    step = max(1, round(width / COLUMNS))
    rows, columns = height // step, width // step
    w, at_u, at_v = _block_means(np.ascontiguousarray(depth), step, rows, columns, LEAST_FILLED, EDGE_SPREAD)
    z = np.where(w > 0, 1 / np.where(w > 0, w, 1), np.nan)
    y = (at_v - K[1, 2]) / K[1, 1]
    x = (at_u - K[0, 2] - K[0, 1] * y) / K[0, 0]
    points = np.stack([x * z, y * z, z], axis=-1).astype(np.float32)
    window = grey[: rows * step, : columns * step]
    means = cv2.resize(window, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float32)
    return BlockPoints(points, _normals(points), means, step, np.array(K, np.float64))


@compiled
def _block_means(
    depth: ndarray, step: int, rows: int, columns: int, least_filled: float, most_spread: float
) -> tuple[ndarray, ndarray, ndarray]:
    """Mean inverse depth of each block, 0 without a surface, and the mean pixel of its measurements."""
    w, at_u, at_v = np.zeros((rows, columns)), np.zeros((rows, columns)), np.zeros((rows, columns))
    for row in range(rows):
        for column in range(columns):
            n, total, squares, sum_u, sum_v = 0, 0.0, 0.0, 0.0, 0.0
            for v in range(row * step, (row + 1) * step):
                for u in range(column * step, (column + 1) * step):
                    if depth[v, u] > 0:
                        inverse = 1.0 / depth[v, u]
                        n += 1
                        total += inverse
                        squares += inverse * inverse
                        sum_u += u
                        sum_v += v
            if n < least_filled * step * step or n == 0:
                continue
            mean = total / n
            if squares / n - mean * mean > (most_spread * mean) ** 2:
                continue
            w[row, column], at_u[row, column], at_v[row, column] = mean, sum_u / n, sum_v / n
    return w, at_u, at_v


def _normals(points: Float32[ndarray, "rows columns 3"]) -> Float32[ndarray, "rows columns 3"]:
    normals = np.full_like(points, np.nan)
    k = NORMAL_REACH
    if min(points.shape[:2]) <= 2 * k:
        return normals
    across = points[k:-k, 2 * k :] - points[k:-k, : -2 * k]
    down = points[2 * k :, k:-k] - points[: -2 * k, k:-k]
    normal = np.cross(down, across)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        # Over an edge both neighbours lie on different surfaces: the middle is then far from between them.
        centre = points[k:-k, k:-k]
        bend = np.abs(points[k:-k, 2 * k :, 2] + points[k:-k, : -2 * k, 2] - 2 * centre[..., 2])
        bend = np.maximum(bend, np.abs(points[2 * k :, k:-k, 2] + points[: -2 * k, k:-k, 2] - 2 * centre[..., 2]))
        flat = bend <= EDGE_SPREAD * centre[..., 2]
        normals[k:-k, k:-k] = np.where(flat[..., None], normal / length, np.nan)
    return normals


def _step(values: Float32[ndarray, " n"], typical: float) -> float:
    """The distance of neighbouring values within a tenth of the median, relative to it."""
    if len(values) < 1000:
        return float("nan")
    near = values[:: max(1, len(values) // 20_000)]
    near = np.unique(near[np.abs(near - typical) < 0.1 * typical])
    return float(np.median(np.diff(near))) / typical if len(near) > 2 else float("nan")


def _noise(depth: Float32[ndarray, "h w"]) -> float:
    """The standard deviation of pixels about the line through their neighbours in the row, relative to depth."""
    rows = depth[:: max(1, depth.shape[0] // 100)]
    left, middle, right = rows[:, :-2], rows[:, 1:-1], rows[:, 2:]
    seen = (left > 0) & (middle > 0) & (right > 0)
    if seen.sum() < 500:
        return float("nan")
    z = middle[seen]
    # Inverse depth is linear over a plane's image; its relative change is that of depth, with the other sign.
    bend = z * (1 / left[seen] + 1 / right[seen]) - 2
    # Of three independent values, weights 1, -2, 1.
    return SIGMA_FROM_MAD * float(np.median(np.abs(bend))) / np.sqrt(6)
