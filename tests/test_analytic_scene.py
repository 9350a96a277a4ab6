"""The pipeline against a scene whose every answer is a formula: 40 views of boxes and spheres, depth noise 1 mm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bask_data.artifact import read_manifest
from bask_data.core.geometry import invert_rigid, project, transform, unproject
from bask_data.dataset import Dataset
from bask_data.engine import make, plan
from bask_data.kinds import Correspondences, ObjectInstances, Reconstruction, VisibleMasks
from bask_data.stages.correspondences import correspondences
from bask_data.stages.masks import masks
from bask_data.stages.objects import objects
from bask_data.stages.reconstruct import reconstruct
from tests.datasets import publish_recording
from tests.scenes import Scene, View, intrinsics, noisy, orbit, tabletop

N_VIEWS, HEIGHT, WIDTH = 40, 480, 640
N_OBJECTS = 5
NOISE = 0.001


@pytest.fixture(scope="module")
def K() -> np.ndarray:
    return intrinsics(HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def world_from_cameras() -> np.ndarray:
    return orbit(N_VIEWS)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return tabletop(N_OBJECTS, seed=1)


@pytest.fixture(scope="module")
def views(scene: Scene, K: np.ndarray, world_from_cameras: np.ndarray) -> list[View]:
    return [scene.render(K, world_from_camera, HEIGHT, WIDTH) for world_from_camera in world_from_cameras]


def run_pipeline(root: Path, views: list[View], K: np.ndarray, world_from_cameras: np.ndarray) -> Dataset:
    dataset, rng = Dataset.create(root), np.random.default_rng(0)
    publish_recording(
        dataset,
        "table",
        rgb=[view.rgb for view in views],
        depth=[noisy(view.depth, NOISE, rng) for view in views],
        K=K,
        world_from_cameras=world_from_cameras,
    )
    for stage in (reconstruct, objects, masks, correspondences):
        [task] = plan(dataset, stage)
        outcome = make(task)
        assert outcome.status == "made", outcome.why
    return dataset


@pytest.fixture(scope="module")
def analytic(
    tmp_path_factory: pytest.TempPathFactory, views: list[View], K: np.ndarray, world_from_cameras: np.ndarray
) -> Dataset:
    return run_pipeline(tmp_path_factory.mktemp("analytic") / "d", views, K, world_from_cameras)


def test_surface_is_within_half_a_voxel(analytic: Dataset, scene: Scene) -> None:
    mesh = Reconstruction(analytic.path(Reconstruction, "table"))
    distance = scene.surface_distance(mesh.vertices.astype(np.float64))
    assert np.median(distance) <= mesh.voxel_size / 2


def test_every_object_is_found_and_nothing_else(analytic: Dataset) -> None:
    assert len(ObjectInstances(analytic.path(ObjectInstances, "table")).instances) == N_OBJECTS


def test_visible_masks_are_the_true_ones(analytic: Dataset, views: list[View]) -> None:
    camera = VisibleMasks(analytic.path(VisibleMasks, "table")).camera("wrist")
    predicted = np.stack([camera.instance(i) for i in range(N_VIEWS)])
    truth = np.stack([view.instance for view in views])
    overlap = np.zeros((N_OBJECTS, N_OBJECTS))
    for label in range(N_OBJECTS):
        for instance in range(N_OBJECTS):
            a, b = truth == label + 1, predicted == instance + 1
            overlap[label, instance] = np.sum(a & b) / np.sum(a | b)
    best = overlap.max(axis=1)
    assert len(set(overlap.argmax(axis=1))) == N_OBJECTS
    assert best.mean() >= 0.95, best
    assert best.min() >= 0.88, best


def test_matches_show_the_same_point(
    analytic: Dataset, views: list[View], K: np.ndarray, world_from_cameras: np.ndarray
) -> None:
    handle = Correspondences(analytic.path(Correspondences, "table"))
    matches = handle.matches()
    columns = {name: matches[name].to_numpy() for name in matches.column_names}
    pairs = handle.pairs()
    frame_a, frame_b = pairs["frame_a"].to_numpy(), pairs["frame_b"].to_numpy()
    error, is_hidden = [], []
    for pair in range(pairs.num_rows):
        mine = columns["pair"] == pair
        uv_a = np.stack([columns["u_a"], columns["v_a"]], axis=1)[mine].astype(np.float64)
        uv_b = np.stack([columns["u_b"], columns["v_b"]], axis=1)[mine].astype(np.float64)
        world_from_a, world_from_b = (world_from_cameras[frames[pair]] for frames in (frame_a, frame_b))
        # The true depth at the pixel itself, not at a rounded one: cast a camera whose only pixel it is.
        depth = exact_depth(views[frame_a[pair]], uv_a)
        points_world = transform(world_from_a, unproject(uv_a, depth, K))
        expected, z = project(transform(invert_rigid(world_from_b), points_world), K)
        error.append(np.linalg.norm(expected - uv_b, axis=1))
        v, u = np.round(expected).astype(int).clip(0, [[WIDTH - 1, HEIGHT - 1]]).T[::-1]
        is_hidden.append(z > views[frame_b[pair]].depth[v, u] + 0.02)
    error_px, hidden = np.concatenate(error), np.concatenate(is_hidden)
    assert len(error_px) > 1000
    assert np.mean(error_px <= 1.0) >= 0.99, np.percentile(error_px, [50, 90, 99])
    assert hidden.sum() == 0


def exact_depth(view: View, uv: np.ndarray) -> np.ndarray:
    """True z-depth at sub-pixel positions: bilinear in inverse depth, which is exact on planes."""
    u0, v0 = np.floor(uv).astype(int).T
    u0, v0 = u0.clip(0, WIDTH - 2), v0.clip(0, HEIGHT - 2)
    fu, fv = uv[:, 0] - u0, uv[:, 1] - v0
    inverse = 1 / np.where(view.depth > 0, view.depth, np.inf)
    upper = (1 - fu) * inverse[v0, u0] + fu * inverse[v0, u0 + 1]
    lower = (1 - fu) * inverse[v0 + 1, u0] + fu * inverse[v0 + 1, u0 + 1]
    return 1 / ((1 - fv) * upper + fv * lower)


def test_same_seed_gives_the_same_bytes(
    analytic: Dataset, tmp_path: Path, views: list[View], K: np.ndarray, world_from_cameras: np.ndarray
) -> None:
    again = run_pipeline(tmp_path / "again", views, K, world_from_cameras)
    for kind in (Reconstruction, ObjectInstances, VisibleMasks, Correspondences):
        digests = [read_manifest(each.path(kind, "table")).digest for each in (analytic, again)]
        assert digests[0] == digests[1], kind.kind
