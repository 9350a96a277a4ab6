from __future__ import annotations

import pickle
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS
from bask_data.formats.options.rlbench import RlbenchOptions
from bask_data.formats.recording import PreparedRecording
from tests.formats.folders import HEIGHT, WIDTH, K, images, rigid, write_image

N = 3
POSES = {name: np.stack([rigid(np.random.default_rng([i, j])) for i in range(N)]) for j, name in enumerate("wf")}
GRIPPERS = np.stack([rigid(np.random.default_rng(100 + i)) for i in range(N)])
NEAR, FAR = 0.01, 4.5
CODE = np.array([2**16, 2**8, 1])
RLBENCH = next(format for format in FORMATS if format.name == "rlbench")


def read(source: Path, **options: object) -> PreparedRecording:
    return RLBENCH.read(source, RlbenchOptions(**options))


@pytest.fixture
def classes(monkeypatch: pytest.MonkeyPatch) -> dict[str, type]:
    """RLBench's classes, by the names under which it pickles them."""
    made = {}
    for package in ("rlbench", "rlbench.backend"):
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
    for module, name in (("rlbench.demo", "Demo"), ("rlbench.backend.observation", "Observation")):
        holder = ModuleType(module)
        made[name] = type(name, (), {"__module__": module})
        setattr(holder, name, made[name])
        monkeypatch.setitem(sys.modules, module, holder)
    return made


def calibration(camera: str, world_from_camera: np.ndarray) -> dict[str, Any]:
    """As PyRep states it: axes x left and y up, negative focal lengths."""
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    return {
        f"{camera}_camera_extrinsics": world_from_camera @ turned,
        f"{camera}_camera_intrinsics": K @ np.diag([-1.0, -1.0, 1.0]),
        f"{camera}_camera_near": NEAR,
        f"{camera}_camera_far": FAR,
    }


def observation(classes: dict[str, type], i: int, cameras: dict[str, np.ndarray]) -> Any:
    made = classes["Observation"]()
    made.wrist_rgb = None
    made.gripper_open = 1.0
    made.gripper_pose = np.concatenate([GRIPPERS[i, :3, 3], Rotation.from_matrix(GRIPPERS[i, :3, :3]).as_quat()])
    made.gripper_joint_positions = np.array([0.03, 0.02 + 0.001 * i])
    made.misc = {key: value for name, poses in cameras.items() for key, value in calibration(name, poses[i]).items()}
    return made


def coded(depth: np.ndarray) -> np.ndarray:
    """Depth in millimetres as RLBench writes it; what was not hit is at the far plane."""
    share = np.where(depth > 0, (depth / 1000 - NEAR) / (FAR - NEAR), 1)
    code = np.rint(share * (2**24 - 1)).astype(np.int64)
    return np.stack([code >> 16, code >> 8 & 255, code & 255], axis=-1).astype(np.uint8)


def write_episode(
    folder: Path, classes: dict[str, type], cameras: tuple[str, ...] = ("wrist",), **changed: Any
) -> tuple[np.ndarray, np.ndarray]:
    """An episode of RLBench; returns colour and depth (millimetres) of its cameras, which are alike."""
    color, depth = images(N)
    poses = dict(zip(cameras, POSES.values(), strict=False))
    for name in cameras:
        for i in range(N):
            write_image(folder / f"{name}_rgb/{i}.png", color[i])
            write_image(folder / f"{name}_depth/{i}.png", coded(depth[i]))
    demo = classes["Demo"]()
    demo._observations = [observation(classes, i, poses) for i in range(N)]
    demo.random_seed = np.random.default_rng(0).integers(0, 9, 4)
    for made in demo._observations:
        made.__dict__.update(changed)
    (folder / "low_dim_obs.pkl").write_bytes(pickle.dumps(demo))
    return color, depth


