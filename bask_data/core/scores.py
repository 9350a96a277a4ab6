"""Accuracy of masks, matches and keypoints compared with ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bask_data.core.geometry import in_image, invert_rigid, project, transform, unproject

N_LABELS = 256
"""Labels and instances are bytes; 0 is background in both."""
OUTSIDE = -1
"""The label that stands for a pixel outside the image."""


@dataclass(frozen=True)
class Distribution:
    """Statistics of n numbers; NaN where there are none."""

    n: int
    median: float
    mean: float
    p90: float
    largest: float


def distribution(values: Float[ndarray, "..."]) -> Distribution:
    """Median, mean, 90th percentile and maximum of the finite values; `n` counts these."""
    finite = values[np.isfinite(values)].astype(np.float64)
    if not len(finite):
        return Distribution(0, np.nan, np.nan, np.nan, np.nan)
    return Distribution(
        n=len(finite),
        median=float(np.median(finite)),
        mean=float(finite.mean()),
        p90=float(np.percentile(finite, 90)),
        largest=float(finite.max()),
    )


def overlap(labels: UInt8[ndarray, "h w"], instances: UInt8[ndarray, "h w"]) -> Int[ndarray, "256 256"]:
    """Pixels by true label (rows) and found instance (columns). Tables of several frames may be added."""
    both = labels.astype(np.int64) * N_LABELS + instances
    return np.bincount(both.ravel(), minlength=N_LABELS * N_LABELS).reshape(N_LABELS, N_LABELS)


@dataclass(frozen=True)
class LabelMatch:
    """The instance with the largest IoU with a label; instance 0 and IoU 0 if none overlaps it."""

    label: int
    instance: int
    iou: float
    n_pixels: int
    """Pixels with this label, over all frames."""


def best_instances(table: Int[ndarray, "256 256"]) -> list[LabelMatch]:
    """For each label that occurs, the instance of largest IoU, over all frames together.

    An instance may be the best of several labels: objects that were not separated have a low IoU.

    Args:
        table: of `overlap`, summed over frames.
    """
    of_label, iou = table.sum(axis=1), _iou(table)
    best = iou.argmax(axis=1)
    return [
        LabelMatch(int(label), int(best[label]), float(iou[label, best[label]]), int(of_label[label]))
        for label in np.flatnonzero(of_label)
        if label != 0
    ]


def joined(touching: Sequence[tuple[int, int]]) -> UInt8[ndarray, "256"]:
    """For each label, the smallest label of its group, where labels that touch are one group.

    Geometry cannot separate touching bodies, so they are compared with one instance. Use it as `joined(t)[labels]`.
    """
    graph = coo_array(
        (np.ones(len(touching), bool), np.asarray(touching, np.int64).reshape(-1, 2).T), shape=(N_LABELS, N_LABELS)
    )
    group = connected_components(graph, directed=False)[1]
    # Groups are numbered in the order of their smallest labels.
    return np.unique(group, return_index=True)[1][group].astype(np.uint8)


def paired_instances(table: Int[ndarray, "256 256"]) -> list[LabelMatch]:
    """For each label that occurs, the instance of the one-to-one assignment with the largest sum of IoU.

    Args:
        table: of `overlap`, summed over frames.
    """
    iou = _iou(table)
    labels = np.flatnonzero(table.sum(axis=1)[1:]) + 1
    chosen = linear_sum_assignment(-iou[labels, 1:])[1] + 1
    return [
        LabelMatch(int(label), int(i) if iou[label, i] > 0 else 0, float(iou[label, i]), int(table[label].sum()))
        for label, i in zip(labels, chosen, strict=True)
    ]


def _iou(table: Int[ndarray, "256 256"]) -> Float[ndarray, "256 256"]:
    """IoU of each label and instance; 0 for instance 0, the background."""
    union = table.sum(axis=1)[:, None] + table.sum(axis=0)[None, :] - table
    iou = np.where(union > 0, table / np.maximum(union, 1), 0.0)
    iou[:, 0] = 0.0
    return iou


def label_at(labels: UInt8[ndarray, "h w"], pixel: Float[ndarray, "*n 2"]) -> Int[ndarray, "*n"]:
    """The label of the nearest pixel; `OUTSIDE` where the position is outside the image or NaN."""
    height, width = labels.shape
    inside = in_image(pixel, height, width)
    nearest = np.rint(np.where(inside[..., None], pixel, 0)).astype(np.int64)
    u, v = nearest[..., 0].clip(0, width - 1), nearest[..., 1].clip(0, height - 1)
    return np.where(inside, labels[v, u].astype(np.int64), OUTSIDE)


@dataclass(frozen=True)
class Landing:
    """The labels at k keypoints in one frame."""

    in_view: Bool[ndarray, "k"]
    """Whether any pixel of the keypoint's own object is in the frame; the other fields are meaningful only then."""
    label: Int[ndarray, "k"]
    """The label at the keypoint, or `OUTSIDE`."""
    exact: Bool[ndarray, "k"]
    """Whether that is the keypoint's own object."""
    near: Bool[ndarray, "k"]
    """Whether the own object is within the tolerance."""
    chance: Float[ndarray, "k"]
    """Chance level: the own object's share of the image."""


