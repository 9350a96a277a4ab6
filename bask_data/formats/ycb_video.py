"""Scenes of YCB-Video in its own layout: `<frame>-color.png`, `-depth.png`, `-label.png` and `-meta.mat`.

Source: github.com/yuxng/YCB_Video_toolbox, README.md and show_pose_annotations.m.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import rigid_fault
from bask_data.core.lens import Lens
from bask_data.errors import BadData
from bask_data.formats.clock import counted
from bask_data.formats.files import Folder, first_readable, listed, paired
from bask_data.formats.images import image_header, read_color, read_labels
from bask_data.formats.intrinsics import intrinsics_matrix
from bask_data.formats.label_files import LARGEST_LABEL
from bask_data.formats.matlab import read_arrays
from bask_data.formats.object_poses import static_poses
from bask_data.formats.options.bop import BopOptions
from bask_data.formats.poses import ROUNDED_TOLERANCE
from bask_data.formats.recording import ObjectPose, SourceCamera, SourceRecording
from bask_data.formats.stated_images import camera_assumptions, intrinsics_of, scaled_depth

META = "-meta.mat"
"""What the name of the file with a frame's calibration and poses ends in."""

ARRAYS = ("intrinsic_matrix", "factor_depth", "rotation_translation_matrix", "cls_indexes", "poses")
"""What is read of such a file."""

CLASSES = (
    "002_master_chef_can",
    "003_cracker_box",
    "004_sugar_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "007_tuna_fish_can",
    "008_pudding_box",
    "009_gelatin_box",
    "010_potted_meat_can",
    "011_banana",
    "019_pitcher_base",
    "021_bleach_cleanser",
    "024_bowl",
    "025_mug",
    "035_power_drill",
    "036_wood_block",
    "037_scissors",
    "040_large_marker",
    "051_large_clamp",
    "052_extra_large_clamp",
    "061_foam_brick",
)
"""Names of the classes, which count from 1. Source: the data set's image_sets/classes.txt."""


@dataclass(frozen=True)
class _Meta:
    """What a frame's file states: lengths in metres, depth in units per metre, and objects by class.

    Args:
        world_from_camera: not finite or not rigid where the file's is not.
    """

    K: Float[ndarray, "3 3"]
    units_per_metre: float
    world_from_camera: Float[ndarray, "4 4"]
    camera_from_objects: dict[int, Float[ndarray, "4 4"]]


def read_ycb_video(folder: Folder, prefix: str, options: BopOptions) -> SourceRecording:
    """The scene in the folder that `prefix` leads to, empty or ending in a slash."""
    groups = {
        "color": folder.files_in(prefix, ("-color.png", "-color.jpg"), "colour"),
        "depth": folder.files_in(prefix, ("-depth.png",), "depth"),
        "meta": folder.files_in(prefix, (META,), "cameras"),
    }
    names, missing = paired(folder.path, groups, patterns=False)
    metas = {name: _read_meta(path) for name, path in groups["meta"].items()}
    seen = [metas.get(name) for name in names]
    color, depth = ([groups[kind].get(name, folder.path) for name in names] for kind in ("color", "depth"))
    poses = np.stack([meta.world_from_camera if meta else np.full((4, 4), np.nan) for meta in seen])
    header = first_readable(image_header, groups["color"].values())
    clock = counted(names, options.fps)
    labels, label_text = _labels(folder, prefix, names)
    depth_scale, read_depth_image = scaled_depth(depth, [1 / meta.units_per_metre if meta else None for meta in seen])
    object_poses, moving = _object_poses(seen)
    if moving:
        label_text += f"; without poses of {listed([_class(label) for label in moving])}, which move"
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(names),
        lens=Lens(intrinsics_of([meta.K if meta else None for meta in seen]), (header.height, header.width)),
        world_from_cameras=poses,
        time=clock.time,
        color=lambda i: read_color(color[i]),
        depth=read_depth_image,
        depth_scale=depth_scale,
        labels=(lambda i: read_labels(labels[i])) if labels else None,
        faults={names.index(name): fault for name, fault in missing.items()},
        pose_places=tuple(str(groups["meta"].get(name, name)) for name in names),
    )
    present = sorted({label for meta in seen if meta for label in meta.camera_from_objects})
    return SourceRecording(
        cameras=(camera,),
        robot=None,
        label_names={label: _class(label) for label in present} if labels else {},
        assumptions={
            "world": "as in rotation_translation_matrix",
            "pose": "rotation_translation_matrix is camera_from_world, metres, OpenCV axes; inverted",
            **camera_assumptions(camera),
            "time": f"{clock.statement}: the files state none",
            "labels": label_text,
        },
        files=(*(file for group in groups.values() for file in group.values()), *labels),
        object_poses=object_poses if labels else {},
    )


