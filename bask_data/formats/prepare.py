"""What is done to every recording, whatever its format: frames left out, lens taken out, depth brought onto colour.

Whatever is done or lost is stated in the assumptions of the result.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import nearest_rigid, rigid_fault
from bask_data.errors import BadData
from bask_data.formats.agreement import agreement
from bask_data.formats.alignment import AlignedFrames, aligned
from bask_data.formats.bad_frames import Bad, bad_frames, chosen_frames, refuse
from bask_data.formats.files import listed
from bask_data.formats.kept_frames import KeptFrames
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.poses import ROUNDED_TOLERANCE, is_rounded, rigid
from bask_data.formats.recording import (
    CameraRecording,
    ObjectPose,
    PreparedRecording,
    RobotRecording,
    SourceCamera,
    SourceRecording,
)
from bask_data.formats.registration import registration
from bask_data.params import NAME, PATTERNS

RESERVED = ("robot", "objects")
"""What lies beside the cameras in a demonstration, and in ground truth."""

FAR_ORIGIN = 1000.0
"""Metres from the origin at which the world is moved: float32, in which meshes and images are computed, has steps of
0.06 mm there."""

ORIGIN_STEP = 1.0
"""A local origin is a multiple of this, metres, for readable numbers. A shelf moved by 441 km has 0.1 % other pixels in
its masks than the unmoved one with a step of 10 m, 5 pixels of a million with 1 m: coordinates near 0 are rounded
least."""


def prepared(
    source: Path,
    recording: SourceRecording,
    options: SourceOptions,
    home: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> PreparedRecording:
    """The recording as it is to be written; see `SourceOptions`.

    Args:
        home: origin of the recordings that are there already; one nearby takes it, too.

    Raises:
        BadData: frames cannot be used, and `options.skip_bad` is not set; or no two parts fit together.
    """
    _check_names(source, recording)
    if recording.completed is not None:
        recording = recording.completed(recording)
    decoded = {each.name: (KeptFrames(each.color), KeptFrames(each.depth)) for each in recording.cameras}
    sources = (replace(each, color=decoded[each.name][0], depth=decoded[each.name][1]) for each in recording.cameras)
    recording = replace(recording, cameras=tuple(sources))
    chosen = {camera.name: chosen_frames(camera, options.frames) for camera in recording.cameras}
    bad = [fault for camera in recording.cameras for fault in bad_frames(camera, chosen[camera.name], options)]
    refused = [fault for fault in bad if not fault.is_expected]
    if refused and not options.skip_bad:
        refuse(source, refused)
    kept = _kept(source, recording, chosen, bad)
    origin = _origin(recording, kept, np.array(home)) if options.local_origin else np.zeros(3)
    cameras, agreements, registrations, assumptions = [], {}, {}, dict(recording.assumptions)
    for camera in recording.cameras:
        frames = aligned(source, camera, kept[camera.name], options)
        for first_images in decoded[camera.name]:
            first_images.hand_out()
        images = KeptFrames(frames.read_color), KeptFrames(frames.read_depth)
        ready = _camera(source, camera, frames, images, kept[camera.name], origin)
        cameras.append(ready)
        prefix = "" if len(recording.cameras) == 1 else f"{camera.name}: "
        assumptions |= {prefix + name: text for name, text in frames.assumptions.items()}
        assumptions |= _counts(prefix, camera, chosen[camera.name], kept[camera.name], bad)
        otherwise = {name: _moved(poses[kept[camera.name]], origin) for name, poses in camera.otherwise.items()}
        agreements[camera.name] = agreement(ready, otherwise, options, camera.depth_scale)
        assumptions[f"{prefix}agreement"] = agreements[camera.name].text
        read_rightly = not agreements[camera.name].judgement.objections
        registrations[camera.name] = registration(ready, read_rightly)
        assumptions[f"{prefix}registration"] = registrations[camera.name].text
        agreements[camera.name].refuse(source, camera.name)
        for kept_images in images:
            kept_images.hand_out()
    if origin.any():
        x, y, z = origin
        assumptions["origin"] = f"({x:.0f}, {y:.0f}, {z:.0f}) m of the source's world is 0 here; exports add it again"
    return PreparedRecording(
        cameras=tuple(cameras),
        robot=_robot(recording, kept, origin),
        label_names=recording.label_names,
        assumptions=assumptions,
        files=recording.files,
        object_poses={
            label: ObjectPose(_moved(pose.world_from_object[None], origin)[0], pose.error)
            for label, pose in recording.object_poses.items()
        },
        agreements=agreements,
        registrations=registrations,
        origin=(float(origin[0]), float(origin[1]), float(origin[2])),
        left_out={f"{fault.camera}/{fault.frame}": fault.reason for fault in bad},
    )


def _check_names(source: Path, recording: SourceRecording) -> None:
    """Refuse names of cameras that cannot be those of folders, or are those of what lies beside cameras; `BadData`."""
    for camera in recording.cameras:
        if not re.fullmatch(NAME, camera.name) or camera.name in RESERVED:
            fix = "rename it in the source, or leave it out." if recording.cameras[1:] else "pass another --camera."
            expected = f"{PATTERNS[NAME]}, and not {' or '.join(RESERVED)}"
            raise BadData(source, "name of a camera", expected=expected, got=repr(camera.name[:80]), fix=fix)


def _kept(
    source: Path, recording: SourceRecording, chosen: dict[str, list[int]], bad: list[Bad]
) -> dict[str, list[int]]:
    """Frames to keep, by camera. A frame that one camera of a robot's lacks is lost for all: they share its states."""
    together = recording.robot is not None
    kept = {}
    for name, frames in chosen.items():
        lost = {fault.index for fault in bad if together or fault.camera == name}
        kept[name] = [i for i in frames if i not in lost]
        if not kept[name]:
            raise BadData(
                source,
                "frames",
                expected="a frame that can be used",
                got=f"none of {len(frames)}: {str(bad[0].reason).removesuffix('.')}" if bad else "none",
                fix="check --frames, and the options that say how to read the files.",
            )
    return kept


