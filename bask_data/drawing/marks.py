"""Keypoints of a track as marks on a frame: for the report's pictures and for videos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bask_data.core.geometry import in_image, invert_rigid, project, transform
from bask_data.drawing.pictures import Colour, Mark
from bask_data.kinds import Camera, KeypointTrack

N_TRAIL = 15
"""Frames that a trail goes back."""


@dataclass(frozen=True)
class CameraTrack:
    """What a track says in the images of one of its cameras.

    Args:
        places: (t, k, 3) metres, world: where the keypoints truly are; NaN where not known.
        pixel: (t, k, 2) of the means.
        observed: (t, k) whether the filter takes the camera to see them.
    """

    track: KeypointTrack
    places: np.ndarray
    camera: Camera
    pixel: np.ndarray
    observed: np.ndarray

    def marks(self, i_frame: int, colours: list[Colour]) -> list[Mark]:
        """What a frame shows of the track: means, where they were, one-sigma ellipses, true places.

        Args:
            colours: of each keypoint.
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
    """The track in each of these cameras that it has pixels of, in the order of the track's own list.

    Args:
        places: as `CameraTrack` has them.
    """
    by_name = {camera.name: camera for camera in cameras}
    return [
        CameraTrack(track, places, by_name[name], track.pixel(name), track.observed(name))
        for name in track.camera_names
        if name in by_name
    ]


def _image_jacobian(points_world: np.ndarray, camera: Camera, i_frame: int) -> np.ndarray:
    """(k, 2, 3): how pixels move with world points."""
    camera_from_world = invert_rigid(camera.world_from_cameras[i_frame])
    x, y, z = transform(camera_from_world, points_world).T
    with np.errstate(divide="ignore", invalid="ignore"):
        rows = [[1 / z, np.zeros_like(z), -x / z**2], [np.zeros_like(z), 1 / z, -y / z**2]]
    return camera.K[:2, :2] @ np.moveaxis(np.array(rows), 2, 0) @ camera_from_world[:3, :3]


def _pixels(points_world: np.ndarray, camera: Camera, i_frame: int) -> np.ndarray:
    camera_from_world = invert_rigid(camera.world_from_cameras[i_frame])
    return project(transform(camera_from_world, points_world.astype(np.float64)), camera.K)[0]
