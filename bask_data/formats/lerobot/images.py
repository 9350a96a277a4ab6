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
from bask_data.formats.depth_files import decode_any_depth, depth_of_array
from bask_data.formats.files import first_readable
from bask_data.formats.images import MAX_PIXELS, decode_color
from bask_data.formats.lerobot.columns import EpisodeRows
from bask_data.formats.lerobot.episodes import EpisodeEntry
from bask_data.formats.lerobot.image_files import EpisodeFiles
from bask_data.formats.lerobot.info import Feature
from bask_data.formats.lerobot.videos import of_video
from bask_data.formats.parquet_values import RowValues
from bask_data.formats.recording import Depth


@dataclass(frozen=True)
class FrameImages:
    """Images of one feature in one episode, by the number of the frame.

    Args:
        size: (height, width), pixels.
        read: RGB or raw depth of a frame.
        faults: why frames have no image.
        is_float: whether it is depth in floating point.
    """

    size: tuple[int, int]
    files: tuple[Path, ...]
    read: Callable[[int], Any]
    faults: dict[int, BadData] = field(default_factory=dict)
    is_float: bool = False


def color_images(rows: EpisodeRows, entry: EpisodeEntry, feature: Feature, time: Float[ndarray, " t"]) -> FrameImages:
    """Colour images of an episode, by whatever the feature is stored as."""
    if feature.dtype == "video":
        video = of_video(rows, entry, feature, time)
        return FrameImages(video.video.size, (video.video.path,), video.color, video.faults)
    if feature.dtype == "image":
        return _of_files(EpisodeFiles(rows, entry, feature), decode_color)
    cells, size = RowValues(rows.table.path, feature.key), array_size(rows, feature)

    def read_array(i: int) -> UInt8[ndarray, "h w 3"]:
        values = cells.array(rows.rows[i])
        is_first = values.ndim == 3 and values.shape[0] == 3 and values.shape[2] != 3
        values = np.moveaxis(values, 0, -1) if is_first else values
        if values.dtype != np.uint8 or values.size != size[0] * size[1] * 3:
            raise _not_image(rows, feature, i, values)
        return np.ascontiguousarray(values.reshape(*size, 3))

    return FrameImages(size, (), read_array)


def depth_images(rows: EpisodeRows, entry: EpisodeEntry, feature: Feature) -> FrameImages:
    """Depth of an episode from image files or arrays."""
    if feature.dtype == "image":
        return _of_files(EpisodeFiles(rows, entry, feature), decode_any_depth)
    cells, size = RowValues(rows.table.path, feature.key), array_size(rows, feature)

    def read_array(i: int) -> Depth:
        values = cells.array(rows.rows[i])
        if values.size != size[0] * size[1]:
            raise _not_image(rows, feature, i, values)
        return depth_of_array(f"{rows.table.path}: {feature.key} of frame {i}", values.reshape(size))

    return FrameImages(size, (), read_array, is_float=feature.dtype.startswith("float"))


def _of_files(images: EpisodeFiles, decode: Callable[[str, bytes], ndarray]) -> FrameImages:
    """Images of files, whose size is that of the first one that decodes; `BadData` if none does."""

    def read(i: int) -> ndarray:
        return decode(*images.read(i))

    first = first_readable(read, range(images.n_frames))
    return FrameImages(first.shape[:2], images.files, read, images.faults, first.dtype.kind == "f")


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