def _camera(
    source: Path,
    camera: SourceCamera,
    frames: AlignedFrames,
    images: tuple[KeptFrames, KeptFrames],
    kept: list[int],
    origin: Float[ndarray, "3"],
) -> CameraRecording:
    poses = np.stack([rigid(camera.pose_place(i), camera.world_from_cameras[i]) for i in kept])
    time = camera.time[kept]
    late = np.flatnonzero(~(np.isfinite(time) & (np.diff(time, prepend=-np.inf) > 0)))
    if len(late):
        raise BadData(
            source,
            f"time of frame {camera.frames[kept[late[0]]]}",
            expected="finite times that increase with the frames",
            got=f"{time[late[0]]} s",
            fix="sort the frames by time and remove duplicates.",
        )
    return CameraRecording(
        name=camera.name,
        K=frames.K,
        height=frames.size[0],
        width=frames.size[1],
        depth_scale=frames.depth_scale,
        world_from_cameras=_moved(poses, origin),
        time=time,
        read=partial(_both, *images),
        read_depth=images[1],
        labels=frames.read_labels if camera.labels else None,
        distortion=frames.distortion,
    )


def _both(color: KeptFrames, depth: KeptFrames, k: int) -> tuple[Any, Any]:
    """Colour and depth of the k-th frame; no lambda, so that a camera can be sent to another process."""
    return color(k), depth(k)


def _counts(prefix: str, camera: SourceCamera, chosen: list[int], kept: list[int], bad: list[Bad]) -> dict[str, str]:
    """What happened to frames and to rounded poses, where anything did."""
    counts = {}
    if len(kept) < len(camera.frames):
        lost = [f"{fault.frame} ({fault.kind})" for fault in bad if fault.camera == camera.name]
        text = f"{len(kept)} of {len(camera.frames)}"
        text += f"; {len(chosen)} were chosen by --frames" if len(chosen) < len(camera.frames) else ""
        text += f"; {len(lost)} left out: {listed(lost)}" if lost else ""
        counts[f"{prefix}frames"] = text
    rounded = sum(is_rounded(camera.world_from_cameras[i]) for i in kept)
    if rounded:
        counts[f"{prefix}rounding"] = (
            f"rotations of {rounded} poses are rounded to three decimals or so; the nearest exact ones are taken, "
            "less than 0.1 degrees away"
        )
    return counts


def _origin(recording: SourceRecording, kept: dict[str, list[int]], home: Float[ndarray, "3"]) -> Float[ndarray, "3"]:
    """The point of the source's world that becomes 0, metres: 0 unless the cameras are far from it."""
    centres = np.concatenate([camera.world_from_cameras[kept[camera.name], :3, 3] for camera in recording.cameras])
    middle = np.median(centres, axis=0)
    if np.abs(middle).max() <= FAR_ORIGIN:
        return np.zeros(3)
    is_near_home = home.any() and np.abs(middle - home).max() <= FAR_ORIGIN
    return home if is_near_home else np.round(middle / ORIGIN_STEP) * ORIGIN_STEP


def _moved(world_from_any: Float[ndarray, "t 4 4"], origin: Float[ndarray, "3"]) -> Float[ndarray, "t 4 4"]:
    moved = world_from_any.copy()
    moved[:, :3, 3] -= origin
    return moved


def _robot(
    recording: SourceRecording, kept: dict[str, list[int]], origin: Float[ndarray, "3"]
) -> RobotRecording | None:
    robot = recording.robot
    if robot is None:
        return None
    rows = kept[recording.cameras[0].name]
    gripper = None
    if robot.world_from_gripper is not None:
        poses = robot.world_from_gripper[rows]
        gripper = np.stack([nearest_rigid(p) if not rigid_fault(p, ROUNDED_TOLERANCE) else p for p in poses])
    return replace(
        robot,
        world_from_gripper=None if gripper is None else _moved(gripper, origin),
        gripper_width=None if robot.gripper_width is None else robot.gripper_width[rows],
        action=None if robot.action is None else robot.action[rows],
    )
