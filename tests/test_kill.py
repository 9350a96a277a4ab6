"""SIGKILL at random moments of a whole run: what was finished stays, the next run completes, nothing is done twice."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from bask_data.artifact import read_manifest
from bask_data.dataset import Dataset
from bask_data.kinds import KeypointTrack
from bask_data.validate import artifacts_on_disk, validate
from tests.tiny import PARAMS, write_recording
from tests.tracked import N_FRAMES, dataset_of, poses

COMMAND = [sys.executable, "-m", "bask_data.cli"]


def bask_data(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def ingested(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with a scan and a demonstration, and nothing made from them yet."""
    folder = tmp_path_factory.mktemp("tiny")
    for name, kind, seed in (("a", "scan", 0), ("b", "demonstration", 0)):
        options = write_recording(folder / name, seed=seed)
        ended = bask_data("ingest", "frames", folder / name, folder / "d", "--scene", name, "--as", kind, *options)
        assert ended.returncode == 0, ended.stderr
    (folder / "params.yaml").write_text(yaml.safe_dump(PARAMS))
    return folder


def finished(root: Path) -> dict[str, tuple[int, int, str]]:
    """What identifies each artifact on disk: a remade one has another inode or time."""
    found = {}
    for artifact in artifacts_on_disk(Dataset(root)):
        status = artifact.path.stat()
        found[str(artifact.path.relative_to(root))] = (
            status.st_ino,
            status.st_mtime_ns,
            read_manifest(artifact.path).digest,
        )
    return found


def killed_and_finished(ingested: Path, root: Path, n_made: int, seconds: float) -> tuple[int, dict[str, str]]:
    """Kill a run so long after it has this many artifacts, run again, and hold what must hold. Gives how many artifacts
    the kill left finished."""
    shutil.copytree(ingested / "d", root)
    arguments = ["run", str(root), "--config", str(ingested / "params.yaml")]
    process = subprocess.Popen([*COMMAND, *arguments], stderr=subprocess.DEVNULL, start_new_session=True)
    while len(artifacts_on_disk(Dataset(root))) < n_made and process.poll() is None:
        time.sleep(0.01)
    time.sleep(seconds)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = finished(root)
    assert validate(Dataset(root)) == []
    again = bask_data(*arguments)
    assert again.returncode == 0, again.stderr
    after = finished(root)
    assert {name: after[name] for name in before} == before
    assert validate(Dataset(root)) == []
    assert not [entry for entry in (root / ".scratch").iterdir() if entry.is_dir()]
    return len(before), {name: digest for name, (_, _, digest) in after.items()}


def run_uninterrupted(ingested: Path, root: Path) -> tuple[float, dict[str, str]]:
    shutil.copytree(ingested / "d", root)
    begun = time.monotonic()
    ended = bask_data("run", root, "--config", ingested / "params.yaml")
    assert ended.returncode == 0, ended.stderr
    return time.monotonic() - begun, {name: digest for name, (_, _, digest) in finished(root).items()}


def hold(ingested: Path, tmp_path: Path, n_kills: int) -> None:
    seconds, digests = run_uninterrupted(ingested, tmp_path / "whole")
    chance = random.Random(0)
    n_ingested, left = len(finished(ingested / "d")), set()
    for i_kill in range(n_kills):
        # Evenly over the artifacts, however fast the machine is just now; anywhere in the making of the next.
        n_made = n_ingested + i_kill * (len(digests) - n_ingested) // n_kills
        moment = chance.uniform(0.0, seconds / (len(digests) - n_ingested))
        n_left, again = killed_and_finished(ingested, tmp_path / "killed", n_made, moment)
        assert again == digests, f"kill {i_kill}, {moment:.2f} s after artifact {n_made}"
        left.add(n_left)
        shutil.rmtree(tmp_path / "killed")
    # Kills that all fall before the first artifact or after the last would prove nothing.
    assert len(left) > 1


@pytest.mark.kill
def test_a_few_kills_lose_nothing_finished(ingested: Path, tmp_path: Path) -> None:
    hold(ingested, tmp_path, 4)


@pytest.mark.kill
@pytest.mark.slow
def test_a_hundred_kills_lose_nothing_finished(ingested: Path, tmp_path: Path) -> None:
    hold(ingested, tmp_path, 100)


ENCODE = """
import sys, time
from bask_data.cli.app import app
from bask_data.kinds import DescriptorNet, arrays
from tests.tracked import ColourNetwork

class Network(ColourNetwork):
    def cells(self, images):
        # From its eighth frame on, what is to be killed takes longer than it will live.
        time.sleep(pause if self.n_images == 7 else 0)
        return super().cells(images)

network = Network()
DescriptorNet.network = lambda self: network
arrays.CHUNK_ROWS = 4
pause = float(sys.argv.pop())
app(sys.argv[1:])
"""
"""`bask-data encode` with a network that needs no training, which writes down its state every four frames, not 256."""


@pytest.mark.kill
def test_killed_encode_resumes_and_gives_the_same_result(tmp_path: Path) -> None:
    whole, cut = (dataset_of(tmp_path / name, {"wrist": poses()}) for name in ("whole", "cut"))
    assert f"{N_FRAMES} frames of 1 camera in " in encoded(whole.root)
    begun = encoding(cut.root, pause=600)
    try:
        state = wait_for(lambda: [*cut.root.glob(".scratch/resume~keypoints~*/state.safetensors")], begun)
    finally:
        os.killpg(begun.pid, signal.SIGKILL)
        begun.communicate()
    assert begun.returncode == -signal.SIGKILL and state.exists()
    assert validate(cut) == [] and not cut.path(KeypointTrack, "reach").exists()
    assert f"{N_FRAMES - 4} frames of 1 camera in " in encoded(cut.root)
    manifests = [read_manifest(one.path(KeypointTrack, "reach")) for one in (whole, cut)]
    assert (manifests[0].digest, manifests[0].files) == (manifests[1].digest, manifests[1].files)
    assert not [entry for entry in (cut.root / ".scratch").iterdir() if entry.is_dir()]


def encoding(root: Path, pause: float = 0) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", ENCODE, "encode", str(root), "--n-particles", "100", str(pause)]
    here = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    return subprocess.Popen(command, env=here, stderr=subprocess.PIPE, text=True, start_new_session=True)


def encoded(root: Path) -> str:
    """What it told of itself."""
    process = encoding(root)
    _, told = process.communicate()
    assert process.returncode == 0, told
    return told


def wait_for(found: Callable[[], list[Path]], process: subprocess.Popen[str]) -> Path:
    while not found():
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.01)
    return found()[0]
