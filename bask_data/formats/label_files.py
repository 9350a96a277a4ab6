"""Label images as ground truth beside a recording of any format: `--labels PATTERN`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bask_data.errors import BadData, UsageError
from bask_data.formats.files import Folder, frame_number, listed
from bask_data.formats.images import read_labels
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.recording import SourceRecording


def with_labels(source: Path, recording: SourceRecording, options: SourceOptions) -> SourceRecording:
    """The recording with the label images that `--labels` names, if any, as its ground truth.

    The text matched by `*` is a frame's name, or has its number. The pattern is looked for in SOURCE, or beside it if
    SOURCE is a file.

    Raises:
        UsageError: there are several cameras: which one is labelled is open.
        BadData: a frame has no label image.
    """
    if not options.labels:
        return recording
    if len(recording.cameras) > 1:
        names = ", ".join(camera.name for camera in recording.cameras)
        raise UsageError("--labels", expected="a source of one camera", got=names, fix="ingest one camera at a time.")
    [camera] = recording.cameras
    folder = Folder(source if source.is_dir() else source.parent, options.follow_links)
    found = folder.matching(options.labels, "labels")
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
    paths = [file for file in files if file is not None]
    present = sorted({int(value) for path in paths for value in np.unique(read_labels(path))} - {0})
    labelled = replace(camera, labels=lambda i: read_labels(paths[i]))
    return replace(
        recording,
        cameras=(labelled,),
        label_names={label: recording.label_names.get(label, f"label {label}") for label in present},
        assumptions={**recording.assumptions, "labels": f"{options.labels}, taken as truth for reports only"},
        files=(*recording.files, *paths),
    )
