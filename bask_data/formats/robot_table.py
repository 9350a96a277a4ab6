"""The robot's states and actions from a table: `--robot FILE` of `ingest frames`."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.files import Folder, listed, read_lines
from bask_data.formats.recording import RobotRecording

WIDTH = "gripper_width"
"""Column of the gripper's width, metres."""

NOT_ACTIONS = ("frame", "time", "timestamp")
"""Columns that are left out: frames have their own names and times."""


@dataclass(frozen=True)
class RobotTable:
    """Columns of numbers by name, a row for each frame."""

    path: Path
    columns: dict[str, Float[ndarray, " t"]]

    def recording(self, world_from_gripper: Float[ndarray, "t 4 4"] | None) -> RobotRecording:
        """States and actions, with the gripper's poses from elsewhere, if known."""
        names = tuple(name for name in self.columns if name not in (WIDTH, *NOT_ACTIONS))
        return RobotRecording(
            world_from_gripper=world_from_gripper,
            gripper_width=self.columns.get(WIDTH),
            action=np.stack([self.columns[name] for name in names], axis=1) if names else None,
            action_names=names or None,
        )


def read_robot_table(folder: Folder, text: str, n_frames: int) -> RobotTable:
    """The table in a CSV file with a header, here or in the source folder.

    Raises:
        BadData: a row is missing or has too few values, a value is no number, or two columns share a name.
    """
    path = Path(text) if Path(text).is_file() else folder.member(text, "--robot")
    try:
        rows = list(csv.reader(read_lines(path)))
    except csv.Error as error:
        raise BadData(path, "rows", expected="values separated by commas", got=str(error)) from error
    names = [name.strip() for name in rows[0]] if rows else []
    if not names or len(set(names)) < len(names) or not all(names) or all(_is_number(name) for name in names):
        raise BadData(
            path,
            "header",
            expected=f"distinct names of columns, such as {WIDTH}",
            got=listed(names) or "none",
            fix="write the names into the first line, separated by commas.",
        )
    if len(rows) - 1 != n_frames:
        raise BadData(
            path,
            "rows",
            expected=f"{n_frames}, one for each frame",
            got=len(rows) - 1,
            fix="write a row for every frame, in the order of the frames.",
        )
    for i, row in enumerate(rows[1:], 1):
        bad = [word for word in row if not _is_number(word)]
        if bad or len(row) != len(names):
            got = repr(bad[0]) if bad else f"{len(row)} values"
            fix = "correct the row, or remove the column."
            raise BadData(path, f"row {i}", expected=f"{len(names)} numbers", got=got, fix=fix)
    values = np.array(rows[1:], dtype=np.float64)
    return RobotTable(path, {name: values[:, i] for i, name in enumerate(names)})


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False
