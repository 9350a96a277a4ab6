"""Recordings of schema version 1, kept in `v1/` as bask-data wrote them, open for ever."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import bask_data as bask
from bask_data.artifact import MANIFEST
from bask_data.dataset import Dataset
from bask_data.engine import make, plan
from bask_data.engine.state import key_parts
from bask_data.errors import BadData, WouldOverwrite
from bask_data.formats import FORMATS
from bask_data.kinds import Demonstration, Reconstruction, Recording, Scan
from bask_data.schemas import FOLDER, OLDER, schema_of
from bask_data.sources.ingest import ingest
from bask_data.stages.reconstruct import reconstruct
from bask_data.validate import validate

V1 = Path(__file__).parent / "v1"
K = np.array([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])
RECORDINGS = [(Scan, "table1"), (Demonstration, "lift1")]


@pytest.fixture
def old(tmp_path: Path) -> Dataset:
    """A scan and a demonstration of two frames as version 1 wrote them, beside their source."""
    shutil.copytree(V1, tmp_path / "v1")
    return Dataset(tmp_path / "v1" / "dataset")


@pytest.mark.parametrize(("kind", "item"), RECORDINGS)
def test_version_1_opens_with_what_version_2_added(old: Dataset, kind: type[Recording], item: str) -> None:
    recording = kind(old.path(kind, item))
    assert recording.manifest.schema_version == 1
    recording.check_complete()
    assert recording.metadata.origin == (0.0, 0.0, 0.0)
    assert recording.metadata.left_out == {} and recording.metadata.lenses == {}
    camera = recording.camera("wrist")
    np.testing.assert_array_equal(camera.Ks, [K, K])
    np.testing.assert_allclose(camera.world_from_cameras[1][:3], [[1, 0, 0, 0.032], [0, -1, 0, 0], [0, 0, -1, 0.4]])
    depth = camera.depth(1)
    np.testing.assert_allclose(np.unique(depth), [0.36, 0.4], rtol=1e-6)
    assert (depth[16:32, 20:36] < 0.38).all()
    assert camera.rgb(0)[20, 30].tolist() == [30, 40, 200]


def test_version_1_is_valid_and_a_version_that_does_not_exist_yet_is_not(old: Dataset) -> None:
    assert validate(old) == []
    manifest = old.path(Scan, "table1") / MANIFEST
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"schema_version": 3}))
    assert any("expected scan v2, got scan v3" in str(problem) for problem in validate(old))
    with pytest.raises(BadData, match="schema: expected scan v2, got scan v3"):
        Scan(old.path(Scan, "table1")).check_complete()


def test_a_stage_runs_on_version_1_and_its_key_knows_only_the_content(old: Dataset) -> None:
    [task] = plan(old, reconstruct, options={"voxel_size": 0.02})
    outcome = make(task)
    assert outcome.status == "made", outcome
    mesh = Reconstruction(old.path(Reconstruction, "table1"))
    assert len(mesh.triangles) > 100
    assert key_parts(task)["inputs"] == {"scan/table1": Scan(old.path(Scan, "table1")).manifest.digest}
    assert bask.open(old.root).demonstrations["lift1"][1].K[0, 2] == 31.5


@pytest.mark.parametrize(("kind", "item"), RECORDINGS)
def test_ingesting_again_keeps_version_1_and_says_so(old: Dataset, kind: type[Recording], item: str) -> None:
    format = next(format for format in FORMATS if format.name == "frames")
    options = format.options(camera="wrist", depth_scale=0.0001, intrinsics="50,50,31.5,23.5")
    arguments = {"format": format, "source": old.root.parent / "source", "options": options, "kind": kind.kind}
    before = (old.path(kind, item) / MANIFEST).read_bytes()
    with pytest.raises(WouldOverwrite, match=f"got {kind.kind} v1, made by an older version.*--force") as refused:
        ingest(old.root, item, **arguments)
    assert refused.value.exit_code == 3 and (old.path(kind, item) / MANIFEST).read_bytes() == before
    ingest(old.root, item, **arguments, force=True)
    made, first = kind(old.path(kind, item)), kind(V1 / "dataset" / kind.kind / item)
    assert made.manifest.schema_version == 2
    arrays = [name for name in made.manifest.files if name.startswith("wrist/")]
    assert {name: made.manifest.files[name] for name in arrays if name.endswith("zarr.json")} == {
        name: first.manifest.files[name] for name in arrays if name.endswith("zarr.json")
    }
    for i_frame in range(2):
        np.testing.assert_array_equal(made.camera("wrist").depth_raw(i_frame), first.camera("wrist").depth_raw(i_frame))
    [again], _ = ingest(old.root, item, **arguments)
    assert again.status == "up to date"


def test_the_schemas_of_older_versions_are_kept() -> None:
    assert {"scan.v1.json", "demonstration.v1.json"} == OLDER
    for kind in (Scan, Demonstration):
        old, new = json.loads((FOLDER / f"{kind.kind}.v1.json").read_text()), schema_of(kind)
        assert (old["schema"], new["schema"]) == (1, 2)
        before, after = (schema["arrays"]["{camera}/intrinsics"] for schema in (old, new))
        assert before["dims"] == after["dims"] == ["3", "3"]
        assert after["other_dims"] == ["t", "3", "3"] and "other_dims" not in before
        assert "origin" in new["metadata"]["properties"] and "origin" not in old["metadata"]["properties"]
