"""Recordings of the app Record3D: colour, depth, confidence, and metadata with poses and intrinsics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Lens, one_if_same
from bask_data.errors import BadData
from bask_data.formats.clock import seconds
from bask_data.formats.files import first_readable
from bask_data.formats.json_values import array, number
from bask_data.formats.lenses import scaled_lens
from bask_data.formats.options.record3d import Record3dOptions
from bask_data.formats.poses import OPENCV_FROM_OPENGL, parse_transform
from bask_data.formats.record3d.files import Record3dFiles, record3d_files
from bask_data.formats.recording import SourceCamera, SourceRecording

SAME_PROPORTIONS = 0.01
"""Largest relative difference between the proportions of the images and those that the intrinsics are for: sizes are
rounded to whole pixels. Chosen; sensitivity not measured."""


def read(source: Path, options: Record3dOptions) -> SourceRecording:
    """The frames of a .r3d file, of its unpacked content, or of an export as EXR and JPG."""
    files = record3d_files(source, options.follow_links)
    where = files.members.place(files.metadata)
    poses = _poses(where, files)
    frames, places = _frames(sorted({*files.color, *files.depth}), len(poses))
    faults = _faults(files, frames, places, len(poses))
    usable = [frames[i] for i in range(len(frames)) if i not in faults]
    if not usable:
        raise faults[0]
    lens, intrinsics = _lens(where, files, places, first_readable(files.color_size, usable))
    depth = first_readable(files.read_depth, usable)
    time, clock = _time(where, files, places)
    unknown = np.full((4, 4), np.nan)
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(str(n) for n in frames),
        lens=lens,
        world_from_cameras=np.stack([poses[k] if k < len(poses) else unknown for k in places])
        * np.diag(OPENCV_FROM_OPENGL),
        time=time,
        color=lambda i: files.read_color(frames[i]),
        depth=lambda i: files.read_depth(frames[i]),
        depth_lens=None if depth.shape == lens.size else scaled_lens(lens, (depth.shape[0], depth.shape[1])),
        confidence=(lambda i: files.read_confidence(frames[i])) if files.confidence else None,
        faults=faults,
        pose_places=tuple(f"{where}: poses[{k}]" for k in places),
    )
    assumptions = {
        "pose": "poses hold world_from_camera, metres, qx qy qz qw tx ty tz; initPose is not applied",
        "camera axes": "ARKit's: x right, y up, z backward; turned to OpenCV's",
        "depth": "z-depth in metres, NaN = no measurement",
        "intrinsics": intrinsics,
        "time": clock,
    }
    if files.confidence:
        assumptions["confidence levels"] = "0 low, 1 medium, 2 high: --confidence 1 keeps medium and high"
    return SourceRecording((camera,), None, {}, assumptions, files.used)


def _poses(where: str, files: Record3dFiles) -> list[Float[ndarray, "4 4"]]:
    """world_from_camera in ARKit's axes, as the metadata list them."""
    stated = files.table.get("poses")
    if stated is None and len(files.color) == 1:
        stated = [files.table.get("initPose")]
    if not stated:
        raise BadData(
            where,
            "poses",
            expected="a pose for each frame",
            got="none",
            fix="record with the rear (LiDAR) camera and world tracking; older versions of the app wrote no poses.",
        )
    rows = array(where, "poses", stated, ((-1, 7),))
    return [parse_transform(f"{where}: poses[{i}]", [*row[4:], *row[:4]]) for i, row in enumerate(rows.tolist())]


def _frames(numbers: list[int], n_poses: int) -> tuple[list[int], list[int]]:
    """Numbers of all frames, and the place of each in the metadata: its number.

    In a part of a recording, whose numbers begin later and have no gaps, the n-th frame has the n-th place.
    """
    if len(numbers) == n_poses and numbers == list(range(numbers[0], numbers[0] + n_poses)):
        return numbers, list(range(n_poses))
    frames = sorted({*numbers, *range(n_poses)})
    return frames, frames


