from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bask_data.core.lens import Distortion
from bask_data.errors import BadData
from bask_data.formats import FORMATS, nerfstudio
from bask_data.formats.options.nerfstudio import NerfstudioOptions
from bask_data.formats.recording import CameraRecording, PreparedRecording
from tests.formats.folders import HEIGHT, WIDTH, K, images, rigid, write_image

OPENGL = np.diag([1.0, -1, -1, 1])
POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(3)])
Change = Callable[[dict[str, Any]], object]


def read(source: Path, **options: object) -> PreparedRecording:
    [format] = [item for item in FORMATS if item.name == "nerfstudio"]
    return format.read(source, NerfstudioOptions(**{"trust": True, **options}))


def camera_of(source: Path, **options: object) -> CameraRecording:
    [camera] = read(source, **options).cameras
    return camera


def write_recording(folder: Path, change: Change = lambda _: None, names: tuple[str, ...] = ("2", "9", "10")) -> None:
    """Three frames, listed in another order than that of their names; `change` is applied to the file's content."""
    color, depth = images(3)
    frames = []
    for name, pose, rgb, z in zip(names, POSES, color, depth, strict=True):
        write_image(folder / f"images/{name}.png", rgb)
        write_image(folder / f"depth/{name}.png", z)
        frames.append(
            {
                "file_path": f"./images/{name}.png",
                "depth_file_path": f"depth/{name}.png",
                "transform_matrix": (pose @ OPENGL).tolist(),
            }
        )
    table: dict[str, Any] = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    table |= {"w": WIDTH, "h": HEIGHT, "camera_model": "OPENCV", "frames": frames[::-1]}
    change(table)
    (folder / "transforms.json").write_text(json.dumps(table))


def changed(**values: object) -> Change:
    return lambda table: table.update(values)


def in_frame(i: int, **values: object) -> Change:
    """Change a frame, counted in the order of the names."""
    return lambda table: table["frames"][2 - i].update(values)


def test_frames_come_in_the_order_of_their_names_with_opencv_poses_and_integer_pixel_centres(tmp_path: Path) -> None:
    write_recording(tmp_path)
    recording = read(tmp_path, fps=10)
    [camera] = recording.cameras
    color, depth = images(3)
    assert np.allclose(camera.world_from_cameras, POSES, atol=1e-12)
    assert np.allclose(camera.K, K, atol=1e-12)
    assert camera.time.tolist() == [0.0, 0.1, 0.2]
    for i in range(3):
        rgb, raw = camera.read(i)
        assert np.array_equal(rgb, color[i])
        assert np.array_equal(raw, depth[i])
    assert camera.depth_scale == 0.001
    assert len(recording.files) == 7


