"""The items that a page shows, and the parts of its sections.

A section is a list of parts, one per item; without parts it is left out. A part is a dictionary that the template lays
out: `numbers` are figures, `tiles` pictures, `rows` lines of a table, `plots` curves; `error` comes without the others.
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
"""Scenes, demonstrations and variants shown, at most: more make a page too large to load."""
N_ROWS = 32
"""Rows of a table, at most; those left out are counted below it."""
N_CAMERAS = 3
"""Cameras shown of an item, at most; those left out are counted."""
TILE, PICTURE, WIDE = 320, 480, 1100
"""Widths in pixels: of a contact sheet's tile, of a picture, of two views side by side."""
Part = dict[str, Any]


@dataclass(frozen=True)
class Chosen:
    """The items that a page shows: the first scenes, demonstrations and variants, and the worst."""

    dataset: Dataset
    measured: Measured
    scenes: list[str]
    demonstrations: list[str]
    variants: list[str]
    n_frames: int
    """Frames shown of each camera."""

    @cached_property
    def tracks(self) -> list[tuple[str, str, TrackScores]]:
        """(demonstration, variant, scores) of each track shown."""
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


def choose(dataset: Dataset, measured: Measured, n_frames: int, worst: Sequence[str] = ()) -> Chosen:
    """The first scenes, demonstrations and variants of the dataset; the worst items are among them."""
    kinds = (DescriptorNet, ReferenceKeypoints, KeypointTrack)
    variants = list(dict.fromkeys(name for kind in kinds for name in dataset.variants(kind)))
    return Chosen(
        dataset=dataset,
        measured=measured,
        scenes=_first(dataset.items("scene"), worst),
        demonstrations=_first(dataset.items("demonstration"), worst),
        variants=variants[:N_ITEMS],
        n_frames=n_frames,
    )


def _first(names: Sequence[str], worst: Sequence[str]) -> list[str]:
    """The worst items and as many of the first as there is space for, in their order."""
    kept = [name for name in dict.fromkeys(worst) if name in names][:N_ITEMS]
    others = [name for name in names if name not in kept][: N_ITEMS - len(kept)]
    return [name for name in names if name in {*kept, *others}]


def per_item(names: Sequence[str], part: Callable[[str], Part | None]) -> list[Part]:
    """The part of each item that has one; an unreadable item becomes a part with the error."""
    parts = []
    for name in names:
        try:
            item_part = part(name)
        except UNREADABLE as error:
            item_part = {"title": name, "error": what_is_wrong(error)}
        if item_part:
            parts.append(item_part)
    return parts


def untitled_if_alone(parts: list[Part]) -> list[Part]:
    """The parts, without a title if there is only one: a single variant needs no name."""
    return [{**part, "title": ""} for part in parts] if len(parts) == 1 else parts
