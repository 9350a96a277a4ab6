"""Scenes that can be evaluated."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from bask_data.artifact import MANIFEST, Artifact
from bask_data.dataset import Dataset
from bask_data.errors import UsageError
from bask_data.kinds import Truth


def scenes_with_truth(dataset: Dataset, kind: type[Artifact], only: Sequence[str]) -> list[str]:
    """The scenes asked for, or all that have both the artifact and ground truth.

    Raises:
        UsageError: there are none, or one asked for lacks either.
    """
    if only:
        dataset.select(only, "scene")
    scenes = [
        name
        for name in only or dataset.items("scene")
        if all((dataset.path(needed, name) / MANIFEST).exists() for needed in (kind, Truth))
    ]
    if not scenes or (only and len(scenes) < len(only)):
        raise UsageError(
            dataset.root,
            ", ".join(name for name in only if name not in scenes),
            expected=f"a scene with ground truth and {kind.kind}",
            got="none",
            fix=f"bask-data run {shlex.quote(str(dataset.root))}; ground truth comes with `ingest sim` and labelled "
            "recordings.",
        )
    return scenes
