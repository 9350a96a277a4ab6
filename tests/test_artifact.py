from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from bask_data import artifact
from bask_data.artifact import (
    new_scratch,
    publish,
    read_json,
    read_manifest,
    recover,
    write_json_atomically,
    write_text_atomically,
)
from bask_data.errors import BadData


def filled(root: Path, text: str) -> Path:
    scratch = new_scratch(root, "thing")
    (scratch / "file").write_text(text)
    return scratch


def dead_process() -> int:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    return child.pid


def as_if_by(scratch: Path, pid: int) -> Path:
    """The same scratch directory, named as process `pid` would have named it."""
    name, host, _, random = scratch.name.split("~")
    return scratch.rename(scratch.with_name(f"{name}~{host}~{pid}~{random}"))


def test_published_artifact_replaces_the_old_one(tmp_path: Path) -> None:
    for text in ("old", "new"):
        publish(filled(tmp_path, text), tmp_path / "kind" / "item")
    assert (tmp_path / "kind" / "item" / "file").read_text() == "new"
    assert list((tmp_path / ".scratch").iterdir()) == []


def test_replacing_works_where_directories_cannot_be_exchanged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(artifact, "_RENAME_EXCHANGE", 1 << 20)  # A flag that the kernel refuses.
    for text in ("old", "new"):
        publish(filled(tmp_path, text), tmp_path / "item")
    assert (tmp_path / "item" / "file").read_text() == "new"
    assert list((tmp_path / ".scratch").iterdir()) == []


def test_recover_restores_what_was_parked_when_the_process_died(tmp_path: Path) -> None:
    parked = filled(tmp_path, "new")
    parked = as_if_by(parked, dead_process())
    parked = parked.rename(parked.with_name(parked.name + ".parked"))
    (parked / "target").write_text(str(tmp_path / "item"))
    (parked / "artifact").mkdir()
    (parked / "artifact" / "file").write_text("old")
    recover(tmp_path)
    assert (tmp_path / "item" / "file").read_text() == "old"
    assert list((tmp_path / ".scratch").iterdir()) == []


def test_recover_never_moves_anything_out_of_the_dataset(tmp_path: Path) -> None:
    root = tmp_path / "root"
    parked = as_if_by(filled(root, "x"), dead_process())
    parked = parked.rename(parked.with_name(parked.name + ".parked"))
    (parked / "target").write_text(str(tmp_path / "outside"))
    (parked / "artifact").mkdir()
    recover(root)
    assert not (tmp_path / "outside").exists()


def test_recover_removes_scratch_of_ended_processes_only(tmp_path: Path) -> None:
    dead = as_if_by(filled(tmp_path, "dead"), dead_process())
    living = filled(tmp_path, "living")
    other_host = living.with_name(f"thing~elsewhere~{dead_process()}~0")
    other_host.mkdir()
    recover(tmp_path)
    assert not dead.exists()
    assert living.exists()
    assert other_host.exists()


def test_json_is_replaced_atomically(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    write_json_atomically(file, {"a": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json_atomically(file, {"a": float("nan")})
    assert read_json(file) == {"a": 1}


def test_failed_write_keeps_the_old_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "file.json"
    write_text_atomically(file, "old")
    with pytest.raises(UnicodeEncodeError):
        write_text_atomically(file, "\ud800")
    assert [(one, one.read_text()) for one in tmp_path.iterdir()] == [(file, "old")]


def test_failed_replacement_leaves_no_temporary_file(tmp_path: Path) -> None:
    folder = tmp_path / "file.json"
    folder.mkdir()
    with pytest.raises(OSError, match=r"file\.json"):
        write_text_atomically(folder, "new")
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{", "got a syntax error in line 1, column 2"),
        (b" ", "got an empty file"),
        (b"\xff\xfe", "got bytes that are not UTF-8 text"),
        (b"[" * 100_000, "got values nested too deeply"),
        (b"1" * 10_000, "got too many digits"),
    ],
)
def test_invalid_json_is_reported_with_its_path(tmp_path: Path, content: bytes, message: str) -> None:
    file = tmp_path / "a.json"
    file.write_bytes(content)
    with pytest.raises(BadData, match=f"expected a JSON document, {message}.  fix: correct the file") as raised:
        read_json(file)
    assert str(file) in str(raised.value)


def test_directory_in_place_of_a_json_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="expected a JSON document, got a directory.  fix: make it again"):
        read_json(tmp_path, "make it again.")


def test_huge_json_is_not_read(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    with file.open("wb") as stream:
        os.truncate(stream.fileno(), 2**30)
    with pytest.raises(BadData, match="below 64 MiB, got 1073741824 bytes"):
        read_json(file)


def test_missing_manifest_is_reported_with_its_path(tmp_path: Path) -> None:
    with pytest.raises(BadData, match=r"artifact.json: expected a file, got nothing.  fix: make it again"):
        read_manifest(tmp_path)


def test_missing_field_of_a_manifest_is_reported(tmp_path: Path) -> None:
    (tmp_path / "artifact.json").write_text('{"kind": "scan"}')
    with pytest.raises(BadData, match="schema_version: expected a value, got none"):
        read_manifest(tmp_path)
