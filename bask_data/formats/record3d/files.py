"""Files of Record3D's recordings: the .r3d file, its unpacked content, or the export of EXR and JPG images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.depth_files import read_any_depth
from bask_data.formats.files import MAX_TEXT_BYTES
from bask_data.formats.images import MAX_PIXELS, decode_color, image_header
from bask_data.formats.json_values import parse_json
from bask_data.formats.lzfse_data import decode_lzfse, stated_size
from bask_data.formats.members import FolderMembers, Members, ZipMembers, members_of
from bask_data.formats.recording import Depth

METADATA = ("metadata", "metadata.json")


@dataclass(frozen=True)
class Record3dFiles:
    """The files by number of frame.

    Args:
        table: the recording's metadata.
        depth_size: (height, width) by the metadata, pixels; None if they do not say.
    """

    members: Members
    metadata: str
    table: Mapping[str, Any]
    color: dict[int, str]
    depth: dict[int, str]
    confidence: dict[int, str]
    depth_size: tuple[int, int] | None

    @property
    def used(self) -> tuple[Path, ...]:
        """All files on disc."""
        groups = (self.color, self.depth, self.confidence)
        return self.members.files([self.metadata, *(name for group in groups for name in group.values())])

    def color_size(self, number: int) -> tuple[int, int]:
        """(height, width) of a colour image, pixels."""
        header = image_header(*self._content(self.color[number]))
        return header.height, header.width

    def read_color(self, number: int) -> UInt8[ndarray, "h w 3"]:
        """A frame's colour."""
        return decode_color(*self._content(self.color[number]))

    def read_depth(self, number: int) -> Depth:
        """A frame's depth, metres; not finite where nothing was measured."""
        name = self.depth[number]
        if isinstance(self.members, FolderMembers) and not name.endswith(".depth"):
            return read_any_depth(self.members.folder.member(name, "depth"))
        place, data = self._content(name)
        height, width = self.depth_size or self._depth_size(number)
        decoded = decode_lzfse(place, data, 4 * height * width, user="record3d")
        return np.frombuffer(decoded, "<f4").reshape(height, width).astype(np.float32)

    def read_confidence(self, number: int) -> UInt8[ndarray, "h w"]:
        """A frame's confidence: 0 low, 1 medium, 2 high."""
        if number not in self.confidence:
            fix = "leave out --confidence, or these frames by --frames."
            place = self.members.place(f"rgbd/{number}.conf")
            raise BadData(place, "confidence", expected="a file for every frame", got="none", fix=fix)
        place, data = self._content(self.confidence[number])
        height, width = self.depth_size or self._depth_size(number)
        decoded = decode_lzfse(place, data, height * width, user="record3d")
        return np.frombuffer(decoded, np.uint8).reshape(height, width)

    def _content(self, name: str) -> tuple[str, bytes]:
        return self.members.place(name), self.members.read(name)

    def _depth_size(self, number: int) -> tuple[int, int]:
        """(height, width) of depth by its number of values, with colour's proportions: older files do not state it."""
        place, data = self._content(self.depth[number])
        n_values = (stated_size(place, data) if data.startswith(b"bvx") else len(data)) // 4
        height, width = self.color_size(number)
        depth_width = round((n_values * width / height) ** 0.5)
        if depth_width < 1 or n_values % depth_width or n_values > MAX_PIXELS:
            got = f"{n_values} values"
            raise BadData(place, "depth", expected=f"an image of the proportions {width} x {height}", got=got)
        return n_values // depth_width, depth_width


def record3d_files(source: Path, follow_links: bool) -> Record3dFiles:
    """The files at `source`, a .r3d file or a folder.

    Raises:
        BadData: there are no metadata, or no images.
        UsageError: `source` is something else.
    """
    members: Members = members_of(source, (".r3d", ".zip"), follow_links)
    if isinstance(members, ZipMembers):
        members = members.at(next((name for name in METADATA if members.at(name).has(name)), METADATA[0]))
    metadata = next((name for name in METADATA if members.has(name)), None)
    if metadata is None:
        fix = "export as .r3d, or as EXR and JPG, and keep metadata beside the images."
        raise BadData(members.place(METADATA[0]), "metadata", expected="a file", got="none", fix=fix)
    table = parse_json(members.place(metadata), members.read(metadata, MAX_TEXT_BYTES))
    is_native = bool(members.named("rgbd", (".depth",)))
    folders = ("rgbd", "rgbd") if is_native else ("rgb", "depth")
    color = _by_number(members, folders[0], (".jpg", ".jpeg", ".png"))
    depth = _by_number(members, folders[1], (".depth",) if is_native else (".exr", ".tiff", ".tif", ".npy", ".png"))
    confidence = _by_number(members, "rgbd", (".conf",)) if is_native else {}
    if not color or not depth:
        fix = "export as .r3d, or as EXR and JPG: videos and point clouds are not enough."
        expected = "rgbd/0.jpg and rgbd/0.depth, or rgb/0.jpg and depth/0.exr, and so on"
        raise BadData(members.place(""), "images", expected=expected, got="none", fix=fix)
    return Record3dFiles(members, metadata, table, color, depth, confidence, _depth_size(members, metadata, table))


def _by_number(members: Members, folder: str, suffixes: tuple[str, ...]) -> dict[int, str]:
    files = members.named(folder, suffixes)
    numbered = {stem: name for stem, name in files.items() if stem.isascii() and stem.isdecimal() and len(stem) < 10}
    return {int(stem): name for stem, name in numbered.items()}


def _depth_size(members: Members, metadata: str, table: Mapping[str, Any]) -> tuple[int, int] | None:
    height: Any = table.get("dh")
    width: Any = table.get("dw")
    if height is None and width is None:
        return None
    are_whole = isinstance(height, int) and isinstance(width, int)
    if not are_whole or min(height, width) < 1 or height * width > MAX_PIXELS:
        expected, got = f"1 to {MAX_PIXELS} pixels", f"{width!r} x {height!r}"
        raise BadData(members.place(metadata), "dw, dh", expected=expected, got=got)
    return height, width
