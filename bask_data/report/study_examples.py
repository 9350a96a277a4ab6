"""Frames in figures of the keypoint study: where keypoints were picked, and where each method finds one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bask_data.dataset import Dataset
from bask_data.drawing.colours import palette
from bask_data.drawing.pictures import Mark, marks_picture
from bask_data.drawing.plots import numbers
from bask_data.errors import BadData
from bask_data.evaluation.lookup import find_recording
from bask_data.report.study_style import remeasured

TRUTH = "#e02020"
STUDY_TILE = 256
"""Half the width of the picture of reference positions, pixels."""


def draw_reference(axes: Any, dataset: Dataset, group: Mapping[str, Any]) -> None:
    """Draw the image that most of the keypoints were picked in."""
    picks = group["keypoints"]
    frames = [(pick["recording"], pick["camera"], pick["frame"]) for pick in picks]
    recording, camera, i_frame = max(frames, key=frames.count)
    image = _frame(dataset, recording, camera, i_frame)
    colours = palette(len(picks))
    marks = [
        Mark(i, np.array([pick["u"], pick["v"]]), colours[i])
        for i, (pick, frame) in enumerate(zip(picks, frames, strict=True))
        if frame == (recording, camera, i_frame)
    ]
    axes.imshow(marks_picture(image, marks, 2 * STUDY_TILE))
    axes.set_title(f"Reference positions ({recording})", fontsize=9)
    axes.set_axis_off()


def draw_example(
    row: Any, dataset: Dataset, group: Mapping[str, Any], example: Mapping[str, Any], colours: Mapping[str, str]
) -> None:
    """Draw a keypoint in some frames of a demonstration: ground truth, and the position by each method."""
    tiles = np.atleast_1d(row.subplots(1, len(example["frames"])))
    keypoint = group["keypoints"][example["keypoint"]]["name"]
    row.suptitle(
        f"{keypoint} in {example['demonstration']}, {example['camera']} camera. Red: ground truth (hollow: occluded)",
        fontsize=8,
        x=0.01,
        ha="left",
    )
    for i, (axes, i_frame) in enumerate(zip(tiles, example["frames"], strict=True)):
        image = _frame(dataset, example["demonstration"], example["camera"], i_frame)
        height, width = image.shape[:2]
        axes.imshow(image)
        for name, pixels in example["pixel"].items():
            u, v = numbers(pixels[i])
            axes.plot(
                np.clip(u, 0, width - 1),
                np.clip(v, 0, height - 1),
                marker="o" if 0 <= u < width and 0 <= v < height else "X",
                color=colours[name],
                markersize=7,
                markeredgecolor="white",
                markeredgewidth=0.8,
            )
        u, v = numbers(example["truth"][i])
        axes.plot(
            np.clip(u, 0, width - 1),
            np.clip(v, 0, height - 1),
            marker="P",
            markersize=9,
            markerfacecolor=TRUTH if example["visible"][i] else "none",
            markeredgecolor="white" if example["visible"][i] else TRUTH,
        )
        axes.set_title(f"frame {i_frame}", fontsize=7)
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)
        axes.set_axis_off()


def _frame(dataset: Dataset, recording: str, camera: str, i_frame: int) -> np.ndarray:
    source = find_recording(dataset, recording)
    if source is None or camera not in source.camera_names or not 0 <= i_frame < source.camera(camera).n_frames:
        where = f"frame {i_frame} of {camera} in {recording}"
        raise BadData(
            dataset.root, where, expected="the frame that the study used", got="none", fix=remeasured(dataset)
        )
    return source.camera(camera).rgb(i_frame)
