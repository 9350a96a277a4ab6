from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.drift_refinement import interpolated
from bask_data.core.geometry import invert_rigid, rotation_angle, view_change
from bask_data.core.pair_alignment import aligned, as_vector, moved, residual
from bask_data.core.pose_refinement import Refinement, refined
from bask_data.core.surface_views import fixed_to_camera, meetings, surface_view
from tests.posed_scenes import HAND_EYE, HEIGHT, SCENE, WIDTH, K, drifting, orbiting, recorded, with_hand_eye_error
from tests.scenes import Plane, Scene, look_at


def refinement_of(depths: list[np.ndarray], poses: np.ndarray, model: str = "auto") -> Refinement:
    return refined(lambda i: depths[i], np.stack([K] * len(depths)), poses, model)  # type: ignore[arg-type]


def difference(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Millimetres and degrees between two transforms."""
    change = invert_rigid(a) @ b
    return 1000 * float(np.linalg.norm(change[:3, 3])), float(np.degrees(rotation_angle(change[:3, :3])))


def test_a_hand_eye_error_of_10_mm_and_2_degrees_is_found() -> None:
    depths, true = recorded("orbiting")
    made = refinement_of(depths, with_hand_eye_error(true))
    assert (made.model, made.verdict) == ("hand-eye", "refined"), made.why
    assert made.given_from_true is not None
    shift, angle = difference(HAND_EYE, made.given_from_true)
    assert shift < 1 and angle < 0.15
    assert made.before is not None and made.after is not None
    assert made.after.mean < 0.6 * made.before.mean
    distance, turn = view_change(true, made.world_from_cameras)
    assert distance.max() < 0.001 and np.degrees(turn.max()) < 0.15


def test_right_poses_stay_as_they_are() -> None:
    depths, true = recorded("orbiting")
    made = refinement_of(depths, true)
    assert (made.model, made.verdict) == ("none", "no better")
    assert np.array_equal(made.world_from_cameras, true)
    assert made.given_from_true is None


def test_drift_is_told_from_a_hand_eye_error_and_taken_out() -> None:
    depths, true = recorded("orbiting")
    given = drifting(true)
    made = refinement_of(depths, given)
    assert (made.model, made.verdict) == ("drift", "refined"), made.why
    np.testing.assert_allclose(made.world_from_cameras[0], given[0], atol=1e-9)
    error = np.linalg.norm((invert_rigid(true[0]) @ true)[:, :3, 3] - relative(made.world_from_cameras), axis=1)
    before = np.linalg.norm((invert_rigid(true[0]) @ true)[:, :3, 3] - relative(given), axis=1)
    assert error.mean() < 0.35 * before.mean()


def relative(poses: np.ndarray) -> np.ndarray:
    """Positions of the cameras in the first one's frame."""
    return (invert_rigid(poses[0]) @ poses)[:, :3, 3]


@pytest.mark.parametrize("motion", ["sideways", "about_one_axis"])
def test_a_camera_that_turns_too_little_cannot_tell_a_hand_eye_error(motion: str) -> None:
    depths, true = recorded(motion)
    given = with_hand_eye_error(true)
    made = refinement_of(depths, given)
    assert made.verdict != "refined", (made.model, made.why)
    assert np.array_equal(made.world_from_cameras, given)


def test_a_camera_on_a_stand_cannot_tell() -> None:
    depths, true = recorded("orbiting")
    made = refinement_of(depths[:1] * 12, np.tile(true[:1], (12, 1, 1)))
    assert (made.verdict, made.why) == ("cannot tell", "the camera hardly moves")


def test_what_right_poses_of_a_poor_motion_leave_open_is_said() -> None:
    depths, true = recorded("sideways")
    made = refinement_of(depths, true, "hand-eye")
    assert made.verdict == "no better"
    assert "could not be told from this motion" in made.why


def test_frames_without_overlap_cannot_tell() -> None:
    poses = np.stack([look_at((0.5, 0.0, 0.4)), look_at((-0.5, 0.0, 0.4))])
    depths = [SCENE.render(K, pose, HEIGHT, WIDTH).depth for pose in poses]
    made = refinement_of(depths, poses)
    assert made.verdict == "cannot tell"
    assert "pairs of frames see the same surfaces" in made.why


def test_frames_without_depth_cannot_tell() -> None:
    made = refinement_of([np.zeros((HEIGHT, WIDTH), np.float32)] * 6, orbiting()[:6])
    assert made.verdict == "cannot tell"


def test_points_and_normals_of_a_view_are_those_of_the_surface() -> None:
    pose = look_at((0.2, -0.3, 0.6))
    view = surface_view(Scene((), (Plane(),)).render(K, pose, HEIGHT, WIDTH).depth, K)
    assert len(view.points) > 700
    np.testing.assert_allclose(view.points @ pose[2, :3] + pose[2, 3], 0, atol=1e-6)
    np.testing.assert_allclose(view.normals @ pose[2, :3], 1, atol=1e-6)


def test_views_of_right_poses_meet_and_wrong_ones_do_not() -> None:
    depths, true = recorded("orbiting")
    a, b = surface_view(depths[4], K), surface_view(depths[6], K)
    b_from_a = invert_rigid(true[6]) @ true[4]
    wrong = b_from_a @ moved(np.array([0.02, 0, 0, 0, 0.005, 0.01]))
    assert residual(a, b, b_from_a) < 0.7 * residual(a, b, wrong)
    met = meetings(a, b, b_from_a)
    assert 0 < len(met.points_b) <= met.n_points == len(a.points)
    shift, angle = difference(b_from_a, aligned(a, b, wrong).b_from_a)
    assert shift < 2 and angle < 0.3


def test_alignment_keeps_the_guess_where_too_little_meets() -> None:
    view = surface_view(np.zeros((HEIGHT, WIDTH), np.float32), K)
    made = aligned(view, view, moved(np.array([0.1, 0, 0, 0, 0, 0])))
    assert not made.is_measured
    assert np.array_equal(made.b_from_a, moved(np.array([0.1, 0, 0, 0, 0, 0])))
    assert np.isnan(residual(view, view, np.eye(4)))


def test_a_gripper_in_view_is_fixed_to_the_camera_and_nothing_else_is() -> None:
    depths, true = recorded("orbiting")
    for depth in depths:
        assert depth.shape == (HEIGHT, WIDTH)
    held = [depth.copy() for depth in depths]
    for depth in held:
        depth[90:, 60:100] = 0.2
    fixed = fixed_to_camera(held, true)
    assert fixed[90:, 60:100].all()
    assert fixed.sum() < 1.2 * 30 * 40
    assert not fixed_to_camera(held[:3], true[:3]).any()


def test_a_gripper_in_view_does_not_disturb_the_correction() -> None:
    depths, true = recorded("orbiting")
    held = [depth.copy() for depth in depths]
    for depth in held:
        depth[80:, 50:110] = 0.2
    made = refinement_of(held, with_hand_eye_error(true), "hand-eye")
    assert made.given_from_true is not None, made.why
    shift, angle = difference(HAND_EYE, made.given_from_true)
    assert shift < 2 and angle < 0.3


def test_frames_between_are_corrected_in_proportion() -> None:
    given = orbiting()
    change = moved(np.array([0, 0, 0.02, 0.01, 0, 0]))
    corrected = np.stack([given[0], given[8] @ change])
    every = interpolated(corrected, given[:9], [0, 8])
    np.testing.assert_allclose(every[8], given[8] @ change, atol=1e-12)
    distance, angle = view_change(given[:9], every)
    np.testing.assert_allclose(distance, 0.01 * np.arange(9) / 8, atol=1e-9)
    np.testing.assert_allclose(angle, 0.02 * np.arange(9) / 8, atol=1e-9)


def test_a_vector_and_its_transform_are_the_same() -> None:
    vector = np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(as_vector(moved(vector)), vector)
