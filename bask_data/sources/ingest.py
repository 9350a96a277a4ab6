"""Ingest: a recording in another format becomes a scan or a demonstration, and its labels, if any, ground truth."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from bask_data.artifact import digest_of, file_digest
from bask_data.dataset import Dataset, Source, check_name
from bask_data.engine import Origin, Outcome, progress, scratches
from bask_data.errors import BadData
from bask_data.formats import Format
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.prepare import prepared
from bask_data.kinds import CameraFrames, Demonstration, Recording, Robot, Scan, Truth
from bask_data.kinds.cameras import LensModel
from bask_data.sources.recordings import is_current, published_recording, refuse_other_scope, undone_if_new, up_to_date

if TYPE_CHECKING:
    from bask_data.formats import recording

INGEST_VERSION = 1
"""To be raised when the same source gives another result."""


def ingest(
    into: Path | Dataset,
    item: str,
    *,
    format: Format,
    source: Path,
    options: SourceOptions,
    kind: Literal["scan", "demonstration"] = "scan",
    force: bool = False,
) -> tuple[list[Outcome], dict[str, str]]:
    """Read a recording into a dataset, which is created if it does not exist.

    Everything is checked and written to scratch first: an error leaves the dataset unchanged.

    Args:
        into: the dataset's directory, or the dataset if it is open already.

    Returns:
        Outcomes, and the assumptions about the source in words.

    Raises:
        WouldOverwrite: the item exists with other content and `force` is not set.
        UsageError: the name belongs to a recording of the other kind, or an option is invalid.
        BadData: the source is damaged, or contradicts the options.
    """
    makes = Scan if kind == "scan" else Demonstration
    check_name(item, f"ingest {format.name}", "--scene")
    dataset, root = (into, into.root) if isinstance(into, Dataset) else (Dataset.open_if_any(into), into)
    refuse_other_scope(dataset, makes, item, "choose another --scene.")
    opened = format.opened(source, options)
    if makes is Scan:
        # Otherwise a frame that one camera lacks would be lost for all, as they share the robot's states.
        opened = replace(opened, robot=None)
    key = _key(makes, format, options, source, opened)
    fix = "choose another --scene, or pass --force."
    if not force and is_current(root, makes, item, key, fix, opened.has_labels):
        # A kill between publishing and listing leaves a recording that is not in `dataset.json`.
        dataset = dataset or Dataset.open_or_create(root)
        if item not in dataset.items(makes.scope):
            _enter(dataset, item, format, source, options, makes, opened.has_labels)
        return [up_to_date(root, makes, item)], {}
    read = prepared(source, opened, options, _home(dataset))
    if makes is Demonstration and read.robot is not None:
        _check_robot(source, read.robot)
    with undone_if_new(root):
        dataset = dataset or Dataset.open_or_create(root)
        return _write(dataset, item, format, source, options, makes, read, key), read.assumptions


def _home(dataset: Dataset | None) -> tuple[float, float, float]:
    """Origin of the dataset's recordings, metres: its first scan's or demonstration's that is not 0."""
    if dataset is None:
        return (0.0, 0.0, 0.0)
    for makes in (Scan, Demonstration):
        for item in dataset.items(makes.scope)[:1]:
            if (path := dataset.path(makes, item)).exists() and any(origin := makes(path).metadata.origin):
                return (origin[0], origin[1], origin[2])
    return (0.0, 0.0, 0.0)


def _check_robot(source: Path, robot: recording.RobotRecording) -> None:
    """Refuse states that keypoints cannot be carried along with; `BadData`."""
    from bask_data.core.geometry import rigid_fault

    states = [] if robot.world_from_gripper is None else [rigid_fault(pose) for pose in robot.world_from_gripper]
    faults = {i: f"a gripper's pose that is no rigid transform: {fault}" for i, fault in enumerate(states) if fault}
    for i, width in enumerate([] if robot.gripper_width is None else robot.gripper_width.tolist()):
        if not math.isfinite(width):
            faults.setdefault(i, f"a gripper's width of {width}")
    if faults:
        first = min(faults)
        raise BadData(
            source,
            f"robot at frame {first} of those read",
            expected="its state at every frame",
            got=f"{faults[first]}" + (f"; so in {len(faults)} frames" if len(faults) > 1 else ""),
            fix="leave such frames out by --frames, or read the recording with --as scan.",
        )


