from __future__ import annotations

from pathlib import Path

import numpy as np

from bask_data.core.geometry import in_image, invert_rigid, project, transform
from bask_data.dataset import Dataset
from bask_data.evaluation.lookup import find_recording
from bask_data.evaluation.reference_points import BEHIND, OUTSIDE, SEEN, UNKNOWN, TruePlaces, reference_points
from bask_data.kinds import Pick, ReferenceKeypoints, Truth, VisibleMasks
from bask_data.kinds.truth import TruthMetadata
from tests.datasets import copied, publish_artifact
from tests.report.filled import (
    HEIGHT,
    LABELS,
    WIDTH,
    Views,
    make_views,
    publish_frames,
    publish_scene,
    publish_truth,
    true_places,
)


def picks_of(dataset: Dataset) -> list[Pick]:
    return ReferenceKeypoints(dataset.path(ReferenceKeypoints)).picks


def camera_of(dataset: Dataset, name: str):
    recording = find_recording(dataset, name)
    assert recording is not None
    return recording.cameras[0]


def expected_pixels(points: np.ndarray, seen: Views, i_frame: int) -> tuple[np.ndarray, list[str]]:
    """By the scene's own depth."""
    uv, z = project(transform(invert_rigid(seen.world_from_cameras[i_frame]), points), seen.K)
    states = []
    for (u, v), far, inside in zip(uv, z, in_image(uv, HEIGHT, WIDTH), strict=True):
        if not inside:
            states.append(OUTSIDE)
        else:
            states.append(BEHIND if far > seen.views[i_frame].depth[round(v), round(u)] + 0.02 else SEEN)
    return uv, states


# Truth ----------------------------------------------------------------------------------------------------------------


def test_a_point_is_where_the_cameras_and_poses_of_objects_put_it(filled_with_network):
    scan, demonstration = make_views(0.3, 6), make_views(0.8, 5)
    picks = picks_of(filled_with_network)
    points = np.array([pick.point_world for pick in picks])
    found = set()
    for name, seen, places in (("scan-a", scan, points), ("demo-a", demonstration, true_places(scan, demonstration))):
        true = TruePlaces(filled_with_network, picks, name)
        for i_frame in range(len(seen.views)):
            uv, states = expected_pixels(places, seen, i_frame)
            told = true.pixels(camera_of(filled_with_network, name), i_frame)
            np.testing.assert_allclose(told.uv, uv, atol=0.05)
            assert told.states == states
            found |= set(states)
    np.testing.assert_allclose(true.places[0], places, atol=1e-3)
    assert {SEEN, BEHIND} <= found


def test_a_point_outside_the_image_is_out_of_view(filled_with_network):
    picks = [picks_of(filled_with_network)[0].model_copy(update={"point_world": (9.0, 0.0, 0.0)})]
    told = TruePlaces(filled_with_network, picks, "scan-a").pixels(camera_of(filled_with_network, "scan-a"), 0)
    assert told.states == [OUTSIDE]


