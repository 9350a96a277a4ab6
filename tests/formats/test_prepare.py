from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bask_data.core.lens import Lens
from bask_data.errors import BadData, UsageError
from bask_data.formats.label_files import with_labels
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.options.stray import StrayOptions
from bask_data.formats.options.tum import TumOptions
from bask_data.formats.prepare import prepared
from bask_data.formats.recording import ObjectPose, PreparedRecording, RobotRecording, SourceCamera, SourceRecording
from tests.formats.folders import HEIGHT, WIDTH, K, images, rigid, write_image


def source_camera(n: int = 4, **changes: Any) -> SourceCamera:
    color, depth = images(n)
    rng = np.random.default_rng(1)
    camera = SourceCamera(
        name="c",
        frames=tuple(f"f{i:03d}" for i in range(n)),
        lens=Lens(K, (HEIGHT, WIDTH)),
        world_from_cameras=np.stack([rigid(rng) for _ in range(n)]),
        time=np.arange(float(n)),
        color=lambda i: color[i],
        depth=lambda i: depth[i],
        depth_scale=0.001,
    )
    return replace(camera, **changes)


def recording_of(camera: SourceCamera, **changes: Any) -> SourceRecording:
    return replace(SourceRecording((camera,), None, {}, {}, ()), **changes)


def prepare(camera: SourceCamera, folder: Path = Path(), **options: Any) -> PreparedRecording:
    given = SourceOptions(**options)
    return prepared(folder, with_labels(folder, recording_of(camera), given), given)


def test_frames_that_need_nothing_stay_as_they_are() -> None:
    camera = source_camera()
    [ready] = prepare(camera).cameras
    assert np.allclose(ready.world_from_cameras, camera.world_from_cameras, atol=1e-14)
    for i in range(4):
        rgb, depth = ready.read(i)
        assert np.array_equal(rgb, camera.color(i)) and np.array_equal(depth, camera.depth(i))


@pytest.mark.parametrize(
    ("text", "expected"), [("1:3", [1, 2]), ("::2", [0, 2]), ("-1:", [3]), ("2", [2]), (":99", [0, 1, 2, 3])]
)
def test_frames_are_chosen_as_first_end_and_step(text: str, expected: list[int]) -> None:
    camera = source_camera()
    result = prepare(camera, frames=text)
    [ready] = result.cameras
    assert ready.time.tolist() == [float(i) for i in expected]
    assert np.array_equal(ready.read(len(expected) - 1)[1], camera.depth(expected[-1]))
    assert np.allclose(ready.world_from_cameras, camera.world_from_cameras[expected], atol=1e-14)


@pytest.mark.parametrize("name", ["../up", "a b", "", ".hidden", "robot", "objects"])
def test_cameras_whose_names_are_no_folders_of_their_own_are_refused(name: str) -> None:
    with pytest.raises(BadData, match="name of a camera: expected letters, digits"):
        prepare(source_camera(name=name))


def test_a_range_without_frames_is_refused() -> None:
    with pytest.raises(UsageError, match="--frames: expected frames of c among 0 to 3, got 7:9"):
        prepare(source_camera(), frames="7:9")


def broken(i: int, at: int) -> np.ndarray:
    if i == at:
        raise BadData("3.png", "image", expected="a readable image", got="one that does not decode")
    return images(5)[1][i]


def test_bad_frames_are_refused_with_the_option_that_leaves_them_out_and_left_out_with_it() -> None:
    poses = source_camera(5).world_from_cameras
    poses[1] = -np.inf
    camera = source_camera(
        5,
        world_from_cameras=poses,
        depth=lambda i: broken(i, 3) if i else np.zeros((HEIGHT, WIDTH), np.uint16),
        faults={4: BadData("f", "frame f004", expected="a depth file", got="none")},
    )
    with pytest.raises(BadData, match="not finite.*fix: pass --skip-bad") as error:
        prepare(camera)
    assert "f004" in error.value.__notes__[0]
    result = prepare(camera, skip_bad=True)
    assert result.cameras[0].time.tolist() == [2.0]
    assert list(result.left_out) == ["c/f000", "c/f001", "c/f003", "c/f004"]
    assert result.assumptions["frames"].startswith("1 of 5; 4 left out: f000 (no depth), f001 (no pose)")


