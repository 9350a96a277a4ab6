from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

import bask_data.core
from bask_data.cli.app import app
from bask_data.dataset import Dataset
from bask_data.kinds import Correspondences, Demonstration, Scan, VisibleMasks
from bask_data.pipeline import STAGES
from tests.datasets import add_scan, publish_artifact
from tests.tiny import write_recording

SHELF = str(Path(__file__).parents[2] / "datasets" / "apc_shelf")


def cli(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def one_scan(tmp_path: Path) -> Dataset:
    dataset = Dataset.create(tmp_path / "table")
    add_scan(dataset, "a")
    return dataset


def test_help_imports_nothing_heavy() -> None:
    heavy = ("open3d", "torch", "zarr", "cv2", "sklearn", "scipy", "matplotlib", "numba", "pyarrow")
    code = f"import sys, bask_data.cli; print([name for name in {heavy!r} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_every_parameter_of_every_stage_is_an_option_that_says_what_it_does(stage) -> None:
    shown = cli(stage.name, "--help")
    assert shown.exit_code == 0
    for name, field in stage.params.model_fields.items():
        assert field.description, f"{stage.name}.{name} has no description"
        assert f"--{name.replace('_', '-')}" in shown.stdout
    for option in ("--jobs", "--cluster", "--force", "--config", "--set", "--dry-run", "--json"):
        assert option in shown.stdout


def test_no_stage_reads_ground_truth_by_default() -> None:
    readers = [stage for stage in STAGES if "truth" in [input_.artifact.kind for input_ in stage.inputs]]
    # `encode` can write ground truth as a track, but by default it does not read it.
    assert [stage.name for stage in readers] == ["encode"]
    assert readers[0].params().reads("truth") == ()


def test_json_is_the_only_output_on_stdout(tmp_path: Path) -> None:
    ended = cli("init", tmp_path / "d", "--json")
    assert json.loads(ended.stdout)["command"] == "init"
    assert "next: bask-data ingest" in ended.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["status", "{root}/none"], 4, "fix: check the path, or create one: bask-data init"),
        (["init", "{root}"], 3, "expected no dataset, got one"),
        (["reconstruct", "{root}", "--voxel-size", "-1"], 2, "voxel_size: expected"),
        (["reconstruct", "{root}", "--only", "b"], 2, "--only: expected one of a, got b"),
        (["run", "{root}", "--only", "b"], 2, "--only: expected one of a, got b"),
        (["reconstruct", "{root}", "--set", "fuse.x=1"], 2, "fuse: expected one of reconstruct"),
        (["objects", "{root}"], 2, "reconstruction/a is missing"),
        (["reconstruct", "{root}", "--stage-version", "99"], 2, "fix: bask-data dvc"),
        (["split", "{root}", "--train", "z"], 2, "splits: expected one of a, got z"),
        (["encode", "{root}"], 2, "expected a demonstration, got none"),
        (["view", "{root}", "--only", "nix"], 2, "fix: `bask-data info "),
        (["split", "{root}", "--train", "nix"], 2, "fix: `bask-data info "),
        (["export", "parquet", "{root}", "{root}-out", "--noise", "-1"], 2, "fix: for instance --noise"),
        (["ingest", "sim", "{root}", "--task", "lid", "--only", "lid_scn0"], 2, "fix: did you mean lid_scan0?"),
        (["ingest", "sim", "{root}", "--task", "lid", "--only", "q"], 2, "fix: for instance --only lid_scan0"),
        (["reconstruct", "{root}", "--workspace", "1,2,3"], 2, "workspace: expected 6 values, got 3: '1,2,3'."),
        (["encode", "{root}", "--variant", "../x"], 2, "--variant: expected letters, digits"),
        (["encode", "{root}", "--descriptor", "a b"], 2, "--descriptor: expected letters, digits"),
        (["ingest", "frames", "{root}", "{root}", "--scene", "a ü"], 2, "ingest frames: --scene: expected letters"),
        (["no-such-command"], 2, "expected one of its commands, got no-such-command"),
        (["ingest", "frames", "{root}/none", "{root}", "--scene", "b"], 2, "SOURCE: expected a directory that exists"),
    ],
)
def test_errors_have_an_exit_code_and_a_fix(one_scan: Dataset, arguments: list[str], code: int, message: str) -> None:
    ended = cli(*[argument.format(root=one_scan.root) for argument in arguments])
    assert (ended.exit_code, message in ended.stderr) == (code, True), ended.stderr


