"""Keypoints of a demonstration."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from bask_data.errors import BadData
from bask_data.kinds import Demonstration, DescriptorNet, KeypointTrack, ReferenceKeypoints
from bask_data.stage import Params, progress, stage

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.bayes_filter import Settings
    from bask_data.core.heatmap import Motion

Distances = Callable[["np.ndarray"], "np.ndarray"]
"""From a colour image (h, w, 3) uint8 to its distance maps (k, h', w') float32, of any resolution."""


class EncodeParams(Params):
    """The filter and its settings."""

    filter: Literal["expectation", "discrete", "particle"] = Field(
        "particle",
        description="expectation: each frame by itself. discrete: belief over pixels. particle: belief over 3D points, "
        "which remembers what is hidden or out of view.",
    )
    alpha: float | None = Field(
        None,
        gt=0,
        description="Temperature: a pixel at descriptor distance z has likelihood exp(-alpha z). "
        "Default: 4; expectation: 20, because the many pixels of background outweigh the match at less.",
    )
    tau: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="Likelihood of an image if the keypoint is hidden or out of view. "
        "Default: from each image, twice the likelihood of its average pixel.",
    )
    n_particles: int = Field(2000, ge=10, description="Particles of each keypoint.")
    walk: float = Field(0.002, ge=0, description="Particle: random walk in one frame and along each axis, metres.")
    walk_px: float = Field(1.0, ge=0, description="Discrete: random walk in one frame, pixels of the distance map.")
    gripper_probability: float = Field(
        0.5, ge=0, le=1, description="Particle: probability that a particle near the gripper moves with it."
    )
    gripper_reach: float = Field(
        0.15, ge=0, description="Particle: metres around the gripper within which particles may move with it."
    )
    seed: int = Field(0, ge=0, description="Seed of the particle filter.")


@stage(makes=KeypointTrack, version=1)
def encode(
    demonstration: Demonstration,
    descriptor: DescriptorNet,
    reference: ReferenceKeypoints,
    params: EncodeParams,
    out: Path,
) -> None:
    """Track the reference keypoints through a demonstration, in 3D.

    One frame is in memory at a time. All cameras of the demonstration are used; their frames belong together by number.
    """
    track(demonstration, describer(descriptor, reference), reference.names, params, out)


def track(
    demonstration: Demonstration, distances: Distances, names: list[str], params: EncodeParams, out: Path
) -> None:
    """Filter every frame of a demonstration and write the track."""
    import numpy as np

    from bask_data.core.bayes_filter import step
    from bask_data.core.geometry import scale_pixels
    from bask_data.core.heatmap import Observation, fitted

    cameras = demonstration.cameras
    n_frames = cameras[0].n_frames
    for camera in cameras:
        if camera.n_frames != n_frames:
            raise BadData(
                demonstration.path,
                f"camera {camera.name}",
                expected=f"as many frames as camera {cameras[0].name} ({n_frames})",
                got=f"{camera.n_frames}",
                fix="ingest the cameras with frames that were taken together.",
            )
    settings, rng, belief = settings_of(params), np.random.default_rng(params.seed), None
    motions = gripper_motions(demonstration, n_frames)
    with KeypointTrack.writer(
        out, names=names, filter=params.filter, cameras=[camera.name for camera in cameras]
    ) as writer:
        for i_frame in progress(range(n_frames), "tracking keypoints"):
            observations = [
                fitted(
                    Observation(
                        distance=distances(camera.rgb(i_frame)),
                        depth=camera.depth(i_frame),
                        K=camera.K,
                        world_from_camera=camera.world_from_cameras[i_frame],
                    )
                )
                for camera in cameras
            ]
            belief, estimate = step(belief, observations, motions[i_frame], rng, settings)
            writer.append(
                mean=estimate.mean,
                covariance=estimate.covariance,
                mode=estimate.mode,
                n_eff=estimate.n_eff,
                log_evidence=estimate.log_evidence,
                cameras={
                    camera.name: (
                        scale_pixels(estimate.pixel[i], seen.depth.shape, (camera.height, camera.width)),
                        estimate.observed[i],
                    )
                    for i, (camera, seen) in enumerate(zip(cameras, observations, strict=True))
                },
            )


def settings_of(params: EncodeParams) -> Settings:
    """The settings of the chosen filter."""
    from bask_data.core.bayes_filter import DiscreteSettings, ExpectationSettings, ParticleSettings

    if params.filter == "expectation":
        return ExpectationSettings(alpha=params.alpha or 20.0)
    if params.filter == "discrete":
        return DiscreteSettings(alpha=params.alpha or 4.0, tau=params.tau, walk_px=params.walk_px)
    return ParticleSettings(
        n_particles=params.n_particles,
        alpha=params.alpha or 4.0,
        tau=params.tau,
        walk=params.walk,
        gripper_probability=params.gripper_probability,
        gripper_reach=params.gripper_reach,
    )


def gripper_motions(demonstration: Demonstration, n_frames: int) -> list[Motion | None]:
    """The gripper's motion before each frame; None before the first, and without a record of it."""
    from bask_data.core.heatmap import Motion

    robot = demonstration.robot
    if robot is None or robot.world_from_gripper is None:
        return [None] * n_frames
    grippers = robot.world_from_gripper
    if len(grippers) != n_frames:
        raise BadData(
            demonstration.path,
            "robot/world_from_gripper",
            expected=f"one transform for each of the {n_frames} frames",
            got=f"{len(grippers)}",
            fix="ingest the demonstration again.",
        )
    return [None, *(Motion(grippers[i - 1], grippers[i]) for i in range(1, n_frames))]


def describer(descriptor: DescriptorNet, reference: ReferenceKeypoints) -> Distances:
    """The network and the references as one function from images to distance maps."""
    network, references = descriptor.network(), reference.descriptors
    dimension = network.settings.descriptor_dim
    if references.shape[1] != dimension:
        raise BadData(
            reference.path,
            "descriptors",
            expected=f"{dimension} values each, as the network gives",
            got=f"{references.shape[1]}",
            fix="run `bask-data reference` again with this network.",
        )
    return lambda rgb: network.distance_maps(rgb, references)
