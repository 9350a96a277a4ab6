"""Lenses from `sensor_msgs/CameraInfo`.

Raw images have the matrix K and the distortion D, rectified ones the matrix P and none. Cropping (roi) and binning are
applied to both, as image_geometry's PinholeCameraModel does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Distortion, Lens
from bask_data.core.time_pairs import nearest
from bask_data.errors import BadData
from bask_data.formats.rosbag.bag import Bag
from bask_data.formats.rosbag.contents import Calibrations, Contents
from bask_data.formats.rosbag.topics import ImageTopic

SAME_MODELS = {"fisheye": "equidistant", "radtan": "plumb_bob"}
"""Other names of ROS's lens models, which some drivers write."""

SAME_K_PX = 0.01
"""Difference of intrinsics, pixels, up to which two cameras are one."""


@dataclass(frozen=True)
class StatedLens:
    """A lens by a bag's CameraInfo.

    Args:
        stated_size: WIDTHxHEIGHT of the images that it is for, or empty.
        statement: in words, for the assumptions of a recording.
    """

    lens: Lens
    stated_size: str
    statement: str


def stated_lens(
    bag: Bag, contents: Contents, image: ImageTopic, size: tuple[int, int], stamps: list[int], option: str, topic: str
) -> StatedLens:
    """The lens of a topic's images of `size`, with a K for each stamp if it changes.

    Args:
        option: which names the topic of CameraInfo.
        topic: its value, or empty.

    Raises:
        BadData: there is no CameraInfo for the images, or it is empty, or its lens model is unknown.
    """
    topic = _info_topic(bag, contents, image, size, option, topic)
    found = contents.calibrations[topic]
    where = f"{bag.paths[0]}: {topic}"
    lenses = [_lens(where, message, image, size) for message in found.messages]
    first = lenses[0]
    if any(lens.lens.distortion != first.lens.distortion for lens in lenses):
        raise BadData(where, "D", expected="one lens distortion", got="several, at different times")
    if all(np.array_equal(lens.lens.K, first.lens.K) for lens in lenses):
        return first
    order = np.argsort(found.stamps, kind="stable")
    start = int(min(stamps))
    known = (np.array(found.stamps, np.int64)[order] - start) / 1e9
    which = nearest((np.array(stamps, np.int64) - start) / 1e9, known, np.inf)
    K = np.stack([lenses[found.which[order[i]]].lens.K for i in which])
    text = f"{first.statement}; it changes, and each frame has the one nearest in time"
    return StatedLens(Lens(K, size, first.lens.distortion), first.stated_size, text)


def has_lens(contents: Contents, image: ImageTopic, topic: str) -> bool:
    """Whether there is CameraInfo beside the images, or an option names it."""
    return bool(topic) or image.info in contents.calibrations


def same_camera(a: Lens, b: Lens) -> bool:
    """Whether two lenses have the same size and intrinsics."""
    return a.size == b.size and bool(np.abs(a.at(0).K - b.at(0).K).max() <= SAME_K_PX)


def _info_topic(bag: Bag, contents: Contents, image: ImageTopic, size: tuple[int, int], option: str, topic: str) -> str:
    if topic in contents.calibrations:
        return topic
    if not topic:
        if image.info in contents.calibrations:
            return image.info
        fitting = [name for name, found in contents.calibrations.items() if _is_for(found, image, size)]
        if len(fitting) == 1:
            return fitting[0]
    there = ", ".join(contents.calibrations) or "no topic of this type"
    by_hand = "--intrinsics fx,fy,cx,cy" if option == "--camera-info-topic" else "--depth-intrinsics fx,fy,cx,cy"
    raise BadData(
        bag.paths[0],
        topic or image.info,
        expected=f"CameraInfo of {image.name}",
        got=there,
        fix=f"pass {option} with one of them, or {by_hand}." if contents.calibrations else f"pass {by_hand}.",
    )


def _is_for(found: Calibrations, image: ImageTopic, size: tuple[int, int]) -> bool:
    return all(
        frame == image.frame and (message.height, message.width) == size
        for frame, message in zip(found.frames, found.messages, strict=True)
    )


def _lens(where: str, info: Any, image: ImageTopic, size: tuple[int, int]) -> StatedLens:
    numbers = {
        name: np.asarray(getattr(info, name, getattr(info, name.upper(), ())), np.float64) for name in ("k", "d", "p")
    }
    by_P = image.is_rectified and numbers["p"][0] > 0
    K = numbers["p"].reshape(3, 4)[:, :3].copy() if by_P else numbers["k"].reshape(3, 3).copy()
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise BadData(
            where,
            "P" if by_P else "K",
            expected="focal lengths above 0",
            got=f"({K[0, 0]:g}, {K[1, 1]:g})",
            fix="the camera was not calibrated: pass --intrinsics fx,fy,cx,cy, or --depth-intrinsics for depth.",
        )
    K, stated = _cropped(K, info)
    distortion = None if image.is_rectified else _distortion(where, info.distortion_model, numbers["d"])
    what = "matrix P, without distortion, as the images are rectified" if by_P else "matrix K"
    if distortion is not None:
        values = ", ".join(f"{value:g}" for value in distortion.parameters)
        what += f" and {distortion.model} distortion ({values})"
    return StatedLens(Lens(K, size, distortion), stated, f"{where.rpartition(': ')[2]}: {what}")


def _cropped(K: Float[ndarray, "3 3"], info: Any) -> tuple[Float[ndarray, "3 3"], str]:
    """K after cropping and binning, and WIDTHxHEIGHT of the image that they leave; empty if it is not stated."""
    roi = info.roi
    bins = np.array([max(info.binning_x, 1), max(info.binning_y, 1)])
    cut = np.array([roi.x_offset, roi.y_offset])
    # A region of no size stands for the whole image.
    width, height = (roi.width, roi.height) if roi.width and roi.height else (info.width, info.height)
    cropped = K.copy()
    cropped[:2, 2] -= cut if roi.width and roi.height else 0
    cropped[:2] /= bins[:, None]
    return cropped, f"{width // bins[0]}x{height // bins[1]}" if width and height else ""


def _distortion(where: str, model: str, parameters: Float[ndarray, " n"]) -> Distortion | None:
    name = SAME_MODELS.get(model.lower(), model)
    if not parameters.any() and not (name == "equidistant" and len(parameters)):
        return None
    try:
        return Distortion(name, tuple(float(value) for value in parameters))
    except ValueError as error:
        fix = "pass --intrinsics and --distortion MODEL:NUMBERS."
        expected = "plumb_bob, rational_polynomial or equidistant"
        raise BadData(where, "distortion_model", expected=expected, got=str(error), fix=fix) from error
