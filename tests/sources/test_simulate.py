from __future__ import annotations

import contextlib
import json
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.core.geometry import rotation_angle
from bask_data.dataset import Dataset
from bask_data.dvc import render
from bask_data.errors import UsageError, WouldOverwrite
from bask_data.kinds import Demonstration, Scan, Truth
from bask_data.pipeline import STAGES
from bask_data.sim import experts
from bask_data.sim.options import SimOptions
from bask_data.sources import simulate as simulate_module
from bask_data.sources.simulate import Job, simulate
from bask_data.validate import validate
from tests.sources.test_ingest import everything_below

TINY = {"height": 24, "width": 32, "frames": 3}


def made(
    root: Path,
    n_scans: int = 1,
    n_demonstrations: int = 0,
    only: tuple[str, ...] = (),
    force: bool = False,
    **options: object,
) -> list[str]:
    values = SimOptions(**{"task": "phone", **TINY, **options})  # type: ignore[arg-type]
    outcomes, _ = simulate(root, values, n_scans=n_scans, n_demonstrations=n_demonstrations, only=only, force=force)
    return [f"{outcome.status} {outcome.kind} {outcome.item}" for outcome in outcomes]


def digests(root: Path) -> dict[str, str]:
    files = [file for kind in ("scan", "demonstration", "truth") for file in (root / kind).glob("*/artifact.json")]
    return {str(file.parent.relative_to(root)): json.loads(file.read_text())["digest"] for file in files}


