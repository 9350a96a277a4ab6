"""A small dataset with exact masks and matches, as if the stages before training had made them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bask_data.core.geometry import view_change
from bask_data.dataset import Dataset
from bask_data.kinds import Correspondences, PairRow, VisibleMasks
from tests.datasets import publish_artifact, publish_recording
from tests.nn import pairs

SMALL = {
    "image_height": 32,
    "steps": 4,
    "pairs_per_step": 1,
    "matches": 24,
    "descriptor_dim": 8,
    "precision": "float32",
}
"""Parameters of a training that takes seconds."""


def learning_dataset(root: Path, scenes: tuple[str, ...] = ("a",), n_views: int = 5) -> Dataset:
    dataset = Dataset.create(root)
    for seed, item in enumerate(scenes):
        scene, world_from_cameras, images = pairs.views(n_views, seed)
        publish_recording(
            dataset,
            item,
            rgb=[image.rgb for image in images],
            depth=[np.minimum(image.depth, 6.0) for image in images],
            K=pairs.K,
            world_from_cameras=world_from_cameras,
        )

        def fill_masks(out: Path, scene=scene, images=images) -> None:
            with VisibleMasks.writer(out, scene.n_objects) as writer:
                camera = writer.camera("wrist", n_views, *pairs.SIZE)
                for image in images:
                    camera.append(image.instance, np.ones(scene.n_objects, np.float32))

        def fill_matches(out: Path, seed=seed, world_from_cameras=world_from_cameras) -> None:
            source = pairs.ScenePairs(n_views, seed)
            indices = [(a, b) for a in range(n_views) for b in range(n_views) if a != b]
            with Correspondences.writer(out) as writer:
                for i, (a, b) in enumerate(indices):
                    pair = source.pair(i)
                    distance, angle = view_change(world_from_cameras[a], world_from_cameras[b])
                    row = PairRow(
                        camera_a="wrist",
                        frame_a=a,
                        camera_b="wrist",
                        frame_b=b,
                        n_attempts=400,
                        distance=float(distance),
                        angle=float(angle),
                    )
                    (u_a, v_a), (u_b, v_b) = pair.uv_a.T, pair.uv_b.T
                    writer.append(row, {"instance": pair.instance, "u_a": u_a, "v_a": v_a, "u_b": u_b, "v_b": v_b})

        publish_artifact(dataset, VisibleMasks, item, fill_masks)
        publish_artifact(dataset, Correspondences, item, fill_matches)
    return dataset
