"""Intrinsics and lens distortion: read from text, and compared with the images they are said to be for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Distortion
from bask_data.errors import BadData, UsageError
from bask_data.formats.calibration_documents import read_document
from bask_data.formats.files import Folder, numbers, read_lines

N_WITH_DISTORTION = (8, 9, 12, 13, 14, 17)
"""Counts of numbers of intrinsics (4, or 9 of a matrix) with OpenCV's distortion (4, 5 or 8) after them."""

LARGEST_DISTORTION = 100.0
"""Bound on the numbers of OpenCV's lens model: above it they are something else, such as an image size. Rational models
reach some tens. Chosen, sensitivity not measured."""

DOCUMENTS = (".json", ".yaml", ".yml")
"""Suffixes of calibrations with named fields."""


MOST_ANISOTROPIC = 2.0
"""Largest ratio of the focal lengths: pixels are square, except in images of 16:9 or 4:3 that were squeezed into
squares (1.78). Sensitivity not measured."""


def check_intrinsics(
    where: Path | str, K: Float[ndarray, "3 3"], size: tuple[int, int], stated: str, instead: str = ""
) -> None:
    """Check that K fits images of this size.

    Intrinsics of another resolution are the most common mistake. The principal point reveals it, as it lies near the
    image's centre, except in crops; the user states the size of these.

    Args:
        where: place for messages.
        size: (height, width), pixels.
        stated: WIDTHxHEIGHT of the images that K was calibrated with, or empty.
        instead: what to do where `--intrinsics` and `--intrinsics-size` are no options; empty where they are.

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
            fix=instead or "scale fx, fy, cx, cy to the images' size.",
        )
    low, high = (0.0, 1.0) if stated else (0.25, 0.75)
    if not (low * width <= cx <= high * width and low * height <= cy <= high * height):
        raise BadData(
            where,
            "intrinsics",
            expected=f"a principal point {'inside' if stated else 'near the middle of'} images of {actual}",
            got=f"({cx:g}, {cy:g})",
            fix=instead
            or "pass the intrinsics of this resolution"
            + ("." if stated else f"; if the images are a crop, state --intrinsics-size {actual}."),
        )
    if not 0.1 * width <= min(fx, fy) <= max(fx, fy) <= 20 * width:
        raise BadData(
            where,
            "intrinsics",
            expected=f"focal lengths in pixels, {0.1 * width:g} to {20 * width:g}",
            got=f"({fx:g}, {fy:g})",
            fix=instead or "pass fx, fy in pixels, not in millimetres.",
        )
    if max(fx, fy) > MOST_ANISOTROPIC * min(fx, fy):
        raise BadData(
            where,
            "intrinsics",
            expected=f"fx and fy alike, within a factor of {MOST_ANISOTROPIC:g}",
            got=f"({fx:g}, {fy:g})",
            fix=instead or "check their order: fx,fy,cx,cy, in pixels.",
        )


@dataclass(frozen=True)
class CameraIntrinsics:
    """What a calibration states about a camera.

    Args:
        K: pixels.
        distortion: None where none is stated.
        size: WIDTHxHEIGHT of the images that it is for, or empty.
        files: the file it came from, if any.
        is_lens_named: whether the distortion stood under a name, and not only after other numbers.
    """

    K: Float[ndarray, "3 3"]
    distortion: Distortion | None = None
    size: str = ""
    files: tuple[Path, ...] = ()
    is_lens_named: bool = True

    @property
    def statement(self) -> str:
        """The lens, in words, for the assumptions of a recording."""
        return self.statement_with("")

    def statement_with(self, option: str) -> str:
        """As `statement`, where `--distortion` decides unless it is empty."""
        if option:
            return f"for colour and depth alike, lens by --distortion {option}; pixel (0, 0) is a centre"
        if self.distortion is None or self.distortion.is_none:
            return "pinhole, for colour and depth alike, no lens distortion; pixel (0, 0) is a centre"
        numbers = ", ".join(f"{value:g}" for value in self.distortion.parameters)
        return (
            f"with {self.distortion.model} lens distortion ({numbers}), for colour and depth alike; pixel (0, 0) is a "
            "centre. --distortion pinhole: if it is already taken out of the images"
        )


def parse_intrinsics(
    folder: Folder, text: str, option: str = "--intrinsics"
) -> tuple[Float[ndarray, "3 3"], tuple[Path, ...]]:
    """K from `fx,fy,cx,cy` or from a file (here or in the source folder), and the files it came from.

    Args:
        option: that holds the text.

    Raises:
        BadData: as `read_calibration`, or a lens distortion is stated, too.
    """
    calibration = read_calibration(folder, text, option)
    if calibration.distortion is not None and not calibration.distortion.is_none:
        raise BadData(
            calibration.files[0] if calibration.files else option,
            "intrinsics",
            expected="no lens distortion here",
            got=f"{calibration.distortion.model} {list(calibration.distortion.parameters)}",
            fix="give fx,fy,cx,cy alone"
            + (", and the distortion with --distortion." if option == "--intrinsics" else ", of undistorted images."),
        )
    return calibration.K, calibration.files


def read_calibration(folder: Folder, text: str, option: str = "--intrinsics") -> CameraIntrinsics:
    """Intrinsics and lens distortion, from numbers or from a file (here or in the source folder).

    Numbers are fx, fy, cx, cy or a 3x3, 3x4 or 4x4 matrix. OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]] may follow the first
    two. JSON and YAML files are those of OpenCV, ROS, Open3D and RealSense, or have fields fx, fy, cx, cy.

    Args:
        option: that holds the text.

    Raises:
        UsageError: no intrinsics, or another count of numbers.
        BadData: the file holds something else.
    """
    if not text:
        raise UsageError(
            option,
            expected="fx,fy,cx,cy or a file",
            got="nothing",
            fix="take them from the camera's calibration; images do not contain them.",
        )
    words = text.split(",")
    path = Path(text)
    if not path.is_file() and not folder.has(text) and len(words) > 1:
        if len(words) not in (4, *N_WITH_DISTORTION):
            fix = "images do not contain them: take them from the camera's calibration."
            raise UsageError(option, expected="4 numbers fx,fy,cx,cy", got=str(len(words)), fix=fix)
        return calibration_of_numbers(folder.path, numbers(Path(option), text))
    path = path if path.is_file() else folder.member(text, option)
    lines = read_lines(path)
    if path.suffix.lower() in DOCUMENTS or (lines and lines[0][0] in "{%"):
        document = read_document(path)
        K = intrinsics_matrix(path, document.intrinsics)
        calibration = CameraIntrinsics(K, document.distortion, document.size)
    else:
        calibration = calibration_of_numbers(path, [value for line in lines for value in numbers(path, line)])
    return replace(calibration, files=(path,))


def calibration_of_numbers(where: Path | str, values: list[float]) -> CameraIntrinsics:
    """Intrinsics and, after them, OpenCV's distortion; `BadData` for another count or no pinhole matrix."""
    n = len(values)
    if n == 12 and values[8:11] == [0, 0, 1]:  # ROS's projection matrix, 3x4
        return CameraIntrinsics(intrinsics_matrix(where, [*values, 0.0, 0.0, 0.0, 1.0]))
    if n not in N_WITH_DISTORTION or (n == 9 and not (values[3] > 0 and _is_moderate(values[4:]))):
        return CameraIntrinsics(intrinsics_matrix(where, values))
    n_first = 9 if n > 12 else 4
    K, distortion = intrinsics_matrix(where, values[:n_first]), values[n_first:]
    if not _is_moderate(distortion):
        raise BadData(
            where,
            "intrinsics",
            expected=f"distortion below {LARGEST_DISTORTION:g} after {n_first} numbers of the intrinsics",
            got=distortion,
            fix="pass --intrinsics fx,fy,cx,cy and, if there is distortion, --distortion opencv:k1,k2,p1,p2.",
        )
    return CameraIntrinsics(K, Distortion("OPENCV", tuple(distortion)), is_lens_named=False)


