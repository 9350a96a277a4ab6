"""Images of a COLMAP folder, and the depth that belongs to each."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from bask_data.errors import BadData
from bask_data.formats.files import Folder, listed, natural

IMAGE_FOLDERS = ("images", "color", "rgb", "input")
"""Folders in which images are looked for; COLMAP leaves the name open, and most tools write `images`."""


SUFFIXES = (".png", ".jpg", ".jpeg", ".ppm", ".pgm")
"""Endings of images that we decode."""


@dataclass(frozen=True)
class FoundImages:
    """The image files of a source.

    Args:
        root: folder that the model's names are relative to, itself relative to the source; "" is the source.
        pattern: regular expression for names, whose group is what depth files are named by.
        files: those there are, by name, in natural order; empty if the folder holds other files as well.
    """

    folder: Folder
    root: str
    pattern: str
    files: dict[str, Path]

    def path(self, name: str) -> Path:
        """The file of an image; `BadData` if there is none, or if it lies outside."""
        return self.files.get(name) or self.folder.member(f"{self.root}/{name}" if self.root else name, "image")

    def depth(self, template: str, name: str) -> Path | None:
        """The depth file of an image; None if there is none.

        Args:
            template: path whose * stands for the image's name without its ending, or what the pattern matched. Tried
                next are the whole name (`0001.jpg.png`), and the name without its folders.
        """
        match = re.fullmatch(self.pattern, name)
        stem = PurePosixPath(name).with_suffix("").as_posix()
        for key in (match[1] if match else stem, name, PurePosixPath(name).stem):
            if self.folder.has(template.replace("*", key)):
                return self.folder.member(template.replace("*", key), "--depth")
        return None


def found_images(folder: Folder, images: str, names: list[str]) -> FoundImages:
    """Where the images are.

    Args:
        images: folder or pattern; empty: the first of `IMAGE_FOLDERS` that has images.
        names: of the model's images, or empty.

    Raises:
        BadData: there are none; or the model's are not where they should be.
    """
    if "*" in images:
        paths = folder.matching(images, "images")
        root = str(PurePosixPath(images.split("*")[0] + "x").parent)
        root = "" if root == "." else root
        files = {path.relative_to(folder.path / root).as_posix(): path for path in paths.values()}
        before, after = images[len(root) + 1 if root else 0 :].split("*")
        return FoundImages(folder, root, f"{re.escape(before)}(.+){re.escape(after)}", files)
    places = [images.strip("/")] if images else [*IMAGE_FOLDERS, ""]
    for root in places:
        if names and any(folder.has(f"{root}/{name}" if root else name) for name in names):
            return FoundImages(folder, root, r"(.+)\.[^./]+", _listed(folder, root) if root else {})
        if not names and root and (files := _listed(folder, root)):
            return FoundImages(folder, root, r"(.+)\.[^./]+", files)
    raise BadData(
        folder.path,
        "images",
        expected=f"the model's images, such as {names[0]}" if names else "a folder of images",
        got=f"none in {listed([place or 'SOURCE itself' for place in places])}",
        fix="pass --images FOLDER, or a pattern: --images 'frame-*.color.png'.",
    )


def _listed(folder: Folder, root: str) -> dict[str, Path]:
    """Images in a folder and in those below it, by their paths relative to it, without hidden ones."""
    found = []
    for place, folders, names in os.walk(folder.path / root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [Path(place, name) for name in names if Path(name).suffix.lower() in SUFFIXES and name[0] != "."]
    relative = {path.relative_to(folder.path / root).as_posix(): path for path in found}
    return {
        name: folder.member(relative[name].relative_to(folder.path).as_posix(), "--images")
        for name in sorted(relative, key=natural)
    }
