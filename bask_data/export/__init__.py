"""Exports of encoded demonstrations to file formats for learning policies.

To add a format, touch two files:

1. `export/<name>.py`, new, with `write(out: Path, episodes: Episodes) -> list[str]`. It fills the empty folder `out`,
   which becomes OUT when it returns; a format that is a single file writes `out / SINGLE_FILE`. It iterates over
   `episodes`, so that one demonstration is in memory at a time, and returns notes for the user, if any. A folder is
   documented by `write_description(out, episodes.described("<name>"))`; a format that keeps this document elsewhere
   also has a function `description(path: Path) -> object` that reads it.
2. `export/table.py`: a line in `FORMATS` with the format's name, help and requirements.

The command line imports the table but not the formats, so that a format may import any package at its top.
`docs/export.md` documents the contents of each format.
"""

from __future__ import annotations

from bask_data.export.settings import ExportSettings
from bask_data.export.table import FORMATS, ExportFormat
from bask_data.export.writing import Exported, export

__all__ = ["FORMATS", "ExportFormat", "ExportSettings", "Exported", "export"]
