"""Intrinsics and lens distortion of transforms.json, stated once or frame by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Distortion, Lens, one_if_same
from bask_data.errors import BadData
from bask_data.formats.json_values import number

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE")
"""Names of models whose k1.., p1, p2 are OpenCV's."""

FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
"""Names of models whose k1..k4 are those of OpenCV's fisheye; COLMAP's with fewer are the same polynomial."""


def lens_of(path: Path, table: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], size: tuple[int, int]) -> Lens:
    """The lens of the colour images.

    What a frame states goes before what the file states for all.

    Args:
        size: (height, width) of the images, pixels.

    Returns:
        K (3, 3), or (t, 3, 3) where frames differ, with pixel (0, 0) as the centre of the top-left pixel; the file's
        cx and cy count from that pixel's corner, as COLMAP does.

    Raises:
        BadData: a number is missing; the images have another size; the model is unknown, or changes between frames.
    """
    distortions = {_distortion(path, {**table, **frame}): _name(frame) for frame in frames}
    if len(distortions) > 1:
        first, second = list(distortions.values())[:2]
        raise BadData(
            path,
            f"distortion of {second}",
            expected=f"one lens for all frames, as {first} has",
            got="another one",
            fix="undistort the images beforehand, or write a file with transforms for each camera.",
        )
    Ks = np.stack([_matrix(path, {**table, **frame}, _name(frame), size) for frame in frames])
    return Lens(one_if_same(Ks), size, next(iter(distortions)))


def depth_lens_of(lens: Lens, size: tuple[int, int]) -> Lens:
    """The lens of the same camera's images of another size: scaled about the corner of the image, as nerfstudio does.

    Args:
        lens: with pixel centres at integers, which lie half a pixel from that corner in both sizes.
    """
    K = lens.K.copy()
    for row, scale in ((0, size[1] / lens.size[1]), (1, size[0] / lens.size[0])):
        K[..., row, :2] *= scale
        K[..., row, 2] = (K[..., row, 2] + 0.5) * scale - 0.5
    return Lens(K, size, lens.distortion)


def _name(frame: Mapping[str, Any]) -> str:
    return str(frame.get("file_path"))


def _matrix(path: Path, table: Mapping[str, Any], name: str, size: tuple[int, int]) -> Float[ndarray, "3 3"]:
    height, width = size
    place = f"{path}: {name}"
    stated = (number(place, table, "w", float(width)), number(place, table, "h", float(height)))
    if stated[0] != width or stated[1] != height:
        raise BadData(
            path,
            f"w, h of {name}",
            expected=f"{width} x {height}, the size of the images",
            got=f"{stated[0]:g} x {stated[1]:g}",
            fix="name the images that the intrinsics are for, or scale w, h, fl_x, fl_y, cx and cy to these.",
        )
    angle = number(place, table, "camera_angle_x", 0.0)
    if "fl_x" not in table and 0 < angle < math.pi:
        fl_x = width / 2 / math.tan(angle / 2)
    else:
        fl_x = number(place, table, "fl_x")
    fl_y = number(place, table, "fl_y", fl_x)
    cx, cy = number(place, table, "cx", width / 2), number(place, table, "cy", height / 2)
    return np.array([[fl_x, 0, cx - 0.5], [0, fl_y, cy - 0.5], [0, 0, 1]])


def _distortion(path: Path, table: Mapping[str, Any]) -> Distortion | None:
    model = str(table.get("camera_model", "OPENCV")).upper()
    model = "OPENCV_FISHEYE" if table.get("is_fisheye") is True and model in PERSPECTIVE else model
    k1, k2, k3, k4, k5, k6, p1, p2 = (
        number(path, table, key, 0.0) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
    )
    if model in FISHEYE:
        return Distortion("OPENCV_FISHEYE", (k1, k2, k3, k4))
    if model not in PERSPECTIVE:
        raise BadData(
            path,
            "camera_model",
            expected=f"one of {', '.join(PERSPECTIVE + FISHEYE)}",
            got=model,
            fix="undistort the images beforehand (COLMAP's image_undistorter), and state PINHOLE.",
        )
    if k5 or k6 or (k4 and model == "FULL_OPENCV"):
        return Distortion("OPENCV", (k1, k2, p1, p2, k3, k4, k5, k6))
    if k4:
        raise BadData(
            path,
            "k4",
            expected="0 in a perspective camera: nerfstudio's fourth radial term is in no other library",
            got=f"{k4:g}",
            fix="state camera_model OPENCV_FISHEYE or FULL_OPENCV if the numbers are of that model.",
        )
    if not any((k1, k2, k3, p1, p2)):
        return None
    return Distortion("OPENCV", (k1, k2, p1, p2, k3) if k3 else (k1, k2, p1, p2))
