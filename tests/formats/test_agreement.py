from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid, pixel_grid, unproject
from bask_data.formats.agreement import agreement, better_options, is_doubtful
from bask_data.formats.recording import CameraRecording

K = np.array([[100.0, 0, 39.5], [0, 100.0, 29.5], [0, 0, 1]])


def turned(angle: float, offset: tuple[float, float, float]) -> Float[ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    matrix[:3, 3] = offset
    return matrix


def camera_before_a_wall(world_from_cameras: Float[ndarray, "t 4 4"]) -> CameraRecording:
    """A camera that sees the plane z = 1 + x / 2 in the world frame, with analytic depth."""

    def read(i: int) -> tuple[ndarray, ndarray]:
        world_from_camera = world_from_cameras[i]
        rays = unproject(pixel_grid(60, 80), np.ones((60, 80)), K) @ world_from_camera[:3, :3].T
        x, _, z = world_from_camera[:3, 3]
        depth = (1 + x / 2 - z) / (rays[..., 2] - rays[..., 0] / 2)
        return np.zeros((60, 80, 3), np.uint8), np.rint(1e4 * depth).astype(np.uint16)

    return CameraRecording(
        "c", K, 60, 80, 1e-4, world_from_cameras, np.arange(len(world_from_cameras), dtype=float), read
    )


POSES = np.stack([turned(0.1 * i, (0.05 * i, 0.0, 0.02 * i)) for i in range(4)])


def test_exact_poses_agree_with_the_depth_of_a_wall() -> None:
    text = agreement(camera_before_a_wall(POSES), {})
    assert text.startswith("100% of the depth of a frame") and not is_doubtful(text) and not better_options(text)


def test_a_better_interpretation_of_the_poses_is_named() -> None:
    camera = camera_before_a_wall(POSES)
    wrong = CameraRecording("c", K, 60, 80, 1e-4, invert_rigid(POSES), camera.time, camera.read)
    text = agreement(wrong, {"--pose-is other": POSES, "--axes worse": invert_rigid(POSES) @ POSES})
    assert text.endswith("with --pose-is other it would be 100%: look at the options")
    assert is_doubtful(text) and better_options(text) == "--pose-is other"


def test_disagreement_without_a_better_interpretation_is_reported() -> None:
    camera = camera_before_a_wall(POSES)
    # A wrong scale alone would hardly show: these cameras mostly rotate, which does not depend on the scale.
    scaled = CameraRecording("c", K * [[2], [2], [1]], 60, 80, 5e-4, POSES, camera.time, camera.read)
    text = agreement(scaled, {})
    assert text.endswith("look at the poses, the intrinsics and the depth scale")
    assert is_doubtful(text) and not better_options(text)


def test_a_single_frame_cannot_be_compared() -> None:
    text = agreement(camera_before_a_wall(POSES[:1]), {})
    assert text == "a single frame: nothing to hold the poses against" and not is_doubtful(text)
