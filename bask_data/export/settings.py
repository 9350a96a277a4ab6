"""What to export, and how."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class ExportSettings:
    """What to export, and how.

    Args:
        variant: of the keypoints.
        only: demonstrations by name; none means all.
        validation, test: demonstrations to hold out; the others are for training.
        noise: standard deviation of Gaussian noise on each coordinate of the keypoints, metres.
        seed: of the noise, which depends on a demonstration's name and not on the others'.
        videos: whether the cameras' images go along.
        task: what is done, in words; without, what the demonstration's source says, or else the dataset's name.
    """

    variant: str = "main"
    only: Sequence[str] = ()
    validation: Sequence[str] = ()
    test: Sequence[str] = ()
    noise: float = 0.0
    seed: int = 0
    videos: bool = False
    task: str = ""
