"""Scenes of boxes whose colours say which point of which box a pixel shows, and networks that read them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from bask_data.core.geometry import invert_rigid, pixel_grid, transform, unproject
from bask_data.dataset import Dataset, Variant
from bask_data.kinds import DescriptorNet, Truth, VisibleMasks
from bask_data.kinds.truth import TruthMetadata
from tests.datasets import publish_artifact, publish_recording
from tests.scenes import Box, Scene, intrinsics, look_at

HEIGHT, WIDTH, N_FRAMES = 48, 64, 12
K = intrinsics(HEIGHT, WIDTH)
NAMES = {1: "carton", 2: "tin"}
HALF = {"carton": (0.06, 0.05, 0.04), "tin": (0.03, 0.03, 0.05)}


def standing(x: float, y: float, angle: float, height: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = x, y, height
    return pose


def boxes(seed: int, half: Mapping[str, tuple[float, float, float]] = HALF) -> Scene:
    """A carton and a tin beside it, elsewhere for each seed."""
    rng = np.random.default_rng(seed)
    (x, y), (turn, other) = rng.uniform(-0.03, 0.03, 2), rng.uniform(-3, 3, 2)
    carton, tin = half["carton"], half["tin"]
    return Scene(
        (
            Box(carton, standing(x - 0.06, y, turn, carton[2])),
            Box(tin, standing(x + 0.08, y + 0.02, other, tin[2])),
        )
    )


def cameras(seed: int) -> np.ndarray:
    """From above and around, at 0.3 to 0.7 metres, upright and lying on one side."""
    rng = np.random.default_rng([seed, 1])
    found = []
    for i in range(N_FRAMES):
        azimuth, elevation, distance = 0.9 * i, rng.uniform(0.5, 1.2), rng.uniform(0.3, 0.7)
        eye = distance * np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        )
        found.append(look_at(eye, (0.0, 0.0, 0.03), up=(*rng.normal(size=2) * 0.7, 1.0)))
    return np.array(found)


def coded(scene: Scene, depth: np.ndarray, instance: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
    """Colours: where on its box each pixel is, a different range of red for each box; the table is black.

    A place is a share of the box's edges, so that boxes of all sizes are coloured alike.
    """
    points = transform(world_from_camera, unproject(pixel_grid(*depth.shape), depth.astype(float), K))
    rgb = np.zeros((*depth.shape, 3))
    for label, box in enumerate(scene.objects, start=1):
        assert isinstance(box, Box)
        mine = instance == label
        share = 0.5 + 0.5 * transform(invert_rigid(box.world_from_box), points[mine]) / np.asarray(box.half)
        rgb[mine] = share * [80.0, 200.0, 200.0] + [20.0 + 110.0 * (label - 1), 30.0, 30.0]
    return np.rint(rgb).astype(np.uint8)


def described_dataset(root: Path, scenes: Mapping[str, Scene], names: Mapping[int, str] = NAMES) -> Dataset:
    """Scans of the scenes with exact truth and a trained network, as far as files tell."""
    dataset = Dataset.create(root)
    for seed, (item, scene) in enumerate(scenes.items()):
        world_from_cameras = cameras(seed)
        views = [scene.render(K, camera, HEIGHT, WIDTH) for camera in world_from_cameras]
        publish_recording(
            dataset,
            item,
            rgb=[
                coded(scene, view.depth, view.instance, camera)
                for view, camera in zip(views, world_from_cameras, strict=True)
            ],
            depth=[view.depth for view in views],
            K=K,
            # The recording's own cameras are wrong, and must not be what matches are made with.
            world_from_cameras=np.stack([np.eye(4)] * N_FRAMES),
        )
        poses = np.stack([box.world_from_box for box in scene.objects if isinstance(box, Box)])
        metadata = TruthMetadata(
            label_names=dict(names),
            world_from_object={label: pose.tolist() for label, pose in zip(names, poses, strict=True)},
        )

        def fill(out: Path, metadata=metadata, poses=poses, views=views, world_from_cameras=world_from_cameras) -> None:
            with Truth.writer(out, metadata, np.repeat(poses[None], N_FRAMES, axis=0)) as writer:
                camera = writer.camera("wrist", N_FRAMES, (HEIGHT, WIDTH), 1e-4)
                for view, world_from_camera in zip(views, world_from_cameras, strict=True):
                    raw = np.round(view.depth * 1e4).astype(np.uint16)
                    camera.append(view.instance, raw, world_from_camera)

        publish_artifact(dataset, Truth, item, fill)
    publish_network(dataset)
    return dataset


def publish_masks(dataset: Dataset, item: str, instances: Sequence[np.ndarray], n: int, visible: np.ndarray) -> None:
    def fill(out: Path) -> None:
        with VisibleMasks.writer(out, n) as writer:
            camera = writer.camera("wrist", len(instances), *instances[0].shape)
            for instance, fraction in zip(instances, visible, strict=True):
                camera.append(instance, fraction.astype(np.float32))

    publish_artifact(dataset, VisibleMasks, item, fill)


def publish_network(
    dataset: Dataset,
    variant: str = "main",
    learned_from: tuple[str, ...] | None = None,
    held_out: float = 0.0,
    **params: object,
) -> None:
    """Files in the place of a network; nothing can be described with it."""

    def fill(out: Path) -> None:
        told = {"learned_from": learned_from, "held_out": held_out}
        DescriptorNet.write(out, validated_on="nothing", metrics={}, curve=[], **told)
        (out / "weights.safetensors").touch()
        (out / "model.json").write_text("{}")

    path = publish_artifact(dataset, DescriptorNet, "", fill, variant)
    manifest = json.loads((path / "artifact.json").read_text())
    (path / "artifact.json").write_text(json.dumps(manifest | {"params": params}))
    if variant != "main":
        dataset.add_variant(DescriptorNet, variant, Variant())


class ReadsColours:
    """A network whose descriptors are the colours, one cell a pixel: perfect, whatever the scale or rotation."""

    dimension = 3

    def input_size(self, size: tuple[int, int]) -> tuple[int, int]:
        return 8 * size[0], 8 * size[1]

    def cells(self, rgb: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(rgb.astype(np.float32)).permute(2, 0, 1)


class ReadsPositions(ReadsColours):
    """A network that says where in the image a pixel is, and nothing of what it shows."""

    def cells(self, rgb: np.ndarray) -> torch.Tensor:
        u, v = np.meshgrid(np.arange(rgb.shape[1]), np.arange(rgb.shape[0]))
        return torch.from_numpy(np.stack([u, v]).astype(np.float32))
