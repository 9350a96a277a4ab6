"""Values that fit the schema and make no sense are refused where they are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr

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
        _ = Scan(scan).camera("wrist").K


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
