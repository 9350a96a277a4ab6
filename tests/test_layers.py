from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parent.parent


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    command = Path(sys.executable).parent / "lint-imports"
    return subprocess.run([command, "--no-cache", "--no-logo"], cwd=folder, capture_output=True, text=True)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(REPOSITORY / "bask_data", tmp_path / "bask_data", ignore=ignored)
    shutil.copy(REPOSITORY / "pyproject.toml", tmp_path)
    return tmp_path


def test_imports_go_downwards_only() -> None:
    answer = lint_imports(REPOSITORY)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert "3 kept, 0 broken" in answer.stdout


@pytest.mark.parametrize(
    ("module", "line", "complaint"),
    [
        (
            "core/geometry.py",
            "from bask_data import artifact",
            "bask_data.core is not allowed to import bask_data.artifact",
        ),
        (
            "nn/__init__.py",
            "from bask_data.formats import files",
            "bask_data.nn is not allowed to import bask_data.formats",
        ),
        ("errors.py", "from bask_data import engine", "bask_data.errors is not allowed to import bask_data.engine"),
        (
            "kinds/scan.py",
            "def f() -> None:\n    import bask_data.cli",
            "bask_data.kinds is not allowed to import bask_data.cli",
        ),
        (
            "view/video.py",
            "from bask_data.report import page",
            "bask_data.view is not allowed to import bask_data.report",
        ),
        ("utils.py", "", "not listed as layers"),
        ("core/loading.py", "from pathlib import Path", "bask_data.core is not allowed to import pathlib"),
    ],
)
def test_an_import_upwards_breaks_the_contract(copy: Path, module: str, line: str, complaint: str) -> None:
    (copy / "bask_data" / module).parent.mkdir(exist_ok=True)
    with (copy / "bask_data" / module).open("a") as file:
        file.write(f"\n{line}\n")
    answer = lint_imports(copy)
    assert answer.returncode == 1
    assert complaint in " ".join(answer.stdout.split())
