from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid, transform
from bask_data.kinds import Pick, Truth
from bask_data.kinds.places import Known, ObjectPoints, carried, object_poses, picked_point, points_on_objects
from bask_data.kinds.truth import TruthMetadata
from tests import scenes

SIZE, N_FRAMES, DEPTH = (6, 8), 3, 1.5
POSE = scenes.look_at(np.array([0.2, -0.1, 1.0]), np.zeros(3))
PICK = Pick(name="a", recording="scan", camera="wrist", frame=1, u=4.0, v=3.0)


def moving() -> np.ndarray:
    """Poses of objects 5 and 7 in each frame (t, 2, 4, 4): the first is static, the second moves along x."""
    poses = np.tile(np.eye(4), (N_FRAMES, 2, 1, 1))
    poses[:, 0, :3, 3] = [1.0, 2.0, 3.0]
    poses[:, 1, 0, 3] = 0.1 * np.arange(N_FRAMES)
    return poses


@pytest.fixture
def truth(tmp_path: Path) -> Truth:
    """Ground truth in which every pixel shows object 7 at the same depth."""
    metadata = TruthMetadata(
        label_names={5: "cup", 7: "lid", 9: "lid", 11: "bin"},
        object_labels=[5, 7],
        world_from_object={11: scenes.look_at(np.ones(3), np.zeros(3)).tolist()},
    )
    with Truth.writer(tmp_path, metadata, moving()) as writer:
        camera = writer.camera("wrist", N_FRAMES, SIZE, 1e-4)
        for _ in range(N_FRAMES):
            camera.append(np.full(SIZE, 7, np.uint8), np.full(SIZE, round(DEPTH * 1e4), np.uint16), POSE)
    return Truth(tmp_path)


def test_a_pick_is_moved_to_exact_depth_on_its_ray(truth: Truth) -> None:
    camera = np.array([0.3, -0.2, DEPTH])
    measured = transform(POSE, 1.02 * camera)
    pick = PICK.model_copy(update={"point_world": tuple(measured.tolist())})
    np.testing.assert_allclose(picked_point(pick, Known(None, truth)), transform(POSE, camera), atol=1e-6)
    np.testing.assert_allclose(picked_point(pick, Known(None, None)), measured)
    np.testing.assert_allclose(picked_point(pick, None), measured)
    assert picked_point(PICK, Known(None, truth)) is None


def test_a_point_is_in_the_frame_of_the_object_it_was_picked_on(truth: Truth) -> None:
    point = transform(POSE, np.array([0.3, -0.2, DEPTH]))
    pick = PICK.model_copy(update={"point_world": tuple(point.tolist())})
    elsewhere = pick.model_copy(update={"recording": "other"})
    points = points_on_objects([pick, elsewhere], {"scan": Known(None, truth)})
    assert points.labels == (7, -1) and points.names == ("lid", "")
    np.testing.assert_allclose(points.points_object[0], point - [0.1, 0.0, 0.0], atol=1e-6)
    assert np.isnan(points.points_object[1]).all()


def test_points_move_with_their_objects(truth: Truth) -> None:
    still = np.array(truth.metadata.world_from_object[11])
    # The last two are known by name under another label, and missing in this recording.
    points = ObjectPoints(
        labels=(5, 7, 11, 3, 4), names=("cup", "lid", "bin", "cup", "spoon"), points_object=np.full((5, 3), 0.5)
    )
    places = carried(points, truth, N_FRAMES)
    assert places.shape == (N_FRAMES, 5, 3)
    np.testing.assert_allclose(places[:, 0], np.tile([1.5, 2.5, 3.5], (N_FRAMES, 1)))
    np.testing.assert_allclose(places[:, 1], np.full(3, 0.5) + 0.1 * np.arange(N_FRAMES)[:, None] * [1, 0, 0])
    np.testing.assert_allclose(places[:, 2], np.tile(transform(still, np.full(3, 0.5)), (N_FRAMES, 1)))
    np.testing.assert_allclose(places[:, 3], places[:, 0])
    assert np.isnan(places[:, 4]).all()


def test_points_of_an_object_without_a_pose_are_unknown(truth: Truth) -> None:
    assert set(object_poses(truth)) == {5, 7, 11}
    points = ObjectPoints(labels=(9,), names=("lid",), points_object=invert_rigid(POSE)[:3, 3][None])
    assert np.isnan(carried(points, truth, N_FRAMES)).all()
