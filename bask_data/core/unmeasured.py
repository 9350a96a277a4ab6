"""Regions with something that no camera could measure: transparent, shiny or black."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from scipy import ndimage

from bask_data.core.fit import Sketch
from bask_data.core.geometry import invert_rigid

WORKSPACE_MARGIN = 0.15
"""Metres around the workspace that are searched, too, because unmeasured objects had no influence on its size. Assumes
a tabletop. Chosen, sensitivity not measured."""

N_SEARCHED_CELLS = 150_000
"""Most cells that the workspace is divided into. Chosen, sensitivity not measured."""

LEAST_CELL = 0.008
"""Metres. Assumes a tabletop: about the distance of a sketch's pixels there. Chosen, sensitivity not measured."""

BLIND_SHARE = 0.3
"""Least share of blind views, which measured nothing, among those that look at a cell. Two transparent containers had
0.3 to 0.6, because stereo cameras see through glass from many sides. Sensitivity not measured."""

LEAST_VIEWS = 6
"""Fewest blind views; fewer may be chance. Chosen, sensitivity not measured."""

SPREAD = 0.8
"""Greatest length of the mean unit vector towards the blind views. From one side, the whole ray is unmeasured wherever
on it the object stands. Chosen, sensitivity not measured."""

CORE = 0.7
"""The box of a region holds the cells whose share of blind views is at least this much of its highest: the rest is
space that too few views could carve. Chosen, sensitivity not measured."""

LEAST_VOLUME = 6e-5
"""Smallest region to report, cubic metres: a cube of 4 cm. Assumes a tabletop. Chosen, sensitivity not measured."""


@dataclass(frozen=True)
class Region:
    """A region that no camera measured: centre and size of its axis-aligned box, world frame, metres, and its volume,
    cubic metres."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    volume: float


@dataclass(frozen=True)
class SketchedView:
    """A frame's sketch, its camera, and the z-depth of the mesh along the sketch's rays, metres (infinity: none)."""

    sketch: Sketch
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]
    mesh_depth: Float32[ndarray, "rows columns"]


def unmeasured_regions(views: Sequence[SketchedView], bounds: Float[ndarray, "2 3"]) -> list[Region]:
    """Regions that many views from many sides looked at without a measurement, largest first.

    Each cell of the workspace is projected into every view. If the mesh hides it, the view is ignored; a measurement on
    or behind it shows a surface or free space; a hole in the measurements, with nothing known in front, makes the view
    blind for the cell. A hole that extends to the image's border is background out of range, and ignored; so are cells
    nearer to a camera than anything measured, which may be too near for the sensor.

    Args:
        bounds: (2, 3) lowest and highest corner of the workspace, world frame, metres.
    """
    nearest = min((_nearest(view.sketch.depth) for view in views), default=np.inf)
    lowest, cell, shape = _cells(bounds + np.array([[-WORKSPACE_MARGIN], [WORKSPACE_MARGIN]]))
    centres = (lowest + (np.indices(shape).reshape(3, -1).T + 0.5) * cell).astype(np.float32)
    n_blind, n_looked = np.zeros(len(centres), np.int32), np.zeros(len(centres), np.int32)
    towards = np.zeros((len(centres), 3), np.float32)
    for view in views:
        looked, blind = _look(centres, view, nearest, 1.5 * cell)
        n_looked += looked
        n_blind += blind
        i_blind = np.flatnonzero(blind)
        to_camera = view.world_from_camera[:3, 3].astype(np.float32) - centres[i_blind]
        towards[i_blind] += to_camera / np.linalg.norm(to_camera, axis=1, keepdims=True)
    blind_share = n_blind / np.maximum(n_looked, 1)
    found = (n_blind >= LEAST_VIEWS) & (blind_share >= BLIND_SHARE)
    found &= np.linalg.norm(towards, axis=1) <= SPREAD * n_blind
    return _regions(np.where(found, blind_share, 0).reshape(shape), lowest, cell)


def _cells(bounds: Float[ndarray, "2 3"]) -> tuple[Float[ndarray, "3"], float, tuple[int, int, int]]:
    """Lowest corner, edge and numbers of the cells that divide the bounds."""
    size = bounds[1] - bounds[0]
    cell = max(LEAST_CELL, float(np.prod(size) / N_SEARCHED_CELLS) ** (1 / 3))
    nx, ny, nz = (max(1, int(n)) for n in np.ceil(size / cell))
    return bounds[0], cell, (nx, ny, nz)


def _nearest(depth: Float32[ndarray, "rows columns"]) -> float:
    """The first percentile of the measured depths; infinity without any."""
    measured = depth[depth > 0]
    return float(np.percentile(measured, 1)) if len(measured) else np.inf


def _holes(sketch: Sketch) -> Bool[ndarray, "rows columns"]:
    """Blocks that are mostly unmeasured, in connected parts that do not touch the image's border."""
    labels, n = ndimage.label(sketch.measured < 128)
    closed = np.ones(n + 1, bool)
    closed[0] = False
    for side in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        closed[side] = False
    return closed[labels]