def test_poses_may_be_in_the_axes_of_opencv(tmp_path: Path) -> None:
    def change(table: dict[str, Any]) -> None:
        for frame in table["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ OPENGL).tolist()

    write_recording(tmp_path, change)
    assert np.allclose(camera_of(tmp_path, axes="opencv").world_from_cameras, POSES, atol=1e-12)
    [camera] = nerfstudio.read(tmp_path, NerfstudioOptions()).cameras
    assert list(camera.otherwise) == ["--axes opencv"]
    assert np.allclose(camera.otherwise["--axes opencv"], POSES, atol=1e-12)


def test_intrinsics_of_a_frame_go_before_those_of_all(tmp_path: Path) -> None:
    write_recording(tmp_path, in_frame(1, fl_x=25.0, cy=6.5))
    camera = camera_of(tmp_path)
    expected = np.stack([K, K, K])
    expected[1, 0, 0], expected[1, 1, 2] = 25, 6
    assert np.allclose(camera.K, expected)


def test_intrinsics_may_be_an_angle_with_the_centre_in_the_middle(tmp_path: Path) -> None:
    def change(table: dict[str, Any]) -> None:
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
            del table[key]
        table["camera_angle_x"] = 2 * np.arctan(WIDTH / 2 / 20)

    write_recording(tmp_path, change)
    assert np.allclose(camera_of(tmp_path).K, [[20, 0, 7.5], [0, 20, 5.5], [0, 0, 1]])


def test_the_applied_transform_and_scale_are_undone_unless_the_files_world_is_wanted(tmp_path: Path) -> None:
    applied = rigid(np.random.default_rng(9))

    def change(table: dict[str, Any]) -> None:
        table |= {"applied_transform": applied[:3].tolist(), "applied_scale": 0.25}
        for frame in table["frames"]:
            pose = applied @ np.array(frame["transform_matrix"])
            pose[:3, 3] *= 0.25
            frame["transform_matrix"] = pose.tolist()

    write_recording(tmp_path, change)
    assert np.allclose(camera_of(tmp_path).world_from_cameras, POSES, atol=1e-12)
    assert "applied_transform and applied_scale 0.25 of the file is undone" in read(tmp_path).assumptions["world"]
    in_file = camera_of(tmp_path, world="file").world_from_cameras
    assert np.allclose(in_file[:, :3, :3], applied[:3, :3] @ POSES[:, :3, :3], atol=1e-12)
    assert np.allclose(in_file[:, :3, 3], 0.25 * (applied @ POSES)[:, :3, 3], atol=1e-12)


@pytest.mark.parametrize("values", [{"applied_transform": np.diag([1, 1, -1, 1]).tolist()}, {"applied_scale": 0}])
def test_a_mirrored_or_collapsed_world_is_refused(tmp_path: Path, values: dict[str, object]) -> None:
    write_recording(tmp_path, changed(**values))
    with pytest.raises(BadData, match=r"applied_transform: expected a rotation.*fix: pass --world file"):
        read(tmp_path)
    assert camera_of(tmp_path, world="file").n_frames == 3


def test_a_frame_without_depth_is_refused_or_left_out(tmp_path: Path) -> None:
    write_recording(tmp_path, in_frame(1, depth_file_path=None))
    with pytest.raises(BadData, match=r"depth_file_path of \./images/9\.png: expected a depth file.*--skip-bad"):
        read(tmp_path)
    assert np.allclose(camera_of(tmp_path, skip_bad=True).world_from_cameras, POSES[[0, 2]])


def test_frames_whose_files_are_missing_are_refused_or_left_out(tmp_path: Path) -> None:
    write_recording(tmp_path)
    (tmp_path / "images/2.png").unlink()
    with pytest.raises(BadData, match=r"2\.png: file_path: expected a file, got no such path.*--skip-bad"):
        read(tmp_path)
    assert np.allclose(camera_of(tmp_path, skip_bad=True).world_from_cameras, POSES[1:])


def test_a_file_without_any_depth_is_refused_with_the_reason(tmp_path: Path) -> None:
    write_recording(tmp_path, lambda table: [frame.pop("depth_file_path") for frame in table["frames"]])
    with pytest.raises(BadData, match="depth_file_path: expected depth for the frames.*got none in 3 frames"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("values", "model", "parameters"),
    [
        ({"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002}, "OPENCV", (-0.1, 0.02, 0.001, -0.002)),
        ({"k1": -0.1, "k3": 0.3}, "OPENCV", (-0.1, 0, 0, 0, 0.3)),
        ({"k1": 0.1, "camera_model": "FULL_OPENCV", "k4": 0.4}, "OPENCV", (0.1, 0, 0, 0, 0, 0.4, 0, 0)),
        ({"k1": 0.1, "k4": 0.4, "camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE", (0.1, 0, 0, 0.4)),
        ({"k1": 0.1, "is_fisheye": True}, "OPENCV_FISHEYE", (0.1, 0, 0, 0)),
        ({"k1": 0.1, "camera_model": "SIMPLE_RADIAL"}, "OPENCV", (0.1, 0, 0, 0)),
    ],
)
def test_the_lens_is_taken_out_by_its_model(
    tmp_path: Path, values: dict[str, object], model: str, parameters: tuple[float, ...]
) -> None:
    write_recording(tmp_path, changed(**values))
    assert camera_of(tmp_path).distortion == Distortion(model, tuple(map(float, parameters)))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model: expected one of OPENCV.*got EQUIRECTANGULAR"),
        ({"k4": 0.1}, "k4: expected 0 in a perspective camera"),
        ({"k1": "a lot"}, "k1: expected a number, got 'a lot'"),
        ({"fl_x": None}, "fl_x: expected a number, got nothing"),
        ({"w": 2 * WIDTH}, rf"w, h of \./images/2\.png: expected {WIDTH} x {HEIGHT}.*got {2 * WIDTH} x {HEIGHT}"),
        ({"frames": {}}, "frames: expected a list of frames, got {}"),
        ({"frames": [{"transform_matrix": []}]}, r"frames\[0\]: expected an object with file_path"),
    ],
)
def test_what_cannot_be_understood_is_refused_by_name(tmp_path: Path, values: dict[str, object], message: str) -> None:
    write_recording(tmp_path, changed(**values))
    with pytest.raises(BadData, match=message):
        read(tmp_path)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"k1": 0.1}, r"distortion of \./images/9\.png: expected one lens for all frames"),
        ({"transform_matrix": [[1, 2], [3, 4]]}, "transform_matrix of .*9.png: expected 4 x 4 or 3 x 4 numbers"),
        ({"file_path": "./images/10.png"}, r"file_path: expected another image for each frame, got .*10\.png twice"),
        ({"file_path": "../../etc/passwd"}, "file_path: expected a path inside the source folder"),
        ({"depth_file_path": "/etc/passwd"}, "depth_file_path: expected a path inside the source folder"),
        ({"depth_file_path": "..\\depth\\9"}, "depth_file_path: expected a path inside the source folder"),
    ],
)
def test_what_cannot_be_used_in_a_frame_is_refused_by_name(
    tmp_path: Path, values: dict[str, object], message: str
) -> None:
    write_recording(tmp_path, in_frame(1, **values))
    with pytest.raises(BadData, match=message):
        read(tmp_path)


