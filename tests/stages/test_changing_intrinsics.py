"""A recording whose principal point moves from frame to frame, as phones that stabilise their images make it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid, project, transform, unproject
from bask_data.dataset import Dataset
from bask_data.engine import make, plan
from bask_data.kinds import Correspondences, ObjectInstances, Scan, VisibleMasks
from bask_data.stages.correspondences import correspondences
from bask_data.stages.masks import masks
from bask_data.stages.objects import objects
from bask_data.stages.reconstruct import reconstruct
from tests.datasets import publish_recording
from tests.scenes import Scene, View, intrinsics, orbit, tabletop

HEIGHT, WIDTH, N = 120, 160, 12
SCENE: Scene = tabletop(3, seed=4)
CAMERAS = orbit(N, radius=0.6)
KS = np.tile(intrinsics(HEIGHT, WIDTH), (N, 1, 1))
SHIFTS = np.random.default_rng(0).integers(-7, 8, (N, 2))
"""Of the principal point (u, v), whole pixels, so that the images of both recordings have the same rays."""
SHIFTED = KS.copy()
SHIFTED[:, :2, 2] += SHIFTS
BORDER_PX = 8
"""More than any shift: pixels beyond may be in one recording only."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """One scene recorded as `fixed`, as `changing`, and as `wrong`: the same images with one matrix for all."""
    dataset = Dataset.create(tmp_path_factory.mktemp("changing") / "d")
    for name, rendered, K in (("fixed", KS, KS[0]), ("changing", SHIFTED, SHIFTED), ("wrong", SHIFTED, KS[0])):
        views: list[View] = [SCENE.render(*of_frame, HEIGHT, WIDTH) for of_frame in zip(rendered, CAMERAS, strict=True)]
        images = {"rgb": [view.rgb for view in views], "depth": [view.depth for view in views]}
        publish_recording(dataset, name, **images, K=K, world_from_cameras=CAMERAS)
    for stage, options in (
        (reconstruct, {"voxel_size": 0.006}),
        (objects, {}),
        (masks, {}),
        (correspondences, {"n_pairs": 8, "n_matches": 100}),
    ):
        for task in plan(dataset, stage, options=options):
            outcome = make(task)
            assert outcome.status == "made" or outcome.item == "wrong", outcome
    return dataset


def share_off(dataset: Dataset, name: str) -> float:
    """Share of the objects' pixels in `fixed` that, moved by the shift, have no pixel of their object beside them."""
    own, fixed = (VisibleMasks(dataset.path(VisibleMasks, item)).camera("wrist") for item in (name, "fixed"))
    n_off = n_all = 0
    inner = (slice(BORDER_PX, -BORDER_PX), slice(BORDER_PX, -BORDER_PX))
    for i_frame, (u, v) in enumerate(SHIFTS):
        mine, there = np.roll(own.instance(i_frame), (-v, -u), axis=(0, 1)), fixed.instance(i_frame)
        for label in range(1, SCENE.n_objects + 1):
            for first, second in ((mine, there), (there, mine)):
                beside = cv2.dilate((second == label).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
                n_off += int(((first == label) & ~beside)[inner].sum())
                n_all += int((first == label)[inner].sum())
    assert n_all > 1000
    return n_off / n_all


def test_masks_are_those_of_a_fixed_camera_within_a_pixel(made: Dataset) -> None:
    assert len(ObjectInstances(made.path(ObjectInstances, "changing")).instances) == SCENE.n_objects
    assert share_off(made, "changing") < 0.002


def test_one_matrix_for_such_images_gives_other_masks(made: Dataset) -> None:
    assert not made.path(VisibleMasks, "wrong").exists() or share_off(made, "wrong") > 0.05


def test_matches_meet_by_each_frames_own_intrinsics(made: Dataset) -> None:
    found = Correspondences(made.path(Correspondences, "changing"))
    camera, table, begin = Scan(made.path(Scan, "changing")).camera("wrist"), found.matches(), 0
    errors = []
    for pair in found.pairs().to_pylist():
        a, b, rows = pair["frame_a"], pair["frame_b"], table.slice(begin, pair["n_matches"])
        begin += pair["n_matches"]
        uv_a, uv_b = (np.stack([rows[f"u_{x}"], rows[f"v_{x}"]], axis=1).astype(np.float64) for x in "ab")
        u, v = np.rint(uv_a).astype(int).T
        points = transform(CAMERAS[a], unproject(uv_a, camera.depth(a)[v, u].astype(np.float64), SHIFTED[a]))
        errors += [np.linalg.norm(project(transform(invert_rigid(CAMERAS[b]), points), SHIFTED[b])[0] - uv_b, axis=1)]
    assert len(errors) > 3 and np.median(np.concatenate(errors)) < 0.5
