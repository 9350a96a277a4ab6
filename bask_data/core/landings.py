"""Where tracked keypoints land on labelled images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from bask_data.core.geometry import in_image
from bask_data.core.label_overlap import N_LABELS

OUTSIDE = -1
"""The label that stands for a pixel outside the image."""


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
