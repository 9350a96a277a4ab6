"""Overlap of instances with labels: which belong together, and their IoU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

N_LABELS = 256
"""Labels and instances are bytes; 0 is background in both."""


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
