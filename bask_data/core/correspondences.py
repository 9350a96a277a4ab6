"""Pixels of two views that show the same point of an object, sub-pixel in the second view, with every doubt a
rejection.

Depth comes from the fused surface, which has a fraction of one image's noise, corrected where the image's own
measurements say clearly that it is wrong (fusion rounds edges). Without a surface, depth is the measured one.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray

from bask_data.core.geometry import in_image, invert_rigid, project, transform, unproject

REJECTIONS = (
    "outside_b",
    "no_depth_in_b",
    "hidden_in_b",
    "other_surface_in_b",
    "other_instance_in_b",
    "doubtful_in_b",
    "cycle",
    "more_than_asked",
)
"""Reasons in the order they are tested; a candidate counts for the first it fails."""
GRAZING = np.cos(np.deg2rad(75.0))
"""More obliquely seen surface is not matched: what is off along its normal is four times as much off along the ray."""
SIGNIFICANT = 2.5
"""The surface is corrected where the measurements around differ from it by so many standard errors of their mean."""
MIN_MEASUREMENTS = 3
SIGMA_FROM_MAD = 1.4826
N_INSTANCES = 256


@dataclass(frozen=True)
class View:
    """One frame, ready to be matched; make it with `view`.

    Args:
        depth: best known z-depth, metres; 0 means unknown.
        instance: visible instance at each pixel, 0 none.
        sure: `instance` where it and the depth can be trusted, else 0.
        pixels: flat indices of sure pixels, grouped: those of instance k are `pixels[first[k]:first[k + 1]]`.
    """

    depth: Float32[ndarray, "h w"]
    instance: UInt8[ndarray, "h w"]
    sure: UInt8[ndarray, "h w"]
    pixels: Int[ndarray, "p"]
    first: Int[ndarray, "257"]
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]


@dataclass(frozen=True)
class Matches:
    """Matches of one pair of views, the same index for the same match."""

    instance: UInt8[ndarray, "m"]
    uv_a: Float32[ndarray, "m 2"]
    uv_b: Float32[ndarray, "m 2"]
    n_attempts: int
    rejections: Counter[str]


class Surface:
    """A mesh that rays can be cast against."""

    def __init__(self, vertices: Float32[ndarray, "n 3"], triangles: Int[ndarray, "m 3"]) -> None:
        self._scene = o3d.t.geometry.RaycastingScene()
        tensor = o3d.core.Tensor.from_numpy
        self._scene.add_triangles(
            tensor(np.ascontiguousarray(vertices)), tensor(np.ascontiguousarray(triangles, dtype=np.uint32))
        )

    def cast(
        self, uv: Float[ndarray, "n 2"], K: Float[ndarray, "3 3"], world_from_camera: Float[ndarray, "4 4"]
    ) -> tuple[Float32[ndarray, "n"], Float32[ndarray, "n"]]:
        """z-depth of the first hit through each pixel, metres, infinity for none; and the cosine of its incidence."""
        directions = (unproject(uv, np.ones(len(uv)), K) @ world_from_camera[:3, :3].T).astype(np.float32)
        rays = np.empty((len(uv), 6), np.float32)
        rays[:, :3], rays[:, 3:] = world_from_camera[:3, 3], directions
        hits = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        cosine = np.abs(np.einsum("ij,ij->i", hits["primitive_normals"].numpy(), directions))
        return hits["t_hit"].numpy(), cosine / np.linalg.norm(directions, axis=1)


def view(
    measured: Float32[ndarray, "h w"],
    instance: UInt8[ndarray, "_ _"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
    surface: Surface | None = None,
    tolerance: tuple[float, float] = (0.005, 0.01),
    margin: int = 2,
) -> View:
    """A frame with the best depth there is and its pixels sorted by instance.

    Args:
        measured: z-depth, metres; 0 means no measurement.
        surface: the fused surface of the scene.
        tolerance: (a, b): a measurement confirms the surface at depth z within a + b z metres.
        margin: pixels to stay away from the edge of a mask: there it is a matter of chance which surface a pixel shows.

    Raises:
        ValueError: sizes of depth and masks differ, or `margin` or a tolerance is negative.
    """
    if measured.shape != instance.shape:
        raise ValueError(f"measured and instance must have one size, got {measured.shape} and {instance.shape}")
    if min(margin, *tolerance) < 0:
        raise ValueError(f"margin and tolerance must be >= 0, got {margin} and {tolerance}")
    sure = inside(instance, margin)
    if surface is None:
        depth = measured
    else:
        where = np.flatnonzero(instance)
        width = instance.shape[1]
        uv = np.stack([where % width, where // width], axis=1).astype(np.float64)
        cast, cosine = surface.cast(uv, K, world_from_camera)
        rendered = np.zeros_like(measured)
        rendered.reshape(-1)[where] = np.where(np.isfinite(cast), cast, 0)
        depth, contradicted = refined(measured, rendered, tolerance)
        sure.reshape(-1)[where[cosine < GRAZING]] = 0
        sure[contradicted] = 0
    sure[depth <= 0] = 0
    pixels = np.flatnonzero(sure)
    labels = sure.reshape(-1)[pixels]
    pixels = pixels[np.argsort(labels, kind="stable")]
    first = np.concatenate([[0], np.cumsum(np.bincount(labels, minlength=N_INSTANCES))])
    return View(depth, instance, sure, pixels, first, K, world_from_camera)


def inside(instance: UInt8[ndarray, "h w"], margin: int) -> UInt8[ndarray, "h w"]:
    """The labels whose pixels around, `margin` far, are all the same; beyond the image's border all are."""
    window = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    alike = cv2.erode(instance, window) == cv2.dilate(instance, window)
    return np.where(alike, instance, np.uint8(0))


