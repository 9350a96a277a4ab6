"""The command line: a command per stage, an `ingest` sub-command per format, and commands for datasets.

`app` lists the commands and loads a command's module when it is used, so that help and completion are fast. A command
parses, calls one function and prints: results on stdout, everything else on stderr.
"""

from __future__ import annotations


def main() -> None:
    """Run the command line and exit with the documented code."""
    from bask_data.cli import app

    app.main()
