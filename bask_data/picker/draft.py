"""The unsaved keypoints, their history of edits, and the file that stores both."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from bask_data.artifact import write_json_atomically
from bask_data.errors import BadData, UsageError
from bask_data.params import first_fault

MOST_MARKS = 256
"""Most keypoints of a draft. Sixteen are usual (von Hartz et al. 2023); the list stays responsive with hundreds."""

MOST_STEPS = 200
"""Most steps that can be undone. Each holds all keypoints in a file written at every step: 0.54 MB with 16 keypoints,
0.1 s on a busy machine. The time is proportional to the number; nothing else depends on it."""

_NAME = re.compile(r"[\w.-][\w. -]{0,39}")
"""Valid names of keypoints. Colons and commas separate picks and their parts on the command line."""


class KeypointMark(BaseModel):
    """A keypoint of the draft: a pixel (u, v) of a frame; integers are pixel centres."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    recording: str
    camera: str
    frame: int
    u: float
    v: float


Marks = tuple[KeypointMark, ...]


class _File(BaseModel):
    """Content of the file: the marks, and their earlier and undone states."""

    model_config = ConfigDict(extra="forbid")

    marks: Marks = ()
    undo: list[Marks] = []
    redo: list[Marks] = []


class Draft:
    """Marks being edited. Every change is written to disk before the method returns, and can be undone."""

    def __init__(self, file: Path, start: Sequence[KeypointMark] = ()) -> None:
        """Load the file, or begin with `start` if it does not exist.

        Raises:
            BadData: the file is damaged.
        """
        self._file = file
        self.is_new = not file.exists()
        try:
            self._kept = _File(marks=tuple(start)) if self.is_new else _File.model_validate_json(file.read_bytes())
        except ValidationError as error:
            field, expected, got = fault_in_json(error)
            fix = "delete it; it holds only unsaved picks."
            raise BadData(file, field, expected=expected, got=got, fix=fix) from error

    @property
    def marks(self) -> Marks:
        """The marks, in the order in which they were added."""
        return self._kept.marks

    @property
    def can_undo(self) -> bool:
        """Whether there is a step to undo."""
        return bool(self._kept.undo)

    @property
    def can_redo(self) -> bool:
        """Whether there is an undone step to redo."""
        return bool(self._kept.redo)

    def add(self, marks: Sequence[KeypointMark]) -> None:
        """Add marks as one step; an empty or taken name is replaced by a free one.

        Raises:
            UsageError: more than `MOST_MARKS` keypoints, or an invalid name.
        """
        added = list(self.marks)
        for mark in marks:
            added.append(mark.model_copy(update={"name": _free(mark.name, {other.name for other in added})}))
        if len(added) > MOST_MARKS:
            raise UsageError("keypoints", "", expected=f"at most {MOST_MARKS}", got=str(len(added)))
        self._do(tuple(added))

    def move(self, name: str, u: float, v: float) -> None:
        """Move a mark within its frame."""
        self._replace(name, lambda mark: mark.model_copy(update={"u": u, "v": v}))

    def rename(self, name: str, new: str) -> None:
        """Rename a mark.

        Raises:
            UsageError: the name is taken or invalid.
        """
        new = checked_name(new)
        if new != name and any(mark.name == new for mark in self.marks):
            raise UsageError("name", "", expected="a name that no other keypoint has", got=new)
        self._replace(name, lambda mark: mark.model_copy(update={"name": new}))

    def delete(self, names: Sequence[str]) -> None:
        """Delete marks as one step."""
        for name in names:
            self.find(name)
        self._do(tuple(mark for mark in self.marks if mark.name not in names))

    def find(self, name: str) -> KeypointMark:
        """The mark with a name; `UsageError` if there is none."""
        for mark in self.marks:
            if mark.name == name:
                return mark
        raise UsageError("name", "", expected="the name of a keypoint", got=name)

    def undo(self) -> None:
        """Undo the last step, if any."""
        if self.can_undo:
            *undo, last = self._kept.undo
            self._keep(_File(marks=last, undo=undo, redo=[*self._kept.redo, self.marks]))

    def redo(self) -> None:
        """Redo the step undone last, if any."""
        if self.can_redo:
            *redo, last = self._kept.redo
            self._keep(_File(marks=last, undo=[*self._kept.undo, self.marks], redo=redo))

    def drop(self, saved: Marks) -> None:
        """Delete the file after these marks have been saved, unless the draft has others by then."""
        if saved == self.marks:
            self._file.unlink(missing_ok=True)

    def _replace(self, name: str, change: Callable[[KeypointMark], KeypointMark]) -> None:
        self.find(name)
        self._do(tuple(change(mark) if mark.name == name else mark for mark in self.marks))

    def _do(self, marks: Marks) -> None:
        if marks != self.marks:
            self._keep(_File(marks=marks, undo=[*self._kept.undo, self.marks][-MOST_STEPS:]))

    def _keep(self, kept: _File) -> None:
        write_json_atomically(self._file, kept.model_dump(mode="json"))
        self._kept = kept


def fault_in_json(error: ValidationError) -> tuple[str, str, str]:
    """`first_fault` with a shorter text for input that is not JSON: field, expected, got."""
    fault = error.errors()[0]
    return ("", "JSON", fault["ctx"]["error"]) if fault["type"] == "json_invalid" else first_fault(error)


def checked_name(name: str) -> str:
    """The name without surrounding spaces; `UsageError` if it is invalid."""
    name = name.strip()
    if not _NAME.fullmatch(name):
        expected = "letters, digits, spaces, '_', '.' and '-', at most 40"
        raise UsageError("name", "", expected=expected, got=repr(name[:60]))
    return name


def _free(name: str, taken: set[str]) -> str:
    """The name if it is free, or else the name with the first free number."""
    if name and name not in taken:
        return checked_name(name)
    stem, n = (f"{name}_", 2) if name else ("point_", 1)
    while f"{stem}{n}" in taken:
        n += 1
    return checked_name(f"{stem}{n}")
