"""Cameras of BOP's scenes: intrinsics, unit of depth and pose of each image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData, UsageError
from bask_data.formats.bop.truth import Annotation
from bask_data.formats.files import listed
from bask_data.formats.intrinsics import intrinsics_matrix
from bask_data.formats.json_values import read_json


@dataclass(frozen=True)
class StatedCamera:
    """What is stated of an image: K, millimetres per unit of depth, and camera_from_world in metres, or None."""

    K: Float[ndarray, "3 3"]
    depth_scale: float
    camera_from_world: Float[ndarray, "4 4"] | None


def read_views(path: Path) -> dict[int, StatedCamera]:
    """What is stated of each image, by id."""
    document = read_json(path)
    return {_id(path, key): _view(f"{path}: image {key}", entry) for key, entry in document.items()}


def _id(path: Path, key: str) -> int:
    try:
        return int(key)
    except ValueError:
        raise BadData(path, "image id", expected="a number", got=repr(key)) from None


def _view(where: str, entry: Any) -> StatedCamera:
    try:
        K = [float(value) for value in entry["cam_K"]]
        depth_scale = float(entry.get("depth_scale", 1.0))
        rotation, translation = entry.get("cam_R_w2c"), entry.get("cam_t_w2c")
        camera_from_world = None
        if rotation is not None and translation is not None:
            camera_from_world = np.eye(4)
            camera_from_world[:3, :3] = np.array(rotation, np.float64).reshape(3, 3)
            camera_from_world[:3, 3] = np.array(translation, np.float64).reshape(3) / 1000
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise BadData(
            where, "", expected="cam_K, depth_scale, cam_R_w2c and cam_t_w2c as numbers", got=repr(error)
        ) from error
    if not 0 < depth_scale < np.inf:
        raise BadData(where, "depth_scale", expected="millimetres per unit, more than 0", got=f"{depth_scale:g}")
    return StatedCamera(intrinsics_matrix(where, K, ""), depth_scale, camera_from_world)


def poses_of(
    path: Path, seen: list[StatedCamera | None], stated: list[list[Annotation]], world_object: int | None
) -> tuple[Float[ndarray, "t 4 4"], str]:
    """Poses of the images and a statement about the world; NaN where there are none."""
    if not any(seen):
        raise BadData(path, "images", expected="cameras of the images beside it", got=f"none of {len(seen)}")
    lost = np.full((4, 4), np.nan)
    if world_object is not None:
        found = [[entry for entry in entries if entry.object_id == world_object] for entries in stated]
        if not any(found) or any(len(entries) > 1 for entries in found):
            raise UsageError(
                "--world-object",
                expected="an object of which every image has one instance",
                got=f"{world_object}, {'of which some have several' if any(found) else 'which no image has'}",
                fix=f"the objects are {listed([str(i) for i in _objects(stated)])}.",
            )
        return np.stack(
            [invert_rigid(entries[0].camera_from_object) if entries else lost for entries in found]
        ), f"the frame of object {world_object}, which is taken to stand still"
    if not any(view and view.camera_from_world is not None for view in seen):
        objects = _objects(stated)
        raise BadData(
            path,
            "cam_R_w2c, cam_t_w2c",
            expected="the camera's pose at each image",
            got=f"none: of {len(seen)} images only what they show is known, not from where",
            fix=f"if all objects stand still, take the frame of one as the world: --world-object {objects[0]}."
            if objects
            else "this scene cannot be read: poses are in no other file of it either.",
        )
    return np.stack(
        [invert_rigid(view.camera_from_world) if view and view.camera_from_world is not None else lost for view in seen]
    ), "as in the files"


def _objects(stated: list[list[Annotation]]) -> list[int]:
    return sorted({entry.object_id for entries in stated for entry in entries})
