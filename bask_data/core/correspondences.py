"""Pixels of two views that show the same point of an object, sub-pixel in the second view, with every doubt a
rejection.

Depth comes from the fused surface, which has a fraction of one image's noise, corrected where the image's own
measurements say clearly that it is wrong (fusion rounds edges). Without a surface, depth is the measured one.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numba import njit
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.depth import SIGMA_FROM_MAD
from bask_data.core.geometry import invert_rigid, unproject
from bask_data.core.visibility.surface import Surface

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
"""Reasons in the order they are tested; a pixel that was tried counts for the first it fails."""
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
GRAZING_ANGLE = np.deg2rad(75.0)
"""More obliquely seen surface is not matched: what is off along its normal is four times as much off along the ray."""
GRAZING = np.cos(GRAZING_ANGLE)
STEEPEST = float(np.tan(GRAZING_ANGLE))
ON_SURFACE = 0.005
"""Metres in front of a point in which a hit is still the surface the point is on."""
EDGE = 0.5
"""A surface begins where depth jumps by more than this share of the tolerance, and the slope of one surface besides."""
MOST_REACH = 6
"""Pixels around a match in which, besides the margin, something in front is looked for at most."""
SIGNIFICANT = 2.5
"""The surface is corrected where the measurements around differ from it by so many standard errors of their mean."""
MIN_MEASUREMENTS = 3
TINY = np.float32(1e-12)
N_INSTANCES = 256


@dataclass(frozen=True)
class View:
    """One frame, ready to be matched; make it with `view`.

    Args:
        depth: best known z-depth, metres; 0 means unknown.
        instance: visible instance at each pixel, 0 none.
        sure: `instance` where it and the depth can be trusted, else 0.
        pixels: flat indices of sure pixels, grouped: those of instance k are `pixels[first[k]:first[k + 1]]`.
        margin: pixels that a match stays away from the edges of masks and of surfaces.
        noise: standard deviation of a measured depth, as a share of the tolerance; 0 where it is not known.
    """

    depth: Float32[ndarray, "h w"]
    instance: UInt8[ndarray, "h w"]
    sure: UInt8[ndarray, "h w"]
    pixels: Int32[ndarray, "p"]
    first: Int[ndarray, "257"]
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]
    margin: int
    noise: float


@dataclass(frozen=True)
class Matches:
    """Matches of one pair of views, the same index for the same match, grouped by instance.

    Args:
        tried: the instances that both views show.
        rejections: how many pixels of each of these failed each of `REJECTIONS`.
    """

    instance: UInt8[ndarray, "m"]
    uv_a: Float32[ndarray, "m 2"]
    uv_b: Float32[ndarray, "m 2"]
    tried: UInt8[ndarray, "k"]
    rejections: Int[ndarray, "k reasons"]

    @property
    def n_attempts(self) -> int:
        return len(self.instance) + int(self.rejections.sum())


def cast_through(
    surface: Surface,
    uv: Float[ndarray, "n 2"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
) -> tuple[Float32[ndarray, "n"], Float32[ndarray, "n"]]:
    """z-depth of the first hit through each pixel, metres, infinity for none; and the cosine of its incidence."""
    directions = (unproject(uv, np.ones(len(uv)), K) @ world_from_camera[:3, :3].T).astype(np.float32)
    rays = np.empty((len(uv), 6), np.float32)
    rays[:, :3], rays[:, 3:] = world_from_camera[:3, 3], directions
    hits = surface.cast(rays)
    cosine = np.abs(np.einsum("ij,ij->i", hits.normal, directions))
    return hits.distance, cosine / np.linalg.norm(directions, axis=1)


def unhidden(
    surface: Surface, points_world: Float[ndarray, "n 3"], world_from_camera: Float[ndarray, "4 4"]
) -> Bool[ndarray, "n"]:
    """Points of a surface with no other part of it between them and the camera."""
    rays = np.empty((len(points_world), 6), np.float32)
    rays[:, :3], rays[:, 3:] = world_from_camera[:3, 3], points_world - world_from_camera[:3, 3]
    length = np.linalg.norm(rays[:, 3:], axis=1)
    clear: Bool[ndarray, "n"] = surface.cast(rays).distance * length > length - ON_SURFACE
    return clear


def view(
    measured: Float32[ndarray, "h w"],
    instance: UInt8[ndarray, "_ _"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
    surface: Surface | None = None,
    tolerance: tuple[float, float] = (0.005, 0.01),
    margin: int = 2,
    distrusted: Bool[ndarray, "h w"] | None = None,
) -> View:
    """A frame with the best depth there is and its pixels sorted by instance.

    Args:
        measured: z-depth, metres; 0 means no measurement.
        surface: the fused surface of the scene.
        tolerance: (a, b): a measurement confirms the surface at depth z within a + b z metres.
        margin: pixels to stay away from the edge of a mask: there it is a matter of chance which surface a pixel shows.
        distrusted: pixels that are not matched, such as those whose measurement was thrown away as no surface's.

    Raises:
        ValueError: sizes of depth and masks differ, or `margin` or a tolerance is negative.
    """
    if measured.shape != instance.shape:
        raise ValueError(f"measured and instance must have one size, got {measured.shape} and {instance.shape}")
    if min(margin, *tolerance) < 0:
        raise ValueError(f"margin and tolerance must be >= 0, got {margin} and {tolerance}")
    sure = instance if distrusted is None else np.where(distrusted, np.uint8(0), instance)
    depth, noise = measured, 0.0
    if surface is not None:
        where = np.flatnonzero(instance)
        width = instance.shape[1]
        uv = np.stack([where % width, where // width], axis=1).astype(np.float64)
        cast, cosine = cast_through(surface, uv, K, world_from_camera)
        rendered = np.zeros_like(measured)
        rendered.reshape(-1)[where] = np.where(np.isfinite(cast), cast, 0)
        depth, doubtful, noise = refined(measured, rendered, tolerance)
        sure = np.where(doubtful, np.uint8(0), sure)
        sure.reshape(-1)[where[cosine < GRAZING]] = 0
    instance, depth = np.ascontiguousarray(instance), np.ascontiguousarray(depth)
    steepest = EDGE * tolerance[0], EDGE * tolerance[1] + STEEPEST / K[0, 0]
    inner, pixels, first = inside(instance, np.ascontiguousarray(sure), depth, margin, steepest)
    return View(depth, instance, inner, pixels, first, K, world_from_camera, margin, noise)


@njit(inline="always")
def _is_jump(one, other, steepest):  # type: ignore[no-untyped-def]
    """Whether two neighbouring pixels show two surfaces; what has no depth says nothing."""
    return one > 0 and other > 0 and abs(one - other) > steepest[0] + steepest[1] * min(one, other)


@compiled
def inside(  # type: ignore[no-untyped-def]
    instance, sure, depth, margin, steepest
):
    """Labels whose pixels around, `margin` far, are all the same and of one surface, that are sure, and have depth,
    else 0 (h, w); beyond the image's border all are the same. And the flat indices of these pixels, grouped by label,
    and where each label begins (257,).

    One pass over the image: a window of one label is as many rows of it below each other as the window is high, and in
    each the label's run must be as long as the window is wide. A step in depth ends a run, along a row and along the
    middle column: no edge crosses a window without crossing one of these.

    Args:
        steepest: (a, b): from a pixel to the next, depth z of one surface changes by at most a + b z metres.
    """
    height, width = instance.shape
    inner = np.zeros((height, width), np.uint8)
    first = np.zeros(N_INSTANCES + 1, np.int64)
    # Rows above each pixel, itself included, that have one label throughout the window's width.
    rows = np.zeros(width, np.int64)
    begin, end = height, 0
    for v in range(height + margin):
        here = min(v, height - 1)
        row, above = instance[here], instance[max(min(v, height) - 1, 0)]
        labelled = np.flatnonzero(row)
        if len(labelled) == 0:
            rows[:] = 0
            continue
        left, right = labelled[0], labelled[-1] + 1
        rows[:left], rows[right:] = 0, 0
        run = left
        for u_end in range(left, right + margin):
            if left < u_end < width and (
                row[u_end] != row[u_end - 1] or _is_jump(depth[here, u_end], depth[here, u_end - 1], steepest)
            ):
                run = u_end
            u = u_end - margin
            if u < left:
                continue
            label = row[u]
            if label == 0 or run > max(u - margin, 0):
                rows[u] = 0
                continue
            if v == 0:
                rows[u] = margin + 1
            elif above[u] == label and (v >= height or not _is_jump(depth[v, u], depth[v - 1, u], steepest)):
                rows[u] += 1
            else:
                rows[u] = 1
            centre = v - margin
            if centre >= 0 and rows[u] > 2 * margin and sure[centre, u] == label and depth[centre, u] > 0:
                inner[centre, u] = label
                first[label + 1] += 1
                begin, end = min(begin, centre), max(end, centre + 1)
    for label in range(N_INSTANCES):
        first[label + 1] += first[label]
    pixels = np.empty(first[-1], np.int32)
    after = first[:-1].copy()
    for v in range(begin, end):
        for u in range(width):
            label = inner[v, u]
            if label > 0:
                pixels[after[label]] = v * width + u
                after[label] += 1
    return inner, pixels, first


def refined(
    measured: Float32[ndarray, "h w"], rendered: Float32[ndarray, "h w"], tolerance: tuple[float, float]
) -> tuple[Float32[ndarray, "h w"], Bool[ndarray, "h w"], float]:
    """The best depth of each pixel, metres, 0 unknown; the pixels where measurement and surface contradict, or none is
    measured near; and the standard deviation of measurements, as a share of the tolerance, 0 where there are too few.

    The rendered depth, moved by the mean difference of the measurements around (5 x 5) where that is significant
    against the noise of the frame, and by as much of the pixel's own difference from that mean as its surroundings
    differ more than noise explains: little where the sensor is noisy, all where it is exact. Where the two contradict,
    and where nothing was rendered, the measured one.

    Args:
        rendered: z-depth of the fused surface, metres; 0 where there is none or it was not asked for.

    Source of the second step: Lee 1980, digital image enhancement and noise filtering by use of local statistics.
    """
    both = (measured > 0) & (rendered > 0)
    difference = np.where(both, measured - rendered, np.float32(0))
    allowed = np.float32(tolerance[0]) + np.float32(tolerance[1]) * measured
    confirms = both & (np.abs(difference) <= allowed)
    difference[~confirms] = 0
    count = np.maximum(_sum_around(confirms.astype(np.float32)), np.float32(1))
    mean = _sum_around(difference) / count
    several = confirms & (count >= MIN_MEASUREMENTS)
    # The spread about the local mean is noise; that of the mean itself may be a surface that is off. Of n values a mean
    # leaves only n - 1 free to spread. Noise grows with depth as the tolerance does.
    spread = (np.abs(difference - mean) * np.sqrt(count / np.maximum(count - 1, 1)) / allowed)[several]
    share = SIGMA_FROM_MAD * float(np.median(spread)) if len(spread) else 0.0
    noise = np.float32(share) * allowed
    significant = (count >= MIN_MEASUREMENTS) & (np.abs(mean) * np.sqrt(count) > SIGNIFICANT * noise)
    best = np.where(significant, rendered + mean, rendered)
    variance = np.maximum(_sum_around(difference**2) - count * mean**2, 0) / np.maximum(count - 1, 1)
    own = np.where(several, np.maximum(1 - SIGNIFICANT * noise**2 / np.maximum(variance, TINY), 0), np.float32(0))
    best = best + own * (measured - best)
    contradicted = both & ~confirms
    # What hands and grippers that give no depth hide is not known; a gap in the depth of a surface has it around.
    supported = (count >= MIN_MEASUREMENTS) & (count > _sum_around(contradicted.astype(np.float32)))
    unsupported = (measured <= 0) & (rendered > 0) & ~supported
    return np.where((rendered > 0) & ~contradicted, best, measured), contradicted | unsupported, share


def _sum_around(image: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    return cv2.boxFilter(image, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)


def shares(available: Int[ndarray, "k"], total: int) -> Int[ndarray, "k"]:
    """How many to take of each so that together they are `total`, or all there is, and as equal as can be."""
    taken = np.zeros_like(available)
    left = total
    for done, i in enumerate(np.argsort(available, kind="stable")):
        taken[i] = min(int(available[i]), left // (len(available) - done))
        left -= int(taken[i])
    return taken


def match(
    a: View,
    b: View,
    rng: np.random.Generator,
    n_attempts: int = 4000,
    n_matches: int = 1000,
    tolerance: tuple[float, float] = (0.005, 0.01),
    max_cycle: float = 0.7,
) -> Matches:
    """Random matches from `a` to `b`, balanced over the instances: the one with the fewest matches is always next.

    A pixel of `a` is lifted by its depth and projected into `b`. It stands if it lands in the image, the depth there
    agrees, the same instance is seen, the way back by the depth of `b` ends within `max_cycle` pixels, and neither end
    is at the edge of a surface.

    Args:
        n_attempts: pixels of `a` tried at most, shared out evenly over the instances.
        n_matches: when there are so many, no more pixels are tried.
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
    """Matches as found: labels (m,), (u, v, u, v) (m, 4), and rejections (k, reasons).

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
    # Shuffled as far as it is used, in a copy: so each draw is of the pixels that were not tried yet.
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
    """The first test that a pixel of `a` fails, or `_MATCH`, and where it is in `b`."""
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
    # The nearest of the four, not the one between: at the edge of something in front, the point may be behind it.
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
    # Were the depth in a two standard deviations off, the point would be elsewhere, and what is there must not hide it.
    off = 2 * noise_a * (tolerance[0] + tolerance[1] * z_a)
    u_off, v_off, _ = _carried(float(u), float(v), z_a + off, K_a, b_from_a, K_b)
    reach = margin_b + min(int(np.sqrt((u_off - u_b) ** 2 + (v_off - v_b) ** 2) + 0.5), MOST_REACH)
    if _is_crowded(depth_b, column, row, z, K_b[0, 0], reach, tolerance):
        return _EDGE_IN_B, u_b, v_b
    return _MATCH, u_b, v_b


@njit(inline="always")
def _carried(u, v, z, K_from, to_from, K_to):  # type: ignore[no-untyped-def]
    """Pixel and depth in another camera of what one camera shows at depth z."""
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

    Interpolated where the four pixels around agree; else that of the closest pixel that has one, because a
    mean of foreground and background is the depth of neither.

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
    """Whether within `reach` pixels some surface is nearer than the slope of one surface explains."""
    height, width = depth.shape
    allowed = EDGE * (tolerance[0] + tolerance[1] * z)
    nearest = np.float32(z - allowed)
    per_pixel = STEEPEST * z / focal
    for row in range(max(v - reach, 0), min(v + reach + 1, height)):
        around = depth[row]
        for column in range(max(u - reach, 0), min(u + reach + 1, width)):
            # Most pixels pass here, at one comparison of the smaller type each.
            if 0 < around[column] < nearest:
                slope = per_pixel * np.sqrt((row - v) ** 2 + (column - u) ** 2)
                if around[column] < z - allowed - slope:
                    return True
    return False
