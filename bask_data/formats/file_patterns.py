"""Patterns with one `*` for the files of a folder, as the options of `frames` take them, found from the names."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

from bask_data.formats.listing import Listing

IMAGES = (".png", ".jpg", ".jpeg", ".pgm", ".tif", ".tiff", ".exr")
ARRAYS = (".npy",)
TEXTS = (".txt",)

LABEL_WORDS = {"label", "labels", "mask", "masks", "seg", "segm", "segmentation", "semantic", "instance", "instances"}
DEPTH_WORDS = {"depth", "depths", "depthmap", "depthmaps", "dep"}
COLOR_WORDS = {"rgb", "color", "colour", "colors", "colours", "image", "images", "img", "imgs", "rgbs"}
POSE_WORDS = {"pose", "poses", "extrinsic", "extrinsics", "extr", "transform", "transforms"}
OTHER_WORDS = {
    "intrinsic",
    "intrinsics",
    "confidence",
    "conf",
    "normal",
    "normals",
    "flow",
    "ir",
    "infrared",
    "thumb",
    "thumbnail",
    "vis",
}
"""Words in names of files and folders that say what the files hold."""

LEAST_SIDE = 16
"""Rows and columns from which an array whose name says nothing is an image, and no matrix."""


@dataclass(frozen=True)
class FilePattern:
    """Files of one kind.

    Args:
        pattern: with one `*`, relative to the source.
        kind: `color`, `depth`, `label`, `pose` or `other`.
        keys: what the `*` matches, for the names that were read.
        first: path of one of the files.
        is_named: whether a word in the names says the kind, and not only the content.
    """

    pattern: str
    kind: str
    keys: frozenset[str]
    first: str
    is_named: bool


def file_patterns(listing: Listing) -> list[FilePattern]:
    """All patterns of files that may be frames', the ones with most files first, upper folders before lower ones."""
    found = []
    for folder in listing.all_folders:
        groups: dict[str, list[str]] = {}
        for name in listing.files(folder):
            if name.lower().endswith((*IMAGES, *ARRAYS, *TEXTS)) and re.search("[0-9]", name):
                groups.setdefault(re.sub("[0-9]+", "0", name), []).append(name)
        for names in groups.values():
            before, after = _around(names)
            prefix = f"{folder}/" if folder else ""
            first = f"{prefix}{names[0]}"
            pattern = f"{prefix}{before}*{after}"
            keys = frozenset(name[len(before) : len(name) - len(after)] for name in names)
            kind, is_named = _kind(listing, pattern, first)
            found.append(FilePattern(pattern, kind, keys, first, is_named))
    return sorted(found, key=lambda each: (-len(each.keys), each.pattern.count("/"), each.pattern))


def words_of(text: str) -> list[str]:
    """Words in a name, in lower case: `camDepth_01` has cam and depth."""
    return [word.lower() for word in re.findall("[A-Z]?[a-z]+|[A-Z]+(?![a-z])", text)]


def count_of_numbers(text: bytes) -> int:
    """How many numbers a text consists of; 0 if of anything else, remarks after # aside."""
    return len(numbers_of(text))


def numbers_of(text: bytes) -> list[float]:
    """The numbers that a text consists of; none if of anything else, remarks after # aside."""
    lines = text.decode("utf-8", errors="replace").splitlines()
    words = re.split(r"[\s,;\[\](){}]+", " ".join(line.split("#", 1)[0] for line in lines))
    try:
        return [float(word) for word in words if word]
    except ValueError:
        return []


def _is_depth_array(header: bytes) -> bool:
    """Whether a .npy file is an image with one channel of 16 bits or in floating point."""
    described = re.search(rb"'descr': '[<>|=]?(f2|f4|f8|u2|i2)'.*'shape': \((\d+), (\d+)\)", header)
    return described is not None and min(int(described[2]), int(described[3])) > LEAST_SIDE


def _around(names: list[str]) -> tuple[str, str]:
    """What is the same before and after the number or time that tells the names apart.

    All names consist of the same text between runs of digits.
    """
    parts = [re.split("([0-9]+)", name) for name in names]
    runs = range(1, len(parts[0]), 2)
    varying = [i for i in runs if len({part[i] for part in parts}) > 1] or [runs[-1]]
    low, high = varying[0], varying[-1]
    # A time such as 1700000000.500000 is one number, even if all names have the same digits after its point.
    while high + 2 < len(parts[0]) and parts[0][high + 1] == ".":
        high += 2
    while low > 1 and parts[0][low - 1] == ".":
        low -= 2
    return "".join(parts[0][:low]), "".join(parts[0][high + 1 :])


def _kind(listing: Listing, pattern: str, first: str) -> tuple[str, bool]:
    """What files are by the words in their names and, for PNG, by their bits; and whether a word says it."""
    suffix = PurePosixPath(first).suffix.lower()
    # The words nearest to the file count first: images/depth/0001.png is depth.
    words = [word for part in reversed(PurePosixPath(pattern).parts) for word in words_of(part.rsplit(".", 1)[0])]
    named = next((kind for word in words if (kind := _kind_of_word(word))), "")
    if suffix in TEXTS:
        n = count_of_numbers(listing.head(first))
        # Files that are named poses are such in any form: the reader says what is wrong with them.
        is_pose = n > 0 if named == "pose" else not named and n in (7, 12, 16)
        return ("pose", named == "pose") if is_pose else ("other", False)
    if named in ("label", "other"):
        return named, True
    if suffix in ARRAYS:
        if not named and _is_depth_array(listing.head(first, 256)):
            return "depth", False
        return (named, True) if named in ("depth", "pose") else ("other", False)
    header = listing.head(first, 26)
    if suffix == ".png" and header.startswith(b"\x89PNG"):
        is_depth = header[24] == 16 and header[25] == 0
    elif named in ("color", "depth"):
        return named, True
    else:
        is_depth = suffix in (".pgm", ".tif", ".tiff", ".exr")
    if is_depth:
        return "depth", named == "depth"
    return ("other", True) if named == "depth" else ("color", named == "color")


def _kind_of_word(word: str) -> str:
    kinds = {
        "label": LABEL_WORDS,
        "depth": DEPTH_WORDS,
        "color": COLOR_WORDS,
        "pose": POSE_WORDS,
        "other": OTHER_WORDS,
    }
    return next((kind for kind, words in kinds.items() if word in words), "")