def test_faults_that_the_format_itself_has_are_left_out_without_being_asked() -> None:
    poses = source_camera().world_from_cameras
    poses[2] = -np.inf
    fault = BadData("f", "pose of f002", expected="a pose", got="-inf")
    camera = source_camera(world_from_cameras=poses, faults={2: fault}, expected={2: "tracking lost"})
    result = prepare(camera)
    assert result.cameras[0].time.tolist() == [0, 1, 3]
    assert result.left_out == {"c/f002": fault.fault}
    assert result.assumptions["frames"] == "3 of 4; 1 left out: f002 (tracking lost)"
    broken_too = replace(camera, faults={**camera.faults, 1: BadData("f", "depth", expected="a file", got="none")})
    with pytest.raises(BadData, match="f: depth: expected a file, got none"):
        prepare(broken_too)


def test_a_frame_that_one_camera_lacks_is_lost_to_the_robots_states_too() -> None:
    poses = source_camera().world_from_cameras
    poses[2] = np.nan
    cameras = (source_camera(world_from_cameras=poses), source_camera(name="d"))
    gripper = source_camera().world_from_cameras
    robot = RobotRecording(gripper, np.arange(4.0), np.arange(8.0).reshape(4, 2), ("a", "b"))
    result = prepared(Path(), SourceRecording(cameras, robot, {}, {}, ()), SourceOptions(skip_bad=True))
    assert [camera.time.tolist() for camera in result.cameras] == [[0, 1, 3], [0, 1, 3]]
    assert result.robot is not None and result.robot.gripper_width is not None and result.robot.action is not None
    assert result.robot.gripper_width.tolist() == [0, 1, 3]
    assert result.robot.action[:, 1].tolist() == [1, 3, 7]


def test_a_mirrored_pose_is_not_lost_tracking() -> None:
    poses = source_camera().world_from_cameras
    poses[2, :3, 0] *= -1
    with pytest.raises(BadData, match="c f002: pose: expected a rigid transform, got a mirrored frame.*convert"):
        prepare(source_camera(world_from_cameras=poses))


def test_poses_of_three_decimals_are_made_rigid_and_that_is_said() -> None:
    poses = source_camera(40).world_from_cameras
    result = prepare(source_camera(40, world_from_cameras=np.round(poses, 3)), trust=True)
    rotation = result.cameras[0].world_from_cameras[:, :3, :3]
    assert np.allclose(np.swapaxes(rotation, 1, 2) @ rotation, np.eye(3), atol=1e-14)
    assert np.abs(rotation - poses[:, :3, :3]).max() < 1e-3
    assert "rounded" in result.assumptions["rounding"]


def test_a_world_far_away_gets_an_origin_nearby_for_cameras_robot_and_objects_alike() -> None:
    far = np.array([441547.25, 5121946.5, 245.0])
    camera, near = source_camera(), source_camera().world_from_cameras
    poses = near.copy()
    poses[:, :3, 3] += far
    robot, pose = RobotRecording(poses), ObjectPose(poses[0], 0.0)
    recording = recording_of(replace(camera, world_from_cameras=poses), robot=robot, object_poses={7: pose})
    result = prepared(Path(), recording, SourceOptions())
    middle = np.median(poses[:, :3, 3], axis=0)
    assert np.abs(result.origin - middle).max() <= 0.5 and np.array_equal(result.origin, np.rint(result.origin))
    moved = near.copy()
    moved[:, :3, 3] += far - result.origin
    assert np.allclose(result.cameras[0].world_from_cameras, moved, atol=1e-9)
    assert result.robot is not None and result.robot.world_from_gripper is not None
    assert np.allclose(result.robot.world_from_gripper, moved, atol=1e-9)
    assert np.allclose(result.object_poses[7].world_from_object, moved[0], atol=1e-9)
    assert prepared(Path(), recording, SourceOptions(local_origin=False)).origin == (0, 0, 0)
    home = (441000.0, 5122000.0, 0.0)
    assert prepared(Path(), recording, SourceOptions(), home).origin == home
    assert prepared(Path(), recording, SourceOptions(), (4e5, 5e6, 0.0)).origin == result.origin
    assert prepare(camera).origin == (0, 0, 0)


