from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bask_data.core.geometry import invert_rigid, project, transform
from bask_data.dataset import Dataset
from bask_data.engine import make, plan, state_of
from bask_data.kinds import Demonstration, DescriptorNet, ReferenceKeypoints, Scan, VisibleMasks
from bask_data.progress import listened_by
from bask_data.stages.reference import as_text, parsed, reference
from tests.datasets import copied, publish_artifact
from tests.nn import pairs
from tests.picker.pickable import untrained
from tests.stages.learning import learning_dataset, publish_views

GOLDEN = Path(__file__).parent / "golden"


@pytest.fixture(scope="module")
def picked_on(pickable, tmp_path_factory) -> Dataset:
    """Two scans, a demonstration, a network, and the references that these tests make."""
    return copied(pickable, tmp_path_factory.mktemp("reference") / "d")


def made(dataset: Dataset, **options):
    [task] = plan(dataset, reference, options=options)
    return make(task, force=True)


def keypoints(dataset: Dataset, **options) -> ReferenceKeypoints:
    outcome = made(dataset, **options)
    assert outcome.status == "made", outcome.why
    return ReferenceKeypoints(dataset.path(ReferenceKeypoints))


def test_keypoints_lie_on_the_objects_with_measured_depth(picked_on):
    found = keypoints(picked_on, n=8)
    _, world_from_cameras, images = pairs.views(4, 0)
    assert found.descriptors.shape == (8, 8)
    # Three objects share eight points.
    assert [pick.instance for pick in found.picks] == [1, 1, 1, 2, 2, 2, 3, 3]
    assert len(set(found.names)) == 8
    for pick in found.picks:
        image = images[pick.frame]
        row, column = round(pick.v), round(pick.u)
        assert pick.recording == "a"
        assert image.instance[row, column] == pick.instance
        camera_from_world = invert_rigid(world_from_cameras[pick.frame])
        uv, z = project(transform(camera_from_world, np.array(pick.point_world)), pairs.K)
        np.testing.assert_allclose(uv, [pick.u, pick.v], atol=1e-6)
        assert z == pytest.approx(image.depth[row, column], abs=1e-4)


def test_descriptors_are_those_of_the_network_at_the_picks(picked_on):
    found = keypoints(picked_on, n=4)
    _, _, images = pairs.views(4, 0)
    for pick, descriptor in zip(found.picks, found.descriptors, strict=True):
        uv = np.array([[pick.u, pick.v]], np.float32)
        expected = untrained().descriptors_at(images[pick.frame].rgb, uv)[0]
        np.testing.assert_allclose(descriptor, expected.numpy(), atol=1e-4)


def test_the_same_seed_gives_the_same_bytes_and_another_other_points(picked_on):
    first = made(picked_on, n=4, seed=1)
    assert made(picked_on, n=4, seed=1).digest == first.digest
    assert made(picked_on, n=4, seed=2).digest != first.digest


def test_progress_is_told_several_times_an_object_and_ends_where_it_said(picked_on):
    calls = []
    with listened_by(lambda *call: calls.append(call)):
        made(picked_on, n=4)
        made(picked_on, picks=("a:wrist:1:40.5:50:corner", "b:wrist:0:10:20"))
    chosen = [(done, total) for label, done, total in calls if label == "choosing keypoints"]
    assert len(chosen) > 15 * 3
    assert chosen == sorted(chosen)
    assert chosen[-1][0] == chosen[-1][1] == chosen[0][1]
    assert [call for call in calls if call[0] == "describing keypoints"] == [
        ("describing keypoints", done, 2) for done in range(3)
    ]


def test_scene_and_instances_can_be_named(picked_on):
    found = keypoints(picked_on, n=3, scene="b", instances=(2,))
    assert {(pick.recording, pick.instance) for pick in found.picks} == {("b", 2)}


def test_points_of_an_object_are_spread_over_it(picked_on):
    points = np.array([pick.point_world for pick in keypoints(picked_on, n=6, instances=(1,)).picks])
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)[np.triu_indices(6, 1)]
    # The objects measure 4 to 12 cm.
    assert apart.min() > 0.005
    assert apart.max() > 0.025


def test_points_by_hand_are_taken_as_they_are(picked_on):
    found = keypoints(picked_on, picks=("a:wrist:1:40.5:50:corner", "b:wrist:0:10:20"))
    assert found.names == ["corner", "point_1"]
    first, second = found.picks
    assert (first.recording, first.frame, first.u, first.v) == ("a", 1, 40.5, 50.0)
    assert (second.recording, second.frame, second.u, second.v) == ("b", 0, 10.0, 20.0)
    _, _, images = pairs.views(4, 0)
    assert first.instance == images[1].instance[50, 40]
    expected = untrained().descriptors_at(images[1].rgb, np.array([[40.5, 50.0]], np.float32))[0]
    np.testing.assert_allclose(found.descriptors[0], expected.numpy(), atol=1e-4)


