"""Cameras of recordings whose intrinsics change from frame to frame."""

from pathlib import Path

import numpy as np
import pytest
import zarr

import bask_data as bask
from bask_data.dataset import Dataset
from bask_data.errors import BadData, UsageError
from bask_data.kinds import CameraFrames, Scan
from bask_data.kinds.arrays import FrameWriter
from bask_data.kinds.cameras import LensModel
from bask_data.notebook.recordings import RecordedFrames
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
    assert frames.origin == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(bask.open(dataset.root).scans["fixed"].K, KS[0])


def written(out: Path, n: int, K: np.ndarray) -> Scan:
    """A scan of n frames, each of its number."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    lenses = {"wrist": LensModel(model="FOV", parameters=[0.5])}
    group = Scan.start(out, "test", {}, origin=(4e5, 5e6, 2.0), left_out={"wrist/7": "no depth"}, lenses=lenses)
    frames = CameraFrames(
        K,
        poses,
        np.arange(n) / 30.0,
        0.001,
        (4, 6),
        lambda i: (np.full((4, 6, 3), i, np.uint8), np.full((4, 6), i, np.uint16)),
    )
    Scan.write_camera(group, "wrist", frames)
    return Scan(out)


def test_what_ingest_did_stands_in_the_metadata(tmp_path: Path) -> None:
    scan = written(tmp_path, 3, KS)
    np.testing.assert_array_equal(scan.camera("wrist").Ks, KS)
    assert scan.metadata.left_out == {"wrist/7": "no depth"}
    assert RecordedFrames(scan, lambda camera, i: np.zeros((4, 6), np.uint8)).origin == (4e5, 5e6, 2.0)
    assert scan.metadata.origin == (4e5, 5e6, 2.0) and scan.metadata.lenses["wrist"].parameters == [0.5]


def test_equal_matrices_of_all_frames_are_stored_once(tmp_path: Path) -> None:
    assert written(tmp_path, 3, KS).group["wrist/intrinsics"].shape == (3, 3, 3)  # type: ignore[union-attr]
    same = np.tile(KS[0], (3, 1, 1))
    assert written(tmp_path / "same", 3, same).group["wrist/intrinsics"].shape == (3, 3)  # type: ignore[union-attr]


def test_frames_that_are_missing_are_an_error(tmp_path: Path) -> None:
    writer = FrameWriter(Scan.start(tmp_path, "test", {}), Scan, "wrist/depth", 3, (4, 6), scale_m=0.001)
    writer.append(np.zeros((4, 6), np.uint16))
    with pytest.raises(ValueError, match="1 frames written, 3 announced"):
        writer.close()


def test_an_origin_that_is_no_number_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="origin"):
        Scan.start(tmp_path, "test", {}, origin=(0.0, np.nan, 0.0))
