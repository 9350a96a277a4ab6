"""The command line: a command per stage, an `ingest` sub-command per format, and the dataset's commands.

`app` lists the commands; the module of each is loaded when it is used, so that help and completion are quick. A command
parses, calls one function and prints: results on stdout, everything else on stderr.
"""

from __future__ import annotations


def main() -> None:
    """Run the command line and leave with the documented exit code."""
    from bask_data.cli import app

    app.main()