def test_points_by_hand_may_lie_in_demonstrations(picked_on, tmp_path):
    copy = copied(picked_on, tmp_path / "copy")
    _, world_from_cameras, images = pairs.views(2, 7)
    depth = images[1].depth.copy()
    depth[20, 30] = 0
    images = [images[0], replace(images[1], depth=depth)]
    publish_views(copy, "reach", pairs.K, world_from_cameras, images, Demonstration)
    found = keypoints(copy, picks=("reach:wrist:1:40:50:corner", "reach:wrist:1:30:20:hole", "b:wrist:0:40:50"))
    assert [pick.recording for pick in found.picks] == ["reach", "reach", "b"]
    corner, hole, _ = found.picks
    # A demonstration has no masks.
    assert (corner.instance, hole.point_world) == (0, None)
    uv, z = project(transform(invert_rigid(world_from_cameras[1]), np.array(corner.point_world)), pairs.K)
    np.testing.assert_allclose(uv, [40, 50], atol=1e-6)
    assert z == pytest.approx(images[1].depth[50, 40], abs=1e-4)
    expected = untrained().descriptors_at(images[1].rgb, np.array([[40, 50]], np.float32))[0]
    np.testing.assert_allclose(found.descriptors[0], expected.numpy(), atol=1e-4)
    assert sorted(found.manifest.inputs) == ["demonstration/reach", "descriptor/main", "masks/b", "scan/b"]


def test_other_recordings_do_not_make_points_by_hand_stale(picked_on, tmp_path):
    copy = copied(picked_on, tmp_path / "copy")
    picks = {"picks": ("a:wrist:1:40.5:50",)}
    keypoints(copy, **picks)
    without_objects(copy, "b")
    [task] = plan(copy, reference, options=picks)
    assert state_of(task).status == "up to date"


def test_a_pick_is_written_as_it_is_read(picked_on):
    recordings = {"a": Scan(picked_on.path(Scan, "a"))}
    text = "a:wrist:1:40.5:50:top corner"
    assert as_text(parsed(text, "", recordings)[0]) == text


def test_automatic_choice_goes_over_picks(picked_on):
    automatic = keypoints(picked_on, n=3)
    assert keypoints(picked_on, n=3, picks=("a:wrist:1:40.5:50",), auto=True).picks == automatic.picks


class Colours:
    """Colours as descriptors: the stage without its network."""

    def describe(self, rgb):
        return torch.from_numpy(rgb).float().permute(2, 0, 1)

    def descriptors_at(self, rgb, uv):
        column, row = uv.astype(int).T
        return torch.from_numpy(rgb[row, column]).float()


def test_golden(tmp_path, monkeypatch):
    """If this differs, mend the code, or raise the stage's version and write the file anew."""
    monkeypatch.setattr(DescriptorNet, "network", lambda net: Colours())
    # One view: with none to find points again in, the choice depends on no distance that rounding could tip.
    dataset = learning_dataset(tmp_path / "d", n_views=1)
    publish_artifact(
        dataset, DescriptorNet, "", lambda out: DescriptorNet.write(out, validated_on="", metrics={}, curve=[])
    )
    found = keypoints(dataset, n=7)
    values = {
        "descriptors": found.descriptors,
        "uv": np.array([(pick.u, pick.v) for pick in found.picks]),
        "instance": np.array([pick.instance for pick in found.picks]),
        "points_world": np.array([pick.point_world for pick in found.picks]),
    }
    file = GOLDEN / f"reference_v{reference.version}.npz"
    if os.environ.get("BASK_WRITE_GOLDEN"):
        np.savez_compressed(file, **values)
    golden = np.load(file)
    assert set(golden.files) == set(values)
    for name in golden.files:
        np.testing.assert_allclose(values[name], golden[name], atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scene": "z"}, r"reference: scene: expected one of a, b, got z"),
        ({"instances": (9,)}, r"reference: instances: expected objects of a, 1..3, got \[9\]"),
        ({"n": 50000}, r"instance 1: expected 16667 pixels with measured depth, got \d+.  fix: ask for fewer"),
        ({"picks": ("a:wrist:1",)}, r"picks: expected recording:camera:frame:u:v or .*, got a:wrist:1"),
        (
            {"picks": ("z:wrist:1:2:3",)},
            r"picks: expected the name of a scan or demonstration of the dataset, got z:wrist:1:2:3",
        ),
        ({"picks": ("a:top:1:2:3",)}, r"picks: expected one of the cameras wrist, got a:top"),
        ({"picks": ("a:wrist:x:2:3",)}, r"picks: expected numbers for frame, u and v, got a:wrist:x"),
        ({"picks": ("a:wrist:4:2:3",)}, r"picks: expected frame 0..3, u 0..127, v 0..95, got a:wrist:4"),
        ({"picks": ("a:wrist:0:nan:3",)}, r"picks: expected frame 0..3, u 0..127, v 0..95, got a:wrist:0:nan"),
        ({"picks": ("a:wrist:0:2:3:p", "a:wrist:0:5:3:p")}, r"picks: expected names that differ, got p twice"),
    ],
)
def test_what_does_not_exist_is_refused(picked_on, options, message):
    outcome = made(picked_on, **options)
    assert outcome.status == "failed"
    assert re.search(message, outcome.why), outcome.why


def without_objects(dataset: Dataset, name: str) -> None:
    """Replace a scene's masks by ones of no object."""

    def fill(out: Path) -> None:
        camera = Scan(dataset.path(Scan, name)).cameras[0]
        with VisibleMasks.writer(out, 0) as writer:
            stream = writer.camera(camera.name, camera.n_frames, camera.height, camera.width)
            for _ in range(camera.n_frames):
                stream.append(np.zeros((camera.height, camera.width), dtype=np.uint8), np.zeros(0, dtype=np.float32))

    publish_artifact(dataset, VisibleMasks, name, fill)


def test_scenes_without_objects_are_passed_over(picked_on, tmp_path):
    copy = copied(picked_on, tmp_path / "copy")
    names = copy.items("scene")
    without_objects(copy, names[0])
    assert {pick.recording for pick in keypoints(copy).picks} == {names[1]}
    for name in names[1:]:
        without_objects(copy, name)
    assert "masks: expected an object in some scene, got none in any" in made(copy).why
