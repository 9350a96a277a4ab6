"""Lookup of artifacts that may be missing or unreadable."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from bask_data.artifact import MANIFEST, Artifact, Manifest
from bask_data.dataset import Dataset
from bask_data.errors import BaskError
from bask_data.evaluation.places import known
from bask_data.kinds import Recording, Truth

A = TypeVar("A", bound=Artifact)
UNREADABLE = (BaskError, LookupError, ValueError, ArithmeticError)
"""What broken or inconsistent artifacts raise: frames or columns missing, shapes that differ. A report shows the error
and continues, because it is where people look for such faults."""


def what_is_wrong(error: Exception) -> str:
    """The error in words; errors that are not ours are named by their type."""
    return str(error) if isinstance(error, BaskError) else f"{type(error).__name__}: {error}"


def find(dataset: Dataset, kind: type[A], item: str = "", variant: str = "main") -> A | None:
    """The artifact, or None if it does not exist."""
    path = dataset.path(kind, item, variant)
    return kind(path) if (path / MANIFEST).exists() else None


def find_recording(dataset: Dataset, item: str) -> Recording | None:
    """A scan or demonstration by name; None for names that are no item, which files from elsewhere may contain."""
    recorded = known(dataset, item)
    return None if recorded is None else recorded.recording


def find_truth(dataset: Dataset, item: str) -> Truth | None:
    """The ground truth of a recording, if there is one."""
    return find(dataset, Truth, item) if item in dataset.items("recording") else None


def spread_frames(n_frames: int, n_wanted: int) -> list[int]:
    """At most n_wanted frames, evenly spaced from the first to the last."""
    return sorted({int(i) for i in np.linspace(0, n_frames - 1, min(n_wanted, n_frames)).round()}) if n_frames else []


def input_path(manifest: Manifest, kind: type[Artifact]) -> str | None:
    """The path in the dataset of an artifact's input of a kind, by its manifest."""
    return next((path for path in sorted(manifest.inputs) if path.split("/")[0] == kind.kind), None)


def input_variant(dataset: Dataset, artifact: Artifact, kind: type[A], fallback: str) -> A | None:
    """The dataset-wide input that an artifact was made from, or the fallback variant's if its manifest names none."""
    path = input_path(artifact.manifest, kind)
    variant = path.split("/")[1] if path and path.count("/") == 1 else fallback
    return find(dataset, kind, "", variant if variant in dataset.variants(kind) else fallback)
