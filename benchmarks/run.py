"""How many times faster we are than a plain way of doing the same, for everything in `benchmarks/bench_*.py`.

A benchmark file has one function:

    def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
        yield "clusters of 1 M points", ours, plain

Both must do the same work; data is made before the `yield`. The two run alternately, so that a machine that slows down
meanwhile slows both, and the median of the ratios counts: ratios transfer between machines, seconds do not.

    python benchmarks/run.py                 all
    python benchmarks/run.py objects filter  only bench_objects.py and bench_filter.py
    python benchmarks/run.py --json out.json the figures as a file, too
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
Work = Callable[[], object]


@dataclass(frozen=True)
class Row:
    """One comparison: `ratio` is how many times faster ours is, `lowest` and `highest` its range over the rounds."""

    benchmark: str
    case: str
    ours_s: float
    plain_s: float
    ratio: float
    lowest: float
    highest: float
    rounds: int


def compare(benchmark: str, case: str, ours: Work, plain: Work, *, budget: float, max_rounds: int) -> Row:
    """Run both in turn until `budget` seconds are spent, at least three times each."""
    seconds(ours)  # The first call compiles, allocates and reads: neither side is charged for it.
    seconds(plain)
    begun = time.perf_counter()
    pairs: list[tuple[float, float]] = []
    while len(pairs) < 3 or (len(pairs) < max_rounds and time.perf_counter() - begun < budget):
        pairs.append((seconds(ours), seconds(plain)))
    ratios = sorted(slow / fast for fast, slow in pairs)
    return Row(
        benchmark,
        case,
        ours_s=statistics.median(fast for fast, _ in pairs),
        plain_s=statistics.median(slow for _, slow in pairs),
        ratio=statistics.median(ratios),
        lowest=ratios[0],
        highest=ratios[-1],
        rounds=len(pairs),
    )


def seconds(work: Work) -> float:
    """Wall time of one call."""
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def cases_of(file: Path) -> Iterator[tuple[str, Work, Work]]:
    """Load a benchmark file and start its `cases`."""
    spec = importlib.util.spec_from_file_location(f"benchmarks.{file.stem}", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield from module.cases()


def benchmark_files(names: list[str], folder: Path = HERE) -> list[Path]:
    """The files asked for, all of them by default."""
    files = {file.stem.removeprefix("bench_"): file for file in sorted(folder.glob("bench_*.py"))}
    unknown = [name for name in names if name not in files]
    if unknown:
        sys.exit(f"error: no benchmark {', '.join(unknown)}.  fix: one of {', '.join(files) or 'none there are'}")
    return [files[name] for name in names or files]


def machine() -> str:
    """What the seconds were measured on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        model = next((line.split(":")[1].strip() for line in cpuinfo.open() if line.startswith("model name")), model)
    return f"{model}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, Python {platform.python_version()}"


def table(rows: list[Row]) -> str:
    """The rows, for reading."""
    width = max([len(row.case) for row in rows] + [4])
    lines = [f"{'':{width}}      ours     plain   times faster (lowest to highest)"]
    lines += [
        f"{row.case:{width}}  {shown(row.ours_s)}  {shown(row.plain_s)}   {row.ratio:.3g}"
        f" ({row.lowest:.3g} to {row.highest:.3g}, {row.rounds} rounds)"
        for row in rows
    ]
    return "\n".join(lines)


def shown(value: float) -> str:
    """Seconds with a unit that fits, 8 wide."""
    unit, scale = next((u, s) for u, s in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)) if value >= s or u == "us")
    return f"{value / scale:5.3g} {unit:2}"


def main(arguments: list[str]) -> int:
    """Run, print, and fail if a benchmark could not be run."""
    parser = argparse.ArgumentParser(description="Compare with a plain way of doing the same.")
    parser.add_argument("names", nargs="*", help="bench_NAME.py to run; all by default")
    parser.add_argument("--json", type=Path, help="write the figures to this file, too")
    parser.add_argument("--seconds", type=float, default=10.0, help="time for each case")
    parser.add_argument("--rounds", type=int, default=20, help="rounds of each case at most")
    options = parser.parse_args(arguments)
    sys.path.insert(0, str(HERE.parent))  # benchmarks may use tests.scenes for their data
    print(machine(), flush=True)
    rows: list[Row] = []
    failed: list[str] = []
    for file in benchmark_files(options.names):
        name = file.stem.removeprefix("bench_")
        try:
            for case, ours, plain in cases_of(file):
                row = compare(name, case, ours, plain, budget=options.seconds, max_rounds=options.rounds)
                print(f"  {name}: {case}: {row.ratio:.3g} times faster", flush=True)
                rows.append(row)
        except Exception as error:  # The others are still worth running; the exit code tells.
            failed.append(f"{file.name}: {type(error).__name__}: {error}")
            print(f"  FAILED {failed[-1]}", flush=True)
    print(f"\n{table(rows)}")
    if options.json:
        figures = {"machine": machine(), "rows": [asdict(row) for row in rows], "failed": failed}
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
