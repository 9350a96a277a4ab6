"""What the ray to the mesh and the measured depth together say of each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8
from numpy import ndarray

EDGE_REACH = 2
"""Pixels by which the silhouette of the mesh may miss that of the object; about a voxel."""

VOTE_RADII = (2, 4)
"""Pixels around one without measurement in which measured ones speak for it; the wider window where the first is
silent. Farther off, a shiny face that is wrongly measured in one place would lose all that was not measured."""


@dataclass(frozen=True)
class Decision:
    """What ray and measurement say together.

    Args:
        measured: False at pixels whose ray meets an object and which have no measurement.
        agrees: the measurement lies on the mesh, at this pixel or within `EDGE_REACH`.
        in_front: the measurement lies before the mesh.
    """

    label: UInt8[ndarray, "h w"]
    measured: Bool[ndarray, "h w"]
    agrees: Bool[ndarray, "h w"]
    in_front: Bool[ndarray, "h w"]
    n_pixels: dict[str, int]


def decided(
    ray_label: UInt8[ndarray, "h w"],
    rendered: Float32[ndarray, "h w"],
    depth: Float32[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
    tolerance: tuple[float, float],
) -> Decision:
    """Label of each pixel from the ray's and from the measurement, and how many objects' pixels were decided by which.

    - Both agree: the ray's label.
    - They do not, but the measurement agrees with the mesh within `EDGE_REACH` pixels: the label from there. So edges
      lie where they were measured, not where the voxels put them, and thin parts keep their width.
    - Measured in front of the mesh: something the mesh does not know is in the way (a hand, a gripper). Measured
      behind: the mesh is wrong there, or the object was moved. Neither shows the object: 0.
    - Not measured: the ray's label, unless the nearest measurements around speak mostly of something in front or
      behind.

    Args:
        ray_label: instance the ray meets first.
        rendered: z-depth of that hit, metres; infinity for none.
        region: pixels a ray was cast for. Outside nothing is known, and nothing changed.
    """
    measured = (depth > 0) & region
    allowed = np.float32(tolerance[0]) + np.float32(tolerance[1]) * depth
    with np.errstate(invalid="ignore"):
        agrees = measured & (np.abs(depth - rendered) <= allowed)
    label = ray_label.copy()
    v, u = np.nonzero(measured & ~agrees)
    doubtful = (v, u)
    corrected, found = _label_nearby(ray_label, rendered, depth, allowed, doubtful)
    label[doubtful] = corrected
    agrees[doubtful] = found
    # A measurement where the mesh has a hole speaks for nothing: the background beside an object is no obstacle
    # before it.
    contradicts = measured & ~agrees & np.isfinite(rendered)
    silent = region & (depth <= 0) & (ray_label > 0)
    hidden = silent & _outvoted(agrees, contradicts, silent)
    label[hidden] = 0
    on_object = ray_label > 0
    in_front = contradicts & (depth < rendered)
    n_pixels = {
        "measured_and_agreeing": int(np.count_nonzero(agrees & on_object)),
        "measured_in_front": int(np.count_nonzero(in_front & on_object)),
        "measured_behind": int(np.count_nonzero(contradicts & ~in_front & on_object)),
        "not_measured_and_kept": int(np.count_nonzero(silent & ~hidden)),
        "not_measured_and_hidden": int(np.count_nonzero(hidden)),
    }
    return Decision(label, ~silent, agrees, in_front, n_pixels)


def _label_nearby(
    ray_label: UInt8[ndarray, "h w"],
    rendered: Float32[ndarray, "h w"],
    depth: Float32[ndarray, "h w"],
    allowed: Float32[ndarray, "h w"],
    doubtful: tuple[Int[ndarray, "n"], Int[ndarray, "n"]],
) -> tuple[UInt8[ndarray, "n"], Bool[ndarray, "n"]]:
    """Label of the nearest pixel around whose rendered depth agrees with the one measured here; (0, False) where none
    does."""
    height, width = depth.shape
    v, u = doubtful
    here, slack = depth[v, u], allowed[v, u]
    corrected, found = np.zeros(len(v), np.uint8), np.zeros(len(v), bool)
    steps = [(dv, du) for dv in range(-EDGE_REACH, EDGE_REACH + 1) for du in range(-EDGE_REACH, EDGE_REACH + 1)]
    for dv, du in sorted(steps, key=lambda step: step[0] ** 2 + step[1] ** 2)[1:]:
        v_near, u_near = np.clip(v + dv, 0, height - 1), np.clip(u + du, 0, width - 1)
        match = ~found & (np.abs(rendered[v_near, u_near] - here) <= slack)
        corrected[match] = ray_label[v_near[match], u_near[match]]
        found |= match
    return corrected, found


def _outvoted(
    agrees: Bool[ndarray, "h w"], contradicts: Bool[ndarray, "h w"], silent: Bool[ndarray, "h w"]
) -> Bool[ndarray, "h w"]:
    """Silent pixels among measured ones most of which contradict the mesh."""
    outvoted = np.zeros(agrees.shape, bool)
    if not contradicts.any():
        return outvoted
    balance = agrees.astype(np.float32) - contradicts
    spoken = (agrees | contradicts).astype(np.float32)
    undecided = silent.copy()
    for radius in VOTE_RADII:
        window = (2 * radius + 1, 2 * radius + 1)
        heard = undecided & (cv2.boxFilter(spoken, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT) > 0.5)
        votes = cv2.boxFilter(balance, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        outvoted |= heard & (votes < -0.5)
        undecided &= ~heard
    return outvoted
