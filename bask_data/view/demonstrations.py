"""The robot's motion and the tracked keypoints of a demonstration."""

from __future__ import annotations

import numpy as np

from bask_data.core.geometry import in_image, rigid_fault
from bask_data.dataset import Dataset
from bask_data.drawing.colours import palette
from bask_data.errors import BadData
from bask_data.evaluation.lookup import find
from bask_data.kinds import Demonstration, KeypointTrack, Recording
from bask_data.progress import progress
from bask_data.view.choice import Choice
from bask_data.view.sheet import CORNER, ORANGE, DrawnItem, Sheet, expect, reading

N_LABELLED = 8
"""Keypoints whose names are always shown, at most: more names would hide the points. Hovering shows the others."""


def draw_demonstration(
    sheet: Sheet, drawn: DrawnItem, dataset: Dataset, name: str, source: Recording | None, choice: Choice
) -> None:
    """Draw the gripper's path and the keypoints in the scene, in the images and over time."""
    if isinstance(source, Demonstration):
        with reading(source):
            _draw_robot(sheet, drawn, source, choice.every)
    track = find(dataset, KeypointTrack, name, choice.variant)
    if track is not None:
        with reading(track):
            _draw_track(sheet, track, source, choice.every)
        drawn.layers.add("spread")
    drawn.note(track is not None, "keypoints", "bask-data encode")


def _seconds(source: Recording | None, n: int) -> list[float | None]:
    """Seconds from the first frame to each, from a camera with n frames; None where there is no such camera."""
    for camera in source.cameras if source else []:
        if len(camera.time) == n:
            return [float(t) for t in expect(camera.path, "time", camera.time, (n,), "f") - camera.time[0]]
    return [None] * n


