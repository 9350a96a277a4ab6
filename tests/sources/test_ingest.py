from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest

from bask_data.dataset import Dataset
from bask_data.errors import BadData, BaskError, UsageError, WouldOverwrite
from bask_data.formats import FORMATS, Format
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.recording import RobotRecording, SourceRecording
from bask_data.kinds import Demonstration, Scan, Truth
from bask_data.sources.ingest import ingest
from bask_data.validate import validate

FORMAT = {format.name: format for format in FORMATS}
DATASETS = Path(__file__).parents[2] / "datasets"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Three frames, millimetres, one of them half unmeasured."""
    folder = tmp_path / "source"
    folder.mkdir()
    for i in range(3):
        rgb = np.full((4, 6, 3), 40 * i, dtype=np.uint8)
        depth = np.full((4, 6), 1000 + i, dtype=np.uint16)
        depth[:2] = 0 if i == 1 else depth[:2]
        cv2.imwrite(str(folder / f"frame-{i:06d}.color.png"), rgb)
        cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), depth)
        pose = np.eye(4)
        pose[0, 3] = 0.1 * i
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
    return folder


def frames(source: Path, root: Path, **arguments: object) -> list[str]:
    options = FORMAT["frames"].options(intrinsics="5,5,2.5,1.5", camera="wrist", **arguments.pop("options", {}))  # type: ignore[arg-type]
    outcomes, _ = ingest(root, "table", format=FORMAT["frames"], source=source, options=options, **arguments)  # type: ignore[arg-type]
    return [outcome.status for outcome in outcomes]


def everything_below(root: Path) -> dict[str, bytes]:
    return {str(file): file.read_bytes() for file in sorted(root.rglob("*")) if file.is_file()}


def test_frames_are_ingested_unchanged(source: Path, tmp_path: Path) -> None:
    assert frames(source, tmp_path / "d") == ["made"]
    dataset = Dataset(tmp_path / "d")
    camera = Scan(dataset.path(Scan, "table")).camera("wrist")
    assert (camera.n_frames, camera.height, camera.width) == (3, 4, 6)
    assert camera.depth(2)[0, 0] == pytest.approx(1.002)
    assert (camera.depth(1)[:2] == 0).all()
    assert camera.rgb(2)[0, 0].tolist() == [80, 80, 80]
    assert camera.world_from_cameras[2, 0, 3] == pytest.approx(0.2)
    assert dataset.file.scenes["table"].format == "frames"
    assert validate(dataset) == []


def test_assumptions_are_recorded(source: Path, tmp_path: Path) -> None:
    frames(source, tmp_path / "d")
    assert "pose" in " ".join(Scan(tmp_path / "d" / "scan" / "table").metadata.assumptions)


def test_same_source_and_options_again_is_up_to_date(source: Path, tmp_path: Path) -> None:
    frames(source, tmp_path / "d")
    assert frames(source, tmp_path / "d") == ["up to date"]


@pytest.mark.parametrize(
    ("option", "text"),
    [("color_from_depth", "1 0 0 0.001  0 1 0 0  0 0 1 0  0 0 0 1"), ("depth_intrinsics", "5 5 2.5 1.5")],
)
def test_a_file_that_an_option_names_is_part_of_the_source(
    source: Path, tmp_path: Path, option: str, text: str
) -> None:
    beside = tmp_path / "calibration.txt"
    beside.write_text(text)
    options = {option: str(beside), "trust": True}
    assert [frames(source, tmp_path / "d", options=options) for _ in range(2)] == [["made"], ["up to date"]]
    beside.write_text(text.replace("0.001", "0.002").replace("2.5", "2.4"))
    with pytest.raises(WouldOverwrite):
        frames(source, tmp_path / "d", options=options)


def test_a_gripper_that_is_lost_is_refused_in_a_demonstration_only(source: Path, tmp_path: Path) -> None:
    poses = np.stack([np.eye(4), np.full((4, 4), np.nan), np.eye(4)])
    with pytest.raises(BadData, match="robot at frame 1 of those read: expected its state at every frame"):
        with_gripper(source, tmp_path / "d", poses, "demonstration")
    assert not (tmp_path / "d").exists()
    with_gripper(source, tmp_path / "d", poses, "scan")


def with_gripper(source: Path, root: Path, poses: np.ndarray, kind: Literal["scan", "demonstration"]) -> None:
    """Ingest the frames of `source` with these poses of a gripper."""

    class WithGripper(Format):
        def opened(self, source: Path, options: SourceOptions) -> SourceRecording:
            return replace(super().opened(source, options), robot=RobotRecording(poses))

    format = WithGripper("frames", "", FORMAT["frames"].options)
    options = FramesOptions(intrinsics="5,5,2.5,1.5")
    ingest(root, "table", format=format, source=source, options=options, kind=kind)


def test_existing_scene_is_kept_without_force(source: Path, tmp_path: Path) -> None:
    frames(source, tmp_path / "d")
    before = everything_below(tmp_path / "d")
    with pytest.raises(WouldOverwrite, match="expected no recording of that name"):
        frames(source, tmp_path / "d", options={"depth_scale": 0.002})
    assert everything_below(tmp_path / "d") == before
    assert frames(source, tmp_path / "d", options={"depth_scale": 0.002}, force=True) == ["made"]
    assert Scan(tmp_path / "d" / "scan" / "table").camera("wrist").depth(0)[0, 0] == pytest.approx(2.0)


def test_name_of_a_demonstration_is_refused_for_a_scan(source: Path, tmp_path: Path) -> None:
    frames(source, tmp_path / "d", kind="demonstration")
    assert Demonstration(tmp_path / "d" / "demonstration" / "table").robot is None
    with pytest.raises(UsageError, match="got the name of a demonstration"):
        frames(source, tmp_path / "d", kind="scan")


def test_recording_that_a_kill_left_unlisted_is_listed_by_the_same_command(source: Path, tmp_path: Path) -> None:
    frames(source, tmp_path / "d")
    listed = (tmp_path / "d" / "dataset.json").read_text()
    document = json.loads(listed)
    document["scenes"] = {}
    (tmp_path / "d" / "dataset.json").write_text(json.dumps(document))
    assert frames(source, tmp_path / "d") == ["up to date"]
    assert (tmp_path / "d" / "dataset.json").read_text() == listed


def test_ground_truth_is_removed_with_the_recording_it_belongs_to(source: Path, tmp_path: Path) -> None:
    format = FORMAT["apc"]
    ingest(tmp_path / "d", "table", format=format, source=DATASETS / "apc_shelf", options=format.options())
    assert (tmp_path / "d" / "truth" / "table").exists()
    frames(source, tmp_path / "d", force=True)
    assert not (tmp_path / "d" / "truth" / "table").exists()


def test_failed_ingest_keeps_recordings_that_another_process_added_to_the_new_dataset(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def meanwhile(*_: object) -> None:
        monkeypatch.undo()
        format = FORMAT["frames"]
        options = format.options(intrinsics="5,5,2.5,1.5", camera="wrist")
        ingest(tmp_path / "d", "other", format=format, source=source, options=options)
        raise KeyboardInterrupt

    monkeypatch.setattr("bask_data.sources.ingest._write", meanwhile)
    with pytest.raises(KeyboardInterrupt):
        frames(source, tmp_path / "d")
    assert Dataset(tmp_path / "d").items("scene") == ["other"]
    assert validate(Dataset(tmp_path / "d")) == []


def all_invalid(source: Path) -> None:
    for file in source.glob("*.depth.png"):
        cv2.imwrite(str(file), np.zeros((4, 6), dtype=np.uint16))


def truncate(source: Path) -> None:
    file = source / "frame-000002.color.png"
    file.write_bytes(file.read_bytes()[:-20])


def mirror(source: Path) -> None:
    np.savetxt(source / "frame-000001.pose.txt", np.diag([1.0, 1.0, -1.0, 1.0]))


def lose(source: Path) -> None:
    (source / "frame-000001.depth.png").unlink()


@pytest.mark.parametrize("defect", [all_invalid, truncate, mirror, lose])
def test_refused_source_writes_nothing(source: Path, tmp_path: Path, defect) -> None:
    copy = shutil.copytree(source, tmp_path / "copy")
    defect(copy)
    with pytest.raises(BaskError, match="expected") as raised:
        frames(copy, tmp_path / "new")
    assert isinstance(raised.value, BadData)
    assert not (tmp_path / "new").exists()
    frames(source, tmp_path / "old")
    before = everything_below(tmp_path / "old")
    with pytest.raises(BadData):
        frames(copy, tmp_path / "old", force=True)
    assert everything_below(tmp_path / "old") == before


def test_labels_become_an_artifact_of_ground_truth(tmp_path: Path) -> None:
    format = FORMAT["apc"]
    outcomes, assumptions = ingest(
        tmp_path / "d", "shelf", format=format, source=DATASETS / "apc_shelf", options=format.options()
    )
    assert [(outcome.kind, outcome.status) for outcome in outcomes] == [("scan", "made"), ("truth", "made")]
    assert "bin" in assumptions["world"]
    truth = Truth(tmp_path / "d" / "truth" / "shelf")
    assert truth.label_names[132] == "tissue box"
    assert set(np.unique(truth.instance("wrist", 0))) == {0, 48, 114, 132, 144}
    assert Scan(tmp_path / "d" / "scan" / "shelf").camera("wrist").n_frames == 15
    assert validate(Dataset(tmp_path / "d")) == []


def test_recordings_of_one_place_far_away_share_an_origin(source: Path, tmp_path: Path) -> None:
    origins = []
    for k, item in enumerate(("first", "second")):
        for i in range(3):
            pose = np.eye(4)
            pose[:3, 3] = (4e5 + 0.1 * i + 40 * k, 5e6, 0.0)
            np.savetxt(source / f"frame-{i:06d}.pose.txt", pose, fmt="%.6f")
        options = FORMAT["frames"].options(intrinsics="5,5,2.5,1.5", camera="wrist")
        ingest(tmp_path / "d", item, format=FORMAT["frames"], source=source, options=options)
        scan = Scan(tmp_path / "d" / "scan" / item)
        origins.append(scan.metadata.origin)
        assert scan.camera("wrist").world_from_cameras[2, 0, 3] == pytest.approx(0.2 + 40 * k - (origins[0][0] - 4e5))
    assert origins[0] == origins[1] != (0, 0, 0)
