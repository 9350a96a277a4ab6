from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from bask_data.core.geometry import pixel_grid, project, transform, unproject
from bask_data.dataset import Dataset, Source
from bask_data.errors import BadData
from bask_data.kinds import Demonstration, DescriptorNet, KeypointTrack, Pick, ReferenceKeypoints, Robot
from bask_data.stage import make, plan
from bask_data.stages.encode import encode
from tests import scenes
from tests.datasets import publish_artifact

GOLDEN = Path(__file__).parent / "golden"
HEIGHT, WIDTH, HALF = 96, 128, 0.6
K = scenes.intrinsics(HEIGHT, WIDTH, 50.0)
N_FRAMES = 12
ARRAYS = ("mean", "covariance", "mode", "n_eff", "log_evidence")


def colour_of(points_world: np.ndarray) -> np.ndarray:
    """The world as its own descriptor: coordinates from -HALF to HALF, in steps of 5 mm, are the colour."""
    return np.clip(np.round((points_world / HALF + 1) / 2 * 255), 0, 255).astype(np.uint8)


def frames(world_from_cameras: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    scene = scenes.tabletop(3, seed=4)
    rgb, depth = [], []
    for world_from_camera in world_from_cameras:
        view = scene.render(K, world_from_camera, HEIGHT, WIDTH)
        points = unproject(pixel_grid(HEIGHT, WIDTH), view.depth.astype(np.float64), K)
        colours = colour_of(transform(world_from_camera, points))
        rgb.append(np.where(view.depth[..., None] > 0, colours, np.uint8(0)))
        depth.append(view.depth)
    return rgb, depth


def keypoints() -> np.ndarray:
    """The middle of the top of each object, as the first camera sees it."""
    scene, first = scenes.tabletop(3, seed=4), poses()[0]
    view = scene.render(K, first, HEIGHT, WIDTH)
    seen = transform(first, unproject(pixel_grid(HEIGHT, WIDTH), view.depth.astype(np.float64), K))
    points = []
    for i_object in (1, 2, 3):
        mine = seen[view.instance == i_object]
        top = mine[mine[:, 2] > mine[:, 2].max() - 0.003]
        points.append(top[np.linalg.norm(top - top.mean(axis=0), axis=1).argmin()])
    return np.array(points)


def poses() -> np.ndarray:
    """Around the table, away from it in the middle, and back."""
    cameras = scenes.orbit(N_FRAMES, elevation_deg=(50.0, 60.0), n_turns=0.3)
    for i in range(6, 9):
        cameras[i] = scenes.look_at(cameras[i][:3, 3], cameras[i][:3, 3] * [3, 3, -1])
    return cameras


def dataset_of(root: Path, cameras: dict[str, np.ndarray], robot: Robot | None = None) -> Dataset:
    dataset = Dataset.create(root)
    dataset.add("demonstration", "reach", Source(format="test", path="none"))

    def fill(out: Path) -> None:
        group = Demonstration.start(out, "test", {})
        for name, world_from_cameras in cameras.items():
            rgb, depth = frames(world_from_cameras)
            Demonstration.write_camera(
                group,
                name,
                K=K,
                world_from_cameras=world_from_cameras,
                time=np.arange(len(rgb)) / 30.0,
                depth_scale=0.0001,
                size=(HEIGHT, WIDTH),
                read=lambda i, rgb=rgb, depth=depth: (rgb[i], np.round(depth[i] * 1e4).astype(np.uint16)),
            )
        if robot:
            Demonstration.write_robot(out, group, robot)

    def weights(out: Path) -> None:
        DescriptorNet.write(out, validated_on="nothing", metrics={}, curve=[])
        (out / "weights.safetensors").write_bytes(b"")
        (out / "model.json").write_text("{}")

    publish_artifact(dataset, Demonstration, "reach", fill)
    publish_artifact(dataset, DescriptorNet, "", weights)
    picks = [Pick(name=f"k{i}", recording="reach", camera="wrist", frame=0, u=0, v=0) for i in range(3)]
    references = colour_of(keypoints()).astype(np.float32)
    publish_artifact(
        dataset,
        ReferenceKeypoints,
        "",
        lambda out: ReferenceKeypoints.write(out, descriptors=references, picks=picks),
    )
    return dataset


class ColourNetwork:
    """Describes every pixel by its colour."""

    settings = SimpleNamespace(descriptor_dim=3)

    def __init__(self) -> None:
        self.n_images = 0

    def distance_maps(self, images: np.ndarray, references: np.ndarray) -> np.ndarray:
        self.n_images += len(images)
        away = images.astype(np.float32)[:, None] - references[None, :, None, None]
        metres = np.linalg.norm(away, axis=-1) / 255 * 2 * HALF
        z = (1 - np.exp(-((metres / 0.05) ** 2) / 2)).astype(np.float32)
        # At half the size of the image, as a network would.
        size = (WIDTH // 2, HEIGHT // 2)
        small = [[cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in maps] for maps in z]
        return np.array(small)


@pytest.fixture(autouse=True)
def network(monkeypatch: pytest.MonkeyPatch) -> ColourNetwork:
    network = ColourNetwork()
    monkeypatch.setattr(DescriptorNet, "network", lambda self: network)
    return network


def tracked(dataset: Dataset, **options: object) -> KeypointTrack:
    [task] = plan(dataset, encode, options=options)
    outcome = make(task)
    assert outcome.status == "made", outcome.why
    return KeypointTrack(dataset.path(KeypointTrack, "reach", "main"))


def test_keypoints_are_followed_around_away_from_and_back_to_the_table(tmp_path: Path) -> None:
    track = tracked(dataset_of(tmp_path / "d", {"wrist": poses()}))
    error = np.linalg.norm(track.mean - keypoints(), axis=-1)
    assert track.names == ["k0", "k1", "k2"]
    assert np.median(error[2:6]) < 0.01
    assert error[6:9].max() < 0.03
    assert np.median(error[9:]) < 0.01
    assert track.observed("wrist")[2:6].mean() > 0.8
    assert not track.observed("wrist")[6:9].any()
    assert track.observed("wrist")[10:].mean() > 0.8


def test_pixels_are_those_of_the_mean_in_the_cameras_image(tmp_path: Path) -> None:
    track = tracked(dataset_of(tmp_path / "d", {"wrist": poses()}))
    world_from_camera = poses()[3]
    uv, _ = project((track.mean[3] - world_from_camera[:3, 3]) @ world_from_camera[:3, :3], K)
    np.testing.assert_allclose(track.pixel("wrist")[3], uv, atol=1e-3)


@pytest.mark.parametrize("filter", ["expectation", "discrete", "particle"])
def test_every_filter_gives_what_it_gave(tmp_path: Path, filter: str) -> None:
    track = tracked(dataset_of(tmp_path / "d", {"wrist": poses()}), filter=filter, n_particles=500)
    assert track.metadata.filter == filter
    golden = np.load(GOLDEN / "encode_v2.npz")
    for name in ARRAYS:
        np.testing.assert_allclose(
            getattr(track, name), golden[f"{filter}.{name}"], rtol=1e-3, atol=1e-5, err_msg=f"{filter} {name}"
        )
    np.testing.assert_allclose(track.pixel("wrist"), golden[f"{filter}.pixel"], rtol=1e-3, atol=1e-2)
    np.testing.assert_array_equal(track.observed("wrist"), golden[f"{filter}.observed"])


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()})
    digests = []
    for seed in (1, 1, 2):
        [task] = plan(dataset, encode, options={"seed": seed, "n_particles": 200})
        digests.append(make(task, force=True).digest)
    # The digest covers the parameters too, so bytes are compared where the seed differs.
    assert digests[0] == digests[1]
    first = tracked(dataset, seed=1, n_particles=200).mean
    assert not np.array_equal(first, tracked(dataset, seed=3, n_particles=200).mean)


