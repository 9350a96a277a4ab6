"""Entities of a dataset's items in a Rerun recording, each of which can be shown or hidden.

Every item has its own tree, `/<item>`, because it has its own world frame:

    world/cameras/<camera>/{rgb,depth,masks,inferred,truth,keypoints,particles}
    world/camera_paths/<camera>
    world/{surface,instances,boxes}            world/matches, matches/{images,lines,points}
    world/{keypoints,particles,spread,keypoint_paths}    world/{gripper,gripper_path}
    heat/<camera>/<point>/{map,best,truth,error}    heat/reference    belief/<camera>/<point>
    plots/{spread,gripper_width,action}

Timelines are `frame`, counted from 0, `time` in seconds and, for matches, `pair`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bask_data.dataset import Dataset
from bask_data.evaluation.lookup import find_recording
from bask_data.kinds import Demonstration, Scan
from bask_data.view.beliefs import draw_beliefs
from bask_data.view.choice import Choice, Shown
from bask_data.view.demonstrations import draw_demonstration
from bask_data.view.frames import draw_frames
from bask_data.view.heat import draw_heat
from bask_data.view.matches import draw_matches
from bask_data.view.scenes import draw_scene, first_eye, measured_points, support_plane
from bask_data.view.sheet import DrawnItem, Sheet, reading

if TYPE_CHECKING:
    import rerun


def draw_item(recording: rerun.RecordingStream, dataset: Dataset, name: str, choice: Choice) -> DrawnItem:
    """Draw all artifacts of an item into the recording."""
    sheet, drawn = Sheet(recording, name), DrawnItem(name, Shown())
    source = find_recording(dataset, name)
    points = np.zeros((0, 3))
    if name in dataset.file.scenes:
        points = draw_scene(sheet, drawn, dataset, name)
    if source is None:
        drawn.shown.missing.append("frames (bask-data ingest)")
    else:
        with reading(source):
            draw_frames(sheet, drawn, dataset, name, source, choice)
            drawn.eye = first_eye(
                points if len(points) else measured_points(source), source, support_plane(dataset, name)
            )
    if isinstance(source, Scan):
        draw_matches(sheet, drawn, dataset, name, source, choice.n_pairs)
    if name in dataset.file.demonstrations:
        draw_demonstration(sheet, drawn, dataset, name, source, choice)
    if choice.beliefs and isinstance(source, Demonstration):
        draw_beliefs(sheet, drawn, dataset, source, choice)
    if source is not None:
        draw_heat(sheet, drawn, dataset, name, source, choice)
    return drawn
