"""What a LeRobot dataset says of itself: `meta/info.json`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bask_data.errors import BadData
from bask_data.formats.files import Folder
from bask_data.formats.json_values import number, read_json

INFO = "meta/info.json"

VERSIONS = ("v3.", "v2.")
"""Beginnings of the versions that are read: from 2.0 on, tables and videos are plain files."""

_PLACE = re.compile(r"\{(\w+)(?::0?(\d{1,2})d?)?\}")
"""A place in a path's template, with a width. Python's own templates reach into objects: `{x.__class__}`."""

FASTEST = 1e5
"""Bound on frames per second: no camera takes as many."""

MAX_PATH = 1000
"""Longest path, characters: a template may repeat its parts."""


@dataclass(frozen=True)
class Feature:
    """A quantity of every frame.

    Args:
        dtype: `video`, `image`, or that of numbers.
        names: of its values, in their order; empty if they have none.
        info: how it is stored: the codec of a video, the unit of depth.
    """

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    info: Mapping[str, Any]

    @property
    def is_visual(self) -> bool:
        """Whether it consists of image files or of a video."""
        return self.dtype in ("image", "video")

    @property
    def n_channels(self) -> int:
        """Channels of an image, by its shape, which is (h, w, c) or (c, h, w)."""
        if len(self.shape) == 2:
            return 1
        if len(self.shape) != 3:
            return 0
        return self.shape[0] if self.names[:1] in (("channel",), ("channels",), ("c",)) else self.shape[2]

    @property
    def is_marked_depth(self) -> bool:
        """Whether it says that it is depth."""
        return any(self.info.get(key) is True for key in ("is_depth_map", "video.is_depth_map"))


@dataclass(frozen=True)
class Info:
    """`meta/info.json`."""

    folder: Folder
    version: str
    fps: float
    features: dict[str, Feature]
    fields: Mapping[str, Any] = field(repr=False)

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder.path / INFO

    @property
    def is_v2(self) -> bool:
        """Whether every episode has files of its own, and lists are JSON lines."""
        return self.version.startswith("v2.")

    def chunk_of(self, episode: int) -> int:
        """Number of the folder that holds an episode's files, before v3.0."""
        size = self.fields.get("chunks_size", 1000)
        return episode // size if isinstance(size, int) and size > 0 else 0

    def file(self, template: str, values: Mapping[str, int | str]) -> Path:
        """A file by the template of a path, `data_path` or `video_path`; `BadData` for one that leads out."""
        text = self.fields.get(template)
        if not isinstance(text, str) or not text:
            raise BadData(self.path, template, expected="the template of a path", got=json.dumps(text)[:80])

        def filled(match: re.Match[str]) -> str:
            value = values.get(match[1])
            if value is None:
                known = ", ".join(sorted(values))
                raise BadData(self.path, template, expected=f"places of {known}", got=match[0])
            return str(value).zfill(int(match[2] or 0)) if isinstance(value, int) else value

        path = _PLACE.sub(filled, text)
        if "{" in path or "}" in path or len(path) > MAX_PATH:
            raise BadData(self.path, template, expected="places as {chunk_index:03d}", got=text[:80])
        return self.folder.member(path, template)


def read_info(folder: Folder) -> Info:
    """`meta/info.json` of a dataset.

    Raises:
        BadData: it is not there or damaged, or the storage or the version is not read.
    """
    path = folder.member(INFO, "LeRobot dataset")
    fields = read_json(path)
    if str(fields.get("storage_format", "")).lower() == "lance" or any(folder.path.glob("*.lance")):
        fix = "save it from LeRobot in its default storage, Parquet and mp4."
        raise BadData(folder.path, "storage", expected="Parquet and mp4", got="Lance tables", fix=fix)
    version = str(fields.get("codebase_version", ""))
    if not version.startswith(VERSIONS):
        raise BadData(
            path,
            "codebase_version",
            expected="v2.0, v2.1 or v3.0",
            got=version[:20] or "none",
            fix="convert the dataset with LeRobot's own scripts, lerobot.datasets.v30.convert_dataset_v21_to_v30.",
        )
    fps, features = number(path, fields, "fps"), fields.get("features")
    if not 0 < fps < FASTEST:
        raise BadData(path, "fps", expected=f"0 to {FASTEST:g} frames per second", got=f"{fps:g}")
    if not isinstance(features, dict):
        raise BadData(path, "features", expected="features by name", got=type(features).__name__)
    return Info(folder, version, fps, {key: _feature(path, key, of) for key, of in features.items()}, fields)


def _feature(path: Path, key: str, of: Any) -> Feature:
    shape = of.get("shape") if isinstance(of, dict) else None
    if not isinstance(shape, list) or not all(isinstance(n, int) and 0 <= n < 2**31 for n in shape):
        raise BadData(path, f"features.{key[:80]}", expected="a dtype and a shape", got=json.dumps(of)[:80])
    info = {
        key: value for name in ("video_info", "info") for key, value in _mapping(of.get(name)).items()
    }  # Older datasets call it video_info.
    return Feature(key, str(of.get("dtype")), tuple(shape), _names(of.get("names")), info)


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _names(value: Any) -> tuple[str, ...]:
    """Names of values, which some datasets list by group: {"motors": [...]}."""
    if isinstance(value, dict):
        return tuple(name for of in value.values() for name in _names(of))
    return tuple(map(str, value)) if isinstance(value, list) else ()
