"""What hides an object and gives no depth, found by its colour."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Int32, UInt8
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.visibility.labelled import NO_VERTEX

N_COLOUR_SAMPLES = 5000
"""Pixels whose colour is held against the mesh's to learn a frame's exposure."""

N_COLOUR_SAMPLES_LEAST = 200
"""Fewer agreeing pixels than that say nothing of it."""

COLOUR_OFF = 4.0
"""Times the usual difference from the mesh's colour at which a pixel shows something else."""

LEAST_COLOUR_OFF = 60.0
"""Grey levels; shadows and highlights of a moving camera change a surface by less."""


def foreign(
    rgb: UInt8[ndarray, "h w 3"],
    colors: UInt8[ndarray, "n 3"],
    i_vertex: Int32[ndarray, "h w"],
    agrees: Bool[ndarray, "h w"],
    in_front: Bool[ndarray, "h w"],
    silent: Bool[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
) -> Bool[ndarray, "h w"]:
    """Pixels without depth that show something the mesh does not: a finger too near or too dark for the sensor.

    Their colour differs from the mesh's by far more than that of the pixels whose depth lies on the mesh does, after
    the frame's exposure was fitted to the mesh's; and they hang together with a place where such a thing comes
    from: the edge of the image or of the region, or a measurement in front of the mesh. A highlight on an object is
    an island, and stays.

    Args:
        colors: of the mesh's vertices.
        i_vertex: vertex nearest to each ray's hit; `NO_VERTEX` for none.
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
    off = _colour_off(rgb, colors, i_vertex, silent & region, gain.astype(np.float32))
    limit = max(COLOUR_OFF * usual, LEAST_COLOUR_OFF)
    # The filters over the whole image, which most frames do not need, take longer than to find out.
    if not _may_be_strange(off, silent, np.float32(0.99 * limit)):
        return nothing
    # One pixel says little: texture is a voxel wide on the mesh. A window's mean does.
    n_around = cv2.boxFilter((off > 0).astype(np.float32), -1, (5, 5), normalize=False)
    mean_off = cv2.boxFilter(off, -1, (5, 5), normalize=False) / np.maximum(n_around, 1)
    strange = silent & region & (mean_off > limit)
    if not strange.any():
        return nothing
    _, component = cv2.connectedComponents((strange | in_front).astype(np.uint8), connectivity=8)
    # What lies outside the region was not looked at, so a thing may come from there.
    inner = cv2.erode(region.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    source = region & (inner == 0)
    # Single pixels measured in front are noise at edges, found around every object.
    source |= cv2.morphologyEx(in_front.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    comes_from_outside = np.isin(component, np.unique(component[source & (component > 0)]))
    return strange & comes_from_outside & (component > 0)


@compiled
def _colour_off(rgb, colors, i_vertex, asked, gain):  # type: ignore[no-untyped-def]
    """(h, w) float32: largest difference of a channel between image and mesh, grey levels; 0 where not asked, or where
    the ray meets nothing. NumPy takes six times as long to gather the colours."""
    off = np.zeros(asked.shape, np.float32)
    for v in range(asked.shape[0]):
        for u in range(asked.shape[1]):
            i = i_vertex[v, u]
            if asked[v, u] and i != NO_VERTEX:
                for channel in range(3):
                    off[v, u] = max(off[v, u], abs(rgb[v, u, channel] - gain[channel] * colors[i, channel]))
    return off


@compiled
def _may_be_strange(off, silent, limit):  # type: ignore[no-untyped-def]
    """Whether the mean of `off` over its non-zero pixels in any silent pixel's window (5 x 5, reflected at the border)
    exceeds a limit. Only the surroundings of pixels that exceed it themselves are looked at."""
    height, width = off.shape
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
