"""Metres per unit of a model, from the depth of its images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bask_data.core.geometry import project
from bask_data.core.lens import Lens
from bask_data.core.metric_scale import LEAST_RATIOS, MetricScale, depth_log_ratios, metric_scale
from bask_data.errors import BadData
from bask_data.formats.alignment import aligned
from bask_data.formats.colmap.model import ImagePose, SparseModel
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.recording import SourceCamera

N_IMAGES = 30
"""Images, spread over the model, that the scale is measured in. Sensitivity not measured."""

MOST_SPREAD = 0.04
"""Largest standard deviation of the scale between images; more, and depth belongs to other images, or the model is
bent. Of 25 images of a table it was 0.004; with the depth of the image 5 further 0.05, in reverse order 0.06. A Kinect
in a room has 0.009."""

MOST_POINT_SPREAD = 0.1
"""As `MOST_SPREAD`, between the points of an image. It was 0.02; with the depth of the image 5 further 0.1, in reverse
order 0.15. A Kinect in a room has 0.04."""


def model_scale(
    source: Path, camera: SourceCamera, poses: dict[int, ImagePose], model: SparseModel, options: SourceOptions
) -> MetricScale:
    """Metres per unit of the model: measured depth over the depth of its points.

    Args:
        camera: with the lens and the depth of the images.
        poses: registered images with depth, by the frame's index.

    Raises:
        BadData: depth cannot be read, lies on too few points, or does not agree with the model.
    """
    chosen = sorted(poses)
    chosen = [chosen[k] for k in np.unique(np.linspace(0, len(chosen) - 1, min(N_IMAGES, len(chosen))).astype(int))]
    frames = aligned(source, camera, chosen, options)
    ratios = []
    for k, i in enumerate(chosen):
        lens = Lens(frames.K, frames.size).at(k)
        uv, z = project(model.points_camera(poses[i]), lens.K)
        ratios.append(depth_log_ratios(uv, z, frames.read_depth(k) * frames.depth_scale))
    scale = metric_scale(ratios)
    if scale is None:
        raise BadData(
            source,
            "depth",
            expected=f"depth at {LEAST_RATIOS} points of the model in an image, to know its scale by",
            got=f"at most {max(len(each) for each in ratios)}, of {model.n_points} points of {model.n_registered} "
            "registered images",
            fix="check --depth; if the model has few points or images, take images with more texture and overlap.",
        )
    if not options.trust and (scale.spread > MOST_SPREAD or scale.point_spread > MOST_POINT_SPREAD):
        raise BadData(
            source,
            "scale",
            expected="the same ratio of depth to the model everywhere",
            got=f"{scale.spread:.1%} standard deviation between images, {scale.point_spread:.1%} between points: "
            "depth and model do not agree",
            fix="check that --depth pairs each image with its own depth, and the intrinsics of both; --trust takes the "
            "median all the same.",
        )
    return scale


def metric(pose: ImagePose, metres_per_unit: float) -> np.ndarray:
    """world_from_camera of a registered image, metres."""
    assert pose.world_from_camera is not None
    result = pose.world_from_camera.copy()
    result[:3, 3] *= metres_per_unit
    return result


def in_words(scale: MetricScale) -> str:
    """The scale, its spread and what it is from."""
    return (
        f"{scale.metres_per_unit:.9g} m per unit of the model, from depth at {scale.n_points} points in "
        f"{scale.n_images} images; standard deviation {scale.spread:.2%} between images, {scale.point_spread:.2%} "
        "between points"
    )
