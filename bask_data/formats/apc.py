"""The MIT-Princeton team's recordings for the Amazon Picking Challenge 2016, and later ones of the same rig.

Two layouts: all numbers in `cam.info.txt`, or intrinsics and poses in separate files. Raw depth is rotated left by
three bits, in tenths of a millimetre. Labels are ground truth: `segm/frame-*.segm.png`, or beside the frames.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.core.lens import Lens
from bask_data.errors import BadData
from bask_data.formats.clock import counted
from bask_data.formats.files import Folder, numbers, paired, read_bytes, source_folder
from bask_data.formats.image_files import ImageFiles
from bask_data.formats.intrinsics import parse_intrinsics
from bask_data.formats.label_files import labels_in
from bask_data.formats.options.apc import ApcOptions
from bask_data.formats.poses import parse_pose, parse_transform, read_transforms
from bask_data.formats.recording import ObjectPose, SourceCamera, SourceRecording

DEPTH_SCALE = 1e-4
"""Metres per unit of depth after rotating its bits back, from the recordings' documentation."""

INFO_FILE = "cam.info.txt"
INTRINSICS_FILE = "camera-intrinsics.color.txt"
POSES_FILE = "object_poses.json"
OBJECT_NAMES = {48: "chenille stems", 114: "bunny book", 132: "tissue box", 144: "joke book"}
"""Names by label, six times the object's position in the challenge's alphabetical list; these four were verified."""


def read(source: Path, options: ApcOptions) -> SourceRecording:
    """The recording in `source`; see `ApcOptions.world` for the world frame."""
    folder = source_folder(source, options.follow_links)
    info = source / INFO_FILE
    groups = {"color": _color_files(folder), "depth": folder.matching("frame-*.depth.png", "depth", is_fixed=True)}
    if not info.exists():
        groups["pose"] = folder.matching("frame-*.pose.txt", "pose", is_fixed=True)
    labels = _label_pattern(source)
    if labels:
        groups["labels"] = folder.matching(labels, "labels", is_fixed=True)
    names, missing = paired(source, groups, patterns=False)
    rig = (
        _rig_of_info(folder.member(INFO_FILE, "calibration"), folder, names)
        if info.exists()
        else _rig_of_files(folder, [groups["pose"].get(name) for name in names])
    )
    world_from_cameras, world = _in_world(source, rig, options.world)
    color, depth, label = (
        tuple(groups[kind].get(name) for name in names if kind in groups) for kind in ("color", "depth", "labels")
    )
    images = ImageFiles(color, depth, label, rotated_depth=True)
    poses, pose_files = _object_poses(folder, rig, options.world)
    clock = counted(names, options.fps)
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(names),
        lens=Lens(rig.K, images.size),
        world_from_cameras=world_from_cameras,
        time=clock.time,
        color=images.read_color,
        depth=images.read_depth,
        depth_scale=DEPTH_SCALE,
        labels=images.read_labels if label else None,
        faults={names.index(name): fault for name, fault in missing.items()},
        pose_places=tuple(f"{rig.files[0].name if info.exists() else 'pose'} of frame {name}" for name in names),
    )
    return SourceRecording(
        cameras=(camera,),
        robot=None,
        label_names=_label_names(images),
        assumptions={
            "world": world,
            "pose": "files hold world_from_camera, metres, OpenCV axes; rounding in the text taken out",
            "depth": "z-depth registered to colour, bits rotated back, 0.0001 m per unit, 0 = no measurement",
            "intrinsics": "the colour camera's, for colour and depth alike, no lens distortion",
            "time": f"{clock.statement}: the files state none",
            "labels": f"{labels}, taken as truth for reports only" if labels else "none found",
        },
        files=(*images.files, *rig.files, *pose_files),
        object_poses=poses,
    )


@dataclass(frozen=True)
class _Rig:
    """Calibration and poses from the text files; `robot_from_bin` is None where they do not state it."""

    K: Float[ndarray, "3 3"]
    robot_from_cameras: Float[ndarray, "t 4 4"]
    robot_from_bin: Float[ndarray, "4 4"] | None
    files: tuple[Path, ...]


def _color_files(folder: Folder) -> dict[str, Path]:
    """PNG as recorded, or JPEG as shipped with this package."""
    suffix = "jpg" if any(folder.path.glob("frame-*.color.jpg")) else "png"
    return folder.matching(f"frame-*.color.{suffix}", "color", is_fixed=True)


