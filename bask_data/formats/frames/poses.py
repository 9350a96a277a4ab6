"""Poses of the frames of `ingest frames`: a file for each, or one file whose poses are given to frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.core.time_pairs import nearest
from bask_data.core.trajectory import interpolated
from bask_data.errors import BadData
from bask_data.formats.clock import seconds
from bask_data.formats.files import Folder, frame_number
from bask_data.formats.frames.times import FrameTimes
from bask_data.formats.options.common import PoseOptions
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.poses import parse_transform, pose_values, refuse_transposed, rigid
from bask_data.formats.trajectory_files import PoseLayout, Trajectory, read_trajectory

At = Callable[[Float[ndarray, "m 4 4"], PoseOptions], Float[ndarray, "t 4 4"]]
"""From the poses in the files, read under some options, to those of the frames; both as written."""


ROUNDED_STAMP = 0.5e-3 + 1e-6
"""Seconds by which a stamp with three decimals may differ from the one it stands for: tools that write poses round the
images' times. A camera at 1 m/s moves 0.5 mm in it."""


@dataclass(frozen=True)
class FramePoses:
    """Poses as written, and how frames get theirs.

    Args:
        written: those in the files.
        at: from these to the frames' poses.
        places: where each frame's pose stands.
        files: that were used.
        quaternions: whether rotations are quaternions.
        statement: how poses in one file are given to frames, in words; empty for a file per frame.
        faults: frames without a pose, by index.
    """

    written: Float[ndarray, "m 4 4"]
    at: At
    places: tuple[str, ...]
    files: tuple[Path, ...]
    quaternions: bool
    statement: str = ""
    faults: dict[int, BadData] = field(default_factory=dict)


def poses_of_files(files: list[Path | None], options: FramesOptions) -> FramePoses:
    """Poses from a file for each frame; not known, where there is none."""
    written = np.full((len(files), 4, 4), np.nan)
    quaternions = False
    for i, path in enumerate(files):
        if path is not None:
            values = pose_values(path)
            quaternions |= len(values) == 7
            written[i] = parse_transform(path, values, options.quat, options.column_major)
    places = tuple(str(path) for path in files)
    refuse_transposed(written, places, options.column_major)
    known = tuple(path for path in files if path is not None)
    return FramePoses(written, lambda poses, options: poses, places, known, quaternions)


def poses_of_trajectory(folder: Folder, names: list[str], times: FrameTimes, options: FramesOptions) -> FramePoses:
    """Poses from one file for all frames: in order, by the frames' numbers, interpolated at their times, or one pose of
    a camera that rests.

    Raises:
        BadData: the file does not fit the frames.
    """
    path = Path(options.pose)
    path = path if path.is_file() else folder.member(options.pose, "--pose")
    trajectory = read_trajectory(path, PoseLayout(options.quat, options.column_major))
    places = [trajectory.place(i) for i in range(len(trajectory.poses))]
    refuse_transposed(trajectory.poses, places, options.column_major)
    by = _belongs(trajectory, names, times, options.pose_by)
    if by == "time":
        return poses_at_times(trajectory, names, times.time, options.time_unit, options.max_pose_gap)
    index, faults = _INDEX[by](trajectory, names)
    at = _at_index(index)
    return FramePoses(
        trajectory.poses,
        at,
        tuple(places[k] if k >= 0 else f"{path}: frame {name}" for k, name in zip(index, names, strict=True)),
        (path,),
        trajectory.quaternions,
        {
            "rest": "one pose for all frames: the camera rests",
            "order": f"one per frame, in the order of {path.name}",
            "number": f"by the frames' numbers, which the poses of {path.name} begin with",
        }[by],
        faults,
    )


def poses_at_times(
    trajectory: Trajectory, names: list[str], time: Float[ndarray, " t"], unit: str, max_gap: float
) -> FramePoses:
    """Poses interpolated at the frames' times, which are on the clock that the poses' lines begin with.

    Raises:
        BadData: the times of the poses are impossible, no frame is between two poses, or a pose is not rigid.
    """
    clock = seconds(trajectory.stamps, trajectory.path, trajectory.lines, unit=unit)  # type: ignore[arg-type]
    known = np.flatnonzero(np.isfinite(trajectory.poses).all(axis=(1, 2)))
    if not len(known):
        fix = "take another file of poses: tracking was lost in every frame of this one."
        raise BadData(trajectory.path, "pose", expected="finite numbers in some line", got="none", fix=fix)
    for k in known:
        rigid(trajectory.place(int(k)), trajectory.poses[k])

    pose_time, still = clock.time[known], np.broadcast_to(np.eye(4), (len(known), 4, 4))
    is_between = interpolated(time, pose_time, still, max_gap)[1]
    near = np.where(is_between, time, _rounded(time, pose_time))
    is_known = interpolated(near, pose_time, still, max_gap)[1]

    def at(written: Float[ndarray, "m 4 4"], options: PoseOptions) -> Float[ndarray, "t 4 4"]:
        # What moves evenly is the camera in the world, not the world in the camera.
        inverse = options.pose_is == "camera_from_world"
        moving = invert_rigid(written[known]) if inverse else written[known]
        poses, _ = interpolated(near, pose_time, moving, max_gap)
        return invert_rigid(poses) if inverse else poses

    if not is_known.any():
        raise BadData(
            trajectory.path,
            "time",
            expected=f"poses around the frames' times, {time[0]:.6f} to {time[-1]:.6f} s",
            got=f"{clock.time[0]:.6f} to {clock.time[-1]:.6f} s, {_median_gap(clock.time)}",
            fix="check that the clocks agree, or pass a larger --max-pose-gap.",
        )
    n_exact = int(np.isin(near, pose_time).sum())
    faults = {
        int(i): BadData(
            f"{trajectory.path}: frame {names[i]}",
            "pose",
            expected=f"poses at most {max_gap:g} s apart around {time[i]:.6f} s",
            got="none",
            fix="pass a larger --max-pose-gap, or --skip-bad to leave out the frames without a pose.",
        )
        for i in np.flatnonzero(~is_known)
    }
    return FramePoses(
        trajectory.poses,
        at,
        tuple(f"{trajectory.path}: time {t:.6f}" for t in time),
        (trajectory.path,),
        trajectory.quaternions,
        f"interpolated at the frames' times between poses at most {max_gap:g} s apart; {n_exact} of {len(time)} frames "
        f"have a pose of their own; pose times: {clock.statement}",
        faults,
    )


