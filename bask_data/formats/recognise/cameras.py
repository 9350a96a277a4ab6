"""Dumps of several cameras, a folder each, and of cameras that a robot carries."""

from __future__ import annotations

from pathlib import PurePosixPath

from bask_data.formats.file_patterns import words_of
from bask_data.formats.listing import Listing

CALIBRATIONS = (
    ({"hand", "eye"}, "poses are the gripper's", "gripper-from-camera"),
    ({"handeye"}, "poses are the gripper's", "gripper-from-camera"),
    ({"gripper", "from", "camera"}, "poses are the gripper's", "gripper-from-camera"),
    ({"color", "from", "depth"}, "depth is of another camera", "color-from-depth"),
)
"""Words that, together in a file's name, say that it is a calibration; when it is needed, and the option for it."""

CAMERA_NAME = "abcdefghijklmnopqrstuvwxyz0123456789_"
"""Characters of a camera's name in a dataset."""


def options_for_cameras(listing: Listing, options: dict[str, str], others: tuple[str, ...]) -> dict[str, str]:
    """The options with `{camera}` for the folder that tells cameras apart; empty if there is only one camera.

    Args:
        options: for one camera: `color`, `depth`, `pose`, and `intrinsics`, if known.
        others: patterns of images that belong to none of these.
    """
    if not {"color", "depth"} <= options.keys():
        return {}
    for i, name in enumerate(PurePosixPath(options["color"]).parts[:-1]):
        if not _replaced(options["depth"], i, name, "x"):
            continue
        names = [
            other
            for pattern in others
            if len(parts := PurePosixPath(pattern).parts) > i + 1
            and (other := parts[i]) != name
            and all(_replaced(options[kind], i, name, other) in others for kind in ("color", "depth"))
            and set(other) <= set(CAMERA_NAME)
        ]
        cameras = sorted({name, *names})
        # Poses or intrinsics may have been found in the folder of another of the cameras.
        given = {
            key: next((at_name for other in names if (at_name := _replaced(path, i, other, name))), path)
            for key, path in options.items()
        }
        if names and set(name) <= set(CAMERA_NAME) and _are_there(listing, given, i, name, [name, *names]):
            in_each = {key: _replaced(path, i, name, "{camera}") for key, path in given.items()}
            return {"camera": ",".join(cameras)} | {key: path for key, path in in_each.items() if path}
    return {}


def calibration_hints(listing: Listing) -> list[str]:
    """Files with transforms between cameras and gripper, and the options for them, not taken without being asked."""
    hints: dict[str, str] = {}
    for folder in listing.all_folders:
        for name in listing.files(folder) if folder.count("/") < 2 else ():
            words = set(words_of(PurePosixPath(name).stem))
            for wanted, condition, option in CALIBRATIONS:
                if name.lower().endswith(".txt") and wanted <= words:
                    path = f"{folder}/{name}".lstrip("/")
                    hints.setdefault(option, f"{path}: if {condition}, --{option} '{path}'")
    return list(hints.values())


def _replaced(path: str, i: int, name: str, other: str) -> str:
    """A path with another name for its folder number i; empty if that folder has not the name."""
    parts = list(PurePosixPath(path).parts)
    if len(parts) <= i + 1 or parts[i] != name:
        return ""
    return "/".join([*parts[:i], other, *parts[i + 1 :]])


def _are_there(listing: Listing, options: dict[str, str], i: int, name: str, others: list[str]) -> bool:
    """Whether each camera has what the first one has of its own."""
    paths = [path for key, path in options.items() if key not in ("color", "depth")]
    wanted = [_replaced(path, i, name, other) for path in paths for other in others]
    return all(
        listing.has(path) if "*" not in path else bool(listing.files(str(PurePosixPath(path).parent)))
        for path in wanted
        if path
    )
