from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from bask_data.cli.app import app
from bask_data.dataset import Dataset
from bask_data.formats import FORMATS
from bask_data.formats.guess import Guess
from bask_data.formats.listing import Listing
from bask_data.formats.recognise import recognise
from bask_data.formats.recognise.folders import RECOGNISERS
from bask_data.formats.recognise.frames import is_rigid_lines
from tests.formats.folders import images, rigid, write_frames, write_image
from tests.formats.test_maniskill import written as write_maniskill
from tests.formats.test_tum import write_sequence

POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(3)])


def auto(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["ingest", "auto", *map(str, arguments)])


def guess_at(source: Path) -> Guess:
    [guess] = recognise(source).guesses
    return guess


def write_dump(folder: Path, color: str = "rgb/{}.png", depth: str = "depth/{}.png", pose: str = "pose/{}.txt") -> Path:
    for i, (rgb, z) in enumerate(zip(*images(3), strict=True)):
        if color:
            write_image(folder / color.format(i), rgb)
        if depth:
            write_image(folder / depth.format(i), z)
        if pose:
            (folder / pose.format(i)).parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(folder / pose.format(i), POSES[i])
    return folder


def test_every_format_can_be_recognised() -> None:
    assert {format.name for format in FORMATS} == {"frames", *RECOGNISERS}


@pytest.mark.parametrize(
    ("color", "depth", "pose"),
    [
        ("rgb/{}.png", "depth/{}.png", "poses/{}.txt"),
        ("color/frame{}.jpg", "depth/frame{}.png", "extrinsics/frame{}.txt"),
        ("cam0/{}_image.png", "cam0/{}_depth.png", "cam0/{}_pose.txt"),
        ("170{}.250000-color.png", "170{}.250000-depth.png", "170{}.250000.txt"),
        ("colour/scene7_0{}.png", "aligned_depth_to_color/scene7_0{}.png", "world_from_camera/scene7_0{}.txt"),
    ],
)
def test_patterns_of_a_dump_are_found_from_the_names(tmp_path: Path, color: str, depth: str, pose: str) -> None:
    guess = guess_at(write_dump(tmp_path, color, depth, pose))
    patterns = {name: guess.options[name].replace("scene7_0*", "scene7_*") for name in ("color", "depth", "pose")}
    expected = {"color": color, "depth": depth, "pose": pose}
    expected = {name: text.replace("170{}.250000", "{}").replace("{}", "*") for name, text in expected.items()}
    assert patterns == {name: text.replace("scene7_0*", "scene7_*") for name, text in expected.items()}
    assert guess.missing == {"intrinsics": "fx,fy,cx,cy"}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("intrinsics.txt", "20 21 7.5 5.5\n"),
        ("camera-intrinsics.color.txt", "20 0 7.5\n0 21 5.5\n0 0 1\n"),
        ("K.txt", "[[20, 0, 7.5], [0, 21, 5.5], [0, 0, 1]]\n"),
        ("camera_info.yaml", "image_width: 16\nK: [20, 0, 7.5, 0, 21, 5.5, 0, 0, 1]\n"),
        ("camera.json", '{"fx": 20, "fy": 21, "cx": 7.5, "cy": 5.5}'),
    ],
)
def test_files_with_intrinsics_are_found(tmp_path: Path, name: str, text: str) -> None:
    write_dump(tmp_path)
    (tmp_path / name).write_text(text)
    (tmp_path / "notes.txt").write_text("1 2 3 4\n")
    guess = guess_at(tmp_path)
    assert (guess.options["intrinsics"], guess.missing) == (name, {})


APC_NAMES = ("frame-00000{}.color.png", "frame-00000{}.depth.png", "frame-00000{}.pose.txt")


@pytest.mark.parametrize("folder", ["", "labels"])
@pytest.mark.parametrize("is_rotated", [True, False])
def test_depth_decides_between_apc_and_other_recordings_whose_files_are_named_so(
    tmp_path: Path, folder: str, is_rotated: bool
) -> None:
    scene = write_dump(tmp_path / folder, *APC_NAMES)
    (scene / "camera-intrinsics.color.txt").write_text("20 0 7.5\n0 21 5.5\n0 0 1\n")
    for i, raw in enumerate(images(3)[1]):
        write_image(scene / APC_NAMES[1].format(i), (raw << 3) | (raw >> 13) if is_rotated else raw)
    guess = guess_at(tmp_path)
    assert (guess.format, guess.source) == (("apc", scene) if is_rotated else ("frames", tmp_path))
    assert ("SOURCE holds it: labels" in guess.reasons) == (is_rotated and folder == "labels")