def test_an_episode_is_read_in_our_axes_and_metres(tmp_path: Path, classes: dict[str, type]) -> None:
    color, depth = write_episode(tmp_path, classes)
    recording = read(tmp_path)
    [camera] = recording.cameras
    assert (camera.name, camera.n_frames, camera.height, camera.width) == ("wrist", N, HEIGHT, WIDTH)
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_allclose(camera.world_from_cameras, POSES["w"], atol=1e-12)
    np.testing.assert_allclose(camera.time, np.arange(N) / 20)
    for i in range(N):
        rgb, raw = camera.read(i)
        np.testing.assert_array_equal(rgb, color[i])
        np.testing.assert_allclose(raw * camera.depth_scale, depth[i] / 1000, atol=1e-9)
    assert recording.robot is not None and recording.robot.action is None
    np.testing.assert_allclose(recording.robot.world_from_gripper, GRIPPERS, atol=1e-12)
    np.testing.assert_allclose(recording.robot.gripper_width, [0.05, 0.051, 0.052])
    assert len(recording.files) == 1 + 2 * N


def test_the_principal_point_of_the_renderer_counts_from_the_corner(tmp_path: Path, classes: dict[str, type]) -> None:
    middle = {
        **calibration("wrist", np.eye(4)),
        "wrist_camera_intrinsics": np.array([[-20, 0, 8], [0, -20, 6], [0, 0, 1]]),
    }
    write_episode(tmp_path, classes, misc=middle)
    recording = read(tmp_path)
    np.testing.assert_array_equal(recording.cameras[0].K, [[20, 0, 7.5], [0, 20, 5.5], [0, 0, 1]])
    assert "half a pixel taken off" in recording.assumptions["intrinsics"]


def test_cameras_that_lack_something_are_left_out_and_named(tmp_path: Path, classes: dict[str, type]) -> None:
    write_episode(tmp_path, classes, ("wrist", "front"))
    for i in range(N):
        (tmp_path / f"front_depth/{i}.png").unlink()
        write_image(tmp_path / f"overhead_rgb/{i}.png", images(N)[0][i])
    recording = read(tmp_path)
    assert [camera.name for camera in recording.cameras] == ["wrist"]
    missing = "no depth, misc overhead_camera_extrinsics, misc overhead_camera_intrinsics"
    assert recording.assumptions["cameras"].startswith(f"wrist; left out: front (no depth), overhead ({missing}")
    with pytest.raises(BadData, match="camera front: expected colour, depth and calibration, got no depth"):
        read(tmp_path, cameras=("front",))
    with pytest.raises(UsageError, match="--cameras: expected names among wrist, front, overhead, got elbow"):
        read(
            tmp_path,
            cameras=(
                "wrist",
                "elbow",
            ),
        )


def test_several_cameras_are_read_and_chosen(tmp_path: Path, classes: dict[str, type]) -> None:
    write_episode(tmp_path, classes, ("wrist", "front"))
    assert [camera.name for camera in read(tmp_path).cameras] == ["front", "wrist"]
    [front] = read(tmp_path, cameras=("front",)).cameras
    np.testing.assert_allclose(front.world_from_cameras, POSES["f"], atol=1e-12)


def test_episodes_are_found_at_every_level(tmp_path: Path, classes: dict[str, type]) -> None:
    for variation in (0, 1):
        for episode in (0, 2):
            write_episode(tmp_path / f"open_drawer/variation{variation}/episodes/episode{episode}", classes)
    task = tmp_path / "open_drawer"
    assert RLBENCH.episodes(task, RlbenchOptions()) == (
        "variation0/episode0",
        "variation0/episode2",
        "variation1/episode0",
        "variation1/episode2",
    )
    assert RLBENCH.episodes(tmp_path, RlbenchOptions())[3] == "open_drawer/variation1/episode2"
    assert RLBENCH.episodes(task / "variation1/episodes", RlbenchOptions()) == ("episode0", "episode2")
    assert read(task / "variation1", episode="2").cameras[0].n_frames == N
    assert read(task, episode="variation1/episode2").cameras[0].n_frames == N
    assert read(task / "variation0/episodes/episode2").cameras[0].n_frames == N
    with pytest.raises(UsageError, match="--episode: .*the source holds 4"):
        read(task)
    with pytest.raises(BadData, match=r"SOURCE: expected an episode of RLBench, with low_dim_obs\.pkl, got 0\.png, 1"):
        read(task / "variation0/episodes/episode0/wrist_rgb")


