"""Label images as ground truth beside a recording of any format: `--labels PATTERN`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from bask_data.errors import BadData, UsageError
from bask_data.formats.choices import CAMERA
from bask_data.formats.files import Folder, folder_of, frame_number, listed
from bask_data.formats.images import read_labels
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.recording import SourceCamera, SourceRecording

LARGEST_LABEL, ROBOT = 254, 255
"""Largest label of an object, and the label of a robot, which evaluation leaves out; 0 is the background."""


def with_labels(source: Path, recording: SourceRecording, options: SourceOptions) -> SourceRecording:
    """The recording with the label images that `--labels` names, if any, as its ground truth.

    The text matched by `*` is a frame's name, or has its number; `{camera}` stands for the camera's name. The pattern
    is looked for in SOURCE, or beside it if SOURCE is a file.

    Raises:
        UsageError: there are several cameras, and the pattern does not say which one is labelled.
        BadData: a frame has no label image, or there is no label but the robot's.
    """
    if not options.labels:
        return recording
    if len(recording.cameras) > 1 and CAMERA not in options.labels:
        names = ", ".join(camera.name for camera in recording.cameras)
        fix = "put {camera} into the pattern, for instance '{camera}/labels_*.png', or ingest one camera at a time."
        raise UsageError("--labels", expected="a pattern with {camera}, of several cameras", got=names, fix=fix)
    folder = folder_of(source, options.follow_links)
    files = {camera.name: _files_of(folder, camera, options.labels) for camera in recording.cameras}
    paths = [path for found in files.values() for path in found]
    present = labels_in(paths)
    if present == [ROBOT]:
        raise BadData(
            folder.path,
            "--labels",
            expected=f"a number from 1 to {LARGEST_LABEL} for each object, and {ROBOT} for the robot only",
            got=f"{ROBOT} alone, as binary masks have it",
            fix="save the masks with another number than 255, such as 1.",
        )
    named = {ROBOT: "robot"} | recording.label_names
    return replace(
        recording,
        cameras=tuple(_labelled(camera, files[camera.name]) for camera in recording.cameras),
        label_names={label: named.get(label, f"label {label}") for label in present},
        assumptions={**recording.assumptions, "labels": f"{options.labels}, taken as truth for reports only"},
        files=(*recording.files, *paths),
    )


def labels_in(files: Iterable[Path]) -> list[int]:
    """Labels of objects that occur in label images, in order."""
    return sorted({int(value) for file in files for value in np.unique(read_labels(file))} - {0})


def _labelled(camera: SourceCamera, paths: list[Path]) -> SourceCamera:
    return replace(camera, labels=lambda i: read_labels(paths[i]))


def _files_of(folder: Folder, camera: SourceCamera, pattern: str) -> list[Path]:
    """The label image of each frame of a camera."""
    found = folder.matching(pattern.replace(CAMERA, camera.name), "labels")
    by_number = {frame_number(name): path for name, path in found.items()}
    files = [found.get(frame) or by_number.get(frame_number(frame)) for frame in camera.frames]
    missing = [frame for frame, file in zip(camera.frames, files, strict=True) if file is None]
    if missing:
        raise BadData(
            folder.path,
            "--labels",
            expected="a label image for every frame",
            got=f"none for {listed(missing)}",
            fix="choose a pattern whose * matches the frames' names or numbers.",
        )
    return [file for file in files if file is not None]