def landing(
    pixel: Float[ndarray, "k 2"],
    own_label: Int[ndarray, "k"],
    labels: UInt8[ndarray, "h w"],
    tolerance_px: float,
) -> Landing:
    """Whether keypoints lie on the objects they belong to.

    Args:
        pixel: (u, v); NaN or outside the image is on no object.
        own_label: label of each keypoint's object; 0, unknown, is never in view.
        tolerance_px: distance from its object, pixels, up to which a keypoint counts as near.

    Raises:
        ValueError: `tolerance_px` is negative.
    """
    if tolerance_px < 0:
        raise ValueError(f"tolerance_px: expected >= 0 pixels, got {tolerance_px}")
    share = np.bincount(labels.ravel(), minlength=N_LABELS) / labels.size
    share[0] = 0.0
    chance = share[own_label]
    under = label_at(labels, pixel)
    exact = (under == own_label) & (own_label > 0)
    near = exact.copy()
    for i in np.flatnonzero(~exact & (chance > 0) & np.isfinite(pixel).all(axis=1)):
        near[i] = _distance_to_label(pixel[i], int(own_label[i]), labels, tolerance_px) <= tolerance_px
    return Landing(in_view=chance > 0, label=under, exact=exact, near=near, chance=chance)


def _distance_to_label(pixel: Float[ndarray, "2"], label: int, labels: UInt8[ndarray, "h w"], reach_px: float) -> float:
    """Pixels to the nearest centre with this label, searched up to about `reach_px`; infinity if there is none."""
    height, width = labels.shape
    u_low, v_low = np.maximum(np.floor(pixel - reach_px), 0).astype(np.int64)
    u_high, v_high = np.minimum(np.ceil(pixel + reach_px) + 1, [width, height]).astype(np.int64)
    if u_low >= u_high or v_low >= v_high:
        return np.inf
    v, u = np.nonzero(labels[v_low:v_high, u_low:u_high] == label)
    if not len(u):
        return np.inf
    return float(np.hypot(u + u_low - pixel[0], v + v_low - pixel[1]).min())


def spread(covariance: Float[ndarray, "t k 3 3"]) -> Float[ndarray, "t k"]:
    """Metres: the root of the covariance's trace, which is the root mean square distance from the mean."""
    return np.sqrt(np.maximum(np.trace(covariance, axis1=-2, axis2=-1).astype(np.float64), 0.0))


def step_length(mean: Float[ndarray, "t k 3"]) -> Float[ndarray, "t_minus_1 k"]:
    """Distance that each keypoint moves from a frame to the next, metres; jitter where nothing moves."""
    return np.linalg.norm(np.diff(mean.astype(np.float64), axis=0), axis=-1)


@dataclass(frozen=True)
class ObjectShares:
    """Labels at keypoints over many frames, as shares of the pairs of frame and keypoint whose own object is in view.

    `right` is on the own object; `right`, `other`, `background` and `outside` add up to one.
    """

    n: int
    right: float
    near: float
    other: float
    background: float
    outside: float
    chance: float


def object_shares(landings: Sequence[Landing], chosen: Bool[ndarray, "k"] | None = None) -> ObjectShares:
    """Shares over frames and keypoints.

    Args:
        chosen: only these keypoints.
    """
    if not landings:
        return ObjectShares(0, *[np.nan] * 6)
    counted = np.stack([frame.in_view for frame in landings])
    if chosen is not None:
        counted &= chosen
    n = int(counted.sum())
    if not n:
        return ObjectShares(0, *[np.nan] * 6)
    exact = np.stack([frame.exact for frame in landings])[counted]
    label = np.stack([frame.label for frame in landings])[counted]
    return ObjectShares(
        n=n,
        right=float(exact.mean()),
        near=float(np.stack([frame.near for frame in landings])[counted].mean()),
        other=float(((label > 0) & ~exact).mean()),
        background=float((label == 0).mean()),
        outside=float((label == OUTSIDE).mean()),
        chance=float(np.stack([frame.chance for frame in landings])[counted].mean()),
    )