def _label_pattern(source: Path) -> str:
    """Pattern of the label files, in a folder or beside the frames; empty without labels."""
    return next((pattern for pattern in ("segm/frame-*.segm.png", "frame-*.segm.png") if any(source.glob(pattern))), "")


def _rig_of_files(folder: Folder, pose_files: Sequence[Path | None]) -> _Rig:
    K, files = parse_intrinsics(folder, str(folder.member(INTRINSICS_FILE, "intrinsics")))
    known = [path for path in pose_files if path is not None]
    return _Rig(K, read_transforms(pose_files), None, (*files, *known))


def _rig_of_info(path: Path, folder: Folder, names: Sequence[str]) -> _Rig:
    """Calibration and poses in `cam.info.txt`, whose matrices have comments as titles."""
    matrices = _titled_matrices(path)
    color = _titled(path, matrices, "color camera intrinsic")
    if len(color) != 9:
        raise BadData(path, "color camera intrinsic", expected="a 3x3 matrix", got=f"{len(color)} numbers")
    K, _ = parse_intrinsics(folder, ",".join(str(color[i]) for i in (0, 4, 2, 5)))
    poses = [parse_transform(f"{path}: frame-{name}", _titled(path, matrices, f"for frame-{name}")) for name in names]
    bins = [values for title, values in matrices.items() if title.startswith("bin-to-world")]
    return _Rig(K, np.stack(poses), parse_pose(f"{path}: bin-to-world", bins[0]) if bins else None, (path,))


def _titled_matrices(path: Path) -> dict[str, list[float]]:
    """Numbers by the comment above them, in lower case; `read_lines` would drop the comments."""
    matrices: dict[str, list[float]] = {}
    title = ""
    for line in read_bytes(path, 2**20).decode("utf-8", errors="replace").splitlines():
        if comment := re.match(r"\s*#\s*(.*?)\s*$", line):
            title = comment.group(1).lower()
        elif line.strip():
            matrices.setdefault(title, []).extend(numbers(path, line))
    return matrices


def _titled(path: Path, matrices: dict[str, list[float]], words: str) -> list[float]:
    candidates = [values for title, values in matrices.items() if words in title]
    if len(candidates) != 1:
        raise BadData(path, words, expected="one matrix under a comment with these words", got=f"{len(candidates)}")
    return candidates[0]


def _object_poses(folder: Folder, rig: _Rig, world: str) -> tuple[dict[int, ObjectPose], tuple[Path, ...]]:
    """Poses of objects from a file beside the frames, if any: `{"world": "bin", "objects": {"132": {...}}}`."""
    if not folder.has(POSES_FILE):
        return {}, ()
    path = folder.member(POSES_FILE, "object poses")
    try:
        document = json.loads(read_bytes(path, 2**20))
        stated, objects = document["world"], document["objects"]
        poses = {
            int(label): ObjectPose(
                parse_pose(f"{path}: {label}", [float(x) for row in entry["world_from_object"] for x in row]),
                float(entry["error"]),
            )
            for label, entry in objects.items()
        }
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise BadData(
            path, "", expected="world and objects with world_from_object and error", got=repr(error)
        ) from error
    chosen = "robot" if rig.robot_from_bin is None or world == "robot" else "bin"
    if stated == chosen:
        return poses, (path,)
    if stated not in ("bin", "robot") or rig.robot_from_bin is None:
        raise BadData(path, "world", expected=f"{chosen}, the recording's world frame", got=str(stated))
    chosen_from_stated = rig.robot_from_bin if chosen == "robot" else invert_rigid(rig.robot_from_bin)
    moved = {
        label: ObjectPose(chosen_from_stated @ pose.world_from_object, pose.error) for label, pose in poses.items()
    }
    return moved, (path,)


def _in_world(source: Path, rig: _Rig, world: str) -> tuple[Float[ndarray, "t 4 4"], str]:
    if world == "bin" and rig.robot_from_bin is None:
        raise BadData(
            source,
            "--world",
            expected=f"the bin's transform in {INFO_FILE} for world frame `bin`",
            got="none",
            fix="pass --world robot.",
        )
    if rig.robot_from_bin is None or world == "robot":
        return rig.robot_from_cameras, "the robot's base frame, z up"
    return invert_rigid(
        rig.robot_from_bin
    ) @ rig.robot_from_cameras, "the shelf bin's frame, as the file states it, z up"


def _label_names(images: ImageFiles) -> dict[int, str]:
    """Names of the labels that occur."""
    present = labels_in(path for path in images.label if path is not None)
    return {label: OBJECT_NAMES.get(label, f"label {label}") for label in present}