def test_depth_of_another_size_is_refused_unless_something_says_how_it_lies() -> None:
    half = source_camera(depth=lambda i: images(4)[1][i][::2, ::2])
    with pytest.raises(BadData, match=r"size of depth: expected 16 x 12, got 8 x 6\.  fix: pass --depth-intrinsics"):
        prepare(half)
    [ready] = prepare(half, depth_intrinsics="scaled").cameras
    assert (ready.height, ready.width) == (6, 8)
    assert np.array_equal(ready.K, [[10, 0, 3.75], [0, 10.5, 2.75], [0, 0, 1]])
    assert "--color-from-depth" in prepare(half, depth_intrinsics="scaled").assumptions["depth camera"]
    assert np.array_equal(ready.read(1)[1], images(4)[1][1][::2, ::2])


def test_colour_is_not_brought_to_depth_along_other_axes() -> None:
    skewed = K.copy()
    skewed[0, 1] = 1.0
    camera = source_camera(depth_lens=Lens(skewed, (HEIGHT, WIDTH)))
    with pytest.raises(BadData, match="c: lens: got intrinsics: expected the same skew.*fix: pass --align color"):
        prepare(camera).cameras[0].read(0)
    assert prepare(camera, align="color").cameras[0].read(0)[1].shape == (HEIGHT, WIDTH)


def test_depth_in_metres_is_kept_in_tenths_of_a_millimetre_and_nan_is_none() -> None:
    metres = images(4)[1].astype(np.float32) / 1000
    metres[:, 0, 0] = (np.nan, np.inf, -np.inf, -1)
    result = prepare(source_camera(depth=lambda i: metres[i], depth_scale=1.0))
    [ready] = result.cameras
    assert ready.depth_scale == pytest.approx(1e-4)
    for i in range(4):
        stored = ready.read(i)[1]
        assert stored[0, 0] == 0
        assert np.allclose(stored[1:] * ready.depth_scale, metres[i][1:], atol=5.1e-5)
    assert "steps of 0.1 mm" in result.assumptions["depth values"]


def test_depth_of_little_confidence_is_left_out_on_request() -> None:
    level = np.tile(np.arange(WIDTH, dtype=np.uint8) % 3, (HEIGHT, 1))
    camera = source_camera(confidence=lambda i: level)
    assert np.array_equal(prepare(camera).cameras[0].read(0)[1], camera.depth(0))
    kept = prepare(camera, confidence=1).cameras[0].read(0)[1]
    assert np.array_equal(kept, np.where(level >= 1, camera.depth(0), 0))
    with pytest.raises(UsageError, match="--confidence: expected a source with confidence maps"):
        prepare(source_camera(), confidence=1)