def test_two_scenes_of_apc_in_a_folder_are_offered_one_by_one(tmp_path: Path) -> None:
    for name in ("labels", "masks"):
        scene = write_dump(tmp_path / name, *APC_NAMES)
        (scene / "camera-intrinsics.color.txt").write_text("20 0 7.5\n0 21 5.5\n0 0 1\n")
        for i, raw in enumerate(images(3)[1]):
            write_image(scene / APC_NAMES[1].format(i), raw << 3)
    found = recognise(tmp_path)
    assert not found.guesses and "labels (apc), masks (apc)" in found.got


@pytest.mark.parametrize("name", ["trajectory.txt", "poses.txt", "CameraTrajectory.txt", "scene.log", "poses.npy"])
def test_a_file_with_all_poses_is_found(tmp_path: Path, name: str) -> None:
    write_dump(tmp_path, pose="")
    if name.endswith(".npy"):
        np.save(tmp_path / name, POSES)
    elif name.endswith(".log"):
        text = "".join(
            f"{i} {i} {i + 1}\n" + "\n".join(" ".join(map(str, row)) for row in POSES[i]) + "\n" for i in range(3)
        )
        (tmp_path / name).write_text(text)
    else:
        np.savetxt(tmp_path / name, POSES.reshape(3, 16))
    guess = guess_at(tmp_path)
    assert (guess.format, guess.options["pose"]) == ("frames", name)


def test_the_command_is_shown_and_run_only_with_yes(tmp_path: Path) -> None:
    source, root = tmp_path / "my scan", tmp_path / "d"
    write_dump(source)
    (source / "intrinsics.txt").write_text("20 21 7.5 5.5\n")
    shown = auto(source, root)
    assert shown.exit_code == 0 and not root.exists()
    assert f"bask-data ingest frames '{source}' {root} --scene my_scan --color 'rgb/*.png'" in shown.stdout
    assert "3 colour files rgb/*.png" in shown.stdout
    ran = auto(source, root, "--yes", "--scene", "a")
    assert ran.exit_code == 0, ran.output
    assert list(Dataset(root).file.scenes) == ["a"]
    described = json.loads(auto(source, root, "--json").stdout)
    assert described["format"] == "frames" and described["command"].startswith("bask-data ingest frames")
    assert "intrinsics in intrinsics.txt" in described["reasons"]


def test_what_no_file_states_is_a_placeholder_and_refused(tmp_path: Path) -> None:
    write_sequence(tmp_path / "desk")
    shown = auto(tmp_path / "desk", tmp_path / "d")
    assert "--intrinsics fx,fy,cx,cy" in shown.stdout and "next: put in --intrinsics" in shown.stderr
    refused = auto(tmp_path / "desk", tmp_path / "d", "--yes")
    assert refused.exit_code == 2 and "bask-data ingest tum" in refused.stderr and not (tmp_path / "d").exists()


def test_a_benchmarks_name_says_its_calibration(tmp_path: Path) -> None:
    write_sequence(tmp_path / "rgbd_dataset_freiburg2_desk")
    assert guess_at(tmp_path / "rgbd_dataset_freiburg2_desk").options == {"intrinsics": "freiburg2"}


def test_a_robot_makes_a_demonstration_and_its_episodes_are_read_all(tmp_path: Path) -> None:
    path = write_maniskill(tmp_path / "a.h5", n_trajectories=2)
    shown = auto(path, tmp_path / "d").stdout
    assert "--as demonstration --episode all" in shown and "2 episodes: traj_0, traj_1" in shown
    assert "--as demonstration" not in auto(path, tmp_path / "d", "--as", "scan").stdout


def test_several_formats_are_listed_and_none_is_run(tmp_path: Path) -> None:
    write_sequence(tmp_path / "s")
    (tmp_path / "s/odometry.csv").write_text("timestamp\n")
    (tmp_path / "s/rgb.mp4").write_bytes(b"")
    refused = auto(tmp_path / "s", tmp_path / "d", "--yes")
    assert refused.exit_code == 2 and "tum, stray" in refused.stderr and not (tmp_path / "d").exists()
    assert "bask-data ingest tum" in refused.stdout and "bask-data ingest stray" in refused.stdout


