from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from bask_data.core.filters.table import settings_named
from bask_data.kinds import Demonstration, Pick, ReferenceKeypoints, Robot
from bask_data.nn.network import DescriptorNetwork, NetworkSettings
from bask_data.observing import FrameObservations, FrameObserver, View, moment_of
from bask_data.tracker import KeypointTracker, TrackedKeypoints
from tests.tracked import N_FRAMES, ColourNetwork, dataset_of, keypoints, poses, side_poses

STEP = np.array([0.0, 0.006, 0.008])
"""Metres that the gripper moves in each frame."""

SIZE, BEFORE = 256, 1.5


@pytest.fixture(scope="module")
def demonstration(tmp_path_factory: pytest.TempPathFactory) -> Demonstration:
    """The gripper is at the first keypoint and moves away, while nothing else does."""
    grippers = np.tile(np.eye(4), (N_FRAMES, 1, 1))
    grippers[:, :3, 3] = keypoints()[1][0] + np.arange(N_FRAMES)[:, None] * STEP
    cameras = {"side": side_poses(), "wrist": poses()}
    dataset = dataset_of(tmp_path_factory.mktemp("observed") / "d", cameras, Robot(world_from_gripper=grippers))
    return Demonstration(dataset.path(Demonstration, "reach"))


@pytest.fixture
def reference(demonstration: Demonstration) -> ReferenceKeypoints:
    return ReferenceKeypoints(demonstration.path.parents[1] / "reference" / "main")


def step(tracker: KeypointTracker, demonstration: Demonstration, i_frame: int, *names: str) -> TrackedKeypoints:
    moment = moment_of([demonstration.camera(name) for name in names], i_frame)
    assert demonstration.robot is not None and demonstration.robot.world_from_gripper is not None
    return tracker.step(*moment, demonstration.robot.world_from_gripper[i_frame])


# Every n-th frame -----------------------------------------------------------------------------------------------------


def test_cameras_take_turns_after_the_first_step(demonstration: Demonstration, reference: ReferenceKeypoints) -> None:
    observer = FrameObserver(ColourNetwork(), reference, every=3)
    images = moment_of([demonstration.camera("side"), demonstration.camera("wrist")], 0).images

    def turn(i_step: int, cameras: list[str]) -> list[str]:
        return [name for names, _ in observer.describe(images, cameras, i_step) for name in names]

    assert [turn(i, ["wrist", "side"]) for i in range(6)] == [["side", "wrist"], [], ["side"], ["wrist"], [], ["side"]]
    assert [turn(i, []) for i in range(4)] == [["side", "wrist"], [], ["wrist"], ["side"]]


def test_the_network_sees_every_nth_frame_only(demonstration: Demonstration, reference: ReferenceKeypoints) -> None:
    network = ColourNetwork()
    tracker = KeypointTracker(network, reference, every=4)
    for i_frame in range(9):
        step(tracker, demonstration, i_frame, "side")
        assert set(tracker.observations) == ({"side"} if i_frame % 4 == 0 else set())
    assert network.n_images == 3


def test_between_described_frames_the_belief_moves_with_the_gripper(
    demonstration: Demonstration, reference: ReferenceKeypoints
) -> None:
    settings = settings_named("particle", gripper_probability=1.0, gripper_memory=0.0, walk=0.0005)
    tracker = KeypointTracker(ColourNetwork(), reference, settings, every=5)
    means = np.array([step(tracker, demonstration, i_frame, "side").mean for i_frame in range(5)])
    moved = means[1:] - means[:-1]
    np.testing.assert_allclose(moved[:, 0], np.tile(STEP, (4, 1)), atol=5e-4)
    np.testing.assert_allclose(moved[:, 1:], 0.0, atol=5e-4)


def test_a_described_frame_counts_twice(demonstration: Demonstration, reference: ReferenceKeypoints) -> None:
    plain, often, twice = (
        KeypointTracker(ColourNetwork(), reference, settings_named("particle", walk=1e-4), every=every)
        for every in (1, 2, 2)
    )
    once = step(plain, demonstration, 0, "side")
    found = step(often, demonstration, 0, "side")
    assert (found.n_eff < once.n_eff).all()
    np.testing.assert_array_equal(found.log_evidence, once.log_evidence)
    none = twice.update(FrameObservations({}, {}))
    assert np.isnan(none.mean).all() and twice.belief is None


@pytest.mark.parametrize("filter", ["expectation", "discrete", "particle"])
def test_between_described_frames_pixels_follow_the_camera(
    demonstration: Demonstration, reference: ReferenceKeypoints, filter: str
) -> None:
    tracker = KeypointTracker(ColourNetwork(), reference, settings_named(filter), every=3)
    seen = step(tracker, demonstration, 5, "wrist").observed["wrist"]
    assert seen.all()
    camera = demonstration.camera("wrist")
    for i_frame in (6, 7):  # The camera looks away here.
        found = step(tracker, demonstration, i_frame, "wrist")
        at = View(camera.Ks[i_frame], camera.world_from_cameras[i_frame]).pixels(found.mean)
        np.testing.assert_allclose(found.pixel["wrist"], at, atol=1e-9)
        assert not found.observed["wrist"].any()
    tracker = KeypointTracker(ColourNetwork(), reference, settings_named(filter), every=3)
    step(tracker, demonstration, 0, "wrist")
    assert step(tracker, demonstration, 1, "wrist").observed["wrist"].all()


