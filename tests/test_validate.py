from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bask_data.artifact import MANIFEST, content_digest, file_digest, list_files
from bask_data.dataset import Dataset
from bask_data.engine import plan, run
from bask_data.kinds import DescriptorNet, Reconstruction
from bask_data.validate import validate
from tests.datasets import add_scan
from tests.toy_stages import fuse, learn, pick


@pytest.fixture
def complete(tmp_path: Path) -> Dataset:
    """A scan and all that the toy stages make from it."""
    dataset = Dataset.create(tmp_path / "table")
    add_scan(dataset, "a")
    for stage in (fuse, pick, learn):
        assert [outcome.status for outcome in run(plan(dataset, stage))] == ["made"]
    return dataset


def reseal(path: Path) -> None:
    """Make the manifest agree with changed files, so that only the schema can object."""
    manifest = json.loads((path / MANIFEST).read_text())
    manifest["files"] = {
        name: {"sha256": file_digest(file), "bytes": file.stat().st_size} for name, file in list_files(path)
    }
    from bask_data.artifact import FileEntry

    manifest["digest"] = content_digest(
        {name: FileEntry.model_validate(entry) for name, entry in manifest["files"].items()}
    )
    (path / MANIFEST).write_text(json.dumps(manifest))


def edit_array(path: Path, **fields: object) -> None:
    document = json.loads((path / "zarr.json").read_text()) | fields
    (path / "zarr.json").write_text(json.dumps(document))


def problems_of(dataset: Dataset) -> list[str]:
    return [str(problem) for problem in validate(dataset)]


def test_valid_dataset_has_no_problem(complete: Dataset) -> None:
    assert problems_of(complete) == []


def test_every_flipped_bit_is_found(complete: Dataset) -> None:
    rng = np.random.default_rng(0)
    files = [file for _, file in list_files(complete.path(Reconstruction, "a"))]
    for file in files:
        content = bytearray(file.read_bytes())
        position = int(rng.integers(len(content)))
        original = content[position]
        content[position] ^= 1 << int(rng.integers(8))
        file.write_bytes(content)
        assert any(file.name in problem for problem in problems_of(complete)), file
        content[position] = original
        file.write_bytes(content)
    assert problems_of(complete) == []


def test_missing_file_is_found(complete: Dataset) -> None:
    (complete.path(Reconstruction, "a") / "mesh.ply").unlink()
    assert any(problem.startswith("reconstruction/a/mesh.ply: missing.") for problem in problems_of(complete))


def test_foreign_file_is_found(complete: Dataset) -> None:
    (complete.path(Reconstruction, "a") / "notes.txt").write_text("mine")
    assert problems_of(complete) == ["reconstruction/a/notes.txt: not part of the artifact.  fix: move it elsewhere."]


def test_missing_recording_is_found(complete: Dataset) -> None:
    shutil.rmtree(complete.root / "scan" / "a")
    assert problems_of(complete)[0].startswith("scan/a: listed in dataset.json, but missing.")


def test_directory_that_is_not_listed_is_found(complete: Dataset) -> None:
    shutil.copytree(complete.root / "scan" / "a", complete.root / "scan" / "z")
    assert problems_of(complete) == ["scan/z: not listed in dataset.json.  fix: remove it, or ingest it."]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"data_type": "float64"}, "vertices: data_type: expected float32, got float64."),
        ({"shape": [6, 4]}, "vertices: shape: expected 3, got 4."),
        ({"shape": [5, 3]}, "vertices: shape: expected n = 6 as colors, got 5."),
        ({"shape": [6]}, "vertices: shape: expected (n, 3), got [6]."),
    ],
)
def test_array_that_differs_from_its_schema_is_found(
    complete: Dataset, fields: dict[str, object], message: str
) -> None:
    path = complete.path(Reconstruction, "a")
    edit_array(path / "vertices", **fields)
    reseal(path)
    assert any(message in problem for problem in problems_of(complete)), problems_of(complete)


def test_missing_array_is_found(complete: Dataset) -> None:
    path = complete.path(Reconstruction, "a")
    shutil.rmtree(path / "triangles")
    reseal(path)
    assert any("triangles: missing: required by the schema." in problem for problem in problems_of(complete))


def test_array_that_is_not_in_the_schema_is_found(complete: Dataset) -> None:
    path = complete.path(Reconstruction, "a")
    shutil.copytree(path / "colors", path / "colours")
    reseal(path)
    assert any("colours: not an array of the schema." in problem for problem in problems_of(complete))


def test_missing_attribute_is_found(complete: Dataset) -> None:
    path = complete.root / "scan" / "a"
    edit_array(path / "wrist" / "depth", attributes={})
    reseal(path)
    assert any("depth: attributes: expected scale_m." in problem for problem in problems_of(complete))


def test_table_with_other_columns_is_found(complete: Dataset) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = complete.path(DescriptorNet)
    pq.write_table(pa.table({"step": [1]}), path / "curve.parquet")
    reseal(path)
    assert any("curve.parquet: columns: expected" in problem for problem in problems_of(complete))
    (path / "curve.parquet").write_bytes(b"PAR1")
    reseal(path)
    assert any("curve.parquet: expected a Parquet table" in problem for problem in problems_of(complete))


def test_invalid_metadata_is_found(complete: Dataset) -> None:
    path = complete.path(Reconstruction, "a")
    document = json.loads((path / "zarr.json").read_text())
    document["attributes"]["bask"]["voxel_size"] = "wide"
    (path / "zarr.json").write_text(json.dumps(document))
    reseal(path)
    assert any("bask.voxel_size: expected a number" in problem for problem in problems_of(complete))
