"""Labels of a scene and the instances that cover them, as `masks_figures` lists them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from bask_data.evaluation import usual


def merged_labels(labels: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of the labelled objects that share an instance with another: they touch, or `objects` merged them."""
    return [str(row["name"]) for row in labels if row["shared"]]


def median_apart(labels: Sequence[Mapping[str, Any]]) -> float | None:
    """Median IoU of the labelled objects with an instance of their own; None without any."""
    apart = [float(row["iou"]) for row in labels if not row["shared"]]
    return median(apart) if apart else None


def labels_confirm(labels: Sequence[Mapping[str, Any]]) -> bool:
    """Whether every labelled object has an instance of its own that overlaps it well."""
    return bool(labels) and all(not row["shared"] and not usual.IOU.is_unusual(row["iou"]) for row in labels)
