"""Random matches between two views, each tested for every known kind of error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int, UInt8
from numba import njit
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.correspondences.matchable import EDGE_JUMP, STEEPEST, MatchableView
from bask_data.core.geometry import invert_rigid

REJECTIONS = (
    "outside_b",
    "no_depth_in_b",
    "hidden_in_b",
    "other_surface_in_b",
    "other_instance_in_b",
    "doubtful_in_b",
    "cycle",
    "edge_in_b",
)
"""Reasons in the order of the tests; a pixel that was tried counts for the first test it fails."""

(
    _OUTSIDE_B,
    _NO_DEPTH_IN_B,
    _HIDDEN_IN_B,
    _OTHER_SURFACE_IN_B,
    _OTHER_INSTANCE_IN_B,
    _DOUBTFUL_IN_B,
    _CYCLE,
    _EDGE_IN_B,
) = range(len(REJECTIONS))

_MATCH = -1
"""No rejection; the others are positions in `REJECTIONS`."""

MOST_REACH = 6
"""Most pixels, beyond the margin, within which an occluder excludes a match. Chosen, sensitivity not measured."""


@dataclass(frozen=True)
class Matches:
    """Matches of one pair of views, grouped by instance.

    Args:
        tried: the instances that both views show.
        rejections: number of pixels of each of these that failed each of `REJECTIONS`.
    """

    instance: UInt8[ndarray, "m"]
    uv_a: Float32[ndarray, "m 2"]
    uv_b: Float32[ndarray, "m 2"]
    tried: UInt8[ndarray, "k"]
    rejections: Int[ndarray, "k reasons"]

    @property
    def n_attempts(self) -> int:
        return len(self.instance) + int(self.rejections.sum())


def shares(available: Int[ndarray, "k"], total: int) -> Int[ndarray, "k"]:
    """Numbers to take of each, as equal as possible, that add up to `total`, or to all that are available."""
    taken = np.zeros_like(available)
    left = total
    for done, i in enumerate(np.argsort(available, kind="stable")):
        taken[i] = min(int(available[i]), left // (len(available) - done))
        left -= int(taken[i])
    return taken


def match(
    a: MatchableView,
    b: MatchableView,
    rng: np.random.Generator,
    n_attempts: int = 4000,
    n_matches: int = 1000,
    tolerance: tuple[float, float] = (0.005, 0.01),
    max_cycle: float = 0.7,
) -> Matches:
    """Random matches from `a` to `b`, balanced over the instances: the one with the fewest matches is always next.

    A pixel of `a` is lifted by its depth and projected into `b`. It is a match if it lies in the image, the depth there
    agrees, the same instance is seen, projecting back by the depth of `b` ends within `max_cycle` pixels, and neither
    pixel is at the edge of a surface.

    Args:
        n_attempts: most pixels of `a` to try, divided evenly over the instances.
        n_matches: number of matches after which the search ends.
        tolerance: (a, b): depths z agree within a + b z metres.

    Raises:
        ValueError: a tolerance or `max_cycle` is negative, or a number is not positive.
    """
    if min(*tolerance, max_cycle) < 0 or min(n_attempts, n_matches) < 1:
        raise ValueError(
            f"tolerance and max_cycle must be >= 0, n_attempts and n_matches >= 1, got {tolerance}, {max_cycle}, "
            f"{n_attempts}, {n_matches}"
        )
    count = np.diff(a.first)
    shared = np.flatnonzero((count > 0) & (np.diff(b.first) > 0))
    quota = shares(count[shared], n_attempts)
    b_from_a = invert_rigid(b.world_from_camera) @ a.world_from_camera
    label, found, rejections = _search(
        (a.depth, a.K, a.noise),
        (b.depth, b.K, b.margin),
        b.instance,
        b.sure,
        b_from_a,
        invert_rigid(b_from_a),
        a.pixels,
        a.first,
        shared,
        quota,
        rng.random(int(quota.sum())),
        n_matches,
        tolerance,
        max_cycle,
    )
    order = np.argsort(label, kind="stable")
    found = found[order]
    return Matches(label[order], found[:, :2].copy(), found[:, 2:].copy(), shared.astype(np.uint8), rejections)


@compiled
def _search(  # type: ignore[no-untyped-def]
    a, b, instance_b, sure_b, b_from_a, a_from_b, pixels, first, shared, quota, draws, n_matches, tolerance, max_cycle
):
    """Matches in the order found: labels (m,), (u_a, v_a, u_b, v_b) (m, 4), and rejections (k, reasons).

    Args:
        a, b: depth and intrinsics of the two views, the noise of a, and the margin of b.
        quota: pixels to try of each of the `shared` instances.
        draws: uniform in [0, 1), one for each of these.
    """
    n_instances = len(shared)
    rejections = np.zeros((n_instances, len(REJECTIONS)), np.int64)
    n_passed, n_tried = np.zeros(n_instances, np.int64), np.zeros(n_instances, np.int64)
    most = min(n_matches, len(draws))
    labels, found = np.empty(most, np.uint8), np.empty((most, 4), np.float32)
    # A copy, shuffled as far as it is used: each draw is then from the pixels that were not tried yet.
    waiting = [pixels[first[k] : first[k + 1]].copy() for k in shared]
    width = a[0].shape[1]
    n_found = 0
    for i_draw in range(len(draws)):
        least = -1
        for i in range(n_instances):
            if n_tried[i] < quota[i] and (least < 0 or n_passed[i] < n_passed[least]):
                least = i
        order, done = waiting[least], n_tried[least]
        drawn = done + int(draws[i_draw] * (len(order) - done))
        pixel = order[drawn]
        order[drawn] = order[done]
        n_tried[least] = done + 1
        u, v = pixel % width, pixel // width
        label = shared[least]
        why, u_b, v_b = _follow(u, v, label, a, b, instance_b, sure_b, b_from_a, a_from_b, tolerance, max_cycle)
        if why != _MATCH:
            rejections[least, why] += 1
            continue
        labels[n_found] = label
        found[n_found, 0], found[n_found, 1], found[n_found, 2], found[n_found, 3] = u, v, u_b, v_b
        n_passed[least] += 1
        n_found += 1
        if n_found == n_matches:
            break
    return labels[:n_found], found[:n_found], rejections


@njit(inline="always")
def _follow(  # type: ignore[no-untyped-def]
    u, v, label, a, b, instance_b, sure_b, b_from_a, a_from_b, tolerance, max_cycle
):
    """The first test that a pixel of `a` fails, or `_MATCH`, and its position in `b`."""
    depth_a, K_a, noise_a = a
    depth_b, K_b, margin_b = b
    height, width = depth_b.shape
    z_a = float(depth_a[v, u])
    u_b, v_b, z = _carried(float(u), float(v), z_a, K_a, b_from_a, K_b)
    if not (z > 0 and -0.5 <= u_b < width - 0.5 and -0.5 <= v_b < height - 0.5):
        return _OUTSIDE_B, u_b, v_b
    allowed = tolerance[0] + tolerance[1] * z
    z_b, nearest = depth_between(depth_b, u_b, v_b, tolerance)
    if z_b <= 0:
        return _NO_DEPTH_IN_B, u_b, v_b
    # The nearest of the four, not the interpolated one: at the edge of an occluder, the point may be behind it.
    if nearest < z - allowed:
        return _HIDDEN_IN_B, u_b, v_b
    if abs(z_b - z) > allowed:
        return _OTHER_SURFACE_IN_B, u_b, v_b
    column, row = min(max(int(np.rint(u_b)), 0), width - 1), min(max(int(np.rint(v_b)), 0), height - 1)
    if sure_b[row, column] != label:
        return (_DOUBTFUL_IN_B if instance_b[row, column] == label else _OTHER_INSTANCE_IN_B), u_b, v_b
    u_back, v_back, z_back = _carried(u_b, v_b, z_b, K_b, a_from_b, K_a)
    if not (z_back > 0 and (u_back - u) ** 2 + (v_back - v) ** 2 <= max_cycle**2):
        return _CYCLE, u_b, v_b
    # With an error of two standard deviations in the depth of a, the point would be elsewhere; it must not be hidden
    # there, either.
    off = 2 * noise_a * (tolerance[0] + tolerance[1] * z_a)
    u_off, v_off, _ = _carried(float(u), float(v), z_a + off, K_a, b_from_a, K_b)
    reach = margin_b + min(int(np.sqrt((u_off - u_b) ** 2 + (v_off - v_b) ** 2) + 0.5), MOST_REACH)
    if _is_crowded(depth_b, column, row, z, K_b[0, 0], reach, tolerance):
        return _EDGE_IN_B, u_b, v_b
    return _MATCH, u_b, v_b


@njit(inline="always")
def _carried(u, v, z, K_from, to_from, K_to):  # type: ignore[no-untyped-def]
    """Pixel and depth, in another camera, of the point that one camera shows at depth z."""
    y = (v - K_from[1, 2]) / K_from[1, 1]
    x = (u - K_from[0, 2] - K_from[0, 1] * y) / K_from[0, 0]
    x, y = x * z, y * z
    x_to = to_from[0, 0] * x + to_from[0, 1] * y + to_from[0, 2] * z + to_from[0, 3]
    y_to = to_from[1, 0] * x + to_from[1, 1] * y + to_from[1, 2] * z + to_from[1, 3]
    z_to = to_from[2, 0] * x + to_from[2, 1] * y + to_from[2, 2] * z + to_from[2, 3]
    if z_to <= 0:
        return np.nan, np.nan, z_to
    u_to = (K_to[0, 0] * x_to + K_to[0, 1] * y_to) / z_to + K_to[0, 2]
    return u_to, K_to[1, 1] * y_to / z_to + K_to[1, 2], z_to


@njit(inline="always")
def depth_between(depth, u, v, tolerance):  # type: ignore[no-untyped-def]
    """Depth between pixels, metres, and the nearest of the four depths around; 0 where none is known.

    Interpolated where the four agree; else the depth of the closest pixel that has one, because a mean of foreground
    and background is the depth of neither.

    Args:
        u, v: inside the image.
        tolerance: (a, b): depths agree within a + b z.
    """
    height, width = depth.shape
    u_0, v_0 = min(max(int(np.floor(u)), 0), max(width - 2, 0)), min(max(int(np.floor(v)), 0), max(height - 2, 0))
    along_u, along_v = min(max(u - u_0, 0.0), 1.0), min(max(v - v_0, 0.0), 1.0)
    nearest, farthest, closest = np.inf, 0.0, 0.0
    heaviest, total, n_known = -1.0, 0.0, 0
    for i in range(4):
        du, dv = i % 2, i // 2
        z = float(depth[min(v_0 + dv, height - 1), min(u_0 + du, width - 1)])
        if z <= 0:
            continue
        weight = (along_u if du else 1 - along_u) * (along_v if dv else 1 - along_v)
        nearest, farthest = min(nearest, z), max(farthest, z)
        total += weight * z
        n_known += 1
        # Bilinear weights fall with distance, so the heaviest measured pixel is the closest one.
        if weight > heaviest:
            heaviest, closest = weight, z
    if n_known == 0:
        return 0.0, 0.0
    if n_known == 4 and farthest - nearest <= tolerance[0] + tolerance[1] * farthest:
        return total, nearest
    return closest, nearest


@njit(inline="always")
def _is_crowded(depth, u, v, z, focal, reach, tolerance):  # type: ignore[no-untyped-def]
    """Whether some surface within `reach` pixels is nearer than the slope of one surface explains."""
    height, width = depth.shape
    allowed = EDGE_JUMP * (tolerance[0] + tolerance[1] * z)
    nearest = np.float32(z - allowed)
    per_pixel = STEEPEST * z / focal
    for row in range(max(v - reach, 0), min(v + reach + 1, height)):
        around = depth[row]
        for column in range(max(u - reach, 0), min(u + reach + 1, width)):
            # Most pixels end here, after one comparison in single precision.
            if 0 < around[column] < nearest:
                slope = per_pixel * np.sqrt((row - v) ** 2 + (column - u) ** 2)
                if around[column] < z - allowed - slope:
                    return True
    return False
