"""Keypoints of a track as marks on a frame: for the report's pictures and for videos."""

from __future__ import annotations

import numpy as np

from bask_data.core.geometry import in_image, invert_rigid, project, transform
from bask_data.drawing.pictures import Colour, Mark
from bask_data.kinds import Camera
from bask_data.report.figures import TrackScores

N_TRAIL = 15
"""Frames that a trail goes back."""


def track_marks(
    scored: TrackScores,
    camera: Camera,
    i_frame: int,
    pixel: np.ndarray,
    observed: np.ndarray,
    colours: list[Colour],
) -> list[Mark]:
    """What a frame of one of its cameras shows of a track: means, where they were, one-sigma ellipses, true places.

    Args:
        pixel: (k, 2) of the means.
        observed: (k,) whether the filter thinks that the camera sees them.
    """
    mean, covariance = scored.track.mean, scored.track.covariance[i_frame]
    truth = _pixels(scored.places[i_frame], camera, i_frame)
    truth[~in_image(truth, camera.height, camera.width)] = np.nan
    jacobian = _image_jacobian(mean[i_frame].astype(np.float64), camera, i_frame)
    in_pixels = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    first = max(i_frame - N_TRAIL, 0)
    return [
        Mark(
            number=i + 1,
            pixel=pixel[i],
            colour=colours[i],
            seen=bool(observed[i]),
            trail=_pixels(mean[first : i_frame + 1, i], camera, i_frame),
            covariance=in_pixels[i],
            truth=truth[i],
        )
        for i in range(len(colours))
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
