"""What a source of unknown format may be."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Guess:
    """A format that a source may have, and how it would be read.

    Args:
        format: its name.
        source: the folder or file to read: the one that was looked at, or inside it.
        reasons: what was seen there, in words.
        options: that the files suggest, by name.
        missing: options that no file states, with a placeholder for the value.
        has_robot: whether the source carries a robot's states.
    """

    format: str
    source: Path
    reasons: tuple[str, ...]
    options: dict[str, str] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    has_robot: bool = False
