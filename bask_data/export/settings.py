"""What to export, and how."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class ExportSettings:
    """What to export, and how.

    Args:
        variant: variant of the keypoints.
        only: names of demonstrations; empty means all.
        validation, test: demonstrations to hold out; the others are for training.
        noise: standard deviation of Gaussian noise on each coordinate of the keypoints, metres.
        seed: seed of the noise, which depends on a demonstration's name but not on the other demonstrations.
        videos: whether to include the cameras' images.
        cameras: whether to include the cameras' images, depth, intrinsics and poses, for `ingest` to read back.
        task: description of the task; if empty, that of the demonstration's source, or else the dataset's name.
    """

    variant: str = "main"
    only: Sequence[str] = ()
    validation: Sequence[str] = ()
    test: Sequence[str] = ()
    noise: float = 0.0
    seed: int = 0
    videos: bool = False
    cameras: bool = False
    task: str = ""
