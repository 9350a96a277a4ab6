"""Agreement of a mesh with the frames it was fused from, by a few rays of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numpy import ndarray

from bask_data.core.depth import DEPTH_SLACK, SIGMA_FROM_MAD
from bask_data.core.geometry import unproject
from bask_data.core.visibility.surface import Surface

LEAST_JUDGED = 50
"""Fewest rays to judge a frame by. Chosen, sensitivity not measured."""

LEAST_FRAMES = 5
"""Fewest frames among which one can be an outlier: it is compared with the two before and the two after it."""


@dataclass(frozen=True)
class Sketch:
    """A frame's depth, subsampled to one pixel of each block of `step` x `step`.

    Attributes:
        step: pixels; the pixel of a block is that at step // 2.
        depth: z-depth there, metres, also beyond the range of fusion; 0 means no measurement.
        measured: share of each block's pixels that have a measurement, in 255ths.
    """

    step: int
    depth: Float32[ndarray, "rows columns"]
    measured: UInt8[ndarray, "rows columns"]


def sketch(raw: Float32[ndarray, "h w"], cleaned: Float32[ndarray, "h w"], far: float, n_columns: int = 40) -> Sketch:
    """A frame's sketch of about `n_columns` columns.

    Args:
        raw: z-depth as measured, metres.
        cleaned: the same as it was fused (`depth.cleaned`), up to `far` metres.
    """
    step = max(1, raw.shape[1] // n_columns)
    rows, columns = raw.shape[0] // step, raw.shape[1] // step
    window = slice(0, rows * step), slice(0, columns * step)
    some = (cleaned > 0) | (raw > 0)
    n_measured = some[window].reshape(rows, step, columns * step).sum(axis=1, dtype=np.int32)
    n_measured = n_measured.reshape(rows, columns, step).sum(axis=2)
    middle = slice(step // 2, rows * step, step), slice(step // 2, columns * step, step)
    beyond = np.where(raw[middle] > far, raw[middle], np.float32(0))
    depth = np.where(cleaned[middle] > 0, cleaned[middle], beyond)
    return Sketch(step, depth, (n_measured * 255 // step**2).astype(np.uint8))


class FacedSurface:
    """A mesh for ray casting that records which of its triangles were hit from the front and from behind."""

    def __init__(self, vertices: Float32[ndarray, "n 3"], triangles: Int32[ndarray, "m 3"]) -> None:
        self._surface = Surface(vertices, triangles)
        corners = vertices[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._area = np.linalg.norm(normals, axis=1) / 2
        self._met = np.zeros((2, len(triangles)), bool)

    def cast(self, rays: Float32[ndarray, "n 6"]) -> tuple[Float32[ndarray, "n"], Bool[ndarray, "n"]]:
        """Ray parameter of the first hit of rays (origin, direction), infinity for none, and whether it is the back
        of a triangle."""
        hits = self._surface.cast(rays)
        behind = np.einsum("nx,nx->n", hits.normal, rays[:, 3:]) > 0
        hit = np.isfinite(hits.distance)
        self._met[behind[hit].astype(np.int64), hits.triangle[hit]] = True
        return hits.distance, behind & hit

    @property
    def area_from_behind(self) -> float:
        """Share of the area hit by rays that was hit from behind only: no camera saw its front."""
        met = float(self._area[self._met.any(axis=0)].sum())
        return float(self._area[self._met[1] & ~self._met[0]].sum()) / met if met else 0.0


@dataclass(frozen=True)
class Fit:
    """Agreement of a mesh and one frame; NaN where there is no such ray.

    Attributes:
        n_judged: rays that can be judged: measured inside the workspace, or behind the mesh.
        explained: share of those whose measurement lies on the mesh.
        residual: median of measured minus mesh depth, metres, where the ray hits the mesh.
        residual_abs: median of its magnitude, metres.
        from_behind: share of the rays that hit the mesh which hit it from behind.
    """

    n_judged: int
    explained: float
    residual: float
    residual_abs: float
    from_behind: float


def fit(
    seen: Sketch,
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
    surface: FacedSurface,
    bounds: Float[ndarray, "2 3"],
    slack: tuple[float, float] = DEPTH_SLACK,
) -> Fit:
    """Agreement of a mesh and the measurements of a frame.

    Measurements outside the workspace have no surface to be compared with. They count only where the mesh is in front
    of them, because the camera would then have seen the mesh.

    Args:
        bounds: (2, 3) lowest and highest corner of the workspace, world frame, metres.
        slack: (a, b): a measurement lies on the mesh within a + b z metres.
    """
    rays = sketch_rays(seen, K, world_from_camera)
    mesh_depth, behind = surface.cast(rays)
    met = np.isfinite(mesh_depth)
    depth = seen.depth.reshape(-1)
    points = rays[:, :3] + depth[:, None] * rays[:, 3:]
    inside = ((points >= bounds[0]) & (points <= bounds[1])).all(axis=1)
    residual = np.where(met, depth, 0) - np.where(met, mesh_depth, 0)
    tolerance = slack[0] + slack[1] * depth
    judged = (depth > 0) & (inside | (met & (residual > tolerance)))
    compared = residual[judged & met]
    explained = judged & met & (np.abs(residual) <= tolerance)
    return Fit(
        n_judged=int(judged.sum()),
        explained=_share(explained, judged),
        residual=float(np.median(compared)) if len(compared) else np.nan,
        residual_abs=float(np.median(np.abs(compared))) if len(compared) else np.nan,
        from_behind=_share(behind, met),
    )


def sketch_rays(
    seen: Sketch, K: Float[ndarray, "3 3"], world_from_camera: Float[ndarray, "4 4"]
) -> Float32[ndarray, "n 6"]:
    """Origin and direction of the rays through a sketch's pixels, row by row; the ray parameter is the z-depth."""
    rows, columns = seen.depth.shape
    v, u = np.mgrid[:rows, :columns].reshape(2, -1) * seen.step + seen.step // 2
    uv = np.stack([u, v], axis=-1).astype(np.float64)
    rays = np.empty((len(uv), 6), np.float32)
    rays[:, :3] = world_from_camera[:3, 3]
    rays[:, 3:] = unproject(uv, np.ones(len(uv)), K) @ world_from_camera[:3, :3].T
    return rays


