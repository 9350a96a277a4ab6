"""What a page shows of a dataset, and how its sections are made of parts.

A section is a list of parts, one per item; no part, no section. A part is a plain dictionary that the template knows
how to lay out: `numbers` are figures, `tiles` pictures, `rows` lines of a table, `plots` curves; `error` stands alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from bask_data.dataset import Dataset
from bask_data.evaluation.figures import Measured
from bask_data.evaluation.lookup import UNREADABLE, find, what_is_wrong
from bask_data.evaluation.network_figures import networks
from bask_data.evaluation.track_figures import TrackScores
from bask_data.kinds import DescriptorNet, KeypointTrack, ReferenceKeypoints

N_ITEMS = 3
"""Scenes, demonstrations and variants shown; more would make a page nobody loads."""
N_ROWS = 32
"""Of a table, at most; what is left out is counted below it."""
N_CAMERAS = 3
"""Cameras of an item that are shown; what is left out is counted."""
TILE, PICTURE, WIDE = 320, 480, 1100
"""Pixels of width: of a contact sheet's tile, of a picture to look into, of two views beside each other on a page."""
Part = dict[str, Any]


@dataclass(frozen=True)
class Chosen:
    """The items a page shows: the first few of each sort."""

    dataset: Dataset
    measured: Measured
    scenes: list[str]
    demonstrations: list[str]
    variants: list[str]
    n_frames: int
    """Frames shown of each camera."""

    @cached_property
    def tracks(self) -> list[tuple[str, str, TrackScores]]:
        """(demonstration, variant, scores) of every track shown."""
        return [
            (name, variant, self.measured.track(name, variant))
            for variant in self.variants
            for name in self.demonstrations
            if find(self.dataset, KeypointTrack, name, variant)
        ]

    @cached_property
    def networks(self) -> dict[str, DescriptorNet]:
        """Descriptor networks by variant."""
        return networks(self.dataset)

    @cached_property
    def masks(self) -> dict[str, dict[str, Any]]:
        """Figures of the masks of each scene shown."""
        return {name: value for name in self.scenes if (value := self.measured.masks(name))}


def choose(dataset: Dataset, measured: Measured, n_frames: int) -> Chosen:
    """The first items of each sort."""
    kinds = (DescriptorNet, ReferenceKeypoints, KeypointTrack)
    variants = list(dict.fromkeys(name for kind in kinds for name in dataset.variants(kind)))
    return Chosen(
        dataset=dataset,
        measured=measured,
        scenes=dataset.items("scene")[:N_ITEMS],
        demonstrations=dataset.items("demonstration")[:N_ITEMS],
        variants=variants[:N_ITEMS],
        n_frames=n_frames,
    )


def per_item(names: Sequence[str], part: Callable[[str], Part | None]) -> list[Part]:
    """A part per item that has one; an item that cannot be read says so and spoils no other."""
    parts = []
    for name in names:
        try:
            made = part(name)
        except UNREADABLE as error:
            made = {"title": name, "error": what_is_wrong(error)}
        if made:
            parts.append(made)
    return parts


def untitled_if_alone(parts: list[Part]) -> list[Part]:
    """A variant's name says something only where there are several."""
    return [{**part, "title": ""} for part in parts] if len(parts) == 1 else parts
