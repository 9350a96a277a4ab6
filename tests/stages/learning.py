"""A small dataset with exact masks and matches, as if the stages before training had made them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bask_data.core.geometry import view_change
from bask_data.dataset import Dataset
from bask_data.kinds import Correspondences, Demonstration, PairRow, Scan, VisibleMasks
from bask_data.nn.sampling import Pair
from tests.datasets import publish_artifact, publish_recording
from tests.nn import pairs
from tests.scenes import View

SMALL = {
    "backbone": "resnet18",
    "image_height": 32,
    "crop_share": 1.0,
    "zoom": (0.7, 2.0),
    "rotation_deg": 20.0,
    "background": 0.3,
    "colour": 0.5,
    "hue_deg": 11.0,
    "steps": 4,
    "pairs_per_step": 1,
    "matches": 24,
    "descriptor_dim": 8,
    "precision": "float32",
    "validations": 2,
}
"""Parameters of a training that takes seconds."""


def learning_dataset(root: Path, scenes: tuple[str, ...] = ("a",), n_views: int = 5) -> Dataset:
    dataset = Dataset.create(root)
    indices = [(a, b) for a in range(n_views) for b in range(n_views) if a != b]
    for seed, item in enumerate(scenes):
        _, world_from_cameras, images = pairs.views(n_views, seed)
        source = pairs.ScenePairs(n_views, seed)
        matched = {pair: source.pair(i) for i, pair in enumerate(indices)}
        publish_learning(dataset, item, pairs.K, world_from_cameras, images, matched)
    return dataset


def publish_views(
    dataset: Dataset,
    item: str,
    K: np.ndarray,
    world_from_cameras: np.ndarray,
    views: Sequence[View],
    kind: type[Scan] | type[Demonstration] = Scan,
) -> None:
    """Enter views as a recording, with depth as far as sensors measure it."""
    publish_recording(
        dataset,
        item,
        rgb=[view.rgb for view in views],
        depth=[np.minimum(view.depth, 6.0) for view in views],
        K=K,
        world_from_cameras=world_from_cameras,
        kind=kind,
    )


def publish_learning(
    dataset: Dataset,
    item: str,
    K: np.ndarray,
    world_from_cameras: np.ndarray,
    views: Sequence[View],
    matched: dict[tuple[int, int], Pair],
) -> None:
    """Enter views as a scan with their masks, and what matches between some of them."""
    publish_views(dataset, item, K, world_from_cameras, views)
    n_objects = max(int(view.instance.max()) for view in views)

    def fill_masks(out: Path) -> None:
        with VisibleMasks.writer(out, n_objects) as writer:
            camera = writer.camera("wrist", len(views), *views[0].instance.shape)
            for view in views:
                camera.append(view.instance, np.ones(n_objects, np.float32))

    def fill_matches(out: Path) -> None:
        with Correspondences.writer(out) as writer:
            for (a, b), pair in matched.items():
                distance, angle = view_change(world_from_cameras[a], world_from_cameras[b])
                row = PairRow(
                    camera_a="wrist",
                    frame_a=a,
                    camera_b="wrist",
                    frame_b=b,
                    n_attempts=len(pair.instance),
                    distance=float(distance),
                    angle=float(angle),
                )
                (u_a, v_a), (u_b, v_b) = pair.uv_a.T, pair.uv_b.T
                writer.append(row, {"instance": pair.instance, "u_a": u_a, "v_a": v_a, "u_b": u_b, "v_b": v_b})

    publish_artifact(dataset, VisibleMasks, item, fill_masks)
    publish_artifact(dataset, Correspondences, item, fill_matches)
