"""Pinhole intrinsics: read from text, and held against the images they are said to be for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData, UsageError
from bask_data.formats.files import Folder, numbers, read_lines


def check_intrinsics(where: Path | str, K: Float[ndarray, "3 3"], size: tuple[int, int], stated: str) -> None:
    """Check that K fits images of this size.

    Intrinsics of another resolution are the most common mistake. The principal point reveals it, as it lies near the
    image's centre, except in crops; the user states the size of these.

    Args:
        where: place for messages.
        size: (height, width), pixels.
        stated: WIDTHxHEIGHT of the images that K was calibrated with, or empty.

    Raises:
        BadData: the size differs, the principal point is off-centre, or the focal lengths are implausible.
    """
    height, width = size
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    actual = f"{width}x{height}"
    if stated and stated != actual:
        raise BadData(
            where,
            "intrinsics",
            expected=f"images of {stated}",
            got=actual,
            fix="scale fx, fy, cx, cy to the images' size.",
        )
    low, high = (0.0, 1.0) if stated else (0.25, 0.75)
    if not (low * width <= cx <= high * width and low * height <= cy <= high * height):
        raise BadData(
            where,
            "intrinsics",
            expected=f"a principal point {'inside' if stated else 'near the middle of'} images of {actual}",
            got=f"({cx:g}, {cy:g})",
            fix="pass the intrinsics of this resolution"
            + ("." if stated else f"; if the images are a crop, state --intrinsics-size {actual}."),
        )
    if not 0.1 * width <= min(fx, fy) <= max(fx, fy) <= 20 * width:
        raise BadData(
            where,
            "intrinsics",
            expected=f"focal lengths in pixels, {0.1 * width:g} to {20 * width:g}",
            got=f"({fx:g}, {fy:g})",
            fix="pass fx, fy in pixels, not in millimetres.",
        )


def parse_intrinsics(folder: Folder, text: str) -> tuple[Float[ndarray, "3 3"], tuple[Path, ...]]:
    """K from `fx,fy,cx,cy` or from a text file (here or in the source folder), and the files it came from."""
    if not text:
        raise UsageError(
            "--intrinsics",
            expected="fx,fy,cx,cy or a file",
            got="nothing",
            fix="take them from the camera's calibration; images do not contain them.",
        )
    words = text.split(",")
    if len(words) == 4:
        return intrinsics_matrix(folder.path, numbers(Path("--intrinsics"), text)), ()
    path = Path(text)
    if not path.is_file():
        if len(words) > 1 and not folder.has(text):
            fix = "images do not contain them: take them from the camera's calibration."
            raise UsageError("--intrinsics", expected="4 numbers fx,fy,cx,cy", got=str(len(words)), fix=fix)
        path = folder.member(text, "--intrinsics")
    values = [value for line in read_lines(path) for value in numbers(path, line)]
    return intrinsics_matrix(path, values), (path,)


def intrinsics_matrix(
    where: Path | str, values: list[float], instead: str = ", or pass --intrinsics fx,fy,cx,cy"
) -> Float[ndarray, "3 3"]:
    """K from 4 numbers fx fy cx cy, or from the 9 or 16 of a matrix row by row, pixels; `BadData` for anything else.

    Args:
        where: place for messages.
        instead: a way to do without the file, which the fix offers.
    """
    array = np.array(values)
    if len(values) == 4:
        fx, fy, cx, cy = values
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)
    elif len(values) in (9, 16):
        side = 3 if len(values) == 9 else 4
        K = array.reshape(side, side)[:3, :3].astype(np.float64)
    else:
        raise BadData(
            where,
            "intrinsics",
            expected="4 numbers fx fy cx cy, or a 3x3 or 4x4 matrix",
            got=f"{len(values)} numbers",
            fix=f"correct the file{instead}.",
        )
    pinhole = np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and K[1, 0] == 0 and (K[2] == [0, 0, 1]).all()
    if not pinhole:
        raise BadData(
            where,
            "intrinsics",
            expected="a pinhole matrix: fx, fy > 0, zero below the diagonal, last row 0 0 1",
            got=K.tolist(),
            fix=_fix_of_intrinsics(K, instead),
        )
    return K


def _fix_of_intrinsics(K: Float[ndarray, "3 3"], instead: str) -> str:
    """What to do about a matrix that is no pinhole matrix: signs of focal lengths say which way the axes point."""
    if K[0, 0] < 0 and K[1, 1] < 0:
        # RLBench and CoppeliaSim: OpenCV's axes turned by 180 degrees about the viewing direction.
        return (
            "x points left and y up here: make fx and fy positive, and multiply each world_from_camera "
            "by diag(-1, -1, 1, 1) from the right."
        )
    if K[0, 0] < 0 < K[1, 1]:
        return "these are OpenGL axes: make fx positive and pass --axes opengl."
    return f"check the file{instead}."
