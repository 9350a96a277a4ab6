from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.errors import BadData, UsageError
from bask_data.picker.draft import MOST_MARKS, Draft, KeypointMark, checked_name


def mark(name: str = "", u: float = 3.0) -> KeypointMark:
    return KeypointMark(name=name, recording="a", camera="wrist", frame=1, u=u, v=4.0)


def names(draft: Draft) -> list[str]:
    return [mark.name for mark in draft.marks]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / ".scratch" / "picks.json"


def test_empty_and_taken_names_are_replaced_by_free_ones(file: Path) -> None:
    draft = Draft(file)
    for name in ("", "rim", "", "rim", "rim"):
        draft.add([mark(name)])
    assert names(draft) == ["point_1", "rim", "point_2", "rim_2", "rim_3"]


def test_every_step_can_be_undone_and_redone_after_a_reload(file: Path) -> None:
    draft = Draft(file, [mark("first")])
    steps = [
        lambda: draft.add([mark("rim"), mark("knob")]),
        lambda: draft.move("rim", 7.5, 8.0),
        lambda: draft.rename("rim", "edge"),
        lambda: draft.delete(["first", "knob"]),
    ]
    seen = [draft.marks]
    for step in steps:
        step()
        seen.append(draft.marks)
    assert [names(draft), draft.marks[0].u] == [["edge"], 7.5]
    for expected in reversed(seen[:-1]):
        draft = Draft(file)
        assert draft.can_undo
        draft.undo()
        assert draft.marks == expected
    assert not draft.can_undo
    draft.undo()
    for expected in seen[1:]:
        draft = Draft(file)
        assert draft.can_redo
        draft.redo()
        assert draft.marks == expected
    assert not draft.can_redo
    draft.redo()
    assert draft.marks == seen[-1]


def test_a_new_step_discards_undone_ones_and_a_move_to_the_same_place_is_no_step(file: Path) -> None:
    draft = Draft(file)
    draft.add([mark("a")])
    draft.undo()
    draft.add([mark("b")])
    assert not draft.can_redo
    draft.move("b", 3.0, 4.0)
    draft.undo()
    assert names(draft) == []


@given(steps=st.lists(st.sampled_from(["add", "move", "delete", "undo", "redo"]), max_size=30))
def test_undoing_everything_restores_the_start(tmp_path_factory, steps: list[str]) -> None:
    draft = Draft(tmp_path_factory.mktemp("draft") / "picks.json", [mark("first")])
    for i, step in enumerate(steps):
        if step == "add":
            draft.add([mark()])
        elif draft.marks and step == "move":
            draft.move(draft.marks[0].name, float(i), 1.0)
        elif draft.marks and step == "delete":
            draft.delete([draft.marks[-1].name])
        elif step == "undo":
            draft.undo()
        elif step == "redo":
            draft.redo()
        assert len(set(names(draft))) == len(draft.marks)
    while draft.can_undo:
        draft.undo()
    assert draft.marks == (mark("first"),)


def test_dropping_a_draft_deletes_its_file(file: Path) -> None:
    draft = Draft(file)
    draft.add([mark("rim")])
    assert not Draft(file).is_new
    draft.drop(draft.marks)
    assert Draft(file).is_new
    assert names(draft) == ["rim"]


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (lambda draft: draft.rename("rim", "knob"), "name: expected a name that no other keypoint has, got knob"),
        (lambda draft: draft.rename("rim", "a:b"), "name: expected letters, digits, spaces, .* at most 40, got 'a:b'"),
        (lambda draft: draft.rename("rim", " "), "name: expected letters"),
        (lambda draft: draft.rename("rim", "x" * 41), "name: expected letters"),
        (lambda draft: draft.move("none", 0.0, 0.0), "name: expected the name of a keypoint, got none"),
        (lambda draft: draft.delete(["rim", "none"]), "name: expected the name of a keypoint, got none"),
        (lambda draft: draft.add([mark()] * MOST_MARKS), f"keypoints: expected at most {MOST_MARKS}, got 258"),
    ],
)
def test_an_invalid_step_changes_nothing(file: Path, step, message: str) -> None:
    draft = Draft(file, [mark("rim"), mark("knob")])
    with pytest.raises(UsageError, match=message):
        step(draft)
    assert names(draft) == ["rim", "knob"]
    assert not draft.can_undo


def test_names_may_have_letters_of_any_language() -> None:
    assert checked_name("  Griff übers Eck.2 ") == "Griff übers Eck.2"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "expected JSON, got EOF while parsing"),
        ("{", "expected JSON, got EOF while parsing"),
        (json.dumps({"marks": [{"name": "x"}]}), "marks.0.recording: expected a value"),
        (json.dumps({"marks": 3}), "marks: expected "),
    ],
)
def test_a_damaged_file_is_reported_with_a_fix(tmp_path: Path, text: str, what: str) -> None:
    file = tmp_path / "picks.json"
    file.write_text(text)
    with pytest.raises(BadData, match=rf"picks.json: {what}.*fix: delete it; it holds only unsaved picks."):
        Draft(file)
