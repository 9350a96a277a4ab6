"""A small dataset, clean or with one fault injected, and the codes that are to be found for each."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bask_data.core.geometry import invert_rigid, project, transform
from bask_data.dataset import Dataset, Source, Splits
from bask_data.kinds import (
    CameraFrames,
    Demonstration,
    InstanceRow,
    KeypointTrack,
    ObjectInstances,
    Scan,
    VisibleMasks,
)
from bask_data.kinds.demonstration import Robot
from tests.datasets import publish_artifact, publish_mesh
from tests.random_recordings import MOTIONS
from tests.scenes import Scene, View, intrinsics, noisy, tabletop

SIZE = (120, 160)
"""Height and width."""

DEPTH_SCALE = 0.0001
"""Metres per unit of depth."""


@dataclass(frozen=True)
class Taken:
    """Frames of a scene."""

    K: np.ndarray
    world_from_cameras: np.ndarray
    views: list[View]
    rng_seed: int


@dataclass(frozen=True)
class Content:
    """What is written; the default is clean.

    Args:
        same_scan: whether the second scan shows the frames of the first again, with other noise.
        rows: changes the objects of the first scan.
        still: whether the robot does not move.
        keypoints: changes positions (t, k, 3) and covariances (t, k, 3, 3).
    """

    splits: bool = False
    same_scan: bool = False
    rows: Callable[[list[InstanceRow]], list[InstanceRow]] = lambda rows: rows
    still: bool = False
    keypoints: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] = lambda mean, cov: (mean, cov)
    afterwards: Callable[[Dataset], None] = lambda dataset: None


def take(seed: int, n_frames: int = 24) -> Taken:
    """A hand-held recording of two boxes and a ball."""
    scene, K = tabletop(3, seed), intrinsics(*SIZE)
    poses = MOTIONS["hand"](np.random.default_rng([seed, 4]), n_frames, np.array([0, 0, 0.03]), 0.5)
    return Taken(K, poses, [_rendered(scene, K, pose) for pose in poses], seed)


def _rendered(scene: Scene, K: np.ndarray, pose: np.ndarray) -> View:
    view = scene.render(K, pose, *SIZE)
    return replace(view, depth=np.where(view.depth < 3, view.depth, 0).astype(np.float32))


def write_dataset(root: Path, seen: tuple[Taken, Taken, Taken], content: Content = Content()) -> Dataset:
    """Scans `left` and `right` with objects and masks, and a demonstration `lift` with keypoints."""
    dataset = Dataset.create(root, "faulty", "CC0-1.0")
    left, right, lift = seen
    for name, taken, seed in (("left", left, 1), ("right", left if content.same_scan else right, 2)):
        publish_taken(dataset, name, taken, np.random.default_rng(seed), Scan)
        publish_mesh(dataset, name, *_triangle_per_object())
        rows = [
            InstanceRow(id=i, n_vertices=3, area_m2=0.01, centroid=(0, 0, 0), extents=(0.1, 0.1, 0.1))
            for i in (1, 2, 3)
        ]
        _publish_objects(dataset, name, content.rows(rows) if name == "left" else rows)
        publish_artifact(dataset, VisibleMasks, name, lambda out, taken=taken: _write_masks(out, taken))
    publish_taken(
        dataset, "lift", lift, np.random.default_rng(3), Demonstration, _robot(len(lift.views), content.still)
    )
    _publish_keypoints(dataset, lift, content)
    if content.splits:
        dataset.set_splits(Splits(train=["left"], validation=[], test=["right"]))
    content.afterwards(dataset)
    return dataset


def publish_taken(
    dataset: Dataset,
    name: str,
    taken: Taken,
    rng: np.random.Generator,
    kind: type[Scan] | type[Demonstration],
    robot: Robot | None = None,
) -> None:
    raw = [np.round(noisy(view.depth, 0.002, rng, 0.03) / DEPTH_SCALE).astype(np.uint16) for view in taken.views]
    rgb = [
        np.clip(view.rgb + rng.normal(scale=2, size=view.rgb.shape), 0, 255).astype(np.uint8) for view in taken.views
    ]

    def fill(out: Path) -> None:
        group = kind.start(out, "test", {})
        frames = CameraFrames(
            K=taken.K,
            world_from_cameras=taken.world_from_cameras,
            time=np.arange(len(raw)) / 10,
            depth_scale=DEPTH_SCALE,
            size=SIZE,
            read=lambda i: (rgb[i], raw[i]),
        )
        kind.write_camera(group, "wrist", frames)
        if robot is not None:
            Demonstration.write_robot(out, group, robot)

    dataset.add(kind.scope, name, Source(format="test", path="none"))
    publish_artifact(dataset, kind, name, fill)


def _robot(n_frames: int, still: bool) -> Robot:
    """A gripper that goes 30 cm and closes, or rests."""
    poses = np.tile(np.eye(4), (n_frames, 1, 1))
    share = np.zeros(n_frames) if still else np.linspace(0, 1, n_frames)
    poses[:, 0, 3] = 0.3 * share
    return Robot(world_from_gripper=poses, gripper_width=0.08 - 0.05 * share)


def _triangle_per_object() -> tuple[np.ndarray, np.ndarray]:
    vertices = np.array([[i, *corner] for i in range(3) for corner in ((0, 0), (0.1, 0), (0, 0.1))], np.float32)
    return vertices * np.array([0.1, 1, 1], np.float32), np.arange(9, dtype=np.int32).reshape(3, 3)


def _publish_objects(dataset: Dataset, name: str, rows: list[InstanceRow]) -> None:
    vertex_instance = np.zeros(9, np.int32)
    for row in rows:
        vertex_instance[3 * (row.id - 1) : 3 * (row.id - 1) + row.n_vertices] = row.id
    plane = np.array([0.0, 0, 1, 0])
    publish_artifact(
        dataset,
        ObjectInstances,
        name,
        lambda out: ObjectInstances.write(
            out, vertex_instance=vertex_instance, support_plane=plane, instances=rows, warnings=[]
        ),
    )


def _write_masks(out: Path, taken: Taken) -> None:
    with VisibleMasks.writer(out, 3) as writer:
        camera = writer.camera("wrist", len(taken.views), *SIZE)
        for view in taken.views:
            camera.append(view.instance, np.ones(3, np.float32), np.ones(SIZE, bool))


def _publish_keypoints(dataset: Dataset, taken: Taken, content: Content) -> None:
    n_frames, names = len(taken.views), [f"k{i}" for i in range(5)]
    places = np.array([[-0.1, 0, 0.04], [0.1, 0, 0.02], [0, 0.1, 0.05], [0, -0.1, 0.03], [0.05, 0.05, 0.0]])
    mean = np.tile(places, (n_frames, 1, 1))
    covariance = np.tile(np.eye(3) * 1e-4, (n_frames, len(names), 1, 1))
    mean, covariance = content.keypoints(mean, covariance)

    def fill(out: Path) -> None:
        with KeypointTrack.writer(out, names=names, filter="particle", cameras=["wrist"]) as writer:
            for i, pose in enumerate(taken.world_from_cameras):
                pixel = project(transform(invert_rigid(pose), mean[i]), taken.K)[0]
                writer.append(
                    mean=mean[i].astype(np.float32),
                    covariance=covariance[i].astype(np.float32),
                    mode=mean[i].astype(np.float32),
                    n_eff=np.full(len(names), 100, np.float32),
                    log_evidence=np.zeros(len(names), np.float32),
                    cameras={"wrist": (pixel.astype(np.float32), np.ones(len(names), bool))},
                )

    publish_artifact(dataset, KeypointTrack, "lift", fill)


# Faults ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DatasetFault:
    """One thing that is wrong with a dataset.

    Args:
        codes: any of these findings tells it.
    """

    name: str
    codes: tuple[str, ...]
    content: Content = field(repr=False)


def _without_vertices(rows: list[InstanceRow]) -> list[InstanceRow]:
    return [*rows[:2], rows[2].model_copy(update={"n_vertices": 0, "area_m2": 0.0, "extents": (0.0, 0.0, 0.0)})]


def _splinter(rows: list[InstanceRow]) -> list[InstanceRow]:
    return [*rows[:2], rows[2].model_copy(update={"area_m2": 0.00002, "extents": (0.006, 0.004, 0.001)})]


def _collapsed(mean: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return mean.mean(axis=1, keepdims=True) + 0.02 * (mean - mean.mean(axis=1, keepdims=True)), covariance


def _exploded(mean: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return mean, covariance * 4000


def _older(dataset: Dataset) -> None:
    """Objects of version 1, as older programs wrote them."""
    folder = dataset.path(ObjectInstances, "left")
    manifest = json.loads((folder / "artifact.json").read_text())
    (folder / "artifact.json").write_text(json.dumps(manifest | {"schema_version": 1}, indent=2) + "\n")


def _strayed(dataset: Dataset) -> None:
    (dataset.path(Scan, "left") / "notes.txt").write_text("looks good\n")


def _damaged(dataset: Dataset) -> None:
    file = max(dataset.path(Scan, "right").rglob("*"), key=lambda file: file.stat().st_size if file.is_file() else 0)
    file.write_bytes(file.read_bytes()[:-7])


DATASET_FAULTS = (
    DatasetFault("split leak", ("split-leak",), Content(splits=True, same_scan=True)),
    DatasetFault("the same scene twice", ("scene-twice",), Content(same_scan=True)),
    DatasetFault("empty instance", ("instance-empty",), Content(rows=_without_vertices)),
    DatasetFault("no instance", ("instance-empty",), Content(rows=lambda rows: [])),
    DatasetFault("tiny instance", ("instance-tiny",), Content(rows=_splinter)),
    DatasetFault("demonstration without motion", ("demonstration-still",), Content(still=True)),
    DatasetFault("collapsed keypoints", ("keypoints-collapsed",), Content(keypoints=_collapsed)),
    DatasetFault("exploding keypoints", ("keypoints-exploded",), Content(keypoints=_exploded)),
    DatasetFault("old version", ("version-old", "version-unreadable"), Content(afterwards=_older)),
    DatasetFault("stray file", ("unlisted-file",), Content(afterwards=_strayed)),
    DatasetFault("damaged file", ("damaged",), Content(afterwards=_damaged)),
)
"""Of a dataset."""
