"""What an export says of itself: the document that every format writes beside its numbers, and by which it is known."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from bask_data.artifact import read_json
from bask_data.errors import BadData

DESCRIPTION = "bask.json"
"""File in an exported folder that says what its numbers mean."""


def write_description(folder: Path, described: dict[str, Any]) -> None:
    """Say in an exported folder what its numbers mean."""
    (folder / DESCRIPTION).write_text(json.dumps(described, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def read_description(folder: Path) -> object:
    """The document in a folder; None where there is none, or none that can be read."""
    file = folder / DESCRIPTION
    with suppress(BadData):
        return read_json(file) if file.is_file() else None
    return None
