"""Whether `bask-data doctor` finds injected faults, and is silent without: `python benchmarks/injected_faults.py`.

Each fault of `tests/faulty_recordings.py` and `tests/faulty_datasets.py` is written as files and examined end to end,
with several seeds. A fault is found if one of its codes is among the findings. A finding of a code that the clean
recording of the seed has, too, does not count. Clean ones must have no error; their warnings are listed.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from typer.testing import CliRunner

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # The faults are among the tests.

from bask_data.cli.app import app
from tests.faulty_datasets import DATASET_FAULTS, Content, take, write_dataset
from tests.faulty_recordings import FAULTS, Frames, clean_frames

Found = list[tuple[str, str]]
"""Severity and code of findings."""


def examined(path: Path, *options: str) -> Found:
    """What `bask-data doctor` finds."""
    shown = CliRunner().invoke(app, ["doctor", str(path), "--json", "--fail-on", "never", *options])
    if shown.exit_code:
        raise RuntimeError(f"doctor {path}: exit code {shown.exit_code}: {shown.output[-2000:]} {shown.exception!r}")
    return [(finding["severity"], finding["code"]) for finding in json.loads(shown.stdout)["findings"]]


def of_frames(frames: Frames, folder: Path) -> Found:
    """What is found in frames, written to a folder."""
    frames.write(folder)
    return examined(folder, "--read-as", shlex.join(["frames", *frames.read_as]))


def main() -> int:
    parser = argparse.ArgumentParser(description="Faults that the doctor finds.")
    parser.add_argument("--seeds", type=int, default=3, help="recordings and datasets per fault")
    parser.add_argument("--seed", type=int, default=1000, help="the first one")
    parser.add_argument("--only", default="", help="faults whose names contain this")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.seeds)
    missed: list[str] = []
    alarms: Counter[str] = Counter()
    tally: dict[str, list[str]] = {}
    with tempfile.TemporaryDirectory() as name:
        for seed in seeds:
            rows = chain(_recordings(seed, Path(name), options.only), _datasets(seed, Path(name), options.only))
            for fault, codes, found, clean in rows:
                if not codes:
                    alarms.update(f"{severity} {code}" for severity, code in found if severity != "note")
                    print(f"seed {seed}, {fault}: {sorted({code for _, code in found})}", flush=True)
                    continue
                told = {code for _, code in found} - {code for _, code in clean}
                is_found = bool(told & set(codes))
                tally.setdefault(fault, []).append("found" if is_found else "missed")
                if not is_found:
                    missed.append(f"{fault}, seed {seed}: expected {' or '.join(codes)}, got {sorted(told)}")
                print(f"seed {seed}, {fault}: {'found' if is_found else 'MISSED'} {sorted(told)}", flush=True)
    print(f"\n{len(tally)} kinds of fault, {options.seeds} seeds each")
    print(*(f"  {fault:32} found {of.count('found')} of {len(of)}" for fault, of in tally.items()), sep="\n")
    n_errors = sum(n for what, n in alarms.items() if what.startswith("error"))
    print(f"clean recordings and datasets: {n_errors} errors; {dict(alarms) or 'no warnings'}")
    print(*missed, sep="\n")
    return 1 if missed or n_errors else 0


Row = tuple[str, tuple[str, ...], Found, Found]
"""A fault, its codes (none: clean), what was found, and what was found without the fault."""


def _recordings(seed: int, folder: Path, only: str) -> Iterator[Row]:
    clean = clean_frames(seed)
    without = of_frames(clean, folder / f"clean{seed}")
    yield "clean recording", (), without, without
    for i, fault in enumerate(FAULTS):
        if only in fault.name:
            found = of_frames(fault.inject(clean), folder / f"fault{seed}_{i}")
            yield fault.name, fault.codes, found, without


def _datasets(seed: int, folder: Path, only: str) -> Iterator[Row]:
    seen = take(seed), take(seed + 10_000), take(seed + 20_000)
    without: Found = []
    for k, content in enumerate((Content(), Content(splits=True))):
        without += examined(write_dataset(folder / f"clean_dataset{seed}_{k}", seen, content).root)
    yield "clean dataset", (), without, without
    for i, fault in enumerate(DATASET_FAULTS):
        if only in fault.name:
            dataset = write_dataset(folder / f"dataset{seed}_{i}", seen, fault.content)
            yield fault.name, fault.codes, examined(dataset.root), without


if __name__ == "__main__":
    sys.exit(main())