def _labels(folder: Folder, prefix: str, names: list[str]) -> tuple[tuple[Path, ...], str]:
    """Label images of all frames, or none, and what is said about them."""
    if not any((folder.path / prefix).glob("*-label.png")):
        return (), "none found"
    files = folder.files_in(prefix, ("-label.png",), "labels")
    lacking = [name for name in names if name not in files]
    if lacking:
        return (), f"none: frames {listed(lacking)} lack them"
    return tuple(files[name] for name in names), "label images of classes, taken as truth for reports only"


def _class(label: int) -> str:
    return CLASSES[label - 1] if 0 < label <= len(CLASSES) else f"class {label}"


def _object_poses(seen: list[_Meta | None]) -> tuple[dict[int, ObjectPose], list[int]]:
    found: dict[int, list[Float[ndarray, "4 4"]]] = {}
    for meta in seen:
        for label, camera_from_object in (meta.camera_from_objects if meta else {}).items():
            assert meta is not None
            world_from_object = meta.world_from_camera @ camera_from_object
            if not rigid_fault(world_from_object, ROUNDED_TOLERANCE):
                found.setdefault(label, []).append(world_from_object)
    return static_poses(found)


def _read_meta(path: Path) -> _Meta:
    arrays = read_arrays(path, ARRAYS)
    sizes = {"intrinsic_matrix": 9, "factor_depth": 1, "rotation_translation_matrix": 12}
    for name, n_values in sizes.items():
        if name not in arrays or arrays[name].size != n_values or np.iscomplexobj(arrays[name]):
            raise BadData(
                path,
                name,
                expected=f"{n_values} numbers",
                got=f"{arrays[name].size}" if name in arrays else "none",
                fix="rendered images (data_syn) have no common world; take a scene of the videos."
                if name == "rotation_translation_matrix"
                else "copy it again from its source.",
            )
    units = float(arrays["factor_depth"].ravel()[0])
    if not 0 < units < np.inf:
        raise BadData(path, "factor_depth", expected="units per metre, more than 0", got=f"{units:g}")
    return _Meta(
        intrinsics_matrix(path, arrays["intrinsic_matrix"].astype(np.float64).ravel().tolist(), ""),
        units,
        _inverse(_whole(arrays["rotation_translation_matrix"].reshape(3, 4))),
        _objects(path, arrays),
    )


def _objects(path: Path, arrays: dict[str, ndarray]) -> dict[int, Float[ndarray, "4 4"]]:
    """camera_from_object by class. MATLAB drops the last dimension of the poses of one object."""
    indexes = arrays.get("cls_indexes", np.zeros(0)).ravel()
    if not np.isin(indexes, np.arange(1, LARGEST_LABEL + 1)).all():
        got = listed([f"{value:g}" for value in indexes])
        raise BadData(path, "cls_indexes", expected=f"whole numbers from 1 to {LARGEST_LABEL}", got=got)
    classes = indexes.astype(int).tolist()
    poses = arrays.get("poses", np.zeros(0))
    if poses.size != 12 * len(classes) or poses.shape[:2] not in ((3, 4), (0,), (0, 0)):
        raise BadData(path, "poses", expected=f"3x4x{len(classes)}, as cls_indexes", got=f"{poses.shape}")
    return {label: _whole(poses.reshape(3, 4, -1)[:, :, k]) for k, label in enumerate(classes)}


def _whole(matrix: ndarray) -> Float[ndarray, "4 4"]:
    whole = np.eye(4)
    whole[:3] = matrix
    return whole


def _inverse(matrix: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """The exact inverse, although the rotation is rounded to six digits: the file's matrix was made by inverting one
    whose translation has six digits, too, and a transposed rotation would move the camera by a micrometre."""
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < ROUNDED_TOLERANCE:
        return np.full((4, 4), np.nan)
    return np.linalg.inv(matrix)
