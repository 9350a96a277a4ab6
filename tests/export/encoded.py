"""Demonstrations with a robot and a track, as made by `encode`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bask_data.dataset import Dataset, Source
from bask_data.kinds import CameraFrames, Demonstration, KeypointTrack, Robot
from tests.datasets import publish_artifact

ACTIONS = ("dx", "dy", "dz", "width")
KEYPOINTS = ["handle", "lid"]
SIZE = (16, 24)


def rotations(n: int) -> np.ndarray:
    """Transforms (n, 4, 4) that rotate about z by 0 to 2 rad."""
    transforms = np.tile(np.eye(4), (n, 1, 1))
    angle = np.linspace(0, 2, n)
    transforms[:, 0, 0] = transforms[:, 1, 1] = np.cos(angle)
    transforms[:, 1, 0] = np.sin(angle)
    transforms[:, 0, 1] = -np.sin(angle)
    return transforms


def picture(i: int, camera: str = "wrist") -> np.ndarray:
    """A picture that differs between frames and cameras."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    blue = np.full(SIZE, 60 if camera == "wrist" else 200)
    return np.stack([100 + 60 * np.sin((u + i) / 4), 5 * v + 40, blue], axis=-1).astype(np.uint8)


class Demo:
    """Content of a demonstration and its track; tests may change it before it is published."""

    def __init__(self, seed: int = 0, n_frames: int = 12, cameras: Sequence[str] = ("wrist",)) -> None:
        rng = np.random.default_rng(seed)
        n, k = n_frames, len(KEYPOINTS)
        self.cameras = cameras
        self.origin = (0.0, 0.0, 0.0)
        self.size = SIZE
        self.time = 5.0 + np.arange(n) / 10.0
        self.K = np.diag([20.0, 20.0, 1.0])
        self.world_from_cameras = np.tile(np.eye(4), (n, 1, 1))
        self.depth_scale = 0.001
        self.depth = np.zeros((n, *SIZE), np.uint16)
        grippers = rotations(n)
        grippers[:, :3, 3] = rng.normal(size=(n, 3))
        self.robot: Robot | None = Robot(grippers, rng.uniform(0, 0.08, n), rng.uniform(-1, 1, (n, 4)), ACTIONS)
        self.names = KEYPOINTS
        self.filter = "particle"
        self.mean = rng.normal(size=(n, k, 3)).astype(np.float32)
        half = rng.normal(size=(n, k, 3, 3)) * 0.01
        self.covariance = (half @ half.swapaxes(-1, -2)).astype(np.float32)
        self.observed = {camera: rng.random((n, k)) < 0.5 for camera in self.cameras}

    def publish(self, dataset: Dataset, item: str, variant: str = "main", **options: str) -> None:
        dataset.add("demonstration", item, Source(format="test", path="none", options=options))
        publish_artifact(dataset, Demonstration, item, self._write_recording)
        self.publish_track(dataset, item, variant)

    def publish_track(self, dataset: Dataset, item: str, variant: str = "main") -> None:
        publish_artifact(dataset, KeypointTrack, item, self._write_track, variant)

    def _write_recording(self, out: Path) -> None:
        names = self.robot.action_names if self.robot else ()
        group = Demonstration.start(out, "test", {}, origin=self.origin, action_names=names)
        for camera in self.cameras:
            Demonstration.write_camera(
                group,
                camera,
                CameraFrames(
                    K=self.K,
                    world_from_cameras=self.world_from_cameras,
                    time=self.time,
                    depth_scale=self.depth_scale,
                    size=self.size,
                    read=lambda i, camera=camera: (
                        np.resize(picture(i, camera), (*self.size, 3)),
                        np.resize(self.depth[i], self.size),
                    ),
                ),
            )
        if self.robot:
            Demonstration.write_robot(out, group, self.robot)

    def _write_track(self, out: Path) -> None:
        n, k = self.mean.shape[:2]
        with KeypointTrack.writer(out, names=self.names, filter=self.filter, cameras=list(self.cameras)) as writer:
            for i in range(n):
                writer.append(
                    mean=self.mean[i],
                    covariance=self.covariance[i],
                    mode=self.mean[i],
                    n_eff=np.ones(k, np.float32),
                    log_evidence=np.full(k, -1.0, np.float32),
                    cameras={
                        camera: (np.ones((k, 2), np.float32), self.observed[camera][i]) for camera in self.cameras
                    },
                )


def seen_demo(seed: int = 0, n_frames: int = 6, depth_scale: float = 0.001) -> Demo:
    """A demonstration whose camera moves, zooms and measures depth from 1 to 1.4 m, with holes."""
    rng = np.random.default_rng(seed)
    demo = Demo(seed, n_frames)
    demo.K = np.tile([[20.0, 0, 11.5], [0, 21.0, 7.5], [0, 0, 1]], (n_frames, 1, 1))
    demo.K[:, 0, 0] += rng.uniform(0, 1, n_frames)
    demo.world_from_cameras = rotations(n_frames)
    demo.world_from_cameras[:, :3, 3] = rng.normal(size=(n_frames, 3))
    demo.depth_scale = depth_scale
    demo.depth = (rng.uniform(1.0, 1.4, (n_frames, *SIZE)) / depth_scale).astype(np.uint16)
    demo.depth[rng.random(demo.depth.shape) < 0.1] = 0
    demo.time = demo.time + rng.uniform(0, 0.003, n_frames)
    return demo


def exported_dataset(root: Path) -> tuple[Dataset, dict[str, Demo]]:
    """Three demonstrations of different lengths, the second of another task."""
    dataset = Dataset.create(root, name="kitchen", licence="CC0")
    cameras = "overhead", "wrist"
    demos = {"a": Demo(0, 12, cameras), "b": Demo(1, 7, cameras), "c": Demo(2, 9, cameras)}
    for name, demo in demos.items():
        demo.publish(dataset, name, task="stir" if name == "b" else "put the lid on")
    return dataset, demos


def state(demo: Demo) -> np.ndarray:
    """A policy's observation (t, s), computed independently of the export."""
    n = len(demo.mean)
    assert demo.robot is not None and demo.robot.world_from_gripper is not None
    gripper = demo.robot.world_from_gripper
    spread = np.sqrt(np.einsum("tkii->tk", demo.covariance))
    columns = [demo.mean.reshape(n, -1), spread, gripper[:, :3, 3], gripper[:, :3, 0], gripper[:, :3, 1]]
    return np.concatenate([*columns, demo.robot.gripper_width[:, None]], axis=1).astype(np.float32)