INTERPOLABLE = 0.02
"""Share by which the farthest of the four depths around a position may exceed the nearest for them to be of one
surface. Chosen; its sensitivity is in docs/benchmarks.md."""


def true_depth(
    depth: Float32[ndarray, "h w"], labels: UInt8[ndarray, "h w"], uv: Float[ndarray, "n 2"]
) -> Float[ndarray, "n"]:
    """z-depth of exact depth images at positions between pixels, metres; 0 where there is none, and outside the image.

    Bilinear in inverse depth, which is exact on planes, where the four pixels around show one surface of one body; else
    that of the nearest pixel.
    """
    height, width = depth.shape
    inside = in_image(uv, height, width)
    uv = np.where(inside[:, None], uv, 0.0)
    u, v = np.rint(uv).astype(np.int64).clip(0, [width - 1, height - 1]).T
    nearest = depth[v, u].astype(np.float64)
    u0, v0 = np.floor(uv).astype(np.int64).clip(0, [max(width - 2, 0), max(height - 2, 0)]).T
    u1, v1 = np.minimum(u0 + 1, width - 1), np.minimum(v0 + 1, height - 1)
    corners = (v0, u0), (v0, u1), (v1, u0), (v1, u1)
    around = np.stack([depth[corner] for corner in corners]).astype(np.float64)
    one_body = np.all([labels[corner] == labels[v, u] for corner in corners], axis=0)
    lowest, highest = around.min(axis=0), around.max(axis=0)
    smooth = one_body & (lowest > 0) & (highest <= (1 + INTERPOLABLE) * lowest)
    along_u, along_v = np.clip(uv - np.stack([u0, v0], axis=1), 0.0, 1.0).T
    weights = np.stack(
        [(1 - along_u) * (1 - along_v), along_u * (1 - along_v), (1 - along_u) * along_v, along_u * along_v]
    )
    between = 1.0 / (weights / np.where(smooth, around, 1.0)).sum(axis=0)
    return np.where(inside, np.where(smooth, between, nearest), 0.0)


@dataclass(frozen=True)
class TrueView:
    """Ground truth of one view.

    Args:
        depth: z-depth, metres; 0 where the ray hits nothing.
        labels: the body at each pixel.
    """

    depth: Float32[ndarray, "h w"]
    labels: UInt8[ndarray, "h w"]
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]


@dataclass(frozen=True)
class MatchErrors:
    """Errors of m matches. The true point is the one that the pixel of the first view shows."""

    error_px: Float[ndarray, "m"]
    """Pixels in the second view between the match and the true point; infinity where there is no true point, or it is
    behind the second camera."""
    depth: Float[ndarray, "m"]
    """z-depth of the true point in the second view, metres; NaN where there is none."""
    behind: Float[ndarray, "m"]
    """Metres by which the true point is behind the surface that the second view shows at the nearest pixel: hidden, if
    more than the slope of a surface explains. Minus infinity without a surface there, and outside the image."""

    def hidden(self, slack: tuple[float, float] = (0.02, 0.0)) -> Bool[ndarray, "m"]:
        """Matches whose true point is hidden in the second view: more than a + b z metres behind the surface there.

        Args:
            slack: (a, b); the default assumes a tabletop.
        """
        return self.behind > slack[0] + slack[1] * np.nan_to_num(self.depth)


def match_errors(
    uv_a: Float[ndarray, "m 2"],
    uv_b: Float[ndarray, "m 2"],
    a: TrueView,
    b: TrueView,
) -> MatchErrors:
    """Errors of matches by exact depth and exact cameras.

    Args:
        uv_a, uv_b: matched pixels of the two views.
    """
    z_a = true_depth(a.depth, a.labels, uv_a.astype(np.float64))
    points_b = transform(
        invert_rigid(b.world_from_camera) @ a.world_from_camera, unproject(uv_a.astype(np.float64), z_a, a.K)
    )
    points_b[z_a <= 0] = np.nan
    true_uv, z_b = project(points_b, b.K)
    error = np.linalg.norm(true_uv - uv_b, axis=1)
    inside = in_image(true_uv, *b.depth.shape)
    nearest = np.rint(np.where(inside[:, None], true_uv, 0.0)).astype(np.int64)
    # Rounding a position on the last half pixel may lead out of the image.
    u, v = nearest.clip(0, [b.depth.shape[1] - 1, b.depth.shape[0] - 1]).T
    shown = b.depth[v, u].astype(np.float64)
    behind = np.where(inside & (shown > 0), z_b - shown, -np.inf)
    return MatchErrors(np.where(np.isfinite(error), error, np.inf), z_b, behind)