@pytest.fixture(scope="module")
def phone_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans and a demonstration; tests must not change it."""
    root = tmp_path_factory.mktemp("sim") / "d"
    names = made(root, 2, 1)
    assert names == [
        f"made {kind} {item}"
        for item, kinds in (("phone_scan0", "scan"), ("phone_scan1", "scan"), ("phone_demo0", "demonstration"))
        for kind in (kinds, "truth")
    ]
    return root


def test_dataset_is_valid_and_lists_its_recordings(phone_root: Path) -> None:
    opened = Dataset(phone_root)
    assert opened.items("scene") == ["phone_scan0", "phone_scan1"]
    assert opened.items("demonstration") == ["phone_demo0"]
    assert validate(opened) == []
    assert (opened.file.scenes["phone_scan0"].format, opened.file.scenes["phone_scan0"].path) == ("sim", "")


def test_scans_have_noise_and_ground_truth_has_none(phone_root: Path) -> None:
    scan, truth = Scan(phone_root / "scan" / "phone_scan0"), Truth(phone_root / "truth" / "phone_scan0")
    assert truth.camera_names == scan.camera_names == ["overhead", "wrist"]
    assert truth.has_depth
    for camera in scan.cameras:
        assert (camera.n_frames, camera.height, camera.width) == (3, 24, 32)
        assert camera.depth_scale == 1e-4
        np.testing.assert_array_equal(camera.Ks[0, :2, 2], [15.5, 11.5])
        error = []
        for i_frame in range(3):
            exact, noisy = truth.depth(camera.name, i_frame), camera.depth(i_frame)
            assert ((exact > 0) == (noisy > 0)).all()
            error.append(((noisy - exact) / (0.001 + 0.005 * exact))[exact > 0])
        assert np.concatenate(error).std() == pytest.approx(1, abs=0.08)
        np.testing.assert_array_equal(truth.world_from_cameras(camera.name), camera.world_from_cameras)


def test_ground_truth_has_names_of_labels_poses_and_touching_objects(phone_root: Path, tmp_path: Path) -> None:
    scan = Truth(phone_root / "truth" / "phone_scan0")
    assert scan.label_names == {1: "base", 2: "phone", 255: "gripper"}
    assert scan.metadata.object_labels == [1, 2]
    assert scan.touching == []
    poses = scan.world_from_objects
    assert poses is not None and poses.shape == (3, 2, 4, 4)
    np.testing.assert_allclose(np.array(scan.metadata.world_from_object[2]), poses[0, 1])
    assert scan.metadata.pose_error == {1: 0.0, 2: 0.0}
    demo = Truth(phone_root / "truth" / "phone_demo0")
    moved = demo.world_from_objects
    assert moved is not None and np.abs(moved[-1, 1] - moved[0, 1]).max() > 0.05
    assert demo.metadata.world_from_object == {}
    made(tmp_path / "d", task="lid")
    assert Truth(tmp_path / "d" / "truth" / "lid_scan0").touching == [(1, 2)]


def test_demonstration_has_the_robots_states_and_actions(phone_root: Path) -> None:
    demo = Demonstration(phone_root / "demonstration" / "phone_demo0")
    n_frames = demo.camera("wrist").n_frames
    assert demo.robot is not None
    assert demo.robot.action_names == ("dx", "dy", "dz", "rx", "ry", "rz", "width")
    assert demo.robot.action is not None and demo.robot.action.shape == (n_frames, 7)
    assert demo.robot.world_from_gripper is not None and demo.robot.world_from_gripper.shape == (n_frames, 4, 4)
    assert demo.robot.gripper_width is not None and np.ptp(demo.robot.gripper_width) > 0.03
    assert np.diff(demo.camera("wrist").time).mean() == pytest.approx(0.05)
    labels = Truth(phone_root / "truth" / "phone_demo0").instance("wrist", 0)
    assert (labels == 255).any()


def test_scenes_differ_and_the_objects_are_the_same(phone_root: Path) -> None:
    first, second = (Truth(phone_root / "truth" / f"phone_scan{i}").world_from_objects for i in (0, 1))
    assert first is not None and second is not None
    assert np.abs(first[0] - second[0]).max() > 0.02


def test_same_options_give_the_same_bytes_in_another_process_and_order(phone_root: Path, tmp_path: Path) -> None:
    subprocess.run(simulating(tmp_path / "d", "--only", "phone_demo0,phone_scan1"), check=True, capture_output=True)
    simulated = digests(tmp_path / "d")
    assert len(simulated) == 4
    assert simulated.items() <= digests(phone_root).items()


def test_again_is_up_to_date_other_options_are_refused_and_force_replaces(tmp_path: Path) -> None:
    root = tmp_path / "d"
    made(root)
    before = everything_below(root)
    assert made(root) == ["up to date scan phone_scan0"]
    with pytest.raises(WouldOverwrite, match="phone_scan0: expected no recording of that name"):
        made(root, 2, seed=1)
    assert everything_below(root) == before
    assert made(root, seed=1, force=True) == ["made scan phone_scan0", "made truth phone_scan0"]
    assert made(root, seed=1) == ["up to date scan phone_scan0"]
    assert validate(Dataset(root)) == []


def test_options_added_later_leave_keys_unchanged_until_they_are_set() -> None:
    plain = Job(Scan, 0, SimOptions(task="lid"))
    assert set(plain.params) == {
        *("index", "task", "seed", "cameras", "frames", "height", "width", "overhead_height", "overhead_width"),
        *("clutter", "depth_noise", "flying", "holes", "pose_noise", "gripper_in_view"),
    }
    changed = [
        Job(Scan, 0, SimOptions(task="lid", **option))
        for option in ({"background_seed": 0}, {"distance_spread": 0.3}, {"finished": 1.0})
    ]
    assert len({plain.key, *(job.key for job in changed)}) == 4
    demonstrations = [
        Job(Demonstration, 0, SimOptions(task="lid", **option)).key
        for option in ({}, {"distance_spread": 0.3}, {"finished": 1.0})
    ]
    assert len({*demonstrations}) == 1


def test_scans_of_the_finished_task_are_spread_evenly_and_show_its_result(tmp_path: Path) -> None:
    made(tmp_path / "d", 4, task="lid", finished=0.5)
    heights = []
    for i in range(4):
        truth = Truth(Dataset(tmp_path / "d").path(Truth, f"lid_scan{i}"))
        names = truth.metadata.label_names
        poses = {names[label]: pose for label, pose in truth.metadata.world_from_object.items()}
        heights.append(poses["lid"][2][3] - poses["saucepan"][2][3])
        assert bool(truth.metadata.touching) == (i % 2 == 0)
    assert np.array(heights) == pytest.approx([heights[0], 0, heights[0], 0], abs=0.004)
    assert heights[0] > 0.05
    # A scan of the finished task does not depend on the other scans.
    made(tmp_path / "alone", only=("lid_scan3",), task="lid", finished=0.5)
    alone = digests(tmp_path / "alone")
    assert alone == {name: digest for name, digest in digests(tmp_path / "d").items() if name in alone}


def test_lost_ground_truth_is_made_again_and_the_recording_stays_the_same(tmp_path: Path) -> None:
    root = tmp_path / "d"
    made(root)
    before = digests(root)
    shutil.rmtree(root / "truth" / "phone_scan0")
    assert made(root) == ["made scan phone_scan0", "made truth phone_scan0"]
    assert digests(root) == before


def test_a_name_given_twice_is_made_once(tmp_path: Path) -> None:
    names = made(tmp_path / "d", only=("phone_scan0", "phone_scan0"))
    assert names == ["made scan phone_scan0", "made truth phone_scan0"]


def test_more_recordings_are_added_to_existing_ones(tmp_path: Path) -> None:
    made(tmp_path / "d")
    assert made(tmp_path / "d", 2)[0] == "up to date scan phone_scan0"
    assert Dataset(tmp_path / "d").items("scene") == ["phone_scan0", "phone_scan1"]


def test_options_of_scans_do_not_change_a_demonstration(phone_root: Path, tmp_path: Path) -> None:
    made(tmp_path / "d", 0, 1, frames=9, gripper_in_view=True)
    assert made(tmp_path / "d", 0, 1) == ["up to date demonstration phone_demo0"]
    assert digests(tmp_path / "d").items() <= digests(phone_root).items()


@pytest.mark.parametrize(
    "defect", [{"depth_noise": 0.02}, {"flying": 0.5}, {"holes": 0.2}, {"pose_noise": 1.0}], ids=lambda d: next(iter(d))
)
def test_defects_change_the_recording_and_not_ground_truth(
    phone_root: Path, tmp_path: Path, defect: dict[str, float]
) -> None:
    made(tmp_path / "d", **defect)
    defective, plain = digests(tmp_path / "d"), digests(phone_root)
    assert defective["truth/phone_scan0"] == plain["truth/phone_scan0"]
    assert defective["scan/phone_scan0"] != plain["scan/phone_scan0"]


def test_pose_noise_is_in_the_recordings_poses_only_and_zero_depth_noise_gives_exact_depth(tmp_path: Path) -> None:
    made(tmp_path / "d", pose_noise=1.0, depth_noise=0.0, frames=40)
    scan, truth = Scan(tmp_path / "d" / "scan" / "phone_scan0"), Truth(tmp_path / "d" / "truth" / "phone_scan0")
    exact, noisy = truth.world_from_cameras("wrist"), scan.camera("wrist").world_from_cameras
    assert (noisy - exact)[:, :3, 3].std() == pytest.approx(0.002, rel=0.3)
    angle = np.degrees(rotation_angle(np.swapaxes(exact, 1, 2)[:, :3, :3] @ noisy[:, :3, :3]))
    assert np.sqrt((angle**2).mean() / 3) == pytest.approx(0.2, rel=0.3)
    overhead = scan.camera("overhead").world_from_cameras
    assert (overhead == overhead[0]).all()
    np.testing.assert_array_equal(scan.camera("wrist").depth(7), truth.depth("wrist", 7))


def test_cameras_may_have_different_sizes(tmp_path: Path) -> None:
    made(tmp_path / "d", overhead_height=20, overhead_width=40)
    scan = Scan(tmp_path / "d" / "scan" / "phone_scan0")
    assert [(camera.name, camera.height, camera.width) for camera in scan.cameras] == [
        ("overhead", 20, 40),
        ("wrist", 24, 32),
    ]
    made(tmp_path / "e", cameras=("wrist",))
    assert Scan(tmp_path / "e" / "scan" / "phone_scan0").camera_names == ["wrist"]


def test_failed_demonstrations_are_counted_and_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = []
    real = experts.demonstrate

    def clumsy(world: object, rng: np.random.Generator) -> object:
        seeds.append(rng.bit_generator.seed_seq.entropy)  # type: ignore[attr-defined]
        return None if len(seeds) < 3 else real(world, rng)  # type: ignore[arg-type]

    monkeypatch.setattr(experts, "demonstrate", clumsy)
    values = SimOptions(task="phone", **TINY)  # type: ignore[arg-type]
    outcomes, n_failed = simulate(tmp_path / "d", values, n_scans=0, n_demonstrations=1)
    assert n_failed == 2
    assert [outcome.item for outcome in outcomes] == ["phone_demo0", "phone_demo0"]
    assert [seed[-1] for seed in seeds] == [0, 1, 2]


def test_a_task_that_never_succeeds_is_given_up_and_leaves_no_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(experts, "demonstrate", lambda *_: None)
    with pytest.raises(
        UsageError, match="phone_demo0: expected a demonstration that succeeds in 20 attempts, got none"
    ):
        made(tmp_path / "d", 0, 1)
    assert not (tmp_path / "d").exists()


def test_interruption_keeps_finished_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = simulate_module._write

    def stopped(out: Path, out_truth: Path, job: simulate_module.Job, *rest: object) -> None:
        if job.index == 1:
            raise KeyboardInterrupt
        real(out, out_truth, job, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(simulate_module, "_write", stopped)
    with pytest.raises(KeyboardInterrupt):
        made(tmp_path / "d", 3)
    assert Dataset(tmp_path / "d").items("scene") == ["phone_scan0"]
    assert validate(Dataset(tmp_path / "d")) == []
    assert list((tmp_path / "d" / ".scratch").glob("*~*")) == []


def simulating(root: Path, *words: object) -> list[str]:
    options = [word for name, value in TINY.items() for word in (f"--{name}", value)]
    command = [sys.executable, "-m", "bask_data.cli", "ingest", "sim", root, "--task", "phone", *options, *words]
    return [str(word) for word in command]


@pytest.mark.kill
@pytest.mark.slow
def test_kills_at_any_time_lose_no_finished_recording(tmp_path: Path) -> None:
    words = ("--scans", 6, "--demonstrations", 2)
    begun = time.monotonic()
    subprocess.run(simulating(tmp_path / "whole", *words), check=True, capture_output=True)
    seconds, whole = time.monotonic() - begun, digests(tmp_path / "whole")
    chance, left = random.Random(0), set()
    for i_kill in range(8):
        root = tmp_path / f"killed{i_kill}"
        process = subprocess.Popen(simulating(root, *words), stderr=subprocess.DEVNULL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(chance.uniform(0.3, 1.0) * seconds)
        process.kill()
        process.wait()
        if (root / "dataset.json").exists():
            assert not [problem for problem in validate(Dataset(root)) if "not listed" not in problem.what]
            left.add(len(Dataset(root).items("recording")))
        subprocess.run(simulating(root, *words), check=True, capture_output=True)
        assert digests(root) == whole
        assert validate(Dataset(root)) == []
        assert not [entry for entry in (root / ".scratch").iterdir() if entry.is_dir()]
    assert len(left) > 1


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path) -> None:
    code = (
        "import resource, sys; from bask_data.cli.app import app\n"
        "try: app(sys.argv[1:])\n"
        "except SystemExit: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    peaks = []
    for n_frames in (100, 500):
        words = ["ingest", "sim", tmp_path / str(n_frames), "--task", "phone", "--scans", 1, "--demonstrations", 0]
        command = [sys.executable, "-c", code, *map(str, words), "--frames", str(n_frames), "--cameras", "wrist"]
        answer = subprocess.run(command, check=True, capture_output=True, text=True)
        peaks.append(int(answer.stdout.split()[-1]))
    # 400 frames of colour and depth twice are 184 MB.
    assert peaks[1] < 1.05 * peaks[0]


def test_recording_that_a_kill_left_unlisted_is_listed_by_the_same_command(tmp_path: Path) -> None:
    made(tmp_path / "d")
    listed = (tmp_path / "d" / "dataset.json").read_text()
    (tmp_path / "d" / "dataset.json").write_text(json.dumps({**json.loads(listed), "scenes": {}}))
    assert made(tmp_path / "d") == ["up to date scan phone_scan0"]
    assert (tmp_path / "d" / "dataset.json").read_text() == listed


def test_name_of_the_other_kind_of_recording_is_refused(tmp_path: Path) -> None:
    made(tmp_path / "d")
    file = tmp_path / "d" / "dataset.json"
    document = json.loads(file.read_text())
    document["demonstrations"], document["scenes"] = document["scenes"], {}
    file.write_text(json.dumps(document))
    with pytest.raises(UsageError, match="expected a new name, got the name of a demonstration"):
        made(tmp_path / "d")


@pytest.mark.parametrize("name", ["lid_scan0", "phone_scan", "phone_view0", "phone_scan0/x"])
def test_only_accepts_names_of_the_tasks_recordings(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="--only: expected names like phone_scan0, phone_demo12, got"):
        made(tmp_path / "d", only=(name,))
    assert not (tmp_path / "d").exists()


def test_a_request_for_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="expected --scans or --demonstrations, got neither"):
        made(tmp_path / "d", 0, 0)


def test_dvc_makes_a_simulated_recording_again_by_name(phone_root: Path, tmp_path: Path) -> None:
    made(tmp_path / "d", gripper_in_view=True, cameras=("wrist",))
    described = yaml.safe_load(render(Dataset(tmp_path / "d"), STAGES, {})["dvc.yaml"])["stages"]
    [stage] = [stage for stage in described.values() if "ingest" in stage["cmd"]]
    words = stage["cmd"].split()
    assert words[:7] == ["bask-data", "ingest", "sim", ".", "--only", "phone_scan0", "--force"]
    assert "deps" not in stage
    before = digests(tmp_path / "d")
    answer = CliRunner().invoke(app, ["ingest", "sim", str(tmp_path / "d"), *words[4:]])
    assert answer.exit_code == 0, answer.output
    assert digests(tmp_path / "d") == before


# The command line -----------------------------------------------------------------------------------------------------


def command(*words: object) -> tuple[int, str, str]:
    answer = CliRunner().invoke(app, ["ingest", "sim", *map(str, words)])
    return answer.exit_code, answer.stdout, answer.stderr


SMALL = ("--height", 24, "--width", 32, "--frames", 2, "--demonstrations", 0, "--scans", 1)


def test_command_reports_its_results_and_the_next_command(tmp_path: Path) -> None:
    code, out, err = command(tmp_path / "d", "--task", "lid", *SMALL, "--json")
    assert code == 0
    document = json.loads(out)
    assert [row["status"] for row in document["outcomes"]] == ["made", "made"]
    assert document["failed_demonstrations"] == 0
    assert f"next: bask-data run {tmp_path / 'd'}" in err
    assert command(tmp_path / "d", "--task", "lid", *SMALL)[0] == 0
    assert command(tmp_path / "d", "--task", "lid", *SMALL, "--seed", 3)[0] == 3


def test_command_reports_failed_demonstrations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulate_module, "simulate", lambda *_, **__: ([], 4))
    stderr = command(tmp_path / "d", "--task", "lid")[2]
    assert "4 demonstrations failed at the task and were replaced by others" in stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--task", "lid", "--depth-noise", "0.5"], "--depth-noise"),
        (["--task", "lid", "--cameras", "wrist,side"], "--cameras"),
        (["--task", "lid", "--cameras", "wrist,wrist"], "each camera once"),
        (["--task", "lid", "--clutter", "99"], "--clutter"),
        (["--task", "sink"], "sink"),
        ([], "--task"),
    ],
)
def test_invalid_options_are_refused_before_anything_is_made(tmp_path: Path, words: list[str], message: str) -> None:
    code, _, err = command(tmp_path / "d", *words)
    assert code == 2
    assert message in err
    assert not (tmp_path / "d").exists()


def test_without_mujoco_the_exit_code_is_5(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    code, _, err = command(tmp_path / "d", "--task", "lid", *SMALL)
    assert code == 5
    assert "fix: pip install 'bask-data[sim]'" in err
    assert not (tmp_path / "d").exists()
