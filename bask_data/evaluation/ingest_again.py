"""The command that reads a recording again, from what the dataset remembers of its source."""

from __future__ import annotations

import os
import shlex

from bask_data.dataset import Dataset
from bask_data.formats import FORMATS

REFINED = "refine"
"""Format of the source of recordings that `bask-data refine` wrote."""


def ingest_command(dataset: Dataset, item: str, fix: str = "") -> str:
    """The command that reads a recording again in place of what is there; that of the simulator is not repeated.

    Args:
        fix: options that replace those with which it was read wrongly.
    """
    source = {**dataset.file.scenes, **dataset.file.demonstrations}[item]
    if source.format == REFINED:
        given = str(source.options.get("recording") or source.options.get("scan"))
        scan = source.options.get("apply")
        words = ["bask-data", "refine", str(dataset.root), given, "--as", item]
        return shlex.join([*words, *(["--apply", str(scan)] if scan else []), "--force"])
    if source.format not in {format.name for format in FORMATS}:
        return f"bask-data ingest {source.format} ... --force"
    path = os.path.normpath(dataset.root / source.path)
    words = ["bask-data", "ingest", source.format, path, str(dataset.root), "--scene", item]
    words += ["--as", "demonstration"] if item in dataset.file.demonstrations else []
    new = {word for word in fix.split() if word.startswith("--")}
    for name, value in source.options.items():
        flag = f"--{name.replace('_', '-')}"
        if flag in new or (fix and name == "trust"):
            continue
        if isinstance(value, bool):
            words.append(flag if value else f"--no-{flag[2:]}")
        else:
            words += [flag, ",".join(map(str, value)) if isinstance(value, list) else str(value)]
    # No shell has seen the fix: a quote in it is a character like any other.
    return shlex.join([*words, *fix.split(), "--force"])
