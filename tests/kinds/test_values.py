"""Values that fit the schema and make no sense are refused where they are read."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import zarr

from bask_data.core.calibration import Calibration
from bask_data.core.tsdf import Mesh
from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.kinds import Pick, Reconstruction, ReferenceKeypoints, Scan
from tests.datasets import add_scan


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    dataset = Dataset.create(tmp_path / "d")
    add_scan(dataset, "a")
    return dataset.path(Scan, "a")


@pytest.mark.parametrize("fault", [np.nan, 0.0])
def test_intrinsics_that_are_no_camera(scan: Path, fault: float) -> None:
    zarr.open_group(str(scan), mode="r+")["wrist/intrinsics"][0, 0] = fault
    with pytest.raises(BadData, match="intrinsics: expected a pinhole matrix"):
        _ = Scan(scan).camera("wrist").Ks


def test_transforms_that_are_not_rigid(scan: Path) -> None:
    zarr.open_group(str(scan), mode="r+")["wrist/world_from_camera"][1] = np.diag([1.0, 1, -1, 1])
    with pytest.raises(BadData, match="world_from_camera 1: expected a rigid transform, got a mirrored frame"):
        _ = Scan(scan).camera("wrist").world_from_cameras


def test_triangles_of_vertices_that_do_not_exist(tmp_path: Path) -> None:
    Reconstruction.write(
        tmp_path,
        Mesh(
            np.zeros((3, 3), dtype=np.float32), np.array([[0, 1, 3]], dtype=np.int32), np.zeros((3, 3), dtype=np.uint8)
        ),
        voxel_size=0.01,
        bounds=(0, 0, 0, 1, 1, 1),
    )
    with pytest.raises(BadData, match="triangles: expected indices below 3, got 3"):
        _ = Reconstruction(tmp_path).triangles


def test_descriptors_that_are_not_finite(tmp_path: Path) -> None:
    pick = Pick(name="x", recording="a", camera="wrist", frame=0, u=0, v=0)
    ReferenceKeypoints.write(tmp_path, descriptors=np.full((1, 4), np.nan, dtype=np.float32), picks=[pick])
    with pytest.raises(BadData, match="descriptors: expected finite numbers"):
        _ = ReferenceKeypoints(tmp_path).descriptors


def test_calibrations_are_read_as_written_and_are_missing_in_artifacts_without_one(tmp_path: Path) -> None:
    pick = Pick(name="x", recording="a", camera="wrist", frame=0, u=0, v=0)
    descriptors = np.zeros((1, 4), dtype=np.float32)
    measured = Calibration(np.array([3.5]), np.array([0.25]), np.array([32.0]))
    ReferenceKeypoints.write(tmp_path / "with", descriptors=descriptors, picks=[pick], calibration=measured)
    ReferenceKeypoints.write(tmp_path / "without", descriptors=descriptors, picks=[pick])
    found = ReferenceKeypoints(tmp_path / "with").calibration
    assert found is not None
    for name in ("alpha", "tau_ratio", "sharp_alpha"):
        np.testing.assert_array_equal(getattr(found, name), getattr(measured, name))
    assert ReferenceKeypoints(tmp_path / "without").calibration is None


@pytest.mark.parametrize(
    ("ratio", "got"),
    [
        ([0.0], r"\[0.0\]"),
        ([-1.0], r"\[-1.0\]"),
        ([math.nan], r"\[nan\]"),
        ([math.inf], r"\[inf\]"),
        ([1e300], r"\[1e\+300\]"),
        ([0.5, 0.5], r"\(2,\) float64"),
    ],
)
def test_calibrations_that_no_filter_can_compute_with(tmp_path: Path, ratio: list[float], got: str) -> None:
    pick = Pick(name="x", recording="a", camera="wrist", frame=0, u=0, v=0)
    wrong = Calibration(np.full(len(ratio), 3.5), np.array(ratio), np.full(len(ratio), 32.0))
    descriptors = np.zeros((1, 4), dtype=np.float32)
    ReferenceKeypoints.write(tmp_path, descriptors=descriptors, picks=[pick], calibration=wrong)
    with pytest.raises(BadData, match=rf"expected 1 numbers above 0, at most 1e\+06, got {got}"):
        _ = ReferenceKeypoints(tmp_path).calibration
