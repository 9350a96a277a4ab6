from __future__ import annotations

import numpy as np

from bask_data.core.geometry import invert_rigid, project, transform
from bask_data.dataset import Dataset
from bask_data.drawing.colours import palette
from bask_data.drawing.marks import N_TRAIL, camera_tracks
from bask_data.kinds import Demonstration, KeypointTrack


def test_marks_are_the_track_s_pixels_with_its_trail_and_the_true_positions_in_view(filled: Dataset) -> None:
    track = KeypointTrack(filled.path(KeypointTrack, "demo-a"))
    cameras = Demonstration(filled.path(Demonstration, "demo-a")).cameras
    places = track.mean.astype(np.float64)
    places[:, 1] = (0.0, 0.0, 1e3)
    [camera_track] = camera_tracks(track, cameras, places)
    i_frame = 4
    first, second = camera_track.marks(i_frame, palette(2))
    np.testing.assert_array_equal(first.pixel, track.pixel(camera_track.camera.name)[i_frame, 0])
    np.testing.assert_allclose(first.trail[-1], first.pixel, atol=0.01)
    assert len(first.trail) == min(i_frame, N_TRAIL) + 1
    np.testing.assert_allclose(first.truth, first.pixel, atol=0.01)
    assert np.isnan(second.truth).all()


def test_an_ellipse_is_the_covariance_seen_through_the_camera(filled: Dataset) -> None:
    track = KeypointTrack(filled.path(KeypointTrack, "demo-a"))
    cameras = Demonstration(filled.path(Demonstration, "demo-a")).cameras
    [camera_track] = camera_tracks(track, cameras, np.full(track.mean.shape, np.nan))
    mark, rng = camera_track.marks(0, palette(2))[0], np.random.default_rng(0)
    moved = rng.multivariate_normal(track.mean[0, 0], track.covariance[0, 0], 40_000)
    camera = camera_track.camera
    pixels = project(transform(invert_rigid(camera.world_from_cameras[0]), moved), camera.Ks[0])[0]
    np.testing.assert_allclose(mark.covariance, np.cov(pixels.T), rtol=0.05, atol=0.05 * np.trace(mark.covariance))


def test_a_camera_that_a_recording_lacks_is_left_out(filled: Dataset) -> None:
    track = KeypointTrack(filled.path(KeypointTrack, "demo-a"))
    assert camera_tracks(track, [], track.mean) == []
