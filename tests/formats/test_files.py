from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.errors import BadData, UsageError
from bask_data.formats import files


def test_a_source_that_is_not_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="SOURCE: expected a folder, got a file"):
        files.source_folder(tmp_path / "file")
    with pytest.raises(UsageError, match="SOURCE: expected a folder, got no such path"):
        files.source_folder(tmp_path / "missing")


@pytest.mark.parametrize("relative", ["../secret.txt", "/etc/passwd", "a/../../secret.txt"])
def test_a_path_out_of_the_source_folder_is_refused(tmp_path: Path, relative: str) -> None:
    with pytest.raises(BadData, match="expected a path inside the source folder.*copy the file into SOURCE"):
        files.Folder(tmp_path).member(relative, "rgb.txt")


@pytest.mark.parametrize("relative", ["a" * 5000, "a/" * 3000, "\0"])
def test_a_name_that_no_file_can_have_is_that_of_a_missing_file(tmp_path: Path, relative: str) -> None:
    assert not files.Folder(tmp_path).has(relative)
    with pytest.raises(BadData, match="expected a file, got no such path") as raised:
        files.Folder(tmp_path).member(relative, "rgb.txt")
    assert len(str(raised.value)) < 500


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="gone.txt: rgb.txt: expected a file, got no such path"):
        files.Folder(tmp_path).member("gone.txt", "rgb.txt")


