"""Small real datasets on disk for tests."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bask_data.artifact import Artifact, digest_of, new_scratch, publish, seal
from bask_data.core.tsdf import Mesh
from bask_data.dataset import Dataset, Source
from bask_data.kinds import (
    CameraFrames,
    Demonstration,
    Identities,
    Reconstruction,
    Scan,
    VisibleMasks,
)
from bask_data.kinds.identities import IdentityRow, MemberRow


def copied(dataset: Dataset, root: Path) -> Dataset:
    """A dataset that a test may change, from one that it may not: twenty times as fast as making it."""
    return Dataset(shutil.copytree(dataset.root, root))


def publish_recording(
    dataset: Dataset,
    item: str,
    *,
    rgb: list[np.ndarray],
    depth: list[np.ndarray],
    K: np.ndarray,
    world_from_cameras: np.ndarray,
    kind: type[Scan] | type[Demonstration] = Scan,
    camera: str = "wrist",
    depth_scale: float = 0.0001,
) -> Path:
    """Enter frames as a scan or demonstration with one camera; `depth` in metres."""
    raw = [np.round(image / depth_scale).astype(np.uint16) for image in depth]

    def fill(out: Path) -> None:
        group = kind.start(out, "test", {})
        kind.write_camera(
            group,
            camera,
            CameraFrames(
                K=K,
                world_from_cameras=world_from_cameras,
                time=np.arange(len(raw)) / 30.0,
                depth_scale=depth_scale,
                size=raw[0].shape,
                read=lambda i: (rgb[i], raw[i]),
            ),
        )

    dataset.add(kind.scope, item, Source(format="test", path="none"))
    return publish_artifact(dataset, kind, item, fill)


def add_scan(
    dataset: Dataset,
    name: str,
    n_frames: int = 2,
    level: int = 0,
    kind: type[Scan] | type[Demonstration] = Scan,
) -> None:
    """Enter a scan of a few grey pixels a frame, a metre away."""
    publish_recording(
        dataset,
        name,
        rgb=[np.full((4, 6, 3), level + i, dtype=np.uint8) for i in range(n_frames)],
        depth=[np.full((4, 6), 1.0) for _ in range(n_frames)],
        K=np.array([[5.0, 0, 2.5], [0, 5, 1.5], [0, 0, 1]]),
        world_from_cameras=np.tile(np.eye(4), (n_frames, 1, 1)),
        kind=kind,
    )


def publish_artifact(
    dataset: Dataset,
    kind: type[Artifact],
    item: str,
    fill,
    variant: str = "main",
    inputs: Sequence[Artifact] = (),
) -> Path:
    """Publish what `fill(out)` writes as an artifact of the dataset, as if a stage had made it."""
    dataset.prepare(kind, variant)
    scratch = new_scratch(dataset.root, kind.kind)
    fill(scratch)
    target = dataset.path(kind, item, variant)
    read = {each.path.relative_to(dataset.root).as_posix(): each.manifest.digest for each in inputs}
    key = digest_of([kind.kind, item])
    seal(scratch, artifact=kind, stage="test", stage_version=1, params={}, inputs=read, key=key)
    publish(scratch, target)
    return target


def publish_mesh(dataset: Dataset, item: str, vertices: np.ndarray, triangles: np.ndarray) -> Path:
    """Publish a reconstruction of these vertices (n, 3) and triangles (m, 3), all black."""
    return publish_artifact(
        dataset,
        Reconstruction,
        item,
        lambda out: Reconstruction.write(
            out,
            Mesh(vertices, triangles, np.zeros(vertices.shape, np.uint8)),
            voxel_size=0.004,
            bounds=(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0),
        ),
    )


def publish_identities(dataset: Dataset, members: Mapping[str, Sequence[tuple[str, int]]]) -> Path:
    """Publish identities by name, each with its members, as if made from the masks that their scans have."""
    rows = [
        IdentityRow(
            id=i, name=name, members=[MemberRow(scene=scene, instance=n, confidence=0.9) for scene, n in places]
        )
        for i, (name, places) in enumerate(members.items(), 1)
    ]
    scenes = dict.fromkeys(scene for places in members.values() for scene, _ in places)
    return publish_artifact(
        dataset,
        Identities,
        "",
        lambda out: Identities.write(
            out,
            identities=rows,
            unknown=[],
            pairs={name: [] for name in Identities.tables["pairs.parquet"].columns},
            picture=b"",
            warnings=[],
        ),
        inputs=[VisibleMasks(dataset.path(VisibleMasks, scene)) for scene in scenes],
    )
