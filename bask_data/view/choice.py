"""What to show of a dataset in the viewer, and what a recording shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Choice:
    """What to show of a dataset.

    Args:
        items: names of scenes and demonstrations.
        every: show every n-th frame.
        n_pairs: pairs of views whose matches are shown, at most, per scene.
        variant: of descriptor network, reference keypoints and tracks.
        beliefs: track demonstrations again to show the filter's belief in each frame.
    """

    items: Sequence[str]
    every: int = 1
    n_pairs: int = 40
    variant: str = "main"
    beliefs: bool = False


@dataclass
class Shown:
    """What a recording shows of one item.

    Args:
        frames: number of frames shown, by camera.
        layers: what is shown, in a few words each.
        missing: what could be shown and is not, and why.
    """

    frames: dict[str, int] = field(default_factory=dict)
    layers: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