def test_depth_of_half_the_size_keeps_its_pixels_with_the_intrinsics_scaled_about_the_corner(tmp_path: Path) -> None:
    write_recording(tmp_path)
    depth = images(3)[1]
    for name, z in zip(("2", "9", "10"), depth, strict=True):
        write_image(tmp_path / f"depth/{name}.png", z[::2, ::2])
    camera = camera_of(tmp_path)
    assert (camera.height, camera.width) == (HEIGHT // 2, WIDTH // 2)
    # The file's cx = 8 from the corner is 4 in the half image, and so 3.5 from the first pixel's centre.
    assert np.allclose(camera.K, [[10, 0, 3.5], [0, 10.5, 2.5], [0, 0, 1]])
    assert np.array_equal(camera.read(1)[1], depth[1, ::2, ::2])


def test_arrays_of_depth_are_read_in_the_unit_that_is_stated(tmp_path: Path) -> None:
    write_recording(
        tmp_path, lambda table: [f.update(depth_file_path=f["depth_file_path"][:-4]) for f in table["frames"]]
    )
    depth = images(3)[1]
    for name, z in zip(("2", "9", "10"), depth, strict=True):
        (tmp_path / f"depth/{name}.png").unlink()
        np.save(tmp_path / f"depth/{name}.npy", z.astype(np.float32) / 1000)
    with pytest.raises(BadData, match=r"2\.npy: depth: expected a median of at least 0\.02 m.*--depth-scale 1"):
        read(tmp_path)
    camera = camera_of(tmp_path, depth_scale=1.0)
    assert np.allclose(camera.read(0)[1] * camera.depth_scale, depth[0] / 1000, atol=camera.depth_scale)


def test_the_file_may_state_the_unit_of_depth(tmp_path: Path) -> None:
    write_recording(tmp_path, changed(integer_depth_scale=0.0005))
    assert camera_of(tmp_path).depth_scale == 0.0005
    assert camera_of(tmp_path, depth_scale=0.002).depth_scale == 0.002


def test_names_without_suffix_and_other_files_with_transforms_are_found(tmp_path: Path) -> None:
    def change(table: dict[str, Any]) -> None:
        for frame in table["frames"]:
            frame["file_path"] = frame["file_path"][:-4].replace("/", "\\")
            frame["depth_path"] = frame.pop("depth_file_path")

    write_recording(tmp_path, change)
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    with pytest.raises(BadData, match="--transforms: expected a file.*fix: pass --transforms transforms_train.json"):
        read(tmp_path)
    assert np.allclose(camera_of(tmp_path, transforms="transforms_train.json").world_from_cameras, POSES)


def test_time_stamps_order_the_frames(tmp_path: Path) -> None:
    def change(table: dict[str, Any]) -> None:
        for i, frame in enumerate(table["frames"]):
            frame["timestamp"] = 5 + i / 10

    write_recording(tmp_path, change)
    camera = camera_of(tmp_path)
    assert np.allclose(camera.time, [5, 5.1, 5.2])
    assert np.allclose(camera.world_from_cameras, POSES[::-1])


@pytest.mark.parametrize("text", ["[" * 100_000, "[1, 2]", "{", '{"frames": ' + "9" * 5000 + "}", "\xff"])
def test_damaged_and_hostile_json_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "transforms.json").write_text(text, encoding="latin-1")
    with pytest.raises(BadData, match=r"transforms\.json: content: expected"):
        read(tmp_path)


def test_numbers_beyond_floating_point_are_refused(tmp_path: Path) -> None:
    write_recording(tmp_path, changed(fl_x=10**400))
    with pytest.raises(BadData, match="fl_x: expected a number"):
        nerfstudio.read(tmp_path, NerfstudioOptions())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.array([{}], dtype=object), "array: expected numbers saved by numpy.save"),
        (np.ones((2, 3, 4)), r"depth: expected one channel, of 16 bits or in floating point, got an array \(2, 3, 4\)"),
    ],
)
def test_arrays_that_hold_no_depth_are_refused(tmp_path: Path, content: np.ndarray, message: str) -> None:
    write_recording(tmp_path, in_frame(0, depth_file_path="depth/2.npy"))
    np.save(tmp_path / "depth/2.npy", content, allow_pickle=True)
    with pytest.raises(BadData, match=rf"2\.npy: {message}"):
        read(tmp_path)
