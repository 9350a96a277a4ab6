"""Ground truth of BOP's scenes: visible masks as label images, and poses of the objects that stand still."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from bask_data.core.geometry import rigid_fault
from bask_data.errors import BadData
from bask_data.formats.files import Folder, listed
from bask_data.formats.images import read_labels
from bask_data.formats.json_values import read_json
from bask_data.formats.label_files import LARGEST_LABEL
from bask_data.formats.object_poses import static_poses
from bask_data.formats.poses import ROUNDED_TOLERANCE
from bask_data.formats.recording import ObjectPose

SAME_INSTANCE = 0.05
"""Largest distance, metres, between the origins of an object in two frames that makes them one instance, where a frame
shows several of its kind. Chosen: less than most objects' size. Sensitivity not measured."""


@dataclass(frozen=True)
class Annotation:
    """An object in an image.

    Args:
        camera_from_object: metres.
    """

    object_id: int
    camera_from_object: Float[ndarray, "4 4"]


@dataclass(frozen=True)
class SceneTruth:
    """Ground truth of a scene.

    Args:
        labels: label image of a frame; None without masks.
        names: by label.
        poses: of the objects that stand still, by label.
        files: of the masks.
        statement: what is said about them in the assumptions.
    """

    labels: Callable[[int], UInt8[ndarray, "h w"]] | None
    names: dict[int, str]
    poses: dict[int, ObjectPose]
    files: tuple[Path, ...]
    statement: str


def read_annotations(folder: Folder, relative: str) -> tuple[dict[int, list[Annotation]], tuple[Path, ...]]:
    """Annotated objects by image id, in the order that masks count them, and their file if there is one."""
    if not folder.has(relative):
        return {}, ()
    path = folder.member(relative, "annotations")
    document = read_json(path)
    try:
        return {int(key): [_annotation(entry) for entry in entries] for key, entries in document.items()}, (path,)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        expected = "obj_id, cam_R_m2c and cam_t_m2c of the objects in each image"
        raise BadData(path, "", expected=expected, got=repr(error)) from error


def _annotation(entry: dict) -> Annotation:
    camera_from_object = np.eye(4)
    camera_from_object[:3, :3] = np.array(entry["cam_R_m2c"], np.float64).reshape(3, 3)
    camera_from_object[:3, 3] = np.array(entry["cam_t_m2c"], np.float64).reshape(3) / 1000
    return Annotation(int(entry["obj_id"]), camera_from_object)


def scene_truth(
    folder: Folder,
    masks: str,
    frames: list[str],
    annotated: list[list[Annotation]],
    world_from_cameras: Float[ndarray, "t 4 4"],
    size: tuple[int, int],
) -> SceneTruth:
    """The truth of the frames.

    Args:
        masks: folder of the visible masks, whose names are frame and place among the annotations.
        annotated: objects in each frame.
        world_from_cameras: metres, NaN where unknown.
        size: (height, width) of the images, pixels.
    """
    if not any(annotated):
        return SceneTruth(None, {}, {}, (), "none found")
    if not (folder.path / masks).is_dir():
        return SceneTruth(None, {}, {}, (), f"none: there are no visible masks, {masks}")
    instances = _instances(annotated, world_from_cameras)
    labels, names = _labels(instances)
    if max(names) > LARGEST_LABEL:
        return SceneTruth(None, {}, {}, (), f"none: {len(names)} objects are more than {LARGEST_LABEL}")
    mask_of = folder.files_in(masks, (".png",), "masks")
    wanted = [[f"{frame}_{k:06d}" for k in range(len(annotated[i]))] for i, frame in enumerate(frames)]
    lacking = [name for names_of_frame in wanted for name in names_of_frame if name not in mask_of]
    if lacking:
        return SceneTruth(None, {}, {}, (), f"none: masks {listed(lacking)} are missing in {masks}")
    files = [[mask_of[name] for name in names_of_frame] for names_of_frame in wanted]

    def read(i: int) -> UInt8[ndarray, "h w"]:
        image = np.zeros(size, np.uint8)
        for file, instance in zip(files[i], instances[i], strict=True):
            mask = read_labels(file)
            if mask.shape != size:
                got = f"{mask.shape[1]} x {mask.shape[0]}"
                raise BadData(file, "size", expected=f"{size[1]} x {size[0]} as the images", got=got)
            image[mask > 0] = labels[instance]
        return image

    poses, moving = static_poses(_world_from_objects(annotated, instances, labels, world_from_cameras))
    statement = f"visible masks of {masks}, taken as truth for reports only; labels are object ids"
    if len(names) > len({object_id for object_id, _ in labels}):
        statement += ", and further numbers for further instances"
    if moving:
        statement += f"; without poses of {listed([names[label] for label in moving])}, which move"
    return SceneTruth(read, names, poses, tuple(file for group in files for file in group), statement)


