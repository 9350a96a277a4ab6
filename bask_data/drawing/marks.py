"""Keypoints of a track as marks on frames, for the report's pictures and for videos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bask_data.core.geometry import in_image, invert_rigid, project, transform
from bask_data.drawing.colours import Colour
from bask_data.drawing.pictures import Mark
from bask_data.kinds import Camera, KeypointTrack

N_TRAIL = 15
"""Length of a trail, frames."""


@dataclass(frozen=True)
class CameraTrack:
    """A track in the images of one of its cameras.

    Args:
        places: (t, k, 3) ground-truth positions of the keypoints, metres, world frame; NaN where unknown.
        pixel: (t, k, 2) projected means.
        observed: (t, k) whether the filter considers them visible to the camera.
    """

    track: KeypointTrack
    places: np.ndarray
    camera: Camera
    pixel: np.ndarray
    observed: np.ndarray

    def marks(self, i_frame: int, colours: list[Colour]) -> list[Mark]:
        """Marks of a frame: means, trails, one-sigma ellipses and ground-truth positions.

        Args:
            colours: one per keypoint.
        """
        camera, mean, covariance = self.camera, self.track.mean, self.track.covariance[i_frame]
        truth = _pixels(self.places[i_frame], camera, i_frame)
        truth[~in_image(truth, camera.height, camera.width)] = np.nan
        jacobian = _image_jacobian(mean[i_frame].astype(np.float64), camera, i_frame)
        in_pixels = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
        first = max(i_frame - N_TRAIL, 0)
        return [
            Mark(
                number=i + 1,
                pixel=self.pixel[i_frame, i],
                colour=colours[i],
                seen=bool(self.observed[i_frame, i]),
                trail=_pixels(mean[first : i_frame + 1, i], camera, i_frame),
                covariance=in_pixels[i],
                truth=truth[i],
            )
            for i in range(len(colours))
        ]


def camera_tracks(track: KeypointTrack, cameras: list[Camera], places: np.ndarray) -> list[CameraTrack]:
    """The track in each of these cameras for which it has pixels, in the track's order of cameras.

    Args:
        places: as in `CameraTrack`.
    """
    by_name = {camera.name: camera for camera in cameras}
    return [
        CameraTrack(track, places, by_name[name], track.pixel(name), track.observed(name))
        for name in track.camera_names
        if name in by_name
    ]


def _image_jacobian(points_world: np.ndarray, camera: Camera, i_frame: int) -> np.ndarray:
    """Jacobian (k, 2, 3) of the pixels with respect to the world points, pixels per metre."""
    camera_from_world = invert_rigid(camera.world_from_cameras[i_frame])
    x, y, z = transform(camera_from_world, points_world).T
    with np.errstate(divide="ignore", invalid="ignore"):
        rows = [[1 / z, np.zeros_like(z), -x / z**2], [np.zeros_like(z), 1 / z, -y / z**2]]
    return camera.Ks[i_frame, :2, :2] @ np.moveaxis(np.array(rows), 2, 0) @ camera_from_world[:3, :3]


def _pixels(points_world: np.ndarray, camera: Camera, i_frame: int) -> np.ndarray:
    """Pixels (n, 2) of world points in a frame of the camera."""
    camera_from_world = invert_rigid(camera.world_from_cameras[i_frame])
    return project(transform(camera_from_world, points_world.astype(np.float64)), camera.Ks[i_frame])[0]