def test_a_link_out_of_the_source_folder_is_refused_and_one_inside_is_followed(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    (tmp_path / "secret").write_text("x")
    (source / "inside").write_text("x")
    (source / "out").symlink_to(tmp_path / "secret")
    (source / "in").symlink_to(source / "inside")
    with pytest.raises(BadData, match="got a link out of it"):
        files.Folder(source).member("out", "--color")
    assert files.Folder(source).member("in", "--color").read_text() == "x"


def test_files_of_a_folder_are_found_in_natural_order_without_hidden_ones(tmp_path: Path) -> None:
    (tmp_path / "color").mkdir()
    for name in ("10.jpg", "9.JPG", "._9.jpg", "9.txt"):
        (tmp_path / "color" / name).write_text("x")
    assert list(files.Folder(tmp_path).files_in("color", (".jpg",), "colour")) == ["9", "10"]
    (tmp_path / "color" / "9.png").write_text("x")
    with pytest.raises(BadData, match="color: colour: expected one file for each frame, got 9.JPG and 9.png"):
        files.Folder(tmp_path).files_in("color", (".jpg", ".png"), "colour")
    with pytest.raises(BadData, match=r"depth: depth: expected files \*\.png or \*\.pgm, got none"):
        files.Folder(tmp_path).files_in("depth", (".png", ".pgm"), "depth")


def test_a_pipe_is_refused_instead_of_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(BadData, match="expected a regular file, got a folder, pipe or device"):
        files.Folder(tmp_path).member("pipe", "--color")


@pytest.mark.parametrize("pattern", ["frame.png", "*/*.png", "**"])
def test_a_pattern_without_exactly_one_star_is_refused(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(UsageError, match="--color: expected a pattern with one \\*"):
        files.Folder(tmp_path).matching(pattern, "color")


@pytest.mark.parametrize("pattern", ["../*.png", "/tmp/*.png"])
def test_a_pattern_out_of_the_source_folder_is_refused(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(UsageError, match="expected a pattern inside SOURCE"):
        files.Folder(tmp_path).matching(pattern, "color")


def test_a_pattern_that_matches_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="--color: expected files that match 'a-\\*.png', got none.  fix: pass --color"):
        files.Folder(tmp_path).matching("a-*.png", "color")


def test_files_are_named_by_the_text_that_the_star_matches_with_frame_9_before_frame_10(tmp_path: Path) -> None:
    for name in ("a[1]-10.png", "a[1]-9.png", "a[1]-9.txt", "a1-11.png"):
        (tmp_path / name).touch()
    assert list(files.Folder(tmp_path).matching("a[1]-*.png", "color")) == ["9", "10"]


def test_a_star_may_match_a_folder(tmp_path: Path) -> None:
    for name in ("2", "10"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "rgb.png").touch()
    assert list(files.Folder(tmp_path).matching("*/rgb.png", "color")) == ["2", "10"]


@given(st.lists(st.integers(0, 10**9), unique=True))
def test_natural_order_is_the_order_of_the_numbers(values: list[int]) -> None:
    assert sorted((f"frame-{v}.color" for v in values), key=files.natural) == [
        f"frame-{v}.color" for v in sorted(values)
    ]


def test_the_frame_number_is_the_last_one_in_a_name() -> None:
    assert files.frame_number("cam2_000012") == 12
    assert files.frame_number("left") is None


def test_frames_without_a_partner_are_named(tmp_path: Path) -> None:
    color = {str(i): tmp_path for i in range(10)}
    depth = {str(i): tmp_path for i in (0, 2)}
    names, missing = files.paired(tmp_path, {"color": color, "depth": depth})
    assert names == [str(i) for i in range(10)]
    assert list(missing) == [str(i) for i in (1, 3, 4, 5, 6, 7, 8, 9)]
    assert "frame 1, 3, 4, 5, 6 and 3 more: expected a depth file for every frame, got none for 8 of 10" in str(
        missing["1"]
    )


def test_an_empty_and_a_huge_file_are_refused_before_they_are_read(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    (tmp_path / "huge").write_bytes(b"0" * 11)
    with pytest.raises(BadData, match="expected some bytes, got an empty file"):
        files.read_bytes(tmp_path / "empty")
    with pytest.raises(BadData, match="expected at most 10 bytes, got 11"):
        files.read_bytes(tmp_path / "huge", limit=10)


@pytest.mark.parametrize("content", [b"\x80\x81\x82", b"1 2\x003"])
def test_a_binary_file_is_refused_as_text(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "pose.txt").write_bytes(content)
    with pytest.raises(BadData, match="content: expected text, got a binary file"):
        files.read_lines(tmp_path / "pose.txt")


def test_comments_and_blank_lines_are_skipped(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf# title\r\n\r\n1 2 # two\r\n 3\r\n")
    assert files.read_lines(tmp_path / "a.txt") == ["1 2", "3"]


def test_words_are_refused_as_numbers(tmp_path: Path) -> None:
    assert files.numbers(tmp_path, "1, 2e-3  nan")[:2] == [1.0, 0.002]
    with pytest.raises(BadData, match="content: expected numbers, got '1 __import__'"):
        files.numbers(tmp_path, "1 __import__")


@pytest.mark.parametrize("line", ["0,5 0,25 -1,0e-3", "0,5;1;2,5", "[1,5 2]"])
def test_decimal_commas_are_refused_with_a_command_that_replaces_them(tmp_path: Path, line: str) -> None:
    path = tmp_path / "my poses" / "0.txt"
    path.parent.mkdir()
    path.write_text(line)
    with pytest.raises(BadData, match="expected numbers with decimal points, got decimal commas") as refused:
        files.numbers(path, line)
    command = refused.value.fix.partition("by: ")[2]
    subprocess.run(command, shell=True, check=True)
    assert files.numbers(path, path.read_text()) == [float(word) for word in re.findall(r"[-\d.e]+", path.read_text())]


@pytest.mark.parametrize("line", ["1,2,3", "1, 2, 3", "[[1 2 3]]", "1;2;3", "(1.0,2.0,3.0)", "1,2,3,"])
def test_numbers_are_read_however_they_are_separated(line: str) -> None:
    assert files.numbers(Path("n.txt"), line) == [1, 2, 3]


def test_the_first_that_can_be_read_is_taken_and_else_the_first_error_raised() -> None:
    def read(i: int) -> int:
        if i < 2:
            raise BadData(f"{i}.png", "image", expected="a picture", got="none")
        return i

    assert files.first_readable(read, [0, 1, 2, 3]) == 2
    with pytest.raises(BadData, match="0.png: image"):
        files.first_readable(read, [0, 1])