def refined(
    measured: Float32[ndarray, "h w"], rendered: Float32[ndarray, "h w"], tolerance: tuple[float, float]
) -> tuple[Float32[ndarray, "h w"], Bool[ndarray, "h w"]]:
    """The best depth of each pixel, metres, 0 unknown; and the pixels where measurement and surface contradict.

    The rendered depth, moved by the mean difference of the measurements around (3 x 3) where that is significant
    against the noise of the frame. Where the two contradict, and where nothing was rendered, the measured one.

    Args:
        rendered: z-depth of the fused surface, metres; 0 where there is none or it was not asked for.
    """
    both = (measured > 0) & (rendered > 0)
    difference = np.where(both, measured - rendered, np.float32(0))
    confirms = both & (np.abs(difference) <= np.float32(tolerance[0]) + np.float32(tolerance[1]) * measured)
    difference[~confirms] = 0
    count = cv2.boxFilter(confirms.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    total = cv2.boxFilter(difference, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    mean = total / np.maximum(count, np.float32(1))
    several = confirms & (count >= MIN_MEASUREMENTS)
    # The spread about the local mean is noise; that of the mean itself may be a surface that is off. Of n values a mean
    # leaves only n - 1 free to spread.
    spread = (np.abs(difference - mean) * np.sqrt(count / np.maximum(count - 1, 1)))[several]
    noise = SIGMA_FROM_MAD * float(np.median(spread)) if len(spread) else np.inf
    significant = (count >= MIN_MEASUREMENTS) & (np.abs(mean) * np.sqrt(count) > SIGNIFICANT * noise)
    best = np.where(significant, rendered + mean, rendered)
    contradicted = both & ~confirms
    return np.where((rendered > 0) & ~contradicted, best, measured), contradicted


def depth_between(
    depth: Float32[ndarray, "h w"], uv: Float[ndarray, "n 2"], tolerance: tuple[float, float]
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Depth between pixels, metres, and the nearest of the four depths around; 0 where none is known.

    Interpolated where the four pixels around agree; else that of the closest pixel that has one, because a
    mean of foreground and background is the depth of neither.

    Args:
        uv: inside the image.
        tolerance: (a, b): depths agree within a + b z.
    """
    height, width = depth.shape
    corner_u = np.clip(np.floor(uv[:, 0]), 0, max(width - 2, 0)).astype(np.int64)
    corner_v = np.clip(np.floor(uv[:, 1]), 0, max(height - 2, 0)).astype(np.int64)
    along_u, along_v = np.clip(uv[:, 0] - corner_u, 0.0, 1.0), np.clip(uv[:, 1] - corner_v, 0.0, 1.0)
    next_u, next_v = np.minimum(corner_u + 1, width - 1), np.minimum(corner_v + 1, height - 1)
    # (4, n) and not (n, 4): NumPy is many times faster along a long last axis.
    flat = depth.reshape(-1)
    rows, below = corner_v * width, next_v * width
    around = flat[np.stack([rows + corner_u, rows + next_u, below + corner_u, below + next_u])].astype(np.float64)
    weights = np.stack(
        [(1 - along_u) * (1 - along_v), along_u * (1 - along_v), (1 - along_u) * along_v, along_u * along_v]
    )
    farthest = around.max(axis=0)
    known = around > 0
    lowest = np.where(known, around, np.inf).min(axis=0)
    agree = known.all(axis=0) & (farthest - lowest <= tolerance[0] + tolerance[1] * farthest)
    # Bilinear weights fall with distance, so the heaviest measured pixel is the closest one.
    closest = around[np.where(known, weights, -1.0).argmax(axis=0), np.arange(len(uv))]
    nearest = np.where(np.isfinite(lowest), lowest, 0.0)
    return np.where(agree, (around * weights).sum(axis=0), closest), nearest


def candidates(a: View, b: View, n_attempts: int, rng: np.random.Generator) -> Int[ndarray, "c"]:
    """Flat indices of pixels of `a` on the instances that both views show, about equally many on each, none twice."""
    count = np.diff(a.first)
    shared = np.flatnonzero((count > 0) & (np.diff(b.first) > 0))
    quota = shares(count[shared], n_attempts)
    drawn = [
        a.pixels[a.first[k] + rng.choice(count[k], size=n, replace=False, shuffle=True)]
        for k, n in zip(shared, quota, strict=True)
    ]
    return np.concatenate([np.zeros(0, np.int64), *drawn])


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
    """Random matches from `a` to `b`, balanced over the instances.

    A pixel of `a` is lifted by its depth and projected into `b`. It stands if it lands in the image, the depth there
    agrees, the same instance is seen, and the way back by the depth of `b` ends within `max_cycle` pixels.

    Args:
        n_attempts: pixels of `a` tried at most; fewer when there are enough matches before.
        n_matches: kept at most.
        tolerance: (a, b): depths z agree within a + b z metres.

    Raises:
        ValueError: a tolerance or `max_cycle` is negative, or a number is not positive.
    """
    if min(*tolerance, max_cycle) < 0 or min(n_attempts, n_matches) < 1:
        raise ValueError(
            f"tolerance and max_cycle must be >= 0, n_attempts and n_matches >= 1, got {tolerance}, {max_cycle}, "
            f"{n_attempts}, {n_matches}"
        )
    tried = candidates(a, b, n_attempts, rng)
    label = a.instance.reshape(-1)[tried]
    # The instances in turn, so that an early end has tried equally many of each.
    in_turn = np.argsort(np.arange(len(tried)) - np.searchsorted(label, label), kind="stable")
    tried, label = tried[in_turn], label[in_turn]
    present = np.unique(label)
    width = a.depth.shape[1]
    uv_a = np.stack([tried % width, tried // width], axis=1).astype(np.float64)
    uv_b, failed = np.zeros((0, 2)), np.zeros(0, np.int64)
    for start in range(0, len(tried), 2 * n_matches):
        some = slice(start, start + 2 * n_matches)
        uv, why = follow(uv_a[some], label[some], a, b, tolerance, max_cycle)
        uv_b, failed = np.concatenate([uv_b, uv]), np.concatenate([failed, why])
        n_passed = np.bincount(label[: len(failed)][failed < 0], minlength=N_INSTANCES)[present]
        if n_passed.min() * len(present) >= n_matches:
            break
    passed = np.flatnonzero(failed < 0)
    passed = passed[np.argsort(label[passed], kind="stable")]
    # Grouped by instance, and within one in random order, so the first ones are a fair draw.
    of, begin, count = np.unique(label[passed], return_index=True, return_counts=True)
    quota, offset = np.zeros(N_INSTANCES, np.int64), np.zeros(N_INSTANCES, np.int64)
    quota[of], offset[of] = shares(count, n_matches), begin
    rank = np.arange(len(passed)) - offset[label[passed]]
    kept = passed[rank < quota[label[passed]]]
    rejections = Counter({REJECTIONS[i]: int(n) for i, n in enumerate(np.bincount(failed[failed >= 0])) if n})
    rejections["more_than_asked"] += len(passed) - len(kept)
    return Matches(label[kept], uv_a[kept].astype(np.float32), uv_b[kept].astype(np.float32), len(failed), rejections)


def follow(
    uv_a: Float[ndarray, "n 2"],
    label: UInt8[ndarray, "n"],
    a: View,
    b: View,
    tolerance: tuple[float, float],
    max_cycle: float,
) -> tuple[Float[ndarray, "n 2"], Int[ndarray, "n"]]:
    """Where pixels of `a` are in `b`, and the index in `REJECTIONS` of the first test each fails, -1 for none.

    Args:
        uv_a: pixel centres of `a` with known depth.
        label: the instance each must show in `b`.
    """
    u, v = uv_a.astype(np.int64).T
    b_from_a = invert_rigid(b.world_from_camera) @ a.world_from_camera
    uv_b, z = project(transform(b_from_a, unproject(uv_a, a.depth[v, u].astype(np.float64), a.K)), b.K)
    height, width = b.depth.shape
    failed = np.where(in_image(uv_b, height, width), -1, REJECTIONS.index("outside_b"))
    at = np.flatnonzero(failed < 0)
    uv, z = uv_b[at], z[at]
    allowed = tolerance[0] + tolerance[1] * z
    z_b, nearest = depth_between(b.depth, uv, tolerance)
    u, v = np.clip(np.rint(uv), 0, [width - 1, height - 1]).astype(np.int64).T
    back, _ = project(transform(invert_rigid(b_from_a), unproject(uv, z_b, b.K)), a.K)
    tests = {
        "no_depth_in_b": z_b <= 0,
        # The nearest of the four, not the one between: at the edge of something in front, the point may be behind it.
        "hidden_in_b": nearest < z - allowed,
        "other_surface_in_b": np.abs(z_b - z) > allowed,
        "other_instance_in_b": b.instance[v, u] != label[at],
        "doubtful_in_b": b.sure[v, u] != label[at],
        "cycle": ~(np.linalg.norm(back - uv_a[at], axis=1) <= max_cycle),
    }
    first = np.full(len(at), -1)
    for reason, fails in tests.items():
        first[(first < 0) & fails] = REJECTIONS.index(reason)
    failed[at] = first
    return uv_b, failed
