from __future__ import annotations

from pathlib import Path

import pytest

from bask_data.errors import MissingDependency, imported


def test_installed_package_is_imported() -> None:
    assert imported("json.decoder", "JSON", user="--x", extra="y").JSONDecoder


def test_missing_package_is_named_with_the_line_that_installs_it() -> None:
    expected = r"--x: no_such_package: expected A Thing, got none.  fix: pip install 'bask-data\[y\]'"
    with pytest.raises(MissingDependency, match=expected):
        imported("no_such_package", "A Thing", user="--x", extra="y")


def test_missing_dependency_of_a_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "needing.py").write_text("import needed_by_it")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingDependency, match="--x: needed_by_it: expected A Thing, got none"):
        imported("needing", "A Thing", user="--x", extra="y")


def test_package_that_fails_to_load_is_not_reported_as_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken.py").write_text("raise ImportError('libthing.so: cannot open')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=r"libthing\.so: cannot open"):
        imported("broken", "A Thing", user="--x", extra="y")
