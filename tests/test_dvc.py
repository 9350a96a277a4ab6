from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from bask_data.config import load_config
from bask_data.dataset import Dataset, Variant
from bask_data.dvc import compared_files, render, written_files
from bask_data.engine import RunRequest, own_parameters, planned, record_requested, run_pipeline
from bask_data.errors import UsageError
from bask_data.kinds import KeypointTrack
from bask_data.pipeline import STAGES
from tests.datasets import add_scan
from tests.tiny import PARAMS, write_recording
from tests.toy_stages import fuse, pick

BIN = Path(sys.executable).parent


def sh(folder: Path, *words: object) -> str:
    """Run a command as a user of the virtual environment would."""
    environment = {**os.environ, "PATH": f"{BIN}:{os.environ['PATH']}", "DVC_NO_ANALYTICS": "1"}
    ended = subprocess.run(
        [str(word) for word in words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, f"{words}\n{ended.stdout}\n{ended.stderr}"
    return ended.stdout + ended.stderr


def ran(output: str) -> set[str]:
    """Names of the DVC stages that were run."""
    return {line.split("'")[1] for line in output.splitlines() if line.startswith("Running stage")}


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A git repository with a dataset of one scan and one demonstration, under DVC."""
    folder = tmp_path / "lab"
    folder.mkdir()
    sh(folder, "git", "init", "-q")
    sh(folder, "dvc", "init", "-q")
    for name, kind in (("a", "scan"), ("d", "demonstration")):
        options = write_recording(folder / "raw" / name)
        sh(folder, "bask-data", "ingest", "frames", f"raw/{name}", "table", "--scene", name, "--as", kind, *options)
    (folder / "table" / "params.yaml").write_text(yaml.safe_dump(PARAMS))
    sh(folder, "bask-data", "dvc", "table")
    return folder


def test_rendered_stages_name_version_inputs_and_parameters(repository: Path) -> None:
    stages = yaml.safe_load((repository / "table" / "dvc.yaml").read_text())["stages"]
    assert stages["objects-a"] == {
        "desc": STAGES[1].help.splitlines()[0],
        "cmd": f"bask-data objects . --only a --config params.yaml --stage-version {STAGES[1].version}",
        "deps": ["scan/a", "reconstruction/a"],
        "params": ["objects"],
        "outs": [{"objects/a": {"persist": True}}],
    }
    assert {"dataset.json": ["splits"]} in stages["train"]["params"]
    assert stages["ingest-a"]["deps"] == ["../raw/a"]
    assert set(stages) == {
        *("ingest-a", "ingest-d", "reconstruct-a", "objects-a", "masks-a", "correspondences-a"),
        *("train", "reference", "encode-d"),
    }


def test_parameters_survive_rendering_again(repository: Path) -> None:
    file = repository / "table" / "params.yaml"
    file.write_text(file.read_text() + "\nreconstruct@a:\n  voxel_size: 0.009\n")
    sh(repository, "bask-data", "dvc", "table")
    values = yaml.safe_load(file.read_text())
    assert values["reconstruct@a"] == {"voxel_size": 0.009}
    assert values["train"]["steps"] == PARAMS["train"]["steps"]
    stages = yaml.safe_load((repository / "table" / "dvc.yaml").read_text())["stages"]
    assert stages["reconstruct-a"]["params"] == ["reconstruct", "reconstruct@a"]
    sh(repository, "bask-data", "dvc", "table", "--check")


def test_every_written_parameter_reads_back_as_it_is(repository: Path) -> None:
    file = repository / "table" / "params.yaml"
    config = load_config(file, [], STAGES)
    assert render(Dataset(repository / "table"), STAGES, config)["params.yaml"] == file.read_text()
    for stage in (each for each in STAGES if not each.on_request):
        wanted = stage.params.model_validate(PARAMS.get(stage.name, {}))
        assert stage.params.model_validate(config[stage.name]) == wanted


def test_other_lines_of_gitignore_are_kept(repository: Path) -> None:
    file = repository / "table" / ".gitignore"
    file.write_text("mine\n")
    sh(repository, "bask-data", "dvc", "table")
    lines = file.read_text().splitlines()
    assert lines[0] == "mine"
    assert "/scan/*/" in lines
    sh(repository, "bask-data", "dvc", "table", "--check")


def test_only_files_that_differ_are_written_and_a_check_refuses_them(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    assert written_files(dataset, STAGES, {}).changed == ("dvc.yaml", "params.yaml", ".gitignore")
    compared_files(dataset, STAGES, {}).refuse_changed()
    (dataset.root / "params.yaml").write_text("train: {}\n")
    with pytest.raises(UsageError, match=r"params\.yaml: expected what the code renders, .*  fix: bask-data dvc"):
        compared_files(dataset, STAGES, {}).refuse_changed()
    assert (dataset.root / "params.yaml").read_text() == "train: {}\n"
    assert written_files(dataset, STAGES, {}).changed == ("params.yaml",)


def test_variants_have_stages_of_their_own(repository: Path) -> None:
    dataset = Dataset(repository / "table")
    dataset.add_variant(KeypointTrack, "plain", Variant(inputs={"descriptor": "main", "reference": "main"}))
    stages = yaml.safe_load(render(dataset, STAGES, {})["dvc.yaml"])["stages"]
    assert "--variant plain --descriptor main --reference main" in stages["encode-plain-d"]["cmd"]
    assert "descriptor/main" in stages["encode-plain-d"]["deps"]


def test_repro_runs_all_then_nothing_then_what_a_change_affects(repository: Path) -> None:
    everything = {
        *("ingest-a", "ingest-d", "reconstruct-a", "objects-a", "masks-a", "correspondences-a"),
        *("train", "reference", "encode-d"),
    }
    table = repository / "table"
    assert ran(sh(table, "dvc", "repro")) == everything
    sh(table, "bask-data", "validate", ".")
    assert ran(sh(table, "dvc", "repro")) == set()

    file = table / "params.yaml"
    file.write_text(file.read_text().replace("n_particles: 50", "n_particles: 60"))
    assert ran(sh(table, "dvc", "repro")) == {"encode-d"}

    # A new scene is read, goes through the stages of its own, and remakes what gathers all scenes.
    options = write_recording(repository / "raw" / "b", seed=3)
    sh(repository, "bask-data", "ingest", "frames", "raw/b", "table", "--scene", "b", *options)
    sh(repository, "bask-data", "dvc", "table")
    assert ran(sh(table, "dvc", "repro")) == {
        *("ingest-b", "reconstruct-b", "objects-b", "masks-b", "correspondences-b"),
        *("train", "reference", "encode-d"),
    }


def test_an_option_given_after_rendering_is_kept_and_rendered(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    add_scan(dataset, "a")
    written_files(dataset, STAGES, {"reconstruct": {"voxel_size": 0.008}})
    reconstruct = STAGES[0]
    request = RunRequest(stages=("reconstruct",), options={"voxel_size": 0.01})
    record_requested(dataset, reconstruct, request, own_parameters(dataset.root, STAGES))
    [batch] = planned(dataset, STAGES, RunRequest(stages=("reconstruct",)))
    assert batch.tasks[0].params.model_dump()["voxel_size"] == 0.01
    with pytest.raises(UsageError, match=r"params\.yaml: expected what the code renders"):
        compared_files(dataset, STAGES, {}).refuse_changed()
    written_files(dataset, STAGES, {})
    assert own_parameters(dataset.root, STAGES)["reconstruct"]["voxel_size"] == 0.01
    compared_files(dataset, STAGES, {}).refuse_changed()


def test_a_stage_on_request_is_described_once_there_is_a_request(dataset: Dataset) -> None:
    stages = (fuse, replace(pick, on_request=True))
    texts = render(dataset, stages, {})
    assert "pick" not in texts["dvc.yaml"] and "pick:" not in texts["params.yaml"]
    list(run_pipeline(dataset, stages, RunRequest(stages=("fuse",))))
    list(run_pipeline(dataset, stages, RunRequest(stages=("pick",), only=("a",))))
    texts = render(dataset, stages, {})
    assert "pick-a" in texts["dvc.yaml"] and "pick:" in texts["params.yaml"]