def test_objects_are_known_by_their_names_not_their_numbers(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    scan, demonstration = make_views(0.3, 6), make_views(0.8, 5)
    renumbered = dict(zip(LABELS[::-1], demonstration.world_from_boxes, strict=True))

    def fill(out: Path) -> None:
        names = {LABELS[1]: "stems", LABELS[0]: "tissue box"}
        poses = {label: pose.tolist() for label, pose in renumbered.items()}
        Truth.write(out, names, {"wrist": (5, (HEIGHT, WIDTH), demonstration.labels)}, poses)

    publish_artifact(dataset, Truth, "demo-a", fill)
    places = TruePlaces(dataset, picks_of(dataset), "demo-a").places
    np.testing.assert_allclose(places[0], true_places(scan, demonstration), atol=1e-3)


def test_points_move_with_their_objects(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    scan, demonstration = make_views(0.3, 6), make_views(0.8, 5)
    poses = np.tile(np.stack(demonstration.world_from_boxes), (5, 1, 1, 1))
    poses[:, 0, 2, 3] += 0.02 * np.arange(5)
    noisy = demonstration.world_from_cameras + np.array([[0, 0, 0, 0.001]] * 3 + [[0, 0, 0, 0]])

    def fill(out: Path) -> None:
        metadata = TruthMetadata(
            label_names=dict(zip(LABELS, ("stems", "tissue box"), strict=True)), object_labels=list(LABELS)
        )
        with Truth.writer(out, metadata, poses) as writer:
            camera = writer.camera("wrist", 5, (HEIGHT, WIDTH), 1e-4)
            for i in range(5):
                depth = np.round(demonstration.views[i].depth * 1e4).astype(np.uint16)
                camera.append(demonstration.labels(i), depth, noisy[i])

    publish_artifact(dataset, Truth, "demo-a", fill)
    true = TruePlaces(dataset, picks_of(dataset), "demo-a")
    still = true_places(scan, demonstration)
    for i in range(5):
        places = still + np.array([[0, 0, 0.02 * i], [0, 0, 0]])
        expected = project(transform(invert_rigid(noisy[i]), places), demonstration.K)[0]
        told = true.pixels(camera_of(dataset, "demo-a"), i)
        np.testing.assert_allclose(told.uv, expected, atol=0.05)


def test_points_without_ground_truth_are_unknown(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    seen = make_views(0.8, 5)
    labels = {"wrist": (5, (HEIGHT, WIDTH), seen.labels)}
    publish_artifact(dataset, Truth, "demo-a", lambda out: Truth.write(out, {LABELS[0]: "stems"}, labels))
    true = TruePlaces(dataset, picks_of(dataset), "demo-a")
    assert true.pixels(camera_of(dataset, "demo-a"), 0).states == [UNKNOWN, UNKNOWN]
    assert true.absent == [False, True]
    assert np.isnan(true.places).all() and true.known == [False, False]


# Networks -------------------------------------------------------------------------------------------------------------


def test_the_points_are_those_of_the_first_variant_that_has_reference_keypoints(filled_with_network):
    assert reference_points(filled_with_network, ["other", "main"]) == picks_of(filled_with_network)


def test_without_reference_keypoints_points_lie_well_inside_the_objects_of_one_frame(filled_with_network):
    picks = reference_points(filled_with_network, ["other"])
    assert [sum(pick.instance == i for pick in picks) for i in (1, 2)] == [8, 8]
    (where,) = {(pick.recording, pick.camera, pick.frame) for pick in picks}
    assert where[:2] == ("scan-a", "wrist")
    instance = VisibleMasks(filled_with_network.path(VisibleMasks, "scan-a")).camera("wrist").instance(where[2])
    for pick in picks:
        around = instance[round(pick.v) - 1 : round(pick.v) + 2, round(pick.u) - 1 : round(pick.u) + 2]
        assert (around == pick.instance).all()
    scan = make_views(0.3, 6)
    uv, states = expected_pixels(np.array([pick.point_world for pick in picks]), scan, where[2])
    np.testing.assert_allclose(uv, [[pick.u, pick.v] for pick in picks], atol=0.05)
    assert states == [SEEN] * 16
    for i in (1, 2):
        mine = uv[[pick.instance == i for pick in picks]]
        extent = np.ptp(np.argwhere(instance == i), axis=0).max()
        assert np.ptp(mine, axis=0).max() > 0.5 * extent, "spread over the object"


def test_each_set_of_objects_has_points_of_its_own_with_the_names_of_its_objects(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    seen = make_views(0.5, 6)
    for name, label_name in (("scan-b", "tissue box"), ("scan-c", "toaster")):
        publish_frames(dataset, name, seen)
        publish_truth(dataset, name, seen, label_name)
        publish_scene(dataset, name, seen)
    picks = reference_points(dataset, ["other"])
    assert {pick.recording for pick in picks} == {"scan-a", "scan-c"}, "scan-b shows what scan-a shows"
    assert {pick.name for pick in picks if pick.recording == "scan-c"} == {"stems", "toaster"}
    true = TruePlaces(dataset, picks, "scan-b")
    assert [pick.name == "toaster" for pick in picks] == true.absent


def test_an_empty_dataset_has_no_points(tmp_path):
    assert reference_points(Dataset.create(tmp_path / "d"), ["main"]) == []
