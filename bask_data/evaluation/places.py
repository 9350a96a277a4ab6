"""Ground truth of reference keypoints in the recordings of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from bask_data.artifact import MANIFEST
from bask_data.dataset import Dataset
from bask_data.kinds import Demonstration, Pick, Scan, Truth
from bask_data.kinds.places import Known, true_places

if TYPE_CHECKING:
    import numpy as np


def known(dataset: Dataset, name: str) -> Known | None:
    """A scan or demonstration with its ground truth; None for names that are no item, as in files from elsewhere."""
    kind: type[Scan] | type[Demonstration] = Scan if name in dataset.file.scenes else Demonstration
    if name not in dataset.items(kind.scope) or not (dataset.path(kind, name) / MANIFEST).exists():
        return None
    path = dataset.path(Truth, name)
    return Known(kind(dataset.path(kind, name)), Truth(path) if (path / MANIFEST).exists() else None)


def known_of(dataset: Dataset, picks: Sequence[Pick], name: str = "") -> dict[str, Known]:
    """By name, a recording and those that keypoints were picked in, as far as they exist."""
    names = dict.fromkeys([*([name] if name else []), *(pick.recording for pick in picks)])
    return {item: recorded for item in names if (recorded := known(dataset, item)) is not None}


def places_of(dataset: Dataset, picks: Sequence[Pick], name: str) -> np.ndarray:
    """Ground-truth positions of keypoints in each frame of a recording that exists (t, k, 3), metres, world frame; NaN
    where unknown, or the object is absent."""
    return true_places(picks, known_of(dataset, picks, name), name)
