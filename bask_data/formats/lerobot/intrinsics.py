"""Intrinsics of a LeRobot dataset's cameras, for which the format has no place of its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Distortion, one_if_same
from bask_data.errors import UsageError
from bask_data.formats.intrinsics import intrinsics_matrix, read_calibration
from bask_data.formats.json_values import array
from bask_data.formats.lerobot.cameras import CameraFeatures, columns_for, words_of
from bask_data.formats.lerobot.columns import EpisodeRows
from bask_data.formats.lerobot.episodes import EpisodeEntry


@dataclass(frozen=True)
class FoundIntrinsics:
    """Lens of a camera, and where it is from.

    Args:
        K: (3, 3) or (t, 3, 3), pixels.
        size: WIDTHxHEIGHT of the images that it is said to be for, or empty.
        column: column it is from, if any.
    """

    K: Float[ndarray, "*t 3 3"]
    statement: str
    distortion: Distortion | None = None
    size: str = ""
    files: tuple[Path, ...] = ()
    column: str = ""


def find_intrinsics(
    rows: EpisodeRows, entry: EpisodeEntry, camera: CameraFeatures, n_cameras: int, given: dict[str, str]
) -> FoundIntrinsics:
    """Intrinsics of a camera.

    Looked for in this order: `--intrinsics`, a column, the list of episodes, what the colour feature says of itself.

    Raises:
        UsageError: they are nowhere.
        BadData: they are no pinhole matrix.
    """
    if camera.name in given:
        read = read_calibration(rows.info.folder, given[camera.name])
        return FoundIntrinsics(read.K, read.statement, read.distortion, read.size, read.files)
    named = [name for name in rows.numeric if {"intrinsics", "intrinsic", "k"} & set(words_of(name))]
    for column in columns_for(camera, named, n_cameras):
        values = rows.column(column)
        if values.shape[1] in (4, 9):
            K = np.stack([_matrix(f"{rows.table.path}: {column}", row) for row in values])
            return FoundIntrinsics(one_if_same(K), f"column {column}, pinhole", column=column)
    stated = {name: value for name, value in entry.fields.items() if "intrinsics" in words_of(name) and value}
    for name in columns_for(camera, stated, n_cameras):
        K = _matrix(f"{entry.files[0]}: {name}", stated[name])
        return FoundIntrinsics(K, f"{name} of the list of episodes, pinhole")
    for name in ("intrinsics", "camera_intrinsics", "camera_matrix", "K"):
        if name in camera.color.info:
            K = _matrix(f"{rows.info.path}: {camera.color.key}", camera.color.info[name])
            return FoundIntrinsics(K, f"{name} of {camera.color.key} in meta/info.json, pinhole")
    example = "fx,fy,cx,cy" if n_cameras == 1 else f"'{camera.name}=fx,fy,cx,cy;...'"
    raise UsageError(
        "--intrinsics",
        expected=f"fx,fy,cx,cy or a file for {camera.name}",
        got="nothing",
        fix=f"pass --intrinsics {example}: take them from the camera's calibration, LeRobot does not keep it.",
    )


def _matrix(where: str, value: object) -> Float[ndarray, "3 3"]:
    """K from 4 or 9 numbers, nested or not."""
    numbers = array(where, "intrinsics", value, ((4,), (9,), (3, 3)))
    return intrinsics_matrix(where, numbers.ravel().tolist())
