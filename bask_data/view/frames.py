"""Cameras with their frames, measured depth, masks and ground-truth labels."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from bask_data.artifact import Artifact
from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.evaluation.lookup import find, find_truth, spread_frames
from bask_data.kinds import Camera, Recording, Scan, VisibleMasks
from bask_data.kinds.masks import CameraMasks
from bask_data.progress import progress
from bask_data.view.choice import Choice
from bask_data.view.sheet import CORNER, GREY, DrawnItem, Sheet, expect, jpeg, name_labels, reading


def draw_frames(sheet: Sheet, drawn: DrawnItem, dataset: Dataset, name: str, source: Recording, choice: Choice) -> None:
    """Draw every camera of a recording."""
    masks = find(dataset, VisibleMasks, name) if isinstance(source, Scan) else None
    truth = find_truth(dataset, name)
    cameras = source.cameras
    begin = min((float(camera.time[0]) for camera in cameras if len(camera.time)), default=0.0)
    for camera in cameras:
        _check(camera)
        frames = range(0, camera.n_frames, choice.every)
        _draw_camera(sheet, camera, frames, begin)
        if masks is not None and camera.name in masks.camera_names:
            of_camera = masks.camera(camera.name)
            _draw_labels(sheet, camera, frames, begin, masks, "masks", of_camera.instance)
            _draw_labels(sheet, camera, frames, begin, masks, "inferred", partial(_inferred, of_camera))
            name_labels(sheet, [("world", "cameras", camera.name, "inferred")], {1: "no depth was measured here"})
        if truth is not None and camera.name in truth.camera_names:
            _draw_labels(sheet, camera, frames, begin, truth, "truth", partial(truth.instance, camera.name))
        drawn.cameras.append(camera.name)
        drawn.shown.frames[camera.name] = len(frames)
    drawn.note(True, "frames", "")
    if isinstance(source, Scan):
        drawn.note(masks is not None, "masks", "bask-data masks")
    if truth is not None:
        name_labels(sheet, [("world", "cameras", camera.name, "truth") for camera in cameras], truth.label_names)
        drawn.note(True, "truth", "")


def _check(camera: Camera) -> None:
    """Raise `BadData` for a camera whose arrays are inconsistent."""
    if min(camera.height, camera.width) < 1:
        raise BadData(camera.path, "rgb", expected="an image", got=f"{camera.width} x {camera.height} pixels")
    expect(camera.path, "world_from_camera", camera.world_from_cameras, (camera.n_frames, 4, 4), "f")
    expect(camera.path, "time", camera.time, (camera.n_frames,), "f")
    if not (np.isfinite(camera.depth_scale) and camera.depth_scale > 0):
        raise BadData(camera.path, "scale_m", expected="> 0 metres per unit", got=camera.depth_scale)


def _draw_camera(sheet: Sheet, camera: Camera, frames: range, begin: float) -> None:
    """Draw one camera's colour, depth and path, frame by frame."""
    import rerun as rr

    size, poses = (camera.height, camera.width), camera.world_from_cameras
    place = ("world", "cameras", camera.name)
    depth_range = _depth_range(camera)
    far = depth_range[1] * camera.depth_scale
    Ks = camera.Ks.copy()
    Ks[:, :2, 2] += CORNER

    def pinhole(i_frame: int) -> rr.Pinhole:
        return rr.Pinhole(image_from_camera=Ks[i_frame], resolution=size[::-1], image_plane_distance=0.1 * far)

    changes = bool((Ks != Ks[:1]).any())
    if not changes and camera.n_frames:
        sheet.fix(place, pinhole(0))
    path = rr.LineStrips3D([poses[:, :3, 3]], colors=[GREY], radii=rr.Radius.ui_points(1.0))
    sheet.fix(("world", "camera_paths", camera.name), path)
    for i_frame in progress(frames, f"drawing {sheet.item}, {camera.name}"):
        with sheet.at(frame=i_frame, seconds=float(camera.time[i_frame]) - begin):
            pose = poses[i_frame]
            if changes:
                sheet.log(place, pinhole(i_frame))
            sheet.log(place, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            rgb = expect(camera.path, "rgb", camera.rgb(i_frame), (*size, 3), "u")
            sheet.log((*place, "rgb"), rr.EncodedImage(contents=jpeg(rgb), media_type="image/jpeg"))
            depth = expect(camera.path, "depth", camera.depth_raw(i_frame), size, "u")
            image = rr.DepthImage(depth, meter=1 / camera.depth_scale, colormap="turbo", depth_range=depth_range)
            sheet.log((*place, "depth"), image)


def _draw_labels(
    sheet: Sheet,
    camera: Camera,
    frames: range,
    begin: float,
    artifact: Artifact,
    layer: str,
    read: Callable[[int], np.ndarray],
) -> None:
    """Draw label images over one camera's frames."""
    import rerun as rr

    for i_frame in progress(frames, f"drawing {sheet.item}, {camera.name}, {layer}"):
        with sheet.at(frame=i_frame, seconds=float(camera.time[i_frame]) - begin), reading(artifact):
            where = artifact.path / camera.name
            image = expect(where, f"frame {i_frame}", read(i_frame), (camera.height, camera.width), "u")
            sheet.log(("world", "cameras", camera.name, layer), rr.SegmentationImage(image, opacity=0.5))


def _inferred(masks: CameraMasks, i_frame: int) -> np.ndarray:
    """Label 1 where no depth was measured, so that the mask, or its absence, is inferred."""
    return (~masks.measured(i_frame)).astype(np.uint8)


def _depth_range(camera: Camera) -> tuple[float, float]:
    """Range in stored units, the same for all frames so that colours compare; from 0, the only dark colour."""
    sampled = [camera.depth_raw(i_frame).ravel()[::37] for i_frame in spread_frames(camera.n_frames, 5)]
    measured = np.concatenate([depth[depth > 0] for depth in sampled]) if sampled else np.zeros(0)
    return 0.0, float(np.percentile(measured, 98)) if len(measured) else 1.0 / camera.depth_scale