def refuse_unnamed_lens(calibration: CameraIntrinsics, option: str) -> None:
    """Refuse distortion that is only said by the number of numbers, unless `--distortion` decides: calibrations often
    stay beside images that were undistorted with them.

    Raises:
        BadData: naming both choices.
    """
    lens = calibration.distortion
    if calibration.is_lens_named or lens is None or lens.is_none or option:
        return
    numbers = ",".join(f"{value:g}" for value in lens.parameters)
    raise BadData(
        calibration.files[0] if calibration.files else "--intrinsics",
        "intrinsics",
        expected="4 numbers fx fy cx cy, or a matrix",
        got=f"{len(lens.parameters)} more, which look like OpenCV's distortion: {numbers}",
        fix=f"pass --distortion opencv:{numbers} to take it out, or --distortion pinhole if the images are without it.",
    )


def intrinsics_matrix(
    where: Path | str, values: list[float], instead: str = ", or pass --intrinsics fx,fy,cx,cy"
) -> Float[ndarray, "3 3"]:
    """K from 4 numbers fx fy cx cy, or from the 9 or 16 of a matrix, pixels; `BadData` for anything else.

    A matrix may be written row by row or column by column: the two cannot be confused.

    Args:
        where: place for messages.
        instead: a way to do without the file, which the fix offers.
    """
    if len(values) == 4:
        fx, fy, cx, cy = values
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)
    elif len(values) in (9, 16):
        side = 3 if len(values) == 9 else 4
        K = np.array(values, dtype=np.float64).reshape(side, side)[:3, :3]
    else:
        raise BadData(
            where,
            "intrinsics",
            expected="4 numbers fx fy cx cy, or a 3x3 or 4x4 matrix",
            got=f"{len(values)} numbers",
            fix=f"correct the file{instead}.",
        )
    if (K[:, 2] == [0, 0, 1]).all() and K[2, 0] > 0:
        K = np.ascontiguousarray(K.T)
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


def _is_moderate(distortion: list[float]) -> bool:
    return all(abs(value) < LARGEST_DISTORTION for value in distortion)  # Also false for NaN.


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
    if K[1, 1] < 0 < K[0, 0]:
        # ICL-NUIM: POV-Ray's axes, which are left-handed, and so is the world.
        return (
            "y points up here, in the camera and in the world (ICL-NUIM): make fy positive, and change the signs of "
            "ty, qx and qz in the poses."
        )
    return f"check the file{instead}."