def test_all_cameras_are_used(tmp_path: Path) -> None:
    other = scenes.orbit(N_FRAMES, elevation_deg=(60.0, 65.0), n_turns=-0.4)
    track = tracked(dataset_of(tmp_path / "d", {"side": other, "wrist": poses()}))
    assert track.observed("side")[6:9].mean() > 0.5
    assert np.median(np.linalg.norm(track.mean - keypoints(), axis=-1)[6:9]) < 0.01


def test_a_gripper_far_from_the_keypoints_moves_none_of_them(tmp_path: Path) -> None:
    grippers = np.tile(np.eye(4), (N_FRAMES, 1, 1))
    grippers[:, :3, 3] = np.array([5.0, 5.0, 5.0]) + 0.02 * np.arange(N_FRAMES)[:, None]
    track = tracked(dataset_of(tmp_path / "d", {"wrist": poses()}, Robot(world_from_gripper=grippers)))
    assert np.linalg.norm(track.mean - keypoints(), axis=-1)[6:9].max() < 0.03


def test_a_robot_with_another_number_of_frames_is_refused(tmp_path: Path) -> None:
    grippers = np.tile(np.eye(4), (N_FRAMES - 2, 1, 1))
    [task] = plan(dataset_of(tmp_path / "d", {"wrist": poses()}, Robot(world_from_gripper=grippers)), encode)
    outcome = make(task)
    assert outcome.status == "failed"
    assert "robot/world_from_gripper: expected one transform for each of the 12 frames, got 10" in outcome.why


def test_cameras_with_different_numbers_of_frames_are_refused(tmp_path: Path) -> None:
    [task] = plan(dataset_of(tmp_path / "d", {"side": poses()[:5], "wrist": poses()}), encode)
    outcome = make(task)
    assert outcome.status == "failed"
    assert "camera wrist: expected as many frames as camera side (5), got 12" in outcome.why