def test_one_level_too_high_or_low_is_seen(tmp_path: Path) -> None:
    write_dump(tmp_path / "all/first/data")
    assert guess_at(tmp_path / "all/first").source.samefile(tmp_path / "all/first/data") or guess_at(
        tmp_path / "all/first"
    ).options["color"].startswith("data/")
    write_sequence(tmp_path / "two/first")
    write_sequence(tmp_path / "two/second")
    refused = auto(tmp_path / "two", tmp_path / "d")
    assert refused.exit_code == 2 and "first (tum), second (tum)" in refused.stderr
    assert f"fix: bask-data ingest auto {tmp_path}/two/first {tmp_path}/d" in refused.stderr
    for inside in ("rgb", "rgb.txt"):
        refused = auto(tmp_path / "two/first" / inside, tmp_path / "d")
        assert refused.exit_code == 2 and f"ingest auto {tmp_path}/two/first {tmp_path}/d" in refused.stderr


def test_a_folder_beside_recordings_is_not_taken_for_a_part_of_one(tmp_path: Path) -> None:
    write_dump(tmp_path / "scene0", color="color/{}.png")
    (tmp_path / "scene0/intrinsic").mkdir()
    (tmp_path / "scene0/intrinsic/intrinsic_depth.txt").write_text("20 0 7 0\n0 20 5 0\n0 0 1 0\n0 0 0 1\n")
    assert guess_at(write_dump(tmp_path / "mine", pose="")).format == "colmap"
    assert guess_at(tmp_path / "scene0").format == "scannet"
    assert "the folder above is scannet's" in auto(tmp_path / "scene0/color", tmp_path / "d").stderr


def test_arrays_of_depth_and_poses_of_any_name_are_known_by_their_content(tmp_path: Path) -> None:
    write_dump(tmp_path, color="farbe/{}.png", depth="", pose="")
    (tmp_path / "tiefe").mkdir()
    for i in range(3):
        np.save(tmp_path / f"tiefe/{i}.npy", np.ones((60, 80), np.float32))
    (tmp_path / "wo.txt").write_text("".join(f"{i} 1 2 3 0 0.6 0.8 0\n" for i in range(3)))
    (tmp_path / "joints.txt").write_text("1 2 3 4 5 6 7\n" * 3)
    guess = guess_at(tmp_path)
    assert guess.format == "frames"
    assert guess.options == {"color": "farbe/*.png", "depth": "tiefe/*.npy", "pose": "wo.txt"}