def _draw_robot(sheet: Sheet, drawn: DrawnItem, source: Demonstration, every: int) -> None:
    import rerun as rr

    robot = source.robot
    if robot is None:
        drawn.shown.missing.append("gripper (only cameras were recorded)")
        return
    poses, width, action = robot.world_from_gripper, robot.gripper_width, robot.action
    n = next((len(column) for column in (poses, width, action) if column is not None), 0)
    where = source.path / "robot"
    if poses is not None:
        for i, pose in enumerate(expect(where, "world_from_gripper", poses, (n, 4, 4), "f")):
            if fault := rigid_fault(pose):
                raise BadData(where, f"world_from_gripper {i}", expected="a rigid transform", got=fault)
        path = rr.LineStrips3D([poses[:, :3, 3]], colors=[ORANGE], radii=rr.Radius.ui_points(1.5))
        sheet.fix(("world", "gripper_path"), path)
        sheet.fix(("world", "gripper"), rr.TransformAxes3D(0.05))
        drawn.note(True, "gripper", "")
    if width is not None:
        expect(where, "gripper_width", width, (n,), "f")
        sheet.fix(("plots", "gripper_width"), rr.SeriesLines(names=["gripper width, m"], colors=[ORANGE]))
        drawn.layers.add("gripper_width")
    if action is not None:
        columns = expect(where, "action", action, (n, None), "f").shape[1]
        names = list(robot.action_names) if len(robot.action_names) == columns else [f"{i}" for i in range(columns)]
        sheet.fix(("plots", "action"), rr.SeriesLines(names=names))
        drawn.note(True, "action", "")
    seconds = _seconds(source, n)
    for i_frame in range(0, n, every):
        with sheet.at(frame=i_frame, seconds=seconds[i_frame]):
            if poses is not None:
                pose = poses[i_frame]
                sheet.log(("world", "gripper"), rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            if width is not None:
                sheet.log(("plots", "gripper_width"), rr.Scalars(width[i_frame]))
            if action is not None:
                sheet.log(("plots", "action"), rr.Scalars(action[i_frame]))


def _draw_track(sheet: Sheet, track: KeypointTrack, source: Recording | None, every: int) -> None:
    """Draw means with their one-sigma ellipsoids, their paths, and their pixels in the images."""
    import rerun as rr

    n, k = len(track.mean), len(track.names)
    for name, shape in (("mean", (n, k, 3)), ("covariance", (n, k, 3, 3))):
        expect(track.path, name, np.nan_to_num(getattr(track, name)), shape, "f")
    colours, seconds = np.array(palette(k), np.uint8).reshape(-1, 3), _seconds(source, n)
    known = np.isfinite(track.mean).all(axis=2) & np.isfinite(track.covariance).all(axis=(2, 3))
    strips = [(strip, colours[i]) for i in range(k) for strip in _strips(track.mean[:, i], known[:, i])]
    sheet.fix(
        ("world", "keypoint_paths"),
        rr.LineStrips3D([s for s, _ in strips], colors=[c for _, c in strips], radii=rr.Radius.ui_points(0.75)),
    )
    sheet.fix(("plots", "spread"), rr.SeriesLines(names=[f"{name}, m" for name in track.names], colors=colours))
    spread = np.sqrt(np.maximum(np.trace(track.covariance, axis1=2, axis2=3), 0))
    pixels = _track_pixels(track, source, n, k)
    for i_frame in progress(range(0, n, every), f"drawing {sheet.item}, keypoints"):
        here = known[i_frame]
        names = [name for name, is_known in zip(track.names, here, strict=True) if is_known]
        mean, sizes, quat_xyzw = track.mean[i_frame, here], *_axes(track.covariance[i_frame, here])
        with sheet.at(frame=i_frame, seconds=seconds[i_frame]):
            sheet.log(
                ("world", "keypoints"),
                rr.Points3D(
                    mean, colors=colours[here], labels=names, show_labels=k <= N_LABELLED, radii=rr.Radius.ui_points(5)
                ),
            )
            sheet.log(
                ("world", "spread"),
                rr.Ellipsoids3D(centers=mean, half_sizes=sizes, quaternions=quat_xyzw, colors=colours[here]),
            )
            sheet.log(("plots", "spread"), rr.Scalars(spread[i_frame]))
            for camera, (pixel, observed, inside) in pixels.items():
                visible = inside[i_frame]
                sheet.log(
                    ("world", "cameras", camera, "keypoints"),
                    rr.Points2D(
                        pixel[i_frame, visible] + CORNER,
                        colors=colours[visible],
                        labels=[name for name, is_visible in zip(track.names, visible, strict=True) if is_visible],
                        show_labels=k <= N_LABELLED,
                        # Keypoints that the filter considers occluded are drawn small.
                        radii=rr.Radius.ui_points(np.where(observed[i_frame, visible], 6.0, 2.5)),
                    ),
                )


def _track_pixels(
    track: KeypointTrack, source: Recording | None, n: int, k: int
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """By camera of the recording: pixels (n, k, 2), whether the filter considers them visible, and lie in the image."""
    pixels = {}
    for camera in source.cameras if source else []:
        if camera.name in track.camera_names:
            where = track.path / camera.name
            pixel = expect(where, "pixel", np.nan_to_num(track.pixel(camera.name), nan=-1e6), (n, k, 2), "f")
            observed = expect(where, "observed", track.observed(camera.name), (n, k), "b")
            inside = in_image(pixel.reshape(-1, 2).astype(np.float64), camera.height, camera.width).reshape(n, k)
            pixels[camera.name] = pixel, observed, inside
    return pixels


def _strips(points: np.ndarray, known: np.ndarray) -> list[np.ndarray]:
    """The parts of a path (t, 3) in which it is known."""
    cuts = np.flatnonzero(np.diff(known.astype(np.int8))) + 1
    pieces = np.split(np.arange(len(points)), cuts)
    return [points[piece] for piece in pieces if len(piece) > 1 and known[piece[0]]]


def _axes(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One-sigma half axes (k, 3), metres, and their orientations (k, 4) as quaternions xyzw."""
    from scipy.spatial.transform import Rotation

    values, vectors = np.linalg.eigh(covariance.astype(np.float64))
    vectors = vectors * np.sign(np.linalg.det(vectors))[:, None, None]
    quat_xyzw = Rotation.from_matrix(vectors).as_quat() if len(vectors) else np.zeros((0, 4))
    return np.sqrt(np.maximum(values, 0)), quat_xyzw