def _look(
    points_world: Float32[ndarray, "n 3"], view: SketchedView, nearest: float, tolerance: float
) -> tuple[Bool[ndarray, "n"], Bool[ndarray, "n"]]:
    """Whether the view looks at each point, and whether it is blind there."""
    # Sums of columns: for matrices this thin, BLAS would start threads that wait for each other.
    image_from_world = (view.K @ invert_rigid(view.world_from_camera)[:3]).astype(np.float32)
    across, down, z = (
        a * points_world[:, 0] + b * points_world[:, 1] + c * points_world[:, 2] + d for a, b, c, d in image_from_world
    )
    in_front = z >= nearest
    scale = 1 / (np.where(in_front, z, np.float32(1)) * view.sketch.step)
    rows, columns = view.sketch.depth.shape
    column, row = (np.floor(along * scale + np.float32(0.5 / view.sketch.step)) for along in (across, down))
    inside = in_front & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    i = np.flatnonzero(inside)
    at = row[i].astype(np.int64), column[i].astype(np.int64)
    hidden = view.mesh_depth[at] < z[i] - tolerance
    hole = _holes(view.sketch)[at]
    depth = view.sketch.depth[at]
    blind, looked = np.zeros((2, len(points_world)), bool)
    blind[i] = ~hidden & hole
    # A measured block without depth at its central pixel is ignored; a measurement in front hides the cell.
    looked[i] = ~hidden & (hole | (depth >= z[i] - tolerance))
    return looked, blind


def _regions(blind_share: Float[ndarray, "x y z"], lowest: Float[ndarray, "3"], cell: float) -> list[Region]:
    """Connected cells as boxes around their cores (`CORE`), largest first, without the small ones.

    Args:
        blind_share: 0 where a cell does not count.
    """
    labels, n = ndimage.label(blind_share > 0)
    n_cells = np.bincount(labels.reshape(-1), minlength=n + 1)
    most = ndimage.maximum(blind_share, labels, np.arange(n + 1))
    core = np.where(blind_share >= CORE * np.asarray(most)[labels], labels, 0)
    regions = []
    for i_region, box in enumerate(ndimage.find_objects(core), start=1):
        if n_cells[i_region] * cell**3 < LEAST_VOLUME:
            continue
        start = lowest + np.array([part.start for part in box]) * cell
        stop = lowest + np.array([part.stop for part in box]) * cell
        volume = int((core[box] == i_region).sum()) * cell**3
        regions.append(Region(_rounded((start + stop) / 2), _rounded(stop - start), round(volume, 7)))
    return sorted(regions, key=lambda region: -region.volume)


def _rounded(vector: Float[ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 4) for value in vector)
    return x, y, z
