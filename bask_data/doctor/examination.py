"""What an examination of a recording or a dataset says: findings, what was found right, and what a page shows."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bask_data.findings import SEVERITIES, Finding, Severity, by_severity

_FRAMES = re.compile(r"(.*?[^\s,]) \d+(?:-\d+)?(?:, \d+(?:-\d+)?)*")
"""A place that ends in numbers of frames."""

MOST_NAMED = 4
"""Places that are named where a finding is about several."""

_LISTED = re.compile(r"(?:\d+ frames:|frames?) (\d+(?:-\d+)?(?:, \d+(?:-\d+)?)*)")
"""Evidence that begins with the numbers of frames."""


@dataclass(frozen=True)
class Picture:
    """A picture for the page: RGB (h, w, 3) uint8, and what it shows."""

    rgb: np.ndarray
    text: str


@dataclass(frozen=True)
class Bar:
    """How well depth supports a way to read a recording.

    Args:
        share: mean evidence, in [0, 1].
        is_told: whether the recording was read this way.
    """

    reading: str
    share: float
    is_told: bool = False


@dataclass(frozen=True)
class ExaminedCamera:
    """One camera of a recording.

    Args:
        place: `recording/camera`.
        facts: figures for readers, by what they are.
        right: what was found right, in sentences.
        evidence: readings that were compared, the best first.
        edges: some frames with the edges of depth over colour.
        odd_frames: frames that findings are about.
    """

    place: str
    facts: dict[str, Any]
    findings: tuple[Finding, ...]
    right: tuple[str, ...] = ()
    evidence: tuple[Bar, ...] = ()
    edges: tuple[Picture, ...] = ()
    odd_frames: tuple[Picture, ...] = ()


@dataclass(frozen=True)
class Examination:
    """All that was found.

    Args:
        subject: what was examined.
        read_as: the command that reads a source so; empty for a dataset.
        findings: those that belong to no camera.
        right: what was found right, in sentences.
    """

    subject: str
    cameras: tuple[ExaminedCamera, ...] = ()
    findings: tuple[Finding, ...] = ()
    right: tuple[str, ...] = ()
    read_as: str = ""
    assumptions: dict[str, str] = field(default_factory=dict)

    @property
    def all_findings(self) -> list[Finding]:
        """Findings of everything, the worst first."""
        return by_severity([*self.findings, *(each for camera in self.cameras for each in camera.findings)])

    @property
    def all_right(self) -> list[str]:
        """What was found right, with its place."""
        of_cameras = [f"{camera.place}: {sentence}" for camera in self.cameras for sentence in camera.right]
        return [*of_cameras, *self.right]

    def count(self, severity: Severity) -> int:
        """Number of findings of a severity."""
        return sum(each.severity == severity for each in self.all_findings)

    def reaches(self, severity: Severity) -> bool:
        """Whether a finding is at least as bad."""
        return any(self.count(each) for each in SEVERITIES[: SEVERITIES.index(severity) + 1])


def by_place(findings: Iterable[Finding]) -> dict[str, list[Finding]]:
    """Findings by what they are about, the place with the worst first.

    Those of single frames are with their camera's. What is said alike of several places is said once, of all of them.
    """
    alike: dict[tuple[str, str, str], list[Finding]] = {}
    for each in by_severity(findings):
        alike.setdefault((each.code, each.evidence, each.fix), []).append(each)
    groups: dict[str, list[Finding]] = {}
    for same in alike.values():
        place = joined([each.place for each in same])
        match = _FRAMES.fullmatch(place) if len(same) == 1 else None
        groups.setdefault(match[1] if match else place, []).append(replace(same[0], place=place))
    return groups


def joined(places: Sequence[str]) -> str:
    """Several places in words: the first ones, and how many more there are."""
    named = list(dict.fromkeys(places))
    more = len(named) - MOST_NAMED
    return ", ".join(named) if more <= 0 else f"{', '.join(named[:MOST_NAMED])} and {more} more"


def frames_of(finding: Finding) -> list[int]:
    """The frames that a finding names: at the end of its place, or at the beginning of its evidence.

    `table/wrist 12-15, 20`, and `frame 3`, `frames 7-9` or `3 frames: 3, 8-9` as `frames_in_words` writes them.
    """
    place = _FRAMES.fullmatch(finding.place)
    listed = finding.place[len(place[1]) :] if place else ""
    if not listed and (match := _LISTED.match(finding.evidence)):
        listed = match[1]
    frames: list[int] = []
    for part in re.findall(r"\d+(?:-\d+)?", listed):
        first, _, last = part.partition("-")
        frames += range(int(first), int(last or first) + 1)
    return frames
