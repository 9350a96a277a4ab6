"""A demonstration whose network is not needed: the colour of a point is its descriptor, and tells where it is."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np

from bask_data.core.geometry import pixel_grid, transform, unproject
from bask_data.dataset import Dataset, Source
from bask_data.kinds import CameraFrames, Demonstration, DescriptorNet, Pick, ReferenceKeypoints, Robot
from tests import scenes
from tests.datasets import publish_artifact

HEIGHT, WIDTH, HALF = 96, 128, 0.6
K = scenes.intrinsics(HEIGHT, WIDTH, 50.0)
N_FRAMES = 12
LABELS = (1, 2, 3)


class ColourNetwork:
    """Describes every pixel by its colour."""

    settings = SimpleNamespace(descriptor_dim=3)

    def __init__(self) -> None:
        self.n_images = 0

    def cells(self, images: np.ndarray) -> np.ndarray:
        """The images themselves."""
        self.n_images += len(images)
        return images

    def maps(self, images: np.ndarray, references: np.ndarray) -> np.ndarray:
        """At half the size of the image, as a network would."""
        away = images.astype(np.float32)[:, None] - references[None, :, None, None]
        metres = np.linalg.norm(away, axis=-1) / 255 * 2 * HALF
        z = (1 - np.exp(-((metres / 0.05) ** 2) / 2)).astype(np.float32)
        size = (images.shape[2] // 2, images.shape[1] // 2)
        small = [[cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in maps] for maps in z]
        return np.array(small)


def colour_of(points_world: np.ndarray) -> np.ndarray:
    """The world as its own descriptor: coordinates from -HALF to HALF, in steps of 5 mm, are the colour."""
    return np.clip(np.round((points_world / HALF + 1) / 2 * 255), 0, 255).astype(np.uint8)


def frames(world_from_cameras: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Colours, depths in metres, and labels of the objects."""
    rgb, depth, labels = zip(*(_frame(one.tobytes()) for one in world_from_cameras), strict=True)
    return list(rgb), list(depth), list(labels)


@cache
def _frame(transform_bytes: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    world_from_camera = np.frombuffer(transform_bytes).reshape(4, 4)
    view = scenes.tabletop(3, seed=4).render(K, world_from_camera, HEIGHT, WIDTH)
    points = unproject(pixel_grid(HEIGHT, WIDTH), view.depth.astype(np.float64), K)
    colours = colour_of(transform(world_from_camera, points))
    return np.where(view.depth[..., None] > 0, colours, np.uint8(0)), view.depth, view.instance.astype(np.uint8)


@cache
def keypoints() -> tuple[np.ndarray, np.ndarray]:
    """The middle of the top of each object, as the first camera sees it: pixels (3, 2) and places (3, 3)."""
    scene, first = scenes.tabletop(3, seed=4), poses()[0]
    view = scene.render(K, first, HEIGHT, WIDTH)
    pixels = pixel_grid(HEIGHT, WIDTH)
    seen = transform(first, unproject(pixels, view.depth.astype(np.float64), K))
    uv, points = [], []
    for label in LABELS:
        mine = view.instance == label
        top = mine & (seen[..., 2] > seen[mine][:, 2].max() - 0.003)
        middle = np.linalg.norm(seen[top] - seen[top].mean(axis=0), axis=1).argmin()
        uv.append(pixels[top][middle])
        points.append(seen[top][middle])
    return np.array(uv), np.array(points)


def poses() -> np.ndarray:
    """Around the table, away from it in the middle, and back."""
    cameras = scenes.orbit(N_FRAMES, elevation_deg=(50.0, 60.0), n_turns=0.3)
    for i in range(6, 9):
        cameras[i] = scenes.look_at(cameras[i][:3, 3], cameras[i][:3, 3] * [3, 3, -1])
    return cameras


def side_poses() -> np.ndarray:
    """The other way around the table, which is always in view."""
    return scenes.orbit(N_FRAMES, elevation_deg=(60.0, 65.0), n_turns=-0.4)


def dataset_of(
    root: Path, cameras: dict[str, np.ndarray], robot: Robot | None = None, has_truth: bool = False
) -> Dataset:
    """The demonstration `reach`, a descriptor network that is not one, and a reference keypoint on each object."""
    dataset = Dataset.create(root)
    dataset.add("demonstration", "reach", Source(format="test", path="none", truth=has_truth))

    def fill(out: Path) -> None:
        group = Demonstration.start(out, "test", {})
        for name, world_from_cameras in cameras.items():
            rgb, depth, _ = frames(world_from_cameras)
            Demonstration.write_camera(
                group,
                name,
                CameraFrames(
                    K=K,
                    world_from_cameras=world_from_cameras,
                    time=np.arange(len(rgb)) / 30.0,
                    depth_scale=0.0001,
                    size=(HEIGHT, WIDTH),
                    read=lambda i, rgb=rgb, depth=depth: (rgb[i], np.round(depth[i] * 1e4).astype(np.uint16)),
                ),
            )
        if robot:
            Demonstration.write_robot(out, group, robot)

    publish_artifact(dataset, Demonstration, "reach", fill)
    publish_network(dataset, b"")
    publish_references(dataset)
    return dataset


def publish_network(dataset: Dataset, weights: bytes) -> None:
    """A network of which only the bytes matter."""

    def fill(out: Path) -> None:
        DescriptorNet.write(out, validated_on="nothing", metrics={}, curve=[])
        (out / "weights.safetensors").write_bytes(weights)
        (out / "model.json").write_text("{}")

    publish_artifact(dataset, DescriptorNet, "", fill)


def publish_references(dataset: Dataset, shift: float = 0.0) -> None:
    """Reference keypoints, whose descriptors are off by some grey levels."""
    uv, points = keypoints()
    picks = [
        Pick(name=f"k{i}", recording="reach", camera="wrist", frame=0, u=u, v=v, point_world=tuple(point.tolist()))
        for i, ((u, v), point) in enumerate(zip(uv.tolist(), points, strict=True))
    ]
    descriptors = colour_of(points).astype(np.float32) + np.float32(shift)
    publish_artifact(
        dataset,
        ReferenceKeypoints,
        "",
        lambda out: ReferenceKeypoints.write(out, descriptors=descriptors, picks=picks),
    )
