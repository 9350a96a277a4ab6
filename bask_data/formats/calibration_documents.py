"""Calibrations with named fields: JSON and YAML of OpenCV, ROS, Open3D, RealSense, and of own scripts."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import yaml

from bask_data.core.lens import Distortion
from bask_data.errors import BadData
from bask_data.formats.files import read_bytes

MAX_DOCUMENT_BYTES = 2**20
"""Largest calibration that is read, bytes; real ones have some kilobytes. Keeps wrong files from filling memory."""

FOCAL = (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"), ("fl_x", "fl_y", "cx", "cy"))
"""Names of focal lengths and principal point: usual ones, RealSense's, and those of transforms.json."""

MATRICES = ("camera_matrix", "k", "intrinsic_matrix", "camera_intrinsics", "cam_k", "intrinsics", "intrinsic", "mtx")
"""Names of a matrix: OpenCV's and ROS's, ROS messages', Open3D's, and those of scripts."""

DISTORTIONS = ("distortion_coefficients", "dist_coeffs", "dist_coefs", "distortion", "dist", "coeffs", "d")
"""Names of the lens distortion's numbers: OpenCV's and ROS's, those of scripts, RealSense's, ROS messages'."""

SIZES = (("width", "height"), ("image_width", "image_height"), ("w", "h"))
"""Names of the images' size."""

MOST_VALUES = 100
"""Numbers of a matrix or a lens that are looked at: YAML may name a list many times over, in lists of such lists."""

MODELS = ("distortion_model", "camera_model", "model")
"""Names of the lens model's name."""

SAME_AS = {"BROWN_CONRADY": "OPENCV", "PINHOLE": "OPENCV", "RADTAN": "OPENCV", "EQUI": "OPENCV_FISHEYE"}
"""Names of lens models besides `core.lens`: RealSense's, Kalibr's."""


@dataclass(frozen=True)
class CalibrationDocument:
    """What the file states of a camera: its intrinsics, its lens, and WIDTHxHEIGHT of its images, or empty."""

    intrinsics: list[float]
    distortion: Distortion | None
    size: str


def read_document(path: Path) -> CalibrationDocument:
    """The calibration of the one camera in the file; of several, that of `color` or `rgb`.

    Raises:
        BadData: it is no JSON or YAML, has no intrinsics that are known here, or the lens model is unknown.
    """
    found = list(_cameras(_document(path), ""))
    color = [(name, fields) for name, fields in found if re.search("colou?r|rgb", name)]
    if len(found) != 1 and len(color) != 1:
        raise BadData(
            path,
            "intrinsics",
            expected="those of one camera: fx, fy, cx, cy, or camera_matrix",
            got=f"those of {', '.join(name for name, _ in found)}" if found else "none",
            fix="pass --intrinsics fx,fy,cx,cy.",
        )
    _, fields = color[0] if len(color) == 1 else found[0]
    sizes = ([fields.get(key) for key in keys] for keys in SIZES)
    size = next((pair for pair in sizes if all(map(_is_number, pair))), None)
    return CalibrationDocument(
        _intrinsics(fields) or [], _distortion(path, fields), "" if size is None else f"{size[0]:.0f}x{size[1]:.0f}"
    )


def _document(path: Path) -> Any:
    text = read_bytes(path, MAX_DOCUMENT_BYTES).decode("utf-8-sig", errors="replace")
    try:
        if text.lstrip().startswith("{"):
            return json.loads(text)
        # OpenCV's files begin with a directive, and have a tag, that YAML does not know.
        return yaml.safe_load(re.sub(r"^%YAML.*$|!!opencv-matrix|!!python/tuple", "", text, flags=re.MULTILINE))
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise BadData(
            path,
            "intrinsics",
            expected="JSON or YAML",
            got=str(error).splitlines()[0][:200],
            fix="correct the file, or pass --intrinsics fx,fy,cx,cy.",
        ) from error


def _cameras(document: Any, name: str, depth: int = 0) -> Iterator[tuple[str, dict[str, Any]]]:
    """Fields of each camera, and the path of names to it; not deeper than real files are nested."""
    if not isinstance(document, dict):
        return
    fields = {str(key).lower(): value for key, value in document.items()}
    if _intrinsics(fields) is not None:
        yield name or "camera", fields
    elif depth < 3:
        for key, value in fields.items():
            yield from _cameras(value, f"{name}.{key}" if name else key, depth + 1)


def _intrinsics(fields: dict[str, Any]) -> list[float] | None:
    for keys in FOCAL:
        if all(_is_number(fields.get(key)) for key in keys):
            return [float(fields[key]) for key in keys]
    found = ((fields.get(key), _numbers(fields.get(key))) for key in MATRICES)
    # Four numbers are fx, fy, cx, cy, but not those of a 2x2 matrix.
    return next((values for value, values in found if values and (len(values) >= 9 or value == values)), None)


def _numbers(value: Any) -> list[float] | None:
    """The numbers of a list, nested or not, or of OpenCV's matrix."""
    if isinstance(value, dict):
        value = value.get("data")
    if not isinstance(value, list):
        return None
    flat = list(islice(_flat(value), MOST_VALUES + 1))
    try:
        # YAML reads 1e-05, without a point, as a text.
        return [float(number) for number in flat] if len(flat) <= MOST_VALUES else None
    except (ValueError, TypeError, OverflowError):
        return None


def _flat(values: list[Any], depth: int = 0) -> Iterator[Any]:
    """The items of a list and of the lists in it, not deeper than real files are nested."""
    for value in values:
        if isinstance(value, list) and value and depth < 3:
            yield from _flat(value, depth + 1)
        else:
            yield value


def _is_number(value: Any) -> bool:
    """Whether a value is a number that floating point holds, maybe not a finite one."""
    return isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63)


def _distortion(path: Path, fields: dict[str, Any]) -> Distortion | None:
    values = next((found for key in DISTORTIONS if (found := _numbers(fields.get(key)))), None)
    if values is None:
        named = [fields.get(key) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
        values = [float(value) if _is_number(value) else 0.0 for value in named]  # type: ignore[arg-type]
        # Fewer numbers are the shorter form of the model.
        values = values[:5] if not any(values[5:]) else values
    if not any(values):
        return None
    model = next((str(fields[key]) for key in MODELS if isinstance(fields.get(key), str)), "OPENCV")
    name = model.removeprefix("distortion.").upper()
    try:
        return Distortion(SAME_AS.get(name, name), tuple(values))
    except ValueError as error:
        raise BadData(
            path,
            "lens",
            expected="a known lens model",
            got=str(error),
            fix="undistort the images with the tool that calibrated the camera, and pass --intrinsics fx,fy,cx,cy.",
        ) from error
