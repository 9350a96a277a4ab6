"""Cameras of a LeRobot dataset: which features are colour and depth of one camera, by their names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bask_data.errors import UsageError
from bask_data.formats.choices import by_camera
from bask_data.formats.files import listed
from bask_data.formats.lerobot.info import Feature, Info
from bask_data.formats.options.lerobot import LerobotOptions

PREFIXES = ("observation.images.", "observation.image.", "observation.", "images.")
"""What precedes a camera's name in a feature's."""

_NOT_A_NAME = {
    *("observation", "observations", "obs", "state", "camera", "cam", "image", "images", "img", "rgb", "color"),
    *("colour", "depth", "pose", "extrinsics", "extrinsic", "intrinsics", "intrinsic", "calibration", "k", "video"),
}
"""Words in names of features and columns that do not say which camera they are of."""


@dataclass(frozen=True)
class CameraFeatures:
    """The features of one camera, whose name is that in the dataset to be made."""

    name: str
    color: Feature
    depth: Feature


def words_of(text: str) -> list[str]:
    """Words of a name, in lower case."""
    return [word for word in re.split(r"[^a-z0-9]+", text.lower()) if word]


def camera_words(text: str) -> tuple[str, ...]:
    """The words of a feature's or column's name that say which camera it is of."""
    return tuple(word for word in words_of(text) if word not in _NOT_A_NAME)


def camera_name(key: str) -> str:
    """A camera's name, by the name of its colour feature: letters, digits, `_` and `-`."""
    prefix = next((prefix for prefix in PREFIXES if key.startswith(prefix)), "")
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", key.removeprefix(prefix)).lstrip("_-")
    return name or "camera"


def is_depth(feature: Feature) -> bool:
    """Whether a feature is depth: it says so, or has one channel and depth in its name."""
    if feature.is_marked_depth:
        return True
    is_one_channel = feature.n_channels == 1 or (len(feature.shape) == 3 and feature.shape[0] == 1)
    return is_one_channel and "depth" in words_of(feature.key) and feature.dtype != "string"


def is_color(feature: Feature) -> bool:
    """Whether a feature is colour: three channels, and not depth that was coloured for the eye."""
    if is_depth(feature) or "depth" in words_of(feature.key):
        return False
    three = feature.n_channels == 3 or (len(feature.shape) == 3 and feature.shape[0] == 3)
    return three and (feature.is_visual or feature.dtype == "uint8")


def find_cameras(source: Path, info: Info, options: LerobotOptions) -> tuple[list[CameraFeatures], dict[str, str]]:
    """The cameras to read, in the order of their features, and what is said of the others.

    Raises:
        UsageError: none has depth, or one that is asked for has none or is not there.
    """
    colors: dict[str, Feature] = {}
    for key, feature in info.features.items():
        if is_color(feature):
            name = camera_name(key)
            colors[name if name not in colors else f"{name}_{len(colors)}"] = feature
    depths = [feature for feature in info.features.values() if is_depth(feature)]
    given = by_camera("--depth", options.depth, options.cameras or list(colors))
    unknown = [name for name in options.cameras if name not in colors]
    if unknown:
        raise UsageError(source, "--cameras", expected=f"cameras among {listed(list(colors))}", got=", ".join(unknown))
    found = {name: _depth_of(source, info, name, colors, depths, given) for name in options.cameras or colors}
    without = [name for name, depth in found.items() if depth is None]
    if not colors or len(without) == len(found) or (options.cameras and without):
        raise UsageError(
            source,
            "depth",
            expected="a camera with colour and depth",
            got=f"no depth of {listed(without)}" if colors else "no colour images",
            fix=f"pass --depth with one of {listed([depth.key for depth in depths])}."
            if depths
            else "read another dataset: bask-data needs depth.",
        )
    left_out = [name for name in colors if found.get(name) is None]
    said = {"cameras": f"{listed(left_out)} left out: no depth, or not asked for"} if left_out else {}
    return [CameraFeatures(name, colors[name], depth) for name, depth in found.items() if depth], said


def _depth_of(
    source: Path, info: Info, name: str, colors: dict[str, Feature], depths: Sequence[Feature], given: dict[str, str]
) -> Feature | None:
    if name in given:
        if given[name] not in info.features:
            known = listed(list(info.features), 12)
            raise UsageError(source, "--depth", expected=f"a feature among {known}", got=given[name])
        return info.features[given[name]]
    words = camera_words(colors[name].key)
    fitting = [depth for depth in depths if camera_words(depth.key) == words]
    if not fitting and len(colors) == len(depths) == 1:
        fitting = list(depths)
    if len(fitting) > 1:
        raise UsageError(
            source,
            "depth",
            expected=f"one feature with depth of {name}",
            got=listed([depth.key for depth in fitting]),
            fix=f"pass --depth '{name}={fitting[0].key}'.",
        )
    return fitting[0] if fitting else None


def columns_for(camera: CameraFeatures, columns: Iterable[str], n_cameras: int) -> list[str]:
    """The columns whose names are of this camera, or of none where there is one camera only."""
    words = {camera_words(camera.color.key), camera_words(camera.name)}
    fitting = [column for column in columns if camera_words(column) in words]
    if not fitting and n_cameras == 1:
        fitting = [column for column in columns if not camera_words(column)]
    return fitting
