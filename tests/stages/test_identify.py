from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bask_data.core.tsdf import Mesh
from bask_data.dataset import Dataset
from bask_data.engine import make, plan
from bask_data.kinds import Identities, InstanceRow, ObjectInstances, Reconstruction, VisibleMasks
from bask_data.stages.identify import identify
from tests.datasets import copied, publish_artifact, publish_recording
from tests.described import standing
from tests.scenes import Box, Scene, intrinsics, orbit

RED = ((0.07, 0.04, 0.05), (200, 60, 50))
BLUE = ((0.03, 0.03, 0.06), (50, 80, 210))
GREEN = ((0.05, 0.05, 0.02), (60, 190, 70))
YELLOW = ((0.06, 0.02, 0.04), (220, 200, 40))

SCANS = {"a": (RED, BLUE, GREEN), "b": (GREEN, RED), "c": (BLUE, RED, YELLOW)}
"""Boxes by scan: half edges and colour, in the order of their ids."""

SIZE, K = (72, 96), intrinsics(72, 96)


def publish_scan(dataset: Dataset, name: str, boxes, seed: int) -> None:
    """A scan of boxes at random places, with its exact surface, objects and masks."""
    rng = np.random.default_rng(seed)
    places = [(0.17 * np.cos(a), 0.17 * np.sin(a)) for a in rng.uniform(0, 6) + np.arange(len(boxes)) * 2 * np.pi / 3]
    bodies = tuple(
        Box(half, standing(x, y, rng.uniform(0, 6), half[2]), colour)
        for (half, colour), (x, y) in zip(boxes, places, strict=True)
    )
    cameras = orbit(6, radius=0.6)
    views = [Scene(bodies).render(K, camera, *SIZE) for camera in cameras]
    publish_recording(
        dataset,
        name,
        rgb=[view.rgb for view in views],
        depth=[view.depth for view in views],
        K=K,
        world_from_cameras=cameras,
    )
    vertices, triangles, labels = surface(bodies)
    mesh = Mesh(vertices, triangles, np.zeros(vertices.shape, np.uint8))
    bounds = (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)
    publish_artifact(
        dataset, Reconstruction, name, lambda out: Reconstruction.write(out, mesh, voxel_size=0.004, bounds=bounds)
    )
    rows = [
        InstanceRow(id=i, n_vertices=8, area_m2=0.01, centroid=(0, 0, 0), extents=(0.1, 0.1, 0.1))
        for i in range(1, len(boxes) + 1)
    ]
    told = {"support_plane": np.array([0, 0, 1.0, 0]), "instances": rows, "warnings": []}
    publish_artifact(
        dataset, ObjectInstances, name, lambda out: ObjectInstances.write(out, vertex_instance=labels, **told)
    )

    def fill(out: Path) -> None:
        with VisibleMasks.writer(out, len(boxes)) as writer:
            camera = writer.camera("wrist", len(views), *SIZE)
            for view in views:
                camera.append(view.instance, np.ones(len(boxes), np.float32))

    publish_artifact(dataset, VisibleMasks, name, fill)


def surface(bodies) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices and triangles of boxes, each face a grid, and the instance of each vertex."""
    n = 6
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij"), -1).reshape(-1, 2)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    cells = np.concatenate(
        [np.stack([corner, corner + 1, corner + n], 1), np.stack([corner + 1, corner + n + 1, corner + n], 1)]
    )
    vertices, triangles, labels = [], [], []
    for i, body in enumerate(bodies, 1):
        for axis in range(3):
            for side in (-1.0, 1.0):
                local = np.insert(grid, axis, side, axis=1) * body.half
                triangles.append(cells + n * n * len(vertices))
                vertices.append(local @ body.world_from_box[:3, :3].T + body.world_from_box[:3, 3])
                labels.append(np.full(n * n, i))
    return (
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(triangles).astype(np.int32),
        np.concatenate(labels).astype(np.int32),
    )


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    dataset = Dataset.create(tmp_path_factory.mktemp("identify") / "d")
    for seed, (name, boxes) in enumerate(SCANS.items()):
        publish_scan(dataset, name, boxes, seed)
    return dataset


def run(dataset: Dataset, **options):
    [task] = plan(dataset, identify, options=options)
    return make(task)


def identities(dataset: Dataset, **options) -> Identities:
    outcome = run(dataset, **options)
    assert outcome.status == "made", outcome.why
    return Identities(dataset.path(Identities))


def members(found: Identities) -> list[list[str]]:
    return [[f"{each.scene}/{each.instance}" for each in row.members] for row in found.identities]


def test_the_same_boxes_are_found_in_other_scans_and_the_one_of_a_single_scan_is_unknown(scanned: Dataset) -> None:
    found = identities(scanned)
    assert members(found) == [["a/1", "b/2", "c/2"], ["a/2", "c/1"], ["a/3", "b/1"]]
    assert all(each.confidence > 0.9 for row in found.identities for each in row.members)
    [unknown] = found.metadata.unknown
    assert (unknown.scene, unknown.instance, unknown.why) == ("c", 3, "no partner")
    assert found.metadata.warnings == ["objects: no other scan shows a likely match of c/3"]
    assert found.of_instances()["c", 1].id == 2
    pairs = found.pairs().to_pylist()
    assert len(pairs) == 8 * 7 // 2
    odds = {(f"{p['scene_a']}/{p['instance_a']}", f"{p['scene_b']}/{p['instance_b']}"): p["log_odds"] for p in pairs}
    assert odds["a/1", "c/2"] > 2 > -2 > odds["a/1", "c/3"]
    assert found.summary()[0].strip().startswith("1  no name: a/1 9")


def test_what_the_user_states_is_followed_and_names_are_kept(scanned: Dataset, tmp_path: Path) -> None:
    dataset = copied(scanned, tmp_path / "d")
    stated = {"names": ("b/2=tin", "c/3=tray"), "same": ("a/3=c/3",), "different": ("a/2=c/1",)}
    found = identities(dataset, **stated)
    named = {row.name: [f"{each.scene}/{each.instance}" for each in row.members] for row in found.identities}
    assert named["tin"] == ["a/1", "b/2", "c/2"]
    assert named["tray"] == ["a/3", "c/3"] or named["tray"] == ["a/3", "b/1", "c/3"]
    assert {(row.scene, row.instance) for row in found.metadata.unknown} >= {("a", 2), ("c", 1)}


def test_twins_are_one_identity_that_says_so(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    publish_scan(dataset, "a", (RED, RED, BLUE), 0)
    publish_scan(dataset, "b", (RED, BLUE), 1)
    found = identities(dataset)
    assert members(found) == [["a/1", "a/2", "b/1"], ["a/3", "b/2"]]
    assert [row.twins for row in found.identities] == [True, False]
    assert "look the same, so which one is which cannot be told: a/1, a/2, b/1" in found.metadata.warnings[0]


def test_a_single_scan_has_no_identities_and_nothing_similar(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    publish_scan(dataset, "a", (RED,), 0)
    found = identities(dataset)
    assert found.identities == []
    [unknown] = found.metadata.unknown
    assert (unknown.why, unknown.similar) == ("no partner", "")