def test_labels_of_another_size_are_refused(tmp_path: Path) -> None:
    for i in range(4):
        write_image(tmp_path / f"label_{i}.png", np.zeros((HEIGHT // 2, WIDTH), np.uint8))
    result = prepare(source_camera(), tmp_path, labels="label_*.png")
    with pytest.raises(BadData, match="size of labels: .*resize them: labels must have the size of the images"):
        result.cameras[0].labels(0)


def test_labels_of_any_format_are_found_by_the_frames_names_or_numbers(tmp_path: Path) -> None:
    for i in range(4):
        write_image(tmp_path / "truth" / f"label_{i}.png", np.full((HEIGHT, WIDTH), i, np.uint8))
    result = prepare(source_camera(), tmp_path, labels="truth/label_*.png")
    assert result.label_names == {1: "label 1", 2: "label 2", 3: "label 3"}
    assert result.cameras[0].labels is not None
    assert [int(result.cameras[0].labels(i)[0, 0]) for i in range(4)] == [0, 1, 2, 3]
    (tmp_path / "truth" / "label_2.png").unlink()
    with pytest.raises(BadData, match="--labels: expected a label image for every frame, got none for f002"):
        prepare(source_camera(), tmp_path, labels="truth/label_*.png")


def test_binary_masks_are_not_taken_for_a_robot(tmp_path: Path) -> None:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    for value, message in ((255, "--labels: expected a number from 1 to 254.* got 255 alone, as binary"), (3, "")):
        mask[3:5] = value
        for i in range(4):
            write_image(tmp_path / f"m{i}.png", mask)
        if message:
            with pytest.raises(BadData, match=message):
                prepare(source_camera(), tmp_path, labels="m*.png")
    mask[0] = 255
    write_image(tmp_path / "m2.png", mask)
    assert prepare(source_camera(), tmp_path, labels="m*.png").label_names == {3: "label 3", 255: "robot"}


@pytest.mark.parametrize("time", [[0.0, 0.0, 1, 2], [1.0, 0.5, 2, 3], [0.0, float("nan"), 1, 2]])
def test_time_that_does_not_increase_is_refused(time: list[float]) -> None:
    with pytest.raises(BadData, match="time of frame f001: expected finite times that increase with the frames"):
        prepare(source_camera(time=np.array(time)))


def test_depth_that_is_invalid_everywhere_is_refused_but_not_in_a_single_frame() -> None:
    depth = images(4)[1]
    depth[0] = 0
    prepare(source_camera(depth=lambda i: depth[i]))
    with pytest.raises(BadData, match="depth: expected a measurement somewhere in the recording, got none in 4 frames"):
        prepare(source_camera(depth=lambda i: depth[i] * np.uint16(0)))


@pytest.mark.parametrize("scale", [1.0, 1e-7])
def test_an_implausible_depth_scale_is_refused(scale: float) -> None:
    message = r"depth: expected a median between 0.001 and 100 m, got .* m at .*fix: check the files' depth"
    with pytest.raises(BadData, match=message):
        prepare(source_camera(depth_scale=scale))


def test_depth_with_rotated_bits_is_refused_whatever_the_scale() -> None:
    # A tilted plane about 8192, the value from which rotated ones start again.
    depth = np.tile(8152 + 5 * np.arange(WIDTH, dtype=np.uint16), (4, HEIGHT, 1))
    prepare(source_camera(depth=lambda i: depth[i]))
    message = r"depth: expected values .* seems bit-rotated, as APC's \[depth-rotated\].*fix: `bask-data ingest apc`"
    for scale in (1.25e-5, 1e-5, 1e-3, 1.0):
        with pytest.raises(BadData, match=message):
            prepare(source_camera(depth=lambda i: (depth[i] << 3) | (depth[i] >> 13), depth_scale=scale), trust=True)


SCALED = {"depth_scale": 1.0}
OFF_CENTRE = {"lens": Lens(K + np.array([[0, 0, WIDTH], [0, 0, 0], [0, 0, 0]]), (HEIGHT, WIDTH))}


@pytest.mark.parametrize(("changes", "options"), [(SCALED, ["--depth-scale"]), (OFF_CENTRE, ["--intrinsics-size"])])
def test_errors_offer_only_options_that_the_format_has(changes: dict[str, Any], options: list[str]) -> None:
    for given in (TumOptions(), StrayOptions()):
        with pytest.raises(BadData) as error:
            prepared(Path(), recording_of(source_camera(**changes)), given)
        offered = re.findall("--[a-z-]+", error.value.fix)
        assert offered == (options if isinstance(given, TumOptions) else [])
