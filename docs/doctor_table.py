"""Render the table of docs/doctor.md: all codes of findings, as the package has them.

python docs/doctor_table.py            write it
python docs/doctor_table.py --check    only say whether it is up to date
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from bask_data.doctor.text import codes_table

PAGE = Path(__file__).resolve().parent / "doctor.md"
BEGIN, END = "<!-- table: codes -->", "<!-- end -->"


def main(arguments: Sequence[str]) -> int:
    """Write the page, or with `--check` only compare."""
    old = PAGE.read_text(encoding="utf-8")
    new = rendered(old)
    if new == old:
        return 0
    if "--check" in arguments:
        print(f"{PAGE}: out of date  fix: python docs/doctor_table.py")
        return 1
    PAGE.write_text(new, encoding="utf-8")
    return 0


def rendered(page: str) -> str:
    """The page with the table as it should be."""
    if page.count(BEGIN) != 1 or END not in page.split(BEGIN)[-1]:
        raise ValueError(f"expected one place for the table, from {BEGIN} to {END}")
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n{codes_table()}\n{END}{rest.split(END, 1)[1]}"


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
