"""The command line: a command per stage, an `ingest` sub-command per format, and the dataset's commands."""

from __future__ import annotations

from bask_data.cli.app import main as main
