"""Cameras of recordings whose intrinsics change from frame to frame."""

from pathlib import Path

import numpy as np
import pytest
import zarr

import bask_data as bask
from bask_data.dataset import Dataset
from bask_data.errors import BadData, UsageError
from bask_data.kinds import Scan
from bask_data.validate import validate
from tests.datasets import add_scan, publish_recording

N = 3
KS = np.tile(np.array([[5.0, 0, 2.5], [0, 5, 1.5], [0, 0, 1]]), (N, 1, 1))
KS[:, 0, 2] += [0.0, 0.25, -0.5]


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """`changing` has intrinsics of each frame, `fixed` one matrix."""
    dataset = Dataset.create(tmp_path / "d")
    add_scan(dataset, "fixed", N)
    publish_recording(
        dataset,
        "changing",
        rgb=[np.full((4, 6, 3), 7, np.uint8)] * N,
        depth=[np.full((4, 6), 2.0)] * N,
        K=KS,
        world_from_cameras=np.tile(np.eye(4), (N, 1, 1)),
    )
    return dataset


def test_a_frame_has_its_own_intrinsics_and_one_matrix_is_that_of_all_frames(dataset: Dataset) -> None:
    changing, fixed = (Scan(dataset.path(Scan, name)).camera("wrist") for name in ("changing", "fixed"))
    np.testing.assert_array_equal(changing.Ks, KS)
    np.testing.assert_array_equal(fixed.Ks, KS[[0, 0, 0]])
    for name, shape in (("changing", (N, 3, 3)), ("fixed", (3, 3))):
        assert zarr.open_group(str(dataset.path(Scan, name)), mode="r")["wrist/intrinsics"].shape == shape  # type: ignore[union-attr]
    assert validate(dataset) == []


def test_world_points_are_of_the_frames_intrinsics(dataset: Dataset) -> None:
    camera = Scan(dataset.path(Scan, "changing")).camera("wrist")
    for i_frame, K in enumerate(KS):
        points = camera.points_world(i_frame, np.array([[4.0, 2.0]]), np.array([2.0]))
        np.testing.assert_allclose(points, [[(4 - K[0, 2]) / 5 * 2, 0.2, 2.0]], atol=1e-12)


def test_intrinsics_of_another_number_of_frames_are_refused(dataset: Dataset) -> None:
    zarr.open_group(str(dataset.path(Scan, "changing")), mode="r+")["wrist/intrinsics"].resize((2, 3, 3))  # type: ignore[union-attr]
    with pytest.raises(BadData, match=r"intrinsics: expected \(3, 3\) or \(3, 3, 3\), got \(2, 3, 3\)"):
        _ = Scan(dataset.path(Scan, "changing")).camera("wrist").Ks
    assert any("intrinsics: shape: expected t = 3" in str(problem) for problem in validate(dataset))


def test_the_frame_without_a_pinhole_matrix_is_named(dataset: Dataset) -> None:
    zarr.open_group(str(dataset.path(Scan, "changing")), mode="r+")["wrist/intrinsics"][1, 0, 0] = 0.0  # type: ignore[index]
    with pytest.raises(BadData, match="intrinsics 1: expected a pinhole matrix"):
        _ = Scan(dataset.path(Scan, "changing")).camera("wrist").Ks


def test_one_matrix_of_frames_that_have_several_is_refused(dataset: Dataset) -> None:
    frames = bask.open(dataset.root).scans["changing"]
    np.testing.assert_array_equal([frame.K for frame in frames], KS)
    np.testing.assert_array_equal(frames[1:2].K, KS[1])
    with pytest.raises(UsageError, match=r"K: expected the same pinhole matrix in all frames, got one that changes"):
        _ = frames.K
    np.testing.assert_array_equal(frames.Ks, KS)
    np.testing.assert_array_equal(bask.open(dataset.root).scans["fixed"].K, KS[0])