def _rounded(time: Float[ndarray, " t"], pose_time: Float[ndarray, " n"]) -> Float[ndarray, " t"]:
    """The frames' times, those of poses where they differ by rounding to three decimals only."""
    index = nearest(time, pose_time, ROUNDED_STAMP)
    return np.where(index >= 0, pose_time[index], time)


def _median_gap(time: Float[ndarray, " n"]) -> str:
    return f"{np.median(np.diff(time)):.3g} s apart" if len(time) > 1 else "a single one"


def _belongs(trajectory: Trajectory, names: list[str], times: FrameTimes, option: str) -> str:
    """How poses belong to frames: `rest`, `order`, `number` or `time`; `BadData` if it is open."""
    if option in ("number", "time") and not trajectory.keys:
        got = "poses without a number or time before them"
        raise BadData(trajectory.path, "--pose-by", expected=option, got=got, fix="leave out --pose-by.")
    if option == "auto" and len(trajectory.poses) == 1:
        return "rest"
    if option == "order" or (option == "auto" and not trajectory.keys):
        return "order"
    if option == "number":
        return "number"
    numbers = {frame_number(name) for name in names}
    found = {number for number in trajectory.numbers if number is not None}
    n_fit = len(numbers & found)
    if option == "auto" and n_fit == len(numbers):
        return "number"
    if option == "auto" and trajectory.in_blocks and len(trajectory.poses) == len(names):
        return "order"
    if times.stated:
        return "time"
    if option == "auto" and n_fit:
        return "number"
    raise _no_times(trajectory, names)


def _no_times(trajectory: Trajectory, names: list[str]) -> BadData:
    first = trajectory.keys[0]
    equal = " in all of them: they were written with too few digits" if len(set(trajectory.keys)) == 1 else ""
    in_order = ""
    if len(trajectory.poses) == len(names):
        in_order = f"; or pass --pose-by order, if its {len(names)} poses are those of the {len(names)} frames in order"
    return BadData(
        trajectory.path,
        "pose",
        expected="lines that begin with the frames' numbers, or times for the frames",
        got=f"times in the lines ({first}{equal}), and none for frame {names[0]}",
        fix=f"pass --timestamps FILE, with one time per frame, or --timestamps name if * matches the time{in_order}; "
        "a folder with rgb.txt and depth.txt is read by: bask-data ingest tum",
    )


def _index_of_rest(trajectory: Trajectory, names: list[str]) -> tuple[list[int], dict[int, BadData]]:
    return [0] * len(names), {}


def _index_of_order(trajectory: Trajectory, names: list[str]) -> tuple[list[int], dict[int, BadData]]:
    n_poses = len(trajectory.poses)
    if n_poses != len(names):
        raise BadData(
            trajectory.path,
            "pose",
            expected=f"a pose for each of {len(names)} frames",
            got=f"{n_poses}",
            fix="check --pose and --color; poses of some of the frames need the frame's number or time before them.",
        )
    return list(range(n_poses)), {}


def _index_of_number(trajectory: Trajectory, names: list[str]) -> tuple[list[int], dict[int, BadData]]:
    by_number = {number: k for k, number in enumerate(trajectory.numbers)}
    numbers = [frame_number(name) for name in names]
    index = [-1 if number is None else by_number.get(number, -1) for number in numbers]
    faults = {
        i: BadData(
            trajectory.path,
            "pose",
            expected="a line for every frame",
            got=f"none that starts with the number of {name}",
            fix="pass --skip-bad to leave out the frames without a pose"
            + ("; or --pose-by order." if len(trajectory.poses) == len(names) else "."),
        )
        for i, (k, name) in enumerate(zip(index, names, strict=True))
        if k < 0
    }
    return index, faults


_INDEX = {"rest": _index_of_rest, "order": _index_of_order, "number": _index_of_number}


def _at_index(index: list[int]) -> At:
    known = np.array(index)

    def at(written: Float[ndarray, "m 4 4"], options: PoseOptions) -> Float[ndarray, "t 4 4"]:
        return np.where((known >= 0)[:, None, None], written[known], np.nan)

    return at
