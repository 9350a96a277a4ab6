"""What of a dataset is to be shown in the viewer, and what was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Choice:
    """What of a dataset to show.

    Args:
        items: scenes and demonstrations by name.
        every: shows each so many-th frame.
        n_pairs: most pairs of views whose matches are shown, for each scene.
        variant: of descriptor network, reference keypoints and tracks.
        beliefs: track demonstrations again, to show what the filter believes in each frame.
    """

    items: Sequence[str]
    every: int = 1
    n_pairs: int = 40
    variant: str = "main"
    beliefs: bool = False


@dataclass
class Shown:
    """What of one item went into a recording.

    Args:
        frames: number of frames shown of each camera.
        layers: what is there to be seen, in a few words each.
        missing: what could be there and is not, and why.
    """

    frames: dict[str, int] = field(default_factory=dict)
    layers: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
