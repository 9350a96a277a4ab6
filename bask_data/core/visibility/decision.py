"""The label of each pixel, from the ray to the mesh and the measured depth together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from bask_data.core.compiled import compiled

EDGE_REACH = 2
"""Pixels by which the mesh's silhouette may be off the object's. Chosen; its sensitivity is in docs/benchmarks.md."""

VOTE_RADII = (2, 4)
"""Half the windows, pixels, in which measured pixels vote on one without measurement; the wider where the first has
none. In a larger window, a single wrong measurement on a shiny face would remove all that was not measured. Chosen,
sensitivity not measured."""


STEPS_NEARBY = np.array(
    sorted(
        ((dv, du) for dv in range(-EDGE_REACH, EDGE_REACH + 1) for du in range(-EDGE_REACH, EDGE_REACH + 1)),
        key=lambda step: step[0] ** 2 + step[1] ** 2,
    )[1:]
)
"""(24, 2) steps along v and u to the pixels within `EDGE_REACH`, nearest first."""


@dataclass(frozen=True)
class Decision:
    """The labels of an image and how they were decided.

    Args:
        measured: False where the ray meets an object and nothing was measured.
        agrees: the measurement lies on the mesh, at this pixel or within `EDGE_REACH`.
        in_front: the measurement lies in front of the mesh.
        n_pixels: pixels of objects by how they were decided.
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
    """The label of each pixel.

    - Ray and measurement agree: the ray's label.
    - They disagree, but the measurement agrees with the mesh within `EDGE_REACH` pixels: the label there. Edges are
      then where they were measured, not where the voxels put them, and thin parts keep their width.
    - Measured in front of the mesh: an occluder that the mesh does not contain, such as a hand or a gripper. Measured
      behind: an error of the mesh, or the object was moved. Neither shows the object: 0.
    - Not measured: the ray's label, unless most measurements nearby are in front of or behind the mesh.

    Args:
        ray_label: instance that the ray meets first.
        rendered: z-depth of that hit, metres; infinity for none.
        depth: measured z-depth, metres; 0 means no measurement.
        region: pixels a ray was cast for; others keep their label.
        tolerance: (a, b): measurement and mesh agree within a + b z metres.
    """
    label, agrees, in_front, silent, vote, counts = _by_measurement(
        ray_label, rendered, depth, region, np.float32(tolerance[0]), np.float32(tolerance[1]), STEPS_NEARBY
    )
    n_agreeing, n_in_front, n_behind, n_silent, n_contradicting = counts.tolist()
    n_hidden = int(_hide_outvoted(vote, silent, label, VOTE_RADII)) if n_silent and n_contradicting else 0
    n_pixels = {
        "measured_and_agreeing": n_agreeing,
        "measured_in_front": n_in_front,
        "measured_behind": n_behind,
        "not_measured_and_kept": n_silent - n_hidden,
        "not_measured_and_hidden": n_hidden,
    }
    return Decision(label, ~silent, agrees, in_front, n_pixels)


@compiled
def _by_measurement(  # type: ignore[no-untyped-def]
    ray_label, rendered, depth, region, constant, per_metre, steps
):
    """All that is decided pixel by pixel, in one pass over the image: label, agrees, in front, silent (h, w); the vote
    of each pixel (h, w), 1 where the measurement lies on the mesh, -1 where it contradicts it; and the numbers of
    pixels of objects that agree, are measured in front, behind, or not at all, and of pixels that contradict.

    Args:
        steps: (n, 2) steps along v and u to the pixels whose surface a measurement off the mesh is compared with,
            nearest first.
    """
    height, width = depth.shape
    label = ray_label.copy()
    agrees, in_front = np.zeros((height, width), np.bool_), np.zeros((height, width), np.bool_)
    silent, vote = np.zeros((height, width), np.bool_), np.zeros((height, width), np.int8)
    counts = np.zeros(5, np.int64)
    for v in range(height):
        for u in range(width):
            if not region[v, u]:
                continue
            z, surface, own = depth[v, u], rendered[v, u], ray_label[v, u]
            if not z > 0:
                if own > 0:
                    silent[v, u] = True
                    counts[3] += 1
                continue
            allowed = constant + per_metre * z
            on_mesh = abs(z - surface) <= allowed
            if not on_mesh:
                label[v, u] = 0
                for k in range(len(steps)):
                    v_near = min(max(v + steps[k, 0], 0), height - 1)
                    u_near = min(max(u + steps[k, 1], 0), width - 1)
                    if abs(rendered[v_near, u_near] - z) <= allowed:
                        label[v, u] = ray_label[v_near, u_near]
                        on_mesh = True
                        break
            if on_mesh:
                agrees[v, u] = True
                vote[v, u] = 1
                counts[0] += own > 0
            elif np.isfinite(surface):
                # A measurement where the mesh has a hole has no vote: the background beside an object does not
                # occlude it.
                vote[v, u] = -1
                counts[4] += 1
                in_front[v, u] = z < surface
                if own > 0:
                    counts[1 if z < surface else 2] += 1
    return label, agrees, in_front, silent, vote, counts


@compiled
def _hide_outvoted(vote, silent, label, radii):  # type: ignore[no-untyped-def]
    """Remove the label of silent pixels around which most measurements contradict the mesh, and count these pixels.

    Sums over a window slide along rows and columns, so a large window costs no more than a small one.
    """
    height, width = vote.shape
    undecided, n_hidden = silent.copy(), 0
    for radius in radii:
        balance, n_spoken = np.zeros(width, np.int32), np.zeros(width, np.int32)
        for v in range(-radius, height):
            below, above = v + radius, v - radius - 1
            if below < height:
                for u in range(width):
                    balance[u] += vote[below, u]
                    n_spoken[u] += abs(vote[below, u])
            if above >= 0:
                for u in range(width):
                    balance[u] -= vote[above, u]
                    n_spoken[u] -= abs(vote[above, u])
            if v < 0:
                continue
            votes, n_heard = 0, 0
            for u in range(-radius, width):
                if u + radius < width:
                    votes += balance[u + radius]
                    n_heard += n_spoken[u + radius]
                if u > radius:
                    votes -= balance[u - radius - 1]
                    n_heard -= n_spoken[u - radius - 1]
                if u >= 0 and undecided[v, u] and n_heard > 0:
                    undecided[v, u] = False
                    if votes < 0:
                        label[v, u] = 0
                        n_hidden += 1
    return n_hidden
