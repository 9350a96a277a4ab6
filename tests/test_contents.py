from __future__ import annotations

from pathlib import Path

from bask_data.artifact import read_manifest
from bask_data.contents import contents
from bask_data.dataset import Dataset
from bask_data.kinds import Demonstration, Scan
from tests.datasets import add_scan


def test_contents_list_every_artifact_with_size_digest_and_cameras(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    assert contents(dataset) == []
    add_scan(dataset, "a")
    add_scan(dataset, "b", kind=Demonstration)
    scan, demonstration = contents(dataset)
    manifest = read_manifest(dataset.path(Scan, "a"))
    assert (scan.artifact, demonstration.artifact) == ("scan/a", "demonstration/b")
    assert scan.digest == manifest.digest
    assert scan.bytes == sum(entry.bytes for entry in manifest.files.values())
    assert scan.made_by == f"{manifest.stage} v{manifest.stage_version}"
    assert scan.cameras == {"wrist": "2 x 6x4"}
    assert {"kind", "schema"}.isdisjoint(scan.metadata)
