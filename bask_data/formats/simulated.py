"""What recordings of simulators have in common: their cameras' intrinsics, and images of object numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Integer, UInt8
from numpy import ndarray

from bask_data.core.lens import one_if_same
from bask_data.errors import BadData, UsageError
from bask_data.formats.label_files import LARGEST_LABEL

CENTRE_TOLERANCE = 1e-3
"""Pixels by which a principal point may differ from the image's exact middle: rounding of float32, nothing more."""


def at_pixel_centres(
    K: Float[ndarray, "t 3 3"], size: tuple[int, int]
) -> tuple[Float[ndarray, "3 3"] | Float[ndarray, "t 3 3"], str]:
    """Intrinsics for pixel (0, 0) at the centre of the top-left pixel, one K if all are equal, and a statement on it.

    Renderers look through the middle of the image. MuJoCo, SAPIEN and CoppeliaSim state it as (width / 2, height / 2):
    from the image's corner, which is half a pixel from the first centre. Any other principal point was set by a user
    and is taken as it is.

    Args:
        K: of each frame, pixels.
        size: (height, width), pixels.
    """
    height, width = size
    middle = np.array([width / 2, height / 2])
    from_corner = np.abs(K[:, :2, 2] - middle).max(axis=1) < CENTRE_TOLERANCE
    shifted = K.copy()
    shifted[from_corner, :2, 2] = middle - 0.5
    text = "pinhole, from the files"
    if from_corner.any():
        text += "; the principal point (width / 2, height / 2) counts from the image's corner: half a pixel taken off"
    return one_if_same(shifted), text


def object_labels(text: str) -> dict[int, tuple[int, str]]:
    """Label and name of each object by its number in the source, from `NUMBER=NAME,NUMBER=NAME`; labels are 1, 2, ...

    Objects of the same name are one object of several parts.

    Raises:
        UsageError: the text has another form.
    """
    objects: dict[int, tuple[int, str]] = {}
    labels: dict[str, int] = {}
    for part in text.split(",") if text else []:
        number, _, name = (word.strip() for word in part.partition("="))
        if not (number.isascii() and number.isdigit()) or not name:
            expected, fix = "NUMBER=NAME,NUMBER=NAME", "for instance --objects 84=lid,85=lid,90=pan"
            raise UsageError("--objects", expected=expected, got=part, fix=fix)
        objects[int(number)] = (labels.setdefault(name, len(labels) + 1), name)
    if len(labels) > LARGEST_LABEL:
        raise UsageError("--objects", expected=f"at most {LARGEST_LABEL} names", got=len(labels))
    return objects


def about_numbers(images: str, objects: str) -> str:
    """What is said of images of object numbers: whether `--objects` makes them ground truth."""
    if objects:
        return f"{images}, taken as truth for reports only; objects by --objects"
    return f"{images} there, but not read: --objects NUMBER=NAME says which numbers are objects"


def labelled(
    numbers: Callable[[int], Integer[ndarray, "h w"]], objects: dict[int, tuple[int, str]]
) -> Callable[[int], UInt8[ndarray, "h w"]]:
    """Labels of a frame from its image of object numbers; what is not among the objects is 0."""
    known = np.array(sorted(objects), dtype=np.int64)
    values = np.array([objects[int(number)][0] for number in known], dtype=np.uint8)

    def read(i: int) -> UInt8[ndarray, "h w"]:
        image = numbers(i).astype(np.int64)
        at = np.searchsorted(known, image).clip(max=len(known) - 1)
        return np.where(known[at] == image, values[at], np.uint8(0))

    return read


def chosen_cameras(source: Path, wanted: Sequence[str], usable: Sequence[str], reasons: dict[str, str]) -> list[str]:
    """The cameras that `--cameras` names; by default all that can be used.

    Args:
        reasons: why other cameras of the source cannot be used, and after a colon what to do about it.

    Raises:
        UsageError: a name is unknown.
        BadData: a camera that is named, or every one, cannot be used.
    """
    names = list(wanted or usable)
    for name in names:
        if name in reasons:
            raise BadData(source, f"camera {name}", expected="colour, depth and calibration", got=reasons[name])
        if name not in usable:
            known = ", ".join([*usable, *reasons])
            raise UsageError("--cameras", expected=f"names among {known}", got=name, fix="leave it out for all.")
    if not names:
        got = "; ".join(f"{name}: {reason}" for name, reason in reasons.items()) or "no cameras"
        fix = "" if ": " in "".join(reasons.values()) else "record the simulator's observations with colour and depth."
        raise BadData(source, "cameras", expected="one with colour, depth and calibration", got=got, fix=fix)
    return list(dict.fromkeys(names))


def left_out(reasons: dict[str, str], chosen: Sequence[str]) -> dict[str, str]:
    """The assumption on cameras that are not read, if there are any."""
    texts = [f"{name} ({reason})" for name, reason in reasons.items() if name not in chosen]
    return {"cameras": f"{', '.join(chosen)}; left out: {', '.join(texts)}"} if texts else {}


def common_length(source: Path, n_frames: dict[str, int]) -> int:
    """Number of frames of all cameras, which share the robot's states; `BadData` if cameras differ."""
    counts = set(n_frames.values())
    if len(counts) > 1:
        got = ", ".join(f"{name}: {n}" for name, n in n_frames.items())
        raise BadData(source, "frames", expected="as many of each camera", got=got, fix="choose one with --cameras.")
    return counts.pop()
