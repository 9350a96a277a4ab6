"""Encoded demonstrations as the files that policies are learned from.

To add a format, touch two files:

1. `export/<name>.py`, new, with `write(out: Path, episodes: Episodes) -> list[str]`. It fills the empty folder `out`,
   which becomes OUT when it returns; a format that is a single file writes `out / SINGLE_FILE`. It goes through
   `episodes` once, so that one demonstration is in memory at a time, and returns notes for a person, if any.
   A folder says what its numbers mean by `write_description(out, episodes.described("<name>"))`; a format that has
   another place for this document has a function `description(path: Path) -> object`, too, which reads it there.
2. `export/table.py`: a line in `FORMATS`, from which the command line has the format's name, help and needs.

The command line imports the table and none of the formats, so that a format may import at its top what it needs.
What a format holds is said in `docs/export.md`.
"""

from __future__ import annotations

from bask_data.export.settings import ExportSettings
from bask_data.export.table import FORMATS, ExportFormat
from bask_data.export.writing import Exported, export

__all__ = ["FORMATS", "ExportFormat", "ExportSettings", "Exported", "export"]
