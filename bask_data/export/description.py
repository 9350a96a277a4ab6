"""The document that describes an export; every format includes it, and exports are recognised by it."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from bask_data.artifact import read_json
from bask_data.errors import BadData

DESCRIPTION = "bask.json"
"""File with the description in an exported folder."""


def write_description(folder: Path, described: dict[str, Any]) -> None:
    """Write the description into an exported folder."""
    (folder / DESCRIPTION).write_text(json.dumps(described, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def read_description(folder: Path) -> object:
    """The description in a folder; None if it is missing or unreadable."""
    file = folder / DESCRIPTION
    with suppress(BadData):
        return read_json(file) if file.is_file() else None
    return None