@pytest.mark.parametrize("rows", [7, 8, 12, 13, 16, 17])
def test_rigid_lines_are_told_from_other_numbers(rows: int) -> None:
    pose = [1, 2, 3, 0, 0.6, 0, 0.8] if rows < 9 else [0, -1, 0, 5, 1, 0, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1][: rows // 4 * 4]
    line = " ".join(map(str, [9.5] * (rows - len(pose)) + pose))
    assert is_rigid_lines(f"{line}\n{line}\n{line}\n".encode())
    assert not is_rigid_lines(f"{line}\n{line}\n".encode())
    assert not is_rigid_lines(f"{line} 1 1\n".encode() * 3)
    assert not is_rigid_lines(f"{line}\n".encode().replace(b"0.6", b"0.7").replace(b"-1", b"-2") * 3)


def test_cameras_in_folders_of_their_own_are_read_together(tmp_path: Path) -> None:
    for name in ("wrist", "top"):
        write_dump(tmp_path / name, color="rgb_{}.png", depth="depth_{}.png", pose="")
        (tmp_path / name / "K.txt").write_text("20 21 7.5 5.5\n")
    (tmp_path / "wrist/ee.txt").write_text("1 2 3 0 0 0 1\n" * 3)
    np.savetxt(tmp_path / "top/ee.txt", np.eye(4))
    np.savetxt(tmp_path / "wrist/hand_eye.txt", np.eye(4))
    guess = guess_at(tmp_path)
    assert guess.options == {
        "camera": "top,wrist",
        "color": "{camera}/rgb_*.png",
        "depth": "{camera}/depth_*.png",
        "pose": "{camera}/ee.txt",
        "intrinsics": "{camera}/K.txt",
    }
    assert any("--gripper-from-camera 'wrist/hand_eye.txt'" in reason for reason in guess.reasons)
    ran = auto(tmp_path, tmp_path / "d", "--yes", "--scene", "a")
    assert ran.exit_code == 0, ran.output

    (tmp_path / "top/ee.txt").write_text("1 2 3 0 0 0 1\n" * 3)
    refused = auto(tmp_path, tmp_path / "d").stderr
    assert (
        "a folder of 2 recordings" in refused
        and "cameras of one recording, `ingest frames` with --camera top,wrist" in refused
    )
    (tmp_path / "top/ee.txt").unlink()
    assert "camera" not in guess_at(tmp_path).options


def test_without_poses_they_are_found_from_the_images(tmp_path: Path) -> None:
    guess = guess_at(write_dump(tmp_path, pose=""))
    assert guess.format == "colmap" and guess.options == {"images": "rgb/*.png", "depth": "depth/*.png"}


@pytest.mark.parametrize(
    ("parts", "got", "fix"),
    [
        ({"depth": "", "pose": ""}, "3 images rgb/*.png, but no depth", "depth is needed"),
        ({"color": "", "pose": ""}, "3 depth images depth/*.png, but no colour", "add colour images"),
        ({"depth": "depth/1{}0.png"}, "no number in common", "associations.txt"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, parts: dict[str, str], got: str, fix: str) -> None:
    refused = auto(write_dump(tmp_path / "s", **parts), tmp_path / "d")
    assert refused.exit_code == 2 and got in refused.stderr and fix in refused.stderr


def test_a_folder_beside_a_recording_is_not_a_part_of_it(tmp_path: Path) -> None:
    for name in ("task/variation0/episodes/episode0/low_dim_obs.pkl", "images/a.png", "scene/scene_camera.json"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_bytes(b"x")
    assert "a part of a recording" not in recognise(tmp_path / "images").got
    assert recognise(tmp_path / "task/variation0/episodes/episode0").guesses
    (tmp_path / "scene/masks").mkdir()
    assert recognise(tmp_path / "scene/masks").got == "a part of a recording: the folder above is bop's"


def test_archives_and_other_files_are_named(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "scan.zip", "w") as archive:
        archive.writestr("rgb/0.png", b"")
    refused = auto(tmp_path / "scan.zip", tmp_path / "d")
    assert refused.exit_code == 2 and "a zip file with rgb/0.png" in refused.stderr and "unpack it" in refused.stderr
    assert "unpack scan.zip" in auto(tmp_path, tmp_path / "d").stderr
    (tmp_path / "scan.zip").unlink()
    (tmp_path / "scan.zip").write_bytes(b"PK\x03\x04 no more")
    assert "a damaged or empty zip file" in auto(tmp_path / "scan.zip", tmp_path / "d").stderr
    (tmp_path / "empty").mkdir()
    refused = auto(tmp_path / "empty", tmp_path / "d")
    assert refused.exit_code == 2 and "an empty folder" in refused.stderr and "docs/formats.md" in refused.stderr


def test_links_to_folders_outside_are_named_with_where_they_lead(tmp_path: Path) -> None:
    write_dump(tmp_path / "disc/scan")
    (tmp_path / "my/scan").mkdir(parents=True)
    for name in ("rgb", "depth"):
        (tmp_path / "my/scan" / name).symlink_to(tmp_path / "disc/scan" / name)
    refused = auto(tmp_path / "my/scan", tmp_path / "d")
    assert refused.exit_code == 2 and "links to folders outside: depth, rgb" in refused.stderr
    assert f"name the folder that they lead to, {tmp_path}/disc/scan" in refused.stderr


def test_a_folder_that_may_not_be_entered_is_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_dump(tmp_path)
    (tmp_path / "lost+found").mkdir()
    is_dir = Path.is_dir

    def denied(path: Path, *, follow_symlinks: bool = True) -> bool:
        if "lost+found" in path.parts and path.name != "lost+found":
            raise PermissionError(13, "Permission denied", str(path))
        return is_dir(path)

    # Tests may run as root, whom no folder refuses.
    monkeypatch.setattr(Path, "is_dir", denied)
    assert not Listing(tmp_path).has_folder("lost+found/intrinsic")
    assert guess_at(tmp_path).format == "frames"


def test_hidden_files_and_links_out_are_not_looked_at(tmp_path: Path) -> None:
    write_frames(tmp_path / "elsewhere", POSES)
    write_dump(tmp_path / "s")
    for name in ("._0.png", ".DS_Store"):
        (tmp_path / "s/rgb" / name).write_bytes(b"\x00\x05")
    (tmp_path / "s/linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "s/camera-intrinsics.txt").symlink_to(tmp_path / "elsewhere/frame-000000.pose.txt")
    listing = Listing(tmp_path / "s")
    assert listing.all_folders == ("", "depth", "pose", "rgb")
    assert "._0.png" not in listing.files("rgb") and listing.head("camera-intrinsics.txt") == b""
    assert guess_at(tmp_path / "s").options["color"] == "rgb/*.png"
