from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from bask_data.cli.app import app
from bask_data.dataset import Dataset
from bask_data.kinds import Demonstration, PoseRefinement, Scan
from bask_data.validate import validate
from tests.datasets import publish_recording
from tests.posed_scenes import HAND_EYE, HEIGHT, WIDTH, K, recorded, with_hand_eye_error


def bask_data(*words: object) -> Result:
    return CliRunner().invoke(app, list(map(str, words)))


@pytest.fixture(scope="module")
def refined(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """A scan with a hand-eye error, a right one, and a demonstration of the same rig; the first two refined."""
    root = tmp_path_factory.mktemp("refine") / "d"
    dataset = Dataset.create(root, "d", "")
    depths, true = recorded("orbiting")
    rgb = [np.full((HEIGHT, WIDTH, 3), i, np.uint8) for i in range(len(depths))]
    wrong = with_hand_eye_error(true)
    for name, poses, kind in (("off", wrong, Scan), ("right", true, Scan), ("demo", wrong[:2], Demonstration)):
        n = len(poses)
        publish_recording(dataset, name, rgb=rgb[:n], depth=depths[:n], K=K, world_from_cameras=poses, kind=kind)
    made = bask_data("refine", root, "off", "right", "--model", "hand-eye", "--json")
    assert made.exit_code == 0, made.output
    return root, json.loads(made.stdout)


def test_a_scan_with_corrected_poses_is_written_beside(refined: tuple[Path, dict]) -> None:
    root, document = refined
    assert document["written"] == ["off-refined"]
    assert [finding["code"] for finding in document["findings"]] == ["refined", "refine-no-better"]
    run, split = document["findings"][0]["fix"].split("; to train without off: ")
    assert run == f"bask-data run {root} --only off-refined"
    assert split == f"bask-data split {root} --train right,off-refined"
    dataset = Dataset(root)
    assert dataset.items("scene") == ["off", "right", "off-refined"]
    given, made = (Scan(dataset.path(Scan, name)) for name in ("off", "off-refined"))
    _, true = recorded("orbiting")
    camera = made.camera("wrist")
    assert np.abs(camera.world_from_cameras - true)[:, :3, 3].max() < 0.002
    assert np.array_equal(camera.depth_raw(3), given.camera("wrist").depth_raw(3))
    assert np.array_equal(camera.rgb(3), given.camera("wrist").rgb(3))
    assert made.metadata.assumptions["poses"].startswith("refined from off by depth: wrist: hand-eye")
    assert np.array_equal(given.camera("wrist").world_from_cameras, with_hand_eye_error(true))
    assert not validate(dataset)


def test_the_refinement_states_what_was_found(refined: tuple[Path, dict]) -> None:
    root, _ = refined
    found = PoseRefinement(root / "refinement" / "off")
    [row] = found.cameras
    assert (row.model, row.verdict) == ("hand-eye", "refined")
    assert np.abs(np.array(row.given_from_true) - HAND_EYE).max() < 0.003
    assert row.before is not None and row.after is not None
    assert row.after.distance_m < row.before.distance_m and row.after.angle_deg < row.before.angle_deg
    made = Scan(root / "scan" / "off-refined").camera("wrist").world_from_cameras
    assert np.array_equal(found.world_from_cameras("wrist"), made)
    assert not PoseRefinement(root / "refinement" / "right").is_refined
    # What was found does not depend on where the dataset lies, nor on the scans beside it.
    stored = [file.read_bytes() for file in (root / "refinement" / "off").rglob("*.json")]
    assert any(b"given_from_true" in each for each in stored)
    assert not any(str(root).encode() in each or b"bask-data split" in each for each in stored)


def test_what_is_up_to_date_is_not_made_again_and_what_a_kill_left_out_is(refined: tuple[Path, dict]) -> None:
    root, _ = refined
    again = bask_data("refine", root, "off", "right", "--model", "hand-eye", "--json")
    assert [row["status"] for row in json.loads(again.stdout)["outcomes"]] == ["up to date"] * 2
    digest = Scan(root / "scan" / "off-refined").manifest.digest
    shutil.rmtree(root / "scan" / "off-refined")  # As after a kill between the two.
    again = bask_data("refine", root, "off", "--model", "hand-eye", "--json")
    assert [row["status"] for row in json.loads(again.stdout)["outcomes"]] == ["made"] * 2
    assert Scan(root / "scan" / "off-refined").manifest.digest == digest


def test_the_hand_eye_correction_is_applied_to_demonstrations_of_the_rig(refined: tuple[Path, dict]) -> None:
    root, _ = refined
    made = bask_data("refine", root, "demo", "--apply", "off")
    assert made.exit_code == 0, made.output
    camera = Demonstration(root / "demonstration" / "demo-refined").camera("wrist")
    E = np.array(PoseRefinement(root / "refinement" / "off").cameras[0].given_from_true)
    given = Demonstration(root / "demonstration" / "demo").camera("wrist")
    np.testing.assert_allclose(camera.world_from_cameras, given.world_from_cameras @ E, atol=1e-12)
    again = bask_data("refine", root, "demo", "--apply", "off", "--json")
    assert json.loads(again.stdout)["outcomes"][0]["status"] == "up to date"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["off", "--as", "off"], "expected a new name"),
        (["off", "--as", "demo"], "name of a demonstration"),
        (["off", "--as", "right"], "one from another source or with other options"),
        (["off", "right", "--as", "c"], "--as: expected one recording"),
        (["nothing"], "nothing"),
        (["demo", "--apply", "right"], "expected a hand-eye correction of wrist, got none"),
        (["--apply", "off"], "expected recordings to apply it to"),
        (["off", "--near", "5"], "expected less than far"),
    ],
)
def test_what_cannot_be_done_is_refused(refined: tuple[Path, dict], words: list[str], message: str) -> None:
    root, _ = refined
    refused = bask_data("refine", root, *words)
    assert refused.exit_code != 0
    assert message in " ".join((str(refused.exception) + refused.output).split())