def _faults(files: Record3dFiles, frames: list[int], places: list[int], n_poses: int) -> dict[int, BadData]:
    faults = {}
    for i, (n, k) in enumerate(zip(frames, places, strict=True)):
        parts = {"colour": n in files.color, "depth": n in files.depth, "pose": k < n_poses}
        lacks = [part for part, is_there in parts.items() if not is_there]
        if lacks:
            faults[i] = BadData(
                files.members.place(""),
                f"frame {n}",
                expected="colour, depth and a pose for every frame",
                got=f"no {' and no '.join(lacks)}",
                fix="pass --skip-bad to leave out the frames that lack something.",
            )
    return faults


def _lens(where: str, files: Record3dFiles, places: list[int], size: tuple[int, int]) -> tuple[Lens, str]:
    """The lens of the colour images, and what the intrinsics are, in words."""
    height, width = (int(number(where, files.table, key, float(side))) for key, side in zip("hw", size, strict=True))
    K, whose = _intrinsics(where, files, places)
    text = f"pinhole, of the colour image, pixel (0, 0) a centre, {whose}; for depth scaled by the ratio of the sizes"
    if (height, width) == size:
        return Lens(K, size), text
    if min(height, width) < 1 or abs(height * size[1] / (width * size[0]) - 1) > SAME_PROPORTIONS:
        got = f"{size[1]} x {size[0]}"
        expected = f"images of {width} x {height}, or of the same proportions"
        raise BadData(where, "w, h", expected=expected, got=got, fix="export again; do not rotate or crop the images.")
    text += f"; the metadata state it for {width} x {height}, scaled to the images' {size[1]} x {size[0]}"
    return scaled_lens(Lens(K, (height, width)), size), text


def _intrinsics(where: str, files: Record3dFiles, places: list[int]) -> tuple[Float[ndarray, "*t 3 3"], str]:
    per_frame = files.table.get("perFrameIntrinsicCoeffs")
    if not per_frame:
        K = array(where, "K", files.table.get("K"), ((9,),)).reshape(3, 3)
        # Written column by column. A matrix written row by row ends in 0 0 1.
        K = K.T if K[2, 0] or K[2, 1] else K
        if not (np.isfinite(K).all() and K[2].tolist() == [0, 0, 1]):
            raise BadData(where, "K", expected="a pinhole matrix, column by column", got=str(K.T.ravel().tolist()))
        return K, "one for all frames"
    rows = array(where, "perFrameIntrinsicCoeffs", per_frame, ((-1, 4),))
    n_needed = len(files.table.get("poses") or [])
    if len(rows) < n_needed or not np.isfinite(rows).all():
        expected = f"fx, fy, cx, cy for each of {n_needed} poses"
        raise BadData(where, "perFrameIntrinsicCoeffs", expected=expected, got=f"{len(rows)} rows, or not finite")
    Ks = np.tile(np.eye(3), (len(places), 1, 1))
    # Frames beyond the last row are without a pose, too.
    Ks[:, [0, 1, 0, 1], [0, 1, 2, 2]] = rows[np.minimum(places, len(rows) - 1)]
    return one_if_same(Ks), "each frame's own"


def _time(where: str, files: Record3dFiles, places: list[int]) -> tuple[Float[ndarray, " t"], str]:
    stamps = files.table.get("frameTimestamps")
    values = array(where, "frameTimestamps", [] if stamps is None else stamps, ((-1,),))
    if len(values) > max(places):
        clock = seconds(values, f"{where}: frameTimestamps", unit="s", option="")
        return clock.time[places], "seconds, from frameTimestamps"
    fps = number(where, files.table, "fps", 30.0)
    if fps <= 0:
        raise BadData(where, "fps", expected="above 0", got=f"{fps:g}")
    return np.array(places) / fps, f"number of the frame / {fps:g} per second: there are no frameTimestamps for all"
