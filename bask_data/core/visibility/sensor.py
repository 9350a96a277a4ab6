"""The noise of a depth sensor relative to a mesh, and the tolerance within which the two agree."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray
from scipy.optimize import nnls

from bask_data.core.depth import SIGMA_FROM_MAD
from bask_data.core.visibility.labelled import LabelledSurface
from bask_data.core.visibility.surface import rays_of

MASK_TOLERANCE = (0.01, 0.02)
"""Measurement and mesh agree within a + b z metres, where the sensor's noise is unknown. On analytic scenes with 1 to 5
mm of noise, masks were the same from 5 mm to 4 cm. Assumes a tabletop: with sparse sensors and imprecise poses,
measurements are two to three centimetres off at half a metre."""

N_SIGMA = 4.0
"""Standard deviations of the sensor's noise by which measurement and mesh may differ. Chosen; its
sensitivity is in docs/benchmarks.md."""

MESH_ERROR = 3.5
"""Voxels by which a fused mesh is off at thin walls and sharp edges. Chosen, sensitivity not measured."""

MOST_TOLERANCE = (0.04, 0.06)
"""Largest (a, b) metres, whatever the sensor's noise: beyond, a hand in front of an object would count as its surface.
Assumes a tabletop. Chosen, sensitivity not measured."""

N_RESIDUALS_LEAST = 400
"""Fewest residuals to estimate noise from. Chosen, sensitivity not measured."""


def residuals(
    surface: LabelledSurface,
    depth: Float32[ndarray, "h w"],
    directions_camera: Float32[ndarray, "h w 3"],
    world_from_camera: Float[ndarray, "4 4"],
    n_rays: int = 4000,
) -> Float32[ndarray, "n 2"]:
    """Measured depth and its difference from the mesh, metres, at up to about `n_rays` pixels whose ray meets it."""
    where = np.flatnonzero(depth)
    where = where[:: max(1, len(where) // n_rays)]
    if len(where) == 0:
        return np.zeros((0, 2), np.float32)
    rendered, _ = surface.cast(rays_of(directions_camera, world_from_camera).at(where))
    met = np.isfinite(rendered)
    here = depth.reshape(-1)[where][met]
    return np.stack([here, here - rendered[met]], axis=1)


def noise(samples: Float32[ndarray, "n 2"], n_bins: int = 8) -> tuple[float, float] | None:
    """(a, b) of the sensor's noise: its standard deviation is a + b z metres; None when there are too few residuals.

    From the median absolute deviation of the residuals in bins of depth, which ignores hands, flying pixels and holes
    in the mesh as long as they are fewer than half. Errors of the mesh and of the poses are included: it is the
    deviation of measurement and mesh where both show one surface.

    Args:
        samples: of `residuals`, all frames of a camera.
        n_bins: of equally many samples.
    """
    z, off = samples.T.astype(np.float64)
    # A wall seen past a table's edge is no residual: more than 5 cm + 5 % is no sensor's noise.
    near = np.abs(off) <= 0.05 + 0.05 * z
    z, off = z[near], off[near]
    if len(z) < N_RESIDUALS_LEAST:
        return None
    edges = np.quantile(z, np.linspace(0, 1, n_bins + 1))
    i_bin = np.clip(np.searchsorted(edges, z, side="right") - 1, 0, n_bins - 1)
    filled = [i for i in range(n_bins) if np.count_nonzero(i_bin == i) >= N_RESIDUALS_LEAST // n_bins // 2]
    centre = np.array([np.median(z[i_bin == i]) for i in filled])
    # About the median: a difference that is the same everywhere is an error of the mesh.
    sigma = np.array([SIGMA_FROM_MAD * np.median(np.abs(off[i_bin == i] - np.median(off[i_bin == i]))) for i in filled])
    (a, b), _ = nnls(np.stack([np.ones(len(centre)), centre], axis=1), sigma)
    return float(a), float(b)


def tolerance_of(deviation: tuple[float, float] | None, voxel_size: float) -> tuple[float, float]:
    """(a, b) of the tolerance a + b z metres for a sensor's noise; `MASK_TOLERANCE` where the noise is unknown.

    Args:
        deviation: (a, b) of `noise`.
        voxel_size: metres; at thin walls the mesh is off by some voxels, however good the sensor.
    """
    if deviation is None:
        return MASK_TOLERANCE
    a, b = (N_SIGMA * sigma for sigma in deviation)
    return min(max(a, MESH_ERROR * voxel_size), MOST_TOLERANCE[0]), min(b, MOST_TOLERANCE[1])
