"""Images of an episode: from videos that many episodes share, from image files, or from arrays in the tables."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.files import read_bytes
from bask_data.formats.images import MAX_PIXELS, decode_color
from bask_data.formats.lerobot_columns import EpisodeRows
from bask_data.formats.lerobot_depth import decode_depth, depth_of_array
from bask_data.formats.lerobot_episodes import EpisodeEntry
from bask_data.formats.lerobot_info import Feature
from bask_data.formats.lerobot_videos import of_video
from bask_data.formats.parquet_values import RowValues
from bask_data.formats.recording import Depth

REMOTE = ("http://", "https://", "hf://", "s3://")


@dataclass(frozen=True)
class FrameImages:
    """Images of one feature in one episode, by the number of the frame.

    Args:
        size: (height, width), pixels.
        read: RGB or raw depth of a frame.
        faults: why frames have no image.
    """

    size: tuple[int, int]
    files: tuple[Path, ...]
    read: Callable[[int], Any]
    faults: dict[int, BadData] = field(default_factory=dict)


class EpisodeFiles:
    """Image files in a column of the table: inside it, or by paths that lie inside the dataset."""

    def __init__(self, rows: EpisodeRows, feature: Feature) -> None:
        self._rows, self._key = rows, feature.key
        self._cells = RowValues(rows.table.path, feature.key)
        self._is_inside = self._cells.files_of(rows.rows.start)[0] is not None

    @property
    def files(self) -> tuple[Path, ...]:
        """Files outside the table."""
        if self._is_inside:
            return ()
        found = (self._cells.files_of(row)[1] for row in self._rows.rows)
        return tuple(self._file(path) for path in found if path)

    def read(self, i: int) -> tuple[str, bytes]:
        """A name for messages, and the content of the frame's image file."""
        row = self._rows.rows[i]
        data, path = self._cells.files_of(row)
        where = f"{self._rows.table.path}: {self._key} of row {row}"
        if data is not None:
            return where, data
        if path is None:
            raise BadData(where, "image", expected="bytes or a path", got="neither", fix="copy the table again.")
        file = self._file(path)
        return str(file), read_bytes(file)

    def _file(self, path: str) -> Path:
        folder = self._rows.info.folder
        if path.startswith(REMOTE):
            raise BadData(
                folder.path,
                self._key,
                expected="images in the dataset",
                got=f"an address: {path[:80]}",
                fix="download the dataset with its images.",
            )
        return folder.member(path, self._key)


def color_images(rows: EpisodeRows, entry: EpisodeEntry, feature: Feature, time: Float[ndarray, " t"]) -> FrameImages:
    """Colour images of an episode, by whatever the feature is stored as."""
    if feature.dtype == "video":
        video = of_video(rows, entry, feature, time)
        return FrameImages(video.video.size, (video.video.path,), video.color, video.faults)
    if feature.dtype == "image":
        images = EpisodeFiles(rows, feature)

        def read(i: int) -> UInt8[ndarray, "h w 3"]:
            return decode_color(*images.read(i))

        height, width = read(0).shape[:2]
        return FrameImages((height, width), images.files, read)
    cells, size = RowValues(rows.table.path, feature.key), array_size(rows, feature)

    def read_array(i: int) -> UInt8[ndarray, "h w 3"]:
        values = cells.array(rows.rows[i])
        is_first = values.ndim == 3 and values.shape[0] == 3 and values.shape[2] != 3
        values = np.moveaxis(values, 0, -1) if is_first else values
        if values.dtype != np.uint8 or values.size != size[0] * size[1] * 3:
            raise _not_image(rows, feature, i, values)
        return np.ascontiguousarray(values.reshape(*size, 3))

    return FrameImages(size, (), read_array)


def depth_images(rows: EpisodeRows, feature: Feature) -> FrameImages:
    """Depth of an episode from image files or arrays."""
    if feature.dtype == "image":
        images = EpisodeFiles(rows, feature)

        def read(i: int) -> Depth:
            return decode_depth(*images.read(i))

        height, width = read(0).shape
        return FrameImages((height, width), images.files, read)
    cells, size = RowValues(rows.table.path, feature.key), array_size(rows, feature)

    def read_array(i: int) -> Depth:
        values = cells.array(rows.rows[i])
        if values.size != size[0] * size[1]:
            raise _not_image(rows, feature, i, values)
        return depth_of_array(f"{rows.table.path}: {feature.key} of frame {i}", values.reshape(size))

    return FrameImages(size, (), read_array)


def array_size(rows: EpisodeRows, feature: Feature) -> tuple[int, int]:
    """(height, width) of images that are arrays, pixels, by the feature's shape."""
    sides = feature.shape
    if len(sides) == 3:
        sides = sides[1:] if sides[0] in (1, 3) and sides[2] not in (1, 3) else sides[:2]
    if len(sides) != 2 or not 0 < sides[0] * sides[1] <= MAX_PIXELS:
        expected = "the shape of an image"
        raise BadData(rows.info.path, feature.key, expected=expected, got=json.dumps(feature.shape)[:80])
    return sides[0], sides[1]


def _not_image(rows: EpisodeRows, feature: Feature, i: int, values: ndarray) -> BadData:
    return BadData(
        f"{rows.table.path}: frame {i}",
        feature.key,
        expected=f"an image of the shape {list(feature.shape)}",
        got=f"{values.dtype} {list(values.shape)}",
        fix="correct the feature's shape in meta/info.json.",
    )
