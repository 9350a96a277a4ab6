"""The filter's belief in each frame: particles, or a map over each camera's pixels.

Tracks do not store beliefs, so the demonstration is tracked again.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress

import numpy as np

from bask_data.core.filters.observation import Observation, WeightedPoints, pixels_of
from bask_data.core.filters.particle.resample import stratified
from bask_data.core.geometry import scale_pixels
from bask_data.dataset import Dataset
from bask_data.drawing.colours import palette
from bask_data.drawing.pictures import heat_picture
from bask_data.evaluation.lookup import find, input_variant
from bask_data.kinds import Camera, Demonstration, DescriptorNet, KeypointTrack, ReferenceKeypoints
from bask_data.observing import moment_of
from bask_data.progress import progress
from bask_data.stages.encode import EncodeParams, cameras_of, dropped, grippers_of, settings_of
from bask_data.tracker import KeypointTracker
from bask_data.view.choice import Choice
from bask_data.view.sheet import CORNER, DrawnItem, Sheet, jpeg, reading

N_PARTICLES = 150
"""Particles shown per keypoint, sampled by weight; more would hide one another."""
SAME = 1e-3
"""Tolerance between the track's means and those tracked again, metres."""
BELIEF_WIDTH = 256
"""Width of a map's picture, pixels, at most."""


def draw_beliefs(
    sheet: Sheet, drawn: DrawnItem, dataset: Dataset, demonstration: Demonstration, choice: Choice
) -> None:
    """Track again with the settings of the demonstration's track, and draw particles or maps of each frame."""
    track = find(dataset, KeypointTrack, demonstration.path.name, choice.variant)
    if track is None:
        return  # Reported with the keypoints.
    with reading(track):
        tracker, params = _tracker(dataset, track, choice.variant)
        if tracker is None:
            drawn.note(
                False, "beliefs", "the track's network or references are missing, or it was made from ground truth"
            )
            return
        cameras = cameras_of(demonstration, params.cameras)
        grippers = grippers_of(demonstration, cameras[0].n_frames)
        shown = ~dropped(cameras[0].n_frames, len(cameras), params.dropout, params.seed)
        is_same = True
        for i_frame in progress(range(len(track.mean)), f"tracking again in {sheet.item}"):
            moment = moment_of(compress(cameras, shown[i_frame]), i_frame)
            tracked = tracker.step(*moment, None if grippers is None else grippers[i_frame])
            is_same &= np.allclose(tracked.mean, track.mean[i_frame], atol=SAME, equal_nan=True)
            if i_frame % choice.every == 0:
                time = cameras[0].time
                with sheet.at(frame=i_frame, seconds=float(time[i_frame] - time[0])):
                    _draw(sheet, drawn, tracker, cameras, i_frame)
    drawn.note(is_same, "beliefs", "keypoints differ when tracked again: bask-data encode --force")


def _tracker(dataset: Dataset, track: KeypointTrack, variant: str) -> tuple[KeypointTracker | None, EncodeParams]:
    """A tracker with the track's settings, before the first frame; None where an input is missing."""
    known = {name: value for name, value in track.manifest.params.items() if name in EncodeParams.model_fields}
    params = EncodeParams.model_validate(known)
    descriptor = input_variant(dataset, track, DescriptorNet, variant)
    reference = input_variant(dataset, track, ReferenceKeypoints, variant)
    if params.source == "truth" or descriptor is None or reference is None:
        return None, params
    settings = settings_of(params, reference.calibration)
    tracker = KeypointTracker(
        descriptor, reference, settings, params.seed, cameras=track.camera_names, **params.savings
    )
    return tracker, params


def _draw(sheet: Sheet, drawn: DrawnItem, tracker: KeypointTracker, cameras: Sequence[Camera], i_frame: int) -> None:
    if tracker.belief is None:
        return
    belief = tracker.hypotheses()
    if isinstance(belief, WeightedPoints):
        drawn.layers.add("particles")
        _draw_particles(sheet, belief, tracker, cameras)
        return
    for name, maps in zip(tracker.cameras, belief.maps, strict=True):
        if maps is not None:
            _draw_maps(sheet, drawn, tracker, cameras, name, maps, i_frame)


def _draw_particles(sheet: Sheet, belief: WeightedPoints, tracker: KeypointTracker, cameras: Sequence[Camera]) -> None:
    """Draw a sample by weight of each keypoint's particles, in the scene and in the images."""
    import rerun as rr

    k = len(belief.weight)
    n = min(N_PARTICLES, belief.weight.shape[1])
    chosen = np.stack([stratified(weight, np.full(n, 0.5)) for weight in belief.weight])
    points = belief.points_world[np.arange(k)[:, None], chosen].reshape(-1, 3)
    colours = np.repeat(np.array(palette(k), np.uint8).reshape(-1, 3), n, axis=0)
    known = np.isfinite(points).all(axis=1)
    sheet.log(("world", "particles"), rr.Points3D(points[known], colors=colours[known], radii=rr.Radius.ui_points(1.2)))
    for camera in cameras:
        seen = tracker.observations.get(camera.name)
        uv = np.zeros((0, 2)) if seen is None else _in_image(points[known], seen, camera)
        inside = np.isfinite(uv).all(axis=1) & (uv >= 0).all(axis=1) & (uv < [camera.width, camera.height]).all(axis=1)
        sheet.log(
            ("world", "cameras", camera.name, "particles"),
            rr.Points2D(uv[inside] + CORNER, colors=colours[known][: len(uv)][inside], radii=rr.Radius.ui_points(1.2)),
        )


def _in_image(points_world: np.ndarray, seen: Observation, camera: Camera) -> np.ndarray:
    """Pixels (n, 2) of the camera's recorded images; NaN behind the camera."""
    return scale_pixels(pixels_of(points_world, seen), seen.depth.shape, (camera.height, camera.width))


def _draw_maps(
    sheet: Sheet,
    drawn: DrawnItem,
    tracker: KeypointTracker,
    cameras: Sequence[Camera],
    name: str,
    maps: np.ndarray,
    i_frame: int,
) -> None:
    """Draw each keypoint's belief over a camera's pixels, overlaid on the frame."""
    import rerun as rr

    [camera] = [one for one in cameras if one.name == name]
    rgb = camera.rgb(i_frame)
    places = [f"{i + 1} {point}" for i, point in enumerate(tracker.names)]
    drawn.believed[name] = places
    for place, heat in zip(places, maps, strict=True):
        picture = heat_picture(rgb, heat, [], min(BELIEF_WIDTH, rgb.shape[1]))
        sheet.log(("belief", name, place), rr.EncodedImage(contents=jpeg(picture), media_type="image/jpeg"))