def _write(
    dataset: Dataset,
    item: str,
    format: Format,
    source: Path,
    options: SourceOptions,
    makes: type[Scan] | type[Demonstration],
    read: recording.PreparedRecording,
    key: str,
) -> list[Outcome]:
    begun = time.perf_counter()
    origin = Origin(
        f"ingest {format.name}",
        INGEST_VERSION,
        options.model_dump(mode="json"),
        {"source": _source_digest(source, read.files)},
        key,
    )
    with scratches(dataset.root, [Truth, makes] if read.has_labels else [makes]) as written:
        if read.has_labels:
            _write_truth(written[Truth], read)
        _write_recording(written[makes], makes, format, read)
        outcomes = published_recording(dataset, item, written, origin, begun)
    _enter(dataset, item, format, source, options, makes, read.has_labels)
    return outcomes


def _enter(
    dataset: Dataset,
    item: str,
    format: Format,
    source: Path,
    options: SourceOptions,
    makes: type[Recording],
    has_labels: bool,
) -> None:
    """Enter a published recording in `dataset.json`."""
    if not has_labels:
        # Otherwise the labels of a replaced recording would count as ground truth of this one.
        shutil.rmtree(dataset.path(Truth, item), ignore_errors=True)
    path = os.path.relpath(source.resolve(), dataset.root.resolve())
    changed = options.model_dump(mode="json", exclude_defaults=True)
    dataset.add(makes.scope, item, Source(format=format.name, path=path, options=changed, truth=has_labels))


def _source_digest(source: Path, files: tuple[Path, ...]) -> str:
    return digest_of({os.path.relpath(file, source): _digest_of_file(file) for file in files})


def _digest_of_file(path: Path) -> str:
    state = path.stat()
    return _known_digest(path, state.st_size, state.st_mtime_ns, state.st_ino)


@lru_cache(maxsize=100_000)
def _known_digest(path: Path, size: int, time_ns: int, inode: int) -> str:
    """The digest of a file, computed once as long as it does not change: episodes share files of many gigabytes."""
    return file_digest(path)


def _key(
    makes: type[Recording], format: Format, options: SourceOptions, source: Path, opened: recording.SourceRecording
) -> str:
    return digest_of(
        {
            "kind": makes.kind,
            "schema": makes.schema_version,
            "stage": f"ingest {format.name}",
            "version": INGEST_VERSION,
            "params": options.model_dump(mode="json"),
            "source": _source_digest(source, opened.files),
        }
    )


def _write_recording(
    out: Path, makes: type[Scan] | type[Demonstration], format: Format, read: recording.PreparedRecording
) -> None:
    lenses = {
        camera.name: LensModel(model=camera.distortion.name, parameters=list(camera.distortion.parameters))
        for camera in read.cameras
        if camera.distortion is not None
    }
    arguments: dict[str, Any] = {"origin": read.origin, "left_out": read.left_out, "lenses": lenses}
    if makes is Demonstration and read.robot is not None:
        arguments["action_names"] = tuple(read.robot.action_names or ())
    group = makes.start(out, format.name, read.assumptions, **arguments)
    for camera in read.cameras:
        makes.write_camera(
            group,
            camera.name,
            CameraFrames(
                K=camera.K,
                world_from_cameras=camera.world_from_cameras,
                time=camera.time,
                depth_scale=camera.depth_scale,
                size=(camera.height, camera.width),
                read=_checked(camera),
            ),
            frames=lambda frames, name=camera.name: progress(frames, f"reading {name}"),  # type: ignore[misc]
        )
    if makes is Demonstration and read.robot is not None:
        robot = read.robot
        Demonstration.write_robot(out, group, Robot(robot.world_from_gripper, robot.gripper_width, robot.action))


def _checked(camera: recording.CameraRecording) -> Callable[[int], tuple[Any, Any]]:
    """The camera's reader, which raises `BadData` at the last frame if no frame has valid depth."""
    n_valid = 0

    def read(i_frame: int) -> tuple[Any, Any]:
        nonlocal n_valid
        rgb, depth = camera.read(i_frame)
        n_valid += int((depth > 0).sum())
        if i_frame == camera.n_frames - 1 and n_valid == 0:
            raise BadData(
                camera.name,
                "depth",
                expected="a measurement in some frame",
                got=f"none in {camera.n_frames} frames",
                fix="check the options that say which depth is read, and how it lies on colour.",
            )
        return rgb, depth

    return read


def _write_truth(out: Path, read: recording.PreparedRecording) -> None:
    cameras = {
        camera.name: (camera.n_frames, (camera.height, camera.width), camera.labels)
        for camera in read.cameras
        if camera.labels is not None
    }
    Truth.write(
        out,
        read.label_names,
        cameras,
        {label: pose.world_from_object.tolist() for label, pose in read.object_poses.items()},
        {label: pose.error for label, pose in read.object_poses.items()},
    )
