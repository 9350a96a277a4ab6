"""A copy of the package that somebody has added to, and its command line."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "bask_data"


class ExtendedPackage:
    """The package as it is, copied to `folder`, to which files and lines of tables are added."""

    def __init__(self, folder: Path, files: Mapping[str, str] = {}) -> None:
        self._folder = folder
        self._package = folder / "bask_data"
        shutil.copytree(PACKAGE, self._package, ignore=shutil.ignore_patterns("__pycache__"))
        for name, text in files.items():
            assert not (self._package / name).exists(), f"{name} would be replaced, not added"
            (self._package / name).write_text(text)

    def add_to_table(self, file: str, line: str, *, table: str = "FORMATS", imports: str = "") -> None:
        """Add a last line to a table, and an import where the line needs one."""
        path = self._package / file
        before, found, after = path.read_text().partition(f"\n{table} = (\n")
        entries, end, rest = after.partition("\n)\n")
        assert found and end, f"{file} has no table {table}"
        first = "from __future__ import annotations\n"
        before = before.replace(first, f"{first}{imports}\n", 1)
        path.write_text(f"{before}{found}{entries}\n    {line}{end}{rest}")

    def command(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        """Run the copy's command line."""
        code = [sys.executable, "-m", "bask_data.cli", *map(str, arguments)]
        environment = os.environ | {"PYTHONPATH": str(self._folder)}
        return subprocess.run(code, cwd=self._folder, env=environment, capture_output=True, text=True)
