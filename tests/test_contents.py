from __future__ import annotations

from pathlib import Path

from bask_data.artifact import read_manifest
from bask_data.contents import contents
from bask_data.dataset import Dataset, Source
from bask_data.kinds import Demonstration, Scan
from bask_data.kinds.cameras import LensModel
from tests.datasets import add_scan, publish_artifact


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


def test_contents_state_what_was_done_to_a_recording(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    add_scan(dataset, "near")

    def fill(out: Path) -> None:
        lenses = {"wrist": LensModel(model="OPENCV_FISHEYE", parameters=[0.1, -0.02, 0.0, 0.0])}
        left_out = {"wrist/3": "no pose", "wrist/7": "no depth"}
        Scan.start(out, "test", {}, origin=(441547.25, 5121946.0, 245.0), left_out=left_out, lenses=lenses)

    dataset.add("scene", "far", Source(format="test", path="none"))
    publish_artifact(dataset, Scan, "far", fill)
    near, far = contents(dataset)
    assert near.stated == ()
    assert far.stated == (
        "origin 441547.25, 5121946, 245 m in the source's world frame",
        "2 frames left out, the first wrist/3: no pose",
        "wrist undistorted from OPENCV_FISHEYE 0.1 -0.02 0 0",
    )
