"""The whole pipeline on the two recordings that ship with the repository; `make demo` runs it.

Every step is a command that a user could type, and is printed before it runs.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import time
from pathlib import Path

REPOSITORY = Path(__file__).parent.parent
BUILD = REPOSITORY / "build" / "demo"
DATASET = BUILD / "dataset"
REPORT = BUILD / "report.html"
CONFIG = "pipelines/tabletop/params.yaml"
COMPARED_FILTERS = ("expectation", "discrete")


def main() -> None:
    """Run all steps; the first that fails ends the demo with its exit code."""
    begun = time.monotonic()
    dataset = str(DATASET.relative_to(REPOSITORY))
    bask_data("ingest", "apc", "datasets/apc_shelf", dataset, "--scene", "apc_shelf", "--force")
    bask_data(
        *("ingest", "apc", "datasets/labelfusion_shelf", dataset, "--scene", "labelfusion_shelf"),
        *("--as", "demonstration", "--force"),
    )
    bask_data("run", dataset, "--config", CONFIG)
    for name in COMPARED_FILTERS:
        variants = ("--variant", name, "--descriptor", "main", "--reference", "main")
        bask_data("encode", dataset, "--config", CONFIG, *variants, "--filter", name)
    bask_data("validate", dataset)
    bask_data("report", dataset, "--out", str(REPORT.relative_to(REPOSITORY)))
    summarise(time.monotonic() - begun)


def bask_data(*arguments: str) -> None:
    """One command, printed as it can be typed."""
    print(f"\n$ bask-data {shlex.join(arguments)}", flush=True)
    command = Path(sys.executable).with_name("bask-data")
    code = subprocess.run([str(command), *arguments], cwd=REPOSITORY, check=False).returncode
    if code:
        sys.exit(code)


def summarise(seconds: float) -> None:
    """Say what was made and where to look."""
    print(f"\nDone in {seconds / 60:.1f} minutes. What was made:")
    for file in sorted(DATASET.rglob("artifact.json")):
        manifest = json.loads(file.read_text())
        size = sum(entry["bytes"] for entry in manifest["files"].values())
        print(f"  {file.parent.relative_to(REPOSITORY)!s:<58} {size / 1e6:7.1f} MB")
    print(f"\nLook at   {REPORT.relative_to(REPOSITORY)}   (open it in a browser)")
    print(f"Read it   zarr.open_group('{DATASET.relative_to(REPOSITORY)}', mode='r')   (any Zarr v3 reader)")
    print("Your own  bask-data ingest frames --help")


if __name__ == "__main__":
    main()