def test_a_missing_image_is_refused_or_left_out_for_all_cameras(tmp_path: Path, classes: dict[str, type]) -> None:
    write_episode(tmp_path, classes, ("wrist", "front"))
    (tmp_path / "front_rgb/1.png").unlink()
    with pytest.raises(BadData, match="front_rgb: frame 1: expected an image for every observation"):
        read(tmp_path)
    recording = read(tmp_path, skip_bad=True)
    assert [camera.n_frames for camera in recording.cameras] == [2, 2]
    assert recording.robot is not None and len(recording.robot.gripper_width) == 2  # type: ignore[arg-type]


def test_masks_are_labels_of_the_objects_that_are_named(tmp_path: Path, classes: dict[str, type]) -> None:
    write_episode(tmp_path, classes)
    handles = np.zeros((HEIGHT, WIDTH), np.int64)
    handles[2:5], handles[5:8], handles[8:] = 84, 70_000, 12
    for i in range(N):
        channels = np.stack([handles & 255, handles >> 8 & 255, handles >> 16], axis=-1).astype(np.uint8)
        write_image(tmp_path / f"wrist_mask/{i}.png", channels)
    assert not read(tmp_path).has_labels and "--objects" in read(tmp_path).assumptions["labels"]
    recording = read(tmp_path, objects="84=lid, 70000=pan")
    assert recording.label_names == {1: "lid", 2: "pan"}
    labels = recording.cameras[0].labels
    assert labels is not None
    np.testing.assert_array_equal(labels(0)[:, 0], [0] * 2 + [1] * 3 + [2] * 3 + [0] * (HEIGHT - 8))
    with pytest.raises(UsageError, match="--objects: expected NUMBER=NAME"):
        read(tmp_path, objects="lid")


def test_a_width_that_contradicts_the_open_gripper_is_not_believed(tmp_path: Path, classes: dict[str, type]) -> None:
    write_episode(tmp_path, classes, gripper_joint_positions=np.array([0.04, 0.04]), gripper_open=0.0)
    recording = read(tmp_path)
    assert recording.robot is not None and recording.robot.gripper_width is not None
    np.testing.assert_array_equal(recording.robot.gripper_width, np.zeros(N))
    assert "contradict" in recording.assumptions["robot"]


def test_a_pickle_that_would_run_something_is_refused(tmp_path: Path, classes: dict[str, type]) -> None:
    write_episode(tmp_path, classes)
    (tmp_path / "low_dim_obs.pkl").write_bytes(b"cposix\nsystem\n(S'touch /tmp/ran'\ntR.")
    with pytest.raises(BadData, match=r"low_dim_obs\.pkl: .*got the name 'posix.system'"):
        read(tmp_path)


def test_wrong_values_are_refused_with_their_place(tmp_path: Path, classes: dict[str, type]) -> None:
    poses = calibration("wrist", np.eye(4))
    write_episode(tmp_path, classes, misc={**poses, "wrist_camera_extrinsics": np.eye(3)})
    with pytest.raises(
        BadData, match=r"observation 0: wrist_camera_extrinsics: expected numbers of shape \(4, 4\), got"
    ):
        read(tmp_path)
    write_episode(tmp_path, classes, misc={**poses, "wrist_camera_far": NEAR})
    with pytest.raises(
        BadData, match=r"wrist_camera_near, _far: expected 0 <= near < far, metres, got 0\.01 and 0\.01"
    ):
        read(tmp_path)
    write_episode(tmp_path, classes, misc={})
    with pytest.raises(BadData, match="cameras: expected one with colour, depth and calibration, got wrist: no misc"):
        read(tmp_path)
    write_episode(tmp_path, classes)
    write_image(tmp_path / "wrist_depth/1.png", images(1)[1][0])
    with pytest.raises(BadData, match=r"1\.png: image: expected 24-bit codes in three channels, got 1 channels of 16"):
        read(tmp_path)


def test_episodes_outside_the_source_are_refused(tmp_path: Path, classes: dict[str, type]) -> None:
    write_episode(tmp_path / "elsewhere", classes)
    (tmp_path / "source").mkdir()
    (tmp_path / "source/episode0").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BadData, match="a link out of it"):
        read(tmp_path / "source")
    assert read(tmp_path / "source", follow_links=True).cameras[0].n_frames == N