@pytest.mark.parametrize("filter", ["discrete", "particle"])
def test_a_tracker_continues_from_its_file_between_described_frames(
    tmp_path: Path, demonstration: Demonstration, reference: ReferenceKeypoints, filter: str
) -> None:
    begun, again = (KeypointTracker(ColourNetwork(), reference, settings_named(filter), every=3) for _ in range(2))
    for i_frame in range(2):
        step(begun, demonstration, i_frame, "side", "wrist")
    begun.save(tmp_path / "state")
    again.load(tmp_path / "state")
    for i_frame in range(2, 5):
        one, other = (step(tracker, demonstration, i_frame, "side", "wrist") for tracker in (begun, again))
        np.testing.assert_array_equal(one.mean, other.mean)
        for name in ("side", "wrist"):
            np.testing.assert_array_equal(one.observed[name], other.observed[name])
            np.testing.assert_array_equal(one.pixel[name], other.pixel[name])


@pytest.mark.parametrize("every", [0, -1, 1.5, float("nan"), "2", None])
def test_every_is_refused_unless_it_counts_frames(reference: ReferenceKeypoints, every: Any) -> None:
    with pytest.raises(ValueError, match=f"every: expected a whole number of at least 1, got {every!r}"):
        KeypointTracker(ColourNetwork(), reference, every=every)


# Smaller images -------------------------------------------------------------------------------------------------------


class ReadsCells(nn.Module):
    """Mean colour of each cell. Where colours are pixels, descriptors are exact positions."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.avg_pool2d(x, 8)[:, :2]


def positions() -> tuple[DescriptorNetwork, np.ndarray]:
    """A network whose descriptors are (u, v) less `BEFORE`, and the image that it reads them in."""
    network = DescriptorNetwork(NetworkSettings("resnet18", 2, SIZE, (0.0, 0.0, 0.0), (1 / 255,) * 3)).eval()
    network.encoder = nn.Sequential(ReadsCells(), nn.Conv2d(2, 2, 1, bias=False))
    nn.init.dirac_(network.encoder[1].weight)
    # In blocks of 4x4 pixels, so that colours are whole numbers in a smaller image, too.
    u, v = np.meshgrid(np.arange(SIZE) // 4 * 4, np.arange(SIZE) // 4 * 4)
    return network, np.stack([u, v, u], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.25])
def test_a_smaller_image_gives_pixels_of_the_whole_one(tmp_path: Path, scale: float) -> None:
    network, rgb = positions()
    points = np.array([[100.3, 61.8], [57.1, 190.4], [128.0, 127.5]], np.float32)
    picks = [Pick(name=f"k{i}", recording="a", camera="wrist", frame=0, u=0, v=0) for i in range(3)]
    ReferenceKeypoints.write(tmp_path / "r", descriptors=points - BEFORE, picks=picks)
    K = np.array([[300.0, 0, 127.5], [0, 300.0, 127.5], [0, 0, 1]])
    # So high a temperature that the width of a heat map is a few pixels.
    tracker = KeypointTracker(network, tmp_path / "r", settings_named("expectation", alpha=0.7), scale=scale)
    depth = np.full((SIZE, SIZE), 0.5, np.float32)
    found = tracker.step({"wrist": rgb}, {"wrist": depth}, {"wrist": K}, {"wrist": np.eye(4)})
    assert tracker.observations["wrist"].distance.shape == (3, scale * SIZE, scale * SIZE)
    # A cell is 8, 16 or 32 pixels wide.
    np.testing.assert_allclose(found.pixel["wrist"], points, atol=0.15)
    np.testing.assert_allclose(found.mean[:, :2], (points - 127.5) / 300.0 * 0.5, atol=0.15 / 300 * 0.5 + 1e-9)


@pytest.mark.parametrize("scale", [0.0, -0.5, 1.5, float("nan")])
def test_a_scale_that_does_not_save_time_is_refused(tmp_path: Path, scale: float) -> None:
    picks = [Pick(name="a", recording="a", camera="wrist", frame=0, u=0, v=0)]
    ReferenceKeypoints.write(tmp_path / "r", descriptors=np.zeros((1, 2), np.float32), picks=picks)
    with pytest.raises(ValueError, match="scale: expected above 0 and at most 1, got"):
        KeypointTracker(positions()[0], tmp_path / "r", scale=scale)


def test_a_network_at_a_smaller_scale_has_the_same_weights_and_leaves_the_other_as_it_is() -> None:
    network, _ = positions()
    half = network.at_scale(0.5)
    assert half.input_size((480, 640)) == (128, 168) and network.input_size((480, 640)) == (256, 344)
    assert all(one is other for one, other in zip(half.parameters(), network.parameters(), strict=True))
    assert network.at_scale(0.001).settings.height == 8
