from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from bask_data.errors import BadData, UsageError
from bask_data.formats.members import Members, ZipMembers, members_of

CONTENT = {
    "cap/rgbd/10.jpg": b"ten",
    "cap/rgbd/9.jpg": b"nine",
    "cap/rgbd/.9.jpg": b"hidden",
    "cap/rgbd/deeper/1.jpg": b"deeper",
    "cap/metadata": b"{}",
    "cap/empty": b"",
    "__MACOSX/cap/rgbd/3.jpg": b"fork",
}


def zipped(path: Path) -> ZipMembers:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in CONTENT.items():
            file.writestr(name, data)
    members = members_of(path, (".zip",), follow_links=False)
    assert isinstance(members, ZipMembers)
    return members


def unzipped(folder: Path) -> Members:
    for name, data in CONTENT.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return members_of(folder / "cap", (".zip",), follow_links=False)


@pytest.mark.parametrize("is_zip", [True, False])
def test_files_have_the_same_names_in_a_folder_and_in_a_zip_file(tmp_path: Path, is_zip: bool) -> None:
    members = zipped(tmp_path / "a.zip").at("metadata") if is_zip else unzipped(tmp_path)
    assert members.named("rgbd", (".jpg",)) == {"9": "rgbd/9.jpg", "10": "rgbd/10.jpg"}
    assert list(members.named("rgbd", (".jpg",))) == ["9", "10"]
    assert members.named("nowhere", (".jpg",)) == {}
    assert members.has("metadata")
    assert not members.has("3.jpg")
    assert members.read("rgbd/9.jpg") == b"nine"
    used = {tmp_path / "a.zip"} if is_zip else {tmp_path / "cap/rgbd/9.jpg", tmp_path / "cap/metadata"}
    assert set(members.files(["rgbd/9.jpg", "metadata"])) == used
    with pytest.raises(BadData, match="size: expected at most 3 bytes"):
        members.read("rgbd/9.jpg", 3)
    with pytest.raises(BadData, match="size: expected some bytes, got an empty file"):
        members.read("empty")
    with pytest.raises(BadData, match="got (none of this name|no such path)"):
        members.read("rgbd/77.jpg")


def test_a_folder_may_be_looked_for_in_a_zip_file_too(tmp_path: Path) -> None:
    members = zipped(tmp_path / "a.zip")
    assert members.at("rgbd/") == ZipMembers(tmp_path / "a.zip", "cap/")
    assert members.at("rgb/") == members


def test_content_larger_than_stated_is_not_read_to_its_end(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("bomb", bytes(5_000_000))
    data = bytearray((tmp_path / "a.zip").read_bytes())
    assert len(data) < 10_000
    for start in (data.find(b"PK\x03\x04") + 22, data.find(b"PK\x01\x02") + 24):
        data[start : start + 4] = (10).to_bytes(4, "little")
    (tmp_path / "a.zip").write_bytes(data)
    with pytest.raises(BadData, match="expected a zip file|expected at most 1000 bytes"):
        members_of(tmp_path / "a.zip", (".zip",), follow_links=False).read("bomb", 1000)
    with zipfile.ZipFile(tmp_path / "b.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("bomb", bytes(5_000_000))
    with pytest.raises(BadData, match="bomb: size: expected at most 1000 bytes, got more"):
        members_of(tmp_path / "b.zip", (".zip",), follow_links=False).read("bomb", 1000)


def test_damaged_and_encrypted_zip_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(b"PK\x03\x04 and nothing more")
    with pytest.raises(BadData, match=r"a\.zip: content: expected a zip file"):
        members_of(tmp_path / "a.zip", (".zip",), follow_links=False).has("metadata")
    zipped(tmp_path / "b.zip")
    data = bytearray((tmp_path / "b.zip").read_bytes())
    data[data.find(b"PK\x01\x02") + 8] |= 1  # encrypted
    (tmp_path / "b.zip").write_bytes(data)
    with pytest.raises(BadData, match="encrypted"):
        members_of(tmp_path / "b.zip", (".zip",), follow_links=False).read("cap/rgbd/10.jpg")


def test_what_is_neither_a_folder_nor_such_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("text")
    with pytest.raises(UsageError, match=r"expected a file \.zip"):
        members_of(tmp_path / "a.txt", (".zip",), follow_links=False)
    with pytest.raises(UsageError, match=r"expected a folder or a file \.zip, got no such path"):
        members_of(tmp_path / "b.zip", (".zip",), follow_links=False)


def test_two_files_for_one_frame_are_refused(tmp_path: Path) -> None:
    for name in ("1.jpg", "1.png"):
        (tmp_path / name).write_bytes(b"x")
    members = members_of(tmp_path.parent, (".zip",), follow_links=False)
    with pytest.raises(BadData, match=r"1: expected one file for each frame, got 1\.jpg and 1\.png"):
        members.named(tmp_path.name, (".jpg", ".png"))


def test_packing_that_would_be_unpacked_whole_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_BZIP2) as file:
        file.writestr("bomb", bytes(5_000_000))
    with pytest.raises(BadData, match="bomb: packing: expected deflate, or none, got method 12"):
        members_of(tmp_path / "a.zip", (".zip",), follow_links=False).read("bomb", 1000)