def _world_from_objects(
    annotated: list[list[Annotation]],
    instances: list[list[tuple[int, int]]],
    labels: dict[tuple[int, int], int],
    world_from_cameras: Float[ndarray, "t 4 4"],
) -> dict[int, list[Float[ndarray, "4 4"]]]:
    """Poses of the objects in every frame that has one, by label."""
    seen: dict[int, list[Float[ndarray, "4 4"]]] = {}
    for entries, of_frame, world_from_camera in zip(annotated, instances, world_from_cameras, strict=True):
        for entry, instance in zip(entries, of_frame, strict=True):
            world_from_object = world_from_camera @ entry.camera_from_object
            if not rigid_fault(world_from_object, ROUNDED_TOLERANCE):
                seen.setdefault(labels[instance], []).append(world_from_object)
    return seen


def _instances(
    annotated: list[list[Annotation]], world_from_cameras: Float[ndarray, "t 4 4"]
) -> list[list[tuple[int, int]]]:
    """Object id and number among its instances, from 0, of each annotation.

    Files do not say which of several alike objects is which from image to image: it is the one at the same place.
    """
    several = {
        entry.object_id
        for entries in annotated
        for entry in entries
        if sum(other.object_id == entry.object_id for other in entries) > 1
    }
    places: dict[int, list[Float[ndarray, "3"]]] = {}
    found = []
    for entries, world_from_camera in zip(annotated, world_from_cameras, strict=True):
        taken: set[tuple[int, int]] = set()
        instances = []
        for entry in entries:
            known = places.setdefault(entry.object_id, [])
            origin = (world_from_camera @ entry.camera_from_object)[:3, 3]
            free = [k for k in range(len(known)) if (entry.object_id, k) not in taken]
            k = min(free, key=lambda k: _distance(known[k], origin), default=len(known))
            if entry.object_id in several and (not free or _distance(known[k], origin) > SAME_INSTANCE):
                k = len(known)
            if k == len(known):
                known.append(origin)
            elif np.isfinite(origin).all():
                known[k] = origin
            taken.add((entry.object_id, k))
            instances.append((entry.object_id, k))
        found.append(instances)
    return found


def _distance(a: Float[ndarray, "3"], b: Float[ndarray, "3"]) -> float:
    """Distance in metres; 0 if a place is unknown, so that such frames make no new instances."""
    distance = float(np.linalg.norm(a - b))
    return distance if np.isfinite(distance) else 0.0


def _labels(instances: list[list[tuple[int, int]]]) -> tuple[dict[tuple[int, int], int], dict[int, str]]:
    """Label of each instance, and names by label: the object's id for its first instance, if it fits."""
    every = sorted({instance for of_frame in instances for instance in of_frame})
    labels = {instance: instance[0] for instance in every if instance[1] == 0 and 0 < instance[0] <= LARGEST_LABEL}
    # Further instances follow the ids, so that no id of another scene is used for one.
    top = max(labels.values(), default=0)
    too_large = range(LARGEST_LABEL + 1, LARGEST_LABEL + 1 + len(every))
    spare = (*range(top + 1, LARGEST_LABEL + 1), *range(1, top), *too_large)
    unused = iter([label for label in spare if label not in labels.values()])
    labels |= {instance: next(unused) for instance in every if instance not in labels}
    names = {
        label: f"obj {object_id}" if k == 0 else f"obj {object_id} ({k + 1})"
        for (object_id, k), label in labels.items()
    }
    return labels, dict(sorted(names.items()))
