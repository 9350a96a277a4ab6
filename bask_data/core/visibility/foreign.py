"""Occluders without depth, found by their colour."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Int32, UInt8
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.visibility.labelled import NO_VERTEX

N_COLOUR_SAMPLES = 5000
"""Pixels whose colour is compared with the mesh's to estimate a frame's exposure. Chosen, sensitivity not measured."""

N_COLOUR_SAMPLES_LEAST = 200
"""Fewest agreeing pixels to estimate the exposure from. Chosen, sensitivity not measured."""

COLOUR_OFF = 4.0
"""A pixel shows something else where its colour differs from the mesh's by so many times the median difference. Chosen,
sensitivity not measured."""

LEAST_COLOUR_OFF = 60.0
"""Smallest such difference, grey levels of 255: shadows and highlights change a surface by less. Chosen, sensitivity
not measured."""


def foreign(
    rgb: UInt8[ndarray, "h w 3"],
    colors: UInt8[ndarray, "n 3"],
    i_vertex: Int32[ndarray, "h w"],
    agrees: Bool[ndarray, "h w"],
    in_front: Bool[ndarray, "h w"],
    silent: Bool[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
) -> Bool[ndarray, "h w"]:
    """Pixels without depth that show something the mesh does not contain: a finger too near or too dark for the sensor.

    After fitting the frame's exposure to the mesh's, their colour differs from the mesh's by far more than that of
    pixels whose depth lies on the mesh; and they are connected to where an occluder can enter: the edge of the image or
    of the region, or a measurement in front of the mesh. A highlight on an object is isolated, and keeps its label.

    Args:
        colors: of the mesh's vertices.
        i_vertex: a vertex of the triangle that each ray hits; `NO_VERTEX` for none.
        agrees, in_front: of `Decision`.
        silent: pixels without measurement.
        region: pixels a ray was cast for.
    """
    nothing = np.zeros(silent.shape, bool)
    if not (silent & (i_vertex != NO_VERTEX)).any():
        return nothing
    where = np.flatnonzero(agrees & (i_vertex != NO_VERTEX))
    if len(where) < N_COLOUR_SAMPLES_LEAST:
        return nothing
    where = where[:: max(1, len(where) // N_COLOUR_SAMPLES)]
    expected = colors[i_vertex.reshape(-1)[where]].astype(np.float32)
    seen = rgb.reshape(-1, 3)[where].astype(np.float32)
    gain = np.median(seen, axis=0) / np.maximum(np.median(expected, axis=0), 1)
    usual = float(np.median(np.abs(seen - gain * expected).max(axis=1)))
    off = _colour_off(rgb, colors, i_vertex, silent & region, gain.astype(np.float32), NO_VERTEX)
    limit = max(COLOUR_OFF * usual, LEAST_COLOUR_OFF)
    # Most frames need no filter over the whole image, and this test is faster than the filters.
    if not _may_be_strange(off, silent, np.float32(0.99 * limit)):
        return nothing
    # A single pixel is no evidence, because the mesh resolves texture by voxels only; the mean of a window is.
    n_around = cv2.boxFilter((off > 0).astype(np.float32), -1, (5, 5), normalize=False)
    mean_off = cv2.boxFilter(off, -1, (5, 5), normalize=False) / np.maximum(n_around, 1)
    strange = silent & region & (mean_off > limit)
    if not strange.any():
        return nothing
    _, component = cv2.connectedComponents((strange | in_front).astype(np.uint8), connectivity=8)
    # Pixels outside the region were not tested, so an occluder may enter from there.
    inner = cv2.erode(region.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    source = region & (inner == 0)
    # Single pixels measured in front are noise at edges, found around every object.
    source |= cv2.morphologyEx(in_front.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    comes_from_outside = np.isin(component, np.unique(component[source & (component > 0)]))
    return strange & comes_from_outside & (component > 0)


@compiled
def _colour_off(rgb, colors, i_vertex, asked, gain, no_vertex):  # type: ignore[no-untyped-def]
    """(h, w) float32: largest difference of a channel between image and mesh, grey levels; 0 where not asked for, or
    where the ray meets nothing. NumPy takes six times as long to gather the colours.

    `no_vertex` is passed, as the machine code kept on disk for this file would not follow a change of another's."""
    off = np.zeros(asked.shape, np.float32)
    for v in range(asked.shape[0]):
        for u in range(asked.shape[1]):
            i = i_vertex[v, u]
            if asked[v, u] and i != no_vertex:
                for channel in range(3):
                    off[v, u] = max(off[v, u], abs(rgb[v, u, channel] - gain[channel] * colors[i, channel]))
    return off


@compiled
def _may_be_strange(off, silent, limit):  # type: ignore[no-untyped-def]
    """Whether the mean of `off` over its non-zero pixels in any silent pixel's window (5 x 5, reflected at the border)
    exceeds a limit. Only windows around pixels that exceed it themselves are tested."""
    height, width = off.shape
    if min(height, width) < 3:
        return True  # The window is reflected more than once, which the indices below do not follow.
    looked = np.zeros((height, width), np.bool_)
    for v in range(height):
        for u in range(width):
            if off[v, u] <= limit:
                continue
            for v_near in range(max(v - 2, 0), min(v + 3, height)):
                for u_near in range(max(u - 2, 0), min(u + 3, width)):
                    if looked[v_near, u_near] or not silent[v_near, u_near]:
                        continue
                    looked[v_near, u_near] = True
                    total, n_around = 0.0, 0
                    for dv in range(-2, 3):
                        for du in range(-2, 3):
                            row, column = abs(v_near + dv), abs(u_near + du)
                            row, column = min(row, 2 * height - 2 - row), min(column, 2 * width - 2 - column)
                            total += off[row, column]
                            n_around += off[row, column] > 0
                    if total > limit * n_around:
                        return True
    return False