def test_interrupt_exits_with_130_and_says_how_to_continue(one_scan: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("bask_data.cli.stages.made", interrupted)
    ended = cli("reconstruct", one_scan.root)
    assert ended.exit_code == 130
    assert "run the same command again to continue" in ended.stderr


def test_library_that_does_not_load_exits_with_5(one_scan: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    # An earlier test may have loaded it already: both the module and the package's name for it have to go.
    monkeypatch.delitem(sys.modules, "bask_data.core.tsdf", raising=False)
    monkeypatch.delattr(bask_data.core, "tsdf", raising=False)
    ended = cli("reconstruct", one_scan.root)
    assert ended.exit_code == 5
    assert "fix: bask-data doctor" in ended.stderr


def test_dry_run_shows_what_would_be_made_and_why_and_makes_nothing(one_scan: Dataset) -> None:
    ended = cli("run", one_scan.root, "--dry-run", "--json")
    outcomes = json.loads(ended.stdout)["outcomes"]
    assert outcomes[0]["label"] == "reconstruct a"
    assert {outcome["status"] for outcome in outcomes} == {"would make"}
    assert outcomes[1]["why"] == "after reconstruction/a"
    assert "next: the same without --dry-run" in ended.stderr
    assert not (one_scan.root / "reconstruction").exists()


def test_status_says_what_is_missing(one_scan: Dataset) -> None:
    rows = json.loads(cli("status", one_scan.root, "--json").stdout)["artifacts"]
    assert rows[0] == {"stage": "reconstruct", "label": "reconstruct a", "status": "missing", "why": ""}
    assert {"stage": "objects", "label": "objects a", "status": "blocked", "why": "reconstruction/a is missing"} in rows


def test_damaged_input_blocks_what_reads_it_and_status_lists_the_rest(one_scan: Dataset) -> None:
    (one_scan.path(Scan, "a") / "artifact.json").write_text("{}")
    rows = json.loads(cli("status", one_scan.root, "--json").stdout)["artifacts"]
    assert (rows[0]["label"], rows[0]["status"]) == ("reconstruct a", "blocked")
    assert "scan/a/artifact.json" in rows[0]["why"] and "bask-data ingest" in rows[0]["why"]
    assert len(rows) > 1
    outcomes = json.loads(cli("run", one_scan.root, "--dry-run", "--json").stdout)["outcomes"]
    assert outcomes[0]["status"] == "blocked"
    assert cli("reconstruct", one_scan.root).exit_code == 4


def test_missing_file_of_a_parameter_is_shown_and_status_lists_the_rest(one_scan: Dataset) -> None:
    for kind, item in ((VisibleMasks, "a"), (Correspondences, "a")):
        publish_artifact(one_scan, kind, item, lambda out: None)
    (one_scan.root / "params.yaml").write_text("train: {weights: nowhere.pth}")
    ended = cli("status", one_scan.root, "--json")
    assert ended.exit_code == 0
    rows = {row["label"]: row for row in json.loads(ended.stdout)["artifacts"]}
    assert rows["train"]["status"] == "blocked"
    assert "train: weights: expected a file, got nowhere.pth" in rows["train"]["why"]
    assert rows["reconstruct a"]["status"] == "missing"


def test_info_and_validate_of_a_recording(one_scan: Dataset) -> None:
    info = json.loads(cli("info", one_scan.root, "--json").stdout)
    assert info["artifacts"][0]["cameras"] == {"wrist": "2 x 6x4"}
    assert cli("validate", one_scan.root).exit_code == 0
    (one_scan.path(Scan, "a") / "wrist" / "zarr.json").unlink()
    ended = cli("validate", one_scan.root)
    assert ended.exit_code == 4
    assert "scan/a/wrist/zarr.json: missing." in ended.stdout


def test_ingest_prints_every_assumption_and_refuses_to_overwrite(tmp_path: Path) -> None:
    ended = cli("ingest", "apc", SHELF, tmp_path / "d", "--scene", "shelf")
    assert ended.exit_code == 0
    assert "assumed     world: the shelf bin's frame" in ended.stderr
    assert "next: bask-data run" in ended.stderr
    again = cli("ingest", "apc", SHELF, tmp_path / "d", "--scene", "shelf", "--fps", "5")
    assert again.exit_code == 3
    assert "pass --force" in again.stderr


def test_poses_of_another_convention_are_refused_with_the_options_that_fit(tmp_path: Path) -> None:
    files, root = tmp_path / "my files", tmp_path / "d"
    options = write_recording(files)
    call = ["ingest", "frames", files, root, "--scene", "a", "--as", "demonstration", *options]
    refused = cli(*call, "--axes", "opengl")
    assert refused.exit_code == 4 and not root.exists()
    assert "fix: pass --pose-is world_from_camera --axes opencv; --trust reads it as told." in refused.stderr
    corrected = cli(*call, "--pose-is", "world_from_camera", "--axes", "opencv")
    assert corrected.exit_code == 0 and "assumed     agreement: " in corrected.stderr
    trusted = cli(*call, "--axes", "opengl", "--trust", "--force")
    assert trusted.exit_code == 0 and "[trusted]" in trusted.stderr
    lines = trusted.stderr.splitlines()
    [warned] = [i for i, line in enumerate(lines) if line.startswith("warning: agreement: ")]
    last = max(i for i, line in enumerate(lines) if line.startswith("  assumed"))
    assert last < warned < len(lines) - 1, "after the assumptions, before what was made"


def test_depth_beside_colour_is_a_warning_with_a_fix(tmp_path: Path) -> None:
    files = tmp_path / "files"
    options = write_recording(files)
    for path in files.glob("*.color.png"):
        cv2.imwrite(str(path), np.roll(cv2.imread(str(path)), (9, -7), axis=(0, 1)))
    ended = cli("ingest", "frames", files, tmp_path / "d", "--scene", "a", *options)
    assert ended.exit_code == 0, ended.stderr
    [warned] = [line for line in ended.stderr.splitlines() if line.startswith("warning: registration: ")]
    assert "(u -7, v +9) away from depth" in warned and "[depth-shifted].  fix: register depth to colour" in warned
    assert "assumed     registration" not in ended.stderr


def test_lists_on_the_command_line_are_split_at_commas(one_scan: Dataset) -> None:
    ended = cli("reconstruct", one_scan.root, "--workspace", "0,0,0,1,1", "--dry-run")
    assert ended.exit_code == 2
    assert "reconstruct: workspace" in ended.stderr
    assert cli("reconstruct", one_scan.root, "--workspace", "0,0,0,1,1,1", "--dry-run").exit_code == 0


def test_split_is_recorded(one_scan: Dataset) -> None:
    add_scan(one_scan, "b", level=9)
    assert cli("split", one_scan.root, "--train", "a", "--validation", "b").exit_code == 0
    assert Dataset(one_scan.root).file.splits.validation == ("b",)
    assert np.array_equal(Dataset(one_scan.root).items("scene"), ["a", "b"])


@pytest.mark.parametrize("option", ["--variant", "--descriptor"])
def test_variant_that_is_a_path_out_of_the_dataset_is_refused(one_scan: Dataset, option: str) -> None:
    precious = one_scan.root.parent / "victim" / "file"
    precious.parent.mkdir()
    precious.touch()
    ended = cli("reference", one_scan.root, option, "../../victim")
    assert ended.exit_code == 2
    assert "got '../../victim'" in ended.stderr
    assert list(precious.parent.iterdir()) == [precious]


def test_bad_value_for_a_late_stage_is_refused_before_the_first_runs(one_scan: Dataset) -> None:
    ended = cli("run", one_scan.root, "--set", "train.steps=many")
    assert ended.exit_code == 2
    assert "train: steps: expected a whole number" in ended.stderr
    assert not (one_scan.root / "reconstruction").exists()


def test_parameters_of_the_dataset_are_used_without_being_named(one_scan: Dataset) -> None:
    (one_scan.root / "params.yaml").write_text("reconstruct: {voxel_size: -1}\n")
    for command in ("reconstruct", "run", "status"):
        ended = cli(command, one_scan.root)
        assert ended.exit_code == 2
        assert "reconstruct: voxel_size: expected" in ended.stderr
    assert cli("reconstruct", one_scan.root, "--set", "reconstruct.voxel_size=1", "--dry-run").exit_code == 0


def test_misspelt_scene_in_a_section_is_refused(one_scan: Dataset) -> None:
    ended = cli("run", one_scan.root, "--set", "reconstruct@tabel.voxel_size=1")
    assert ended.exit_code == 2
    assert "reconstruct@tabel: expected reconstruct@ and one of a" in ended.stderr


def test_workspace_with_swapped_corners_is_refused_before_anything_runs(one_scan: Dataset) -> None:
    ended = cli("reconstruct", one_scan.root, "--workspace", "1,1,1,0,0,0", "--dry-run")
    assert ended.exit_code == 2
    assert "each minimum below its maximum" in ended.stderr


def test_next_command_can_be_pasted(tmp_path: Path) -> None:
    ended = cli("init", tmp_path / "my data")
    assert f"SOURCE '{tmp_path}/my data' --scene" in ended.stderr


def test_dataset_without_scenes_says_what_to_ingest(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    add_scan(dataset, "x", kind=Demonstration)
    ended = cli("run", dataset.root)
    assert ended.exit_code == 2
    assert "fix: bask-data ingest FORMAT SOURCE ROOT --scene NAME --as scan" in ended.stderr


def test_status_ends_with_the_command_that_makes_what_it_showed(one_scan: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "my params.yaml"
    file.write_text("train: {steps: 5}")
    options = ["--only", "a", "--config", str(file), "--preset", "bask", "--set", "masks.tolerance=0.01", "--defaults"]
    ended = cli("status", one_scan.root, *options)
    assert ended.exit_code == 0, ended.stderr
    assert shlex.split(ended.stderr.splitlines()[-1])[1:] == ["bask-data", "run", str(one_scan.root), *options]
    assert cli("status", one_scan.root).stderr.splitlines()[-1] == f"next: bask-data run {one_scan.root}"


def test_status_of_one_scene_leaves_out_the_others(one_scan: Dataset) -> None:
    add_scan(one_scan, "b")
    rows = json.loads(cli("status", one_scan.root, "--only", "b", "--json").stdout)["artifacts"]
    labels = [row["label"] for row in rows]
    assert "reconstruct b" in labels
    assert "reconstruct a" not in labels


def test_status_of_an_empty_dataset_points_to_ingest(tmp_path: Path) -> None:
    Dataset.create(tmp_path / "d")
    assert "next: bask-data ingest" in cli("status", tmp_path / "d").stderr.splitlines()[-1]


def test_info_lists_the_rest_of_a_dataset_with_a_damaged_artifact(one_scan: Dataset) -> None:
    add_scan(one_scan, "b")
    manifest = one_scan.path(Scan, "a") / "artifact.json"
    manifest.write_bytes(manifest.read_bytes()[:40])
    ended = cli("info", one_scan.root)
    assert ended.exit_code == 4
    assert "scan/a" in ended.stdout and "damaged" in ended.stdout and "scan/b" in ended.stdout
    assert f"error: {manifest}: expected a JSON document" in ended.stderr
    artifacts = json.loads(cli("info", one_scan.root, "--json").stdout)["artifacts"]
    assert [bool(artifact["fault"]) for artifact in artifacts] == [True, False]