RISE = 1.25
"""A residual has risen when it is this many times that of the frames before and after. Chosen, sensitivity not
measured."""


def outliers(
    n_judged: Int[ndarray, "t"], explained: Float[ndarray, "t"], residual_abs: Float[ndarray, "t"]
) -> Bool[ndarray, "t"]:
    """Frames of one camera, in order, that the mesh explains far worse than the others: their pose is wrong, or
    something moved.

    A frame is compared with all others and, in the share explained, with the two before and the two after it: the view
    has more influence than a small error of the pose, but changes slowly. Limits are in robust deviations, because
    recordings differ, with lower bounds; a small dip in the share is an oblique view unless the residual rises with it.
    On eight recordings of 10 to 200 frames the worst good frame was 5 deviations from those around it; 40 of 40 frames
    with poses 10 cm off were found.

    Args:
        n_judged, explained, residual_abs: of `Fit`, for each frame.
    """
    judged = (n_judged >= LEAST_JUDGED) & np.isfinite(explained) & np.isfinite(residual_abs)
    odd = np.zeros(len(judged), bool)
    if judged.sum() < LEAST_FRAMES:
        return odd
    share, error = explained[judged], residual_abs[judged]
    dip, rises = _around(share) - share, error > RISE * _around(error)
    alone = _far(-share, 7.0, 0.27) | _far(error, 8.0, 0.006)
    odd[judged] = alone | _far(dip, 6.0, 0.2) | (_far(dip, 6.0, 0.07) & rises)
    return odd


def _far(values: Float[ndarray, "n"], deviations: float, least: float) -> Bool[ndarray, "n"]:
    """Values above the median by so many robust deviations and by `least`."""
    median, deviation = _median_and_deviation(values)
    return values > median + max(least, deviations * deviation)


def _around(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """The median of the two values before and the two after each."""
    padded = np.pad(values, 2, mode="reflect")
    return np.median([padded[k : len(padded) - 4 + k] for k in (0, 1, 3, 4)], axis=0)


def _median_and_deviation(values: Float[ndarray, "n"]) -> tuple[float, float]:
    """The median, and the standard deviation of a normal distribution with the same median absolute deviation."""
    median = float(np.median(values))
    return median, SIGMA_FROM_MAD * float(np.median(np.abs(values - median)))


def _share(part: Bool[ndarray, "n"], whole: Bool[ndarray, "n"]) -> float:
    n = int(whole.sum())
    return int((part & whole).sum()) / n if n else float("nan")
