"""The data that accuracy tables on keypoints were tuned on, and report: `python benchmarks/keypoint_sets.py`.

`keypoint_sets.yaml` names them. The benchmarks read from it what they measure, and this check, a part of `make check`,
refuses a table that reports what its settings were chosen on without saying so.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

HERE = Path(__file__).resolve().parent
FILE = HERE / "keypoint_sets.yaml"
AXES = (("tasks", "seed"), ("recording", "points", "frames"))
"""What a set names: of the simulator, and of a recording."""
HALVES = ("even", "odd", "all")
FIELDS = ("script", "section", "chosen_on", "reports", "tuned")
LABEL = "tuned on what it reports"
"""Words in the section of each table that is."""
READERS = ("simulated", "static")
"""The functions below by which a benchmark reads the sets of a table."""


@dataclass(frozen=True)
class Simulated:
    """Recordings of the simulator that a table reports."""

    tasks: tuple[str, ...]
    seed: int


@dataclass(frozen=True)
class Static:
    """A recording of a static scene: how it is ingested, and how exact its depth is, metres."""

    table: str
    folder: str
    ingest: tuple[str, ...]
    tolerance: float


def simulated(table: str) -> Simulated:
    """What a table of the simulator reports."""
    given = load()
    [name] = _table(given, table)["reports"]
    entry = given["sets"][name]
    return Simulated(tuple(entry["tasks"]), entry["seed"])


def static(recording: str) -> Static | None:
    """How a recording is read, and the table that reports its odd points and frames; None if no set names it."""
    given = load()
    wanted = {"recording": recording, "points": "odd", "frames": "odd"}
    for table, row in given["tables"].items():
        for name in row["reports"]:
            if given["sets"][name] == wanted:
                how = given["recordings"][recording]
                return Static(table, how.get("folder", ""), tuple(how["ingest"]), how["tolerance"])
    return None


def load(file: Path = FILE) -> dict[str, Any]:
    """The file's content."""
    content: dict[str, Any] = yaml.safe_load(file.read_text())
    return content


def _table(given: Mapping[str, Any], table: str) -> Mapping[str, Any]:
    if table not in given["tables"]:
        raise LookupError(
            f"{FILE}: tables: expected one of {', '.join(given['tables'])}, got {table}.  "
            "fix: add the table, with what its settings were chosen on."
        )
    row: Mapping[str, Any] = given["tables"][table]
    return row


# The check -----------------------------------------------------------------------------------------------------------


def findings(given: Mapping[str, Any], repository: Path) -> Iterator[str]:
    """Every violation, in words.

    Args:
        given: content of the file.
        repository: with the pages and scripts that the tables name.
    """
    malformed = [*_malformed(given)]
    yield from malformed
    if malformed:
        return
    for table, row in given["tables"].items():
        yield from _overlaps(given["sets"], table, row)
        yield from _unlabelled(repository, table, row)
    yield from _unread(given, repository / "benchmarks")


def _malformed(given: Mapping[str, Any]) -> Iterator[str]:
    for name, entry in given["sets"].items():
        if tuple(entry) not in AXES:
            yield f"set {name}: expected {' or '.join(', '.join(axes) for axes in AXES)}, got {', '.join(entry)}"
        for axis in ("points", "frames"):
            if axis in entry and entry[axis] not in HALVES:
                yield f"set {name}: {axis}: expected one of {', '.join(HALVES)}, got {entry[axis]}"
    for table, row in given["tables"].items():
        missing = [name for name in FIELDS[:-1] if not row.get(name)]
        if missing or set(row) - set(FIELDS):
            yield f"table {table}: expected {', '.join(FIELDS[:-1])}, perhaps {FIELDS[-1]}, got {', '.join(row)}"
            continue
        unknown = [name for name in (*row["chosen_on"], *row["reports"]) if name not in given["sets"]]
        yield from (f"table {table}: expected a set of {', '.join(given['sets'])}, got {name}" for name in unknown)


def _overlaps(sets: Mapping[str, Any], table: str, row: Mapping[str, Any]) -> Iterator[str]:
    shared = [
        (chosen, reported)
        for chosen in row["chosen_on"]
        for reported in row["reports"]
        if overlap(sets[chosen], sets[reported])
    ]
    if row.get("tuned") and not shared:
        yield f"table {table}: expected no `tuned`, as it reports nothing that settings were chosen on, got it"
    if not row.get("tuned"):
        for chosen, reported in shared:
            yield (
                f"table {table}: expected sets that share nothing, got {chosen} to choose on, {reported} to report.  "
                "fix: report other data, or say in `tuned` why not."
            )


def overlap(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether two sets share a task, or a half of the points or of the frames of one recording."""
    if "tasks" in a or "tasks" in b:
        return bool(set(a.get("tasks", ())) & set(b.get("tasks", ())))
    if a["recording"] != b["recording"]:
        return False
    return any(a[axis] == b[axis] or "all" in (a[axis], b[axis]) for axis in ("points", "frames"))


def _unlabelled(repository: Path, table: str, row: Mapping[str, Any]) -> Iterator[str]:
    """Sections that do not exist, and those of tuned tables that do not say so."""
    page, _, anchor = row["section"].partition("#")
    text = section(repository / page, anchor)
    if text is None:
        yield f"table {table}: expected a section of a page, got {row['section']}"
    elif row.get("tuned") and LABEL not in " ".join(text.split()):
        yield f"table {table}: expected {LABEL!r} in {row['section']}, because it is, got nothing of it"


def section(page: Path, anchor: str) -> str | None:
    """The text below a heading, up to the next; None if there is none of that anchor."""
    if not page.is_file():
        return None
    for part in re.split(r"^#+ ", page.read_text(), flags=re.MULTILINE)[1:]:
        heading, _, text = part.partition("\n")
        if re.sub(r"[^\w -]", "", heading.lower()).strip().replace(" ", "-") == anchor:
            return text
    return None


def _unread(given: Mapping[str, Any], benchmarks: Path) -> Iterator[str]:
    """Tables whose script is missing or reads no sets, and tables that a script reads and nothing names."""
    read = {file.name: tables_read(file.read_text()) for file in sorted(benchmarks.glob("*.py"))}
    for script, tables in read.items():
        for table in tables - {None}:
            if table not in given["tables"]:
                yield f"{script}: expected one of the tables {', '.join(given['tables'])}, got {table}"
    for table, row in given["tables"].items():
        script = row["script"]
        if not (benchmarks / script).is_file():
            yield f"table {table}: expected a script, got {script}"
        # What reads recordings by name asks `static` for any of them. What is tuned may be given its data by hand.
        elif not row.get("tuned") and script in read and not read[script] & {table, None}:
            yield f"table {table}: expected {script} to read its sets, got none of its name there"


def tables_read(script: str) -> set[str | None]:
    """Names of the tables whose sets a script reads; None for one that is known only as it runs."""
    found: set[str | None] = set()
    for node in ast.walk(ast.parse(script)):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in READERS and node.args:
            given = node.args[0]
            found.add(given.value if isinstance(given, ast.Constant) else None)
    return found


def main() -> int:
    given = load()
    found = [*findings(given, HERE.parent)]
    print("\n".join(found) or f"keypoint sets: {len(given['tables'])} tables, nothing found")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
