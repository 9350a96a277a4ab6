from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS
from bask_data.formats.options.colmap import ColmapOptions
from bask_data.formats.recording import PreparedRecording
from tests.formats.corner import SIZE, K, camera, model, model_from_world, poses, rendered, write_corner, write_model
from tests.formats.folders import write_image

[COLMAP] = [format for format in FORMATS if format.name == "colmap"]
PER_UNIT = 0.25
"""Metres per unit of the models below."""
POSES = poses(6)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images and depth of six cameras, without a model."""
    folder = tmp_path_factory.mktemp("corner")
    write_corner(folder, POSES)
    return folder


@pytest.fixture
def source(images: Path, tmp_path: Path) -> Path:
    """As `images`, with an empty folder of their own for models and more."""
    for name in ("images", "depth"):
        (tmp_path / name).mkdir()
        for file in (images / name).iterdir():
            (tmp_path / name / file.name).hardlink_to(file)
    return tmp_path


def read(source: Path, **options: Any) -> PreparedRecording:
    return COLMAP.read(source, ColmapOptions(**options))


def expected_poses(metres: float = 1.0) -> Float[ndarray, "n 4 4"]:
    """World of the model, in metres if the scale is right."""
    result = model_from_world() @ POSES
    result[:, :3, 3] *= metres
    return result


def scale_of(recording: PreparedRecording) -> float:
    return float(recording.assumptions["scale"].split()[0])


@pytest.mark.parametrize(("place", "text"), [("sparse/0", False), ("sparse", True), ("colmap/sparse/0", False)])
def test_model_is_read_and_scaled_by_depth(source: Path, place: str, text: bool) -> None:
    write_model(source / place, model(POSES, PER_UNIT), text)
    recording = read(source)
    [ready] = recording.cameras
    scale = scale_of(recording)
    assert scale == pytest.approx(PER_UNIT, rel=5e-4)
    assert ready.world_from_cameras == pytest.approx(expected_poses(scale / PER_UNIT), abs=1e-8)
    assert np.allclose(ready.K, K, atol=1e-12)
    assert "6 images, 120 points" in recording.assumptions["pose"]
    assert "arbitrary" in recording.assumptions["world"]
    assert "no other reading does as well" in recording.assumptions["agreement"]


def test_model_without_rigs_and_frames_is_read(source: Path) -> None:
    write_model(source / "sparse", model(POSES, PER_UNIT), text=True)
    for name in ("rigs", "frames"):
        (source / "sparse" / f"{name}.txt").unlink()
    assert read(source).cameras[0].n_frames == 6


@pytest.mark.parametrize("how", ["json", "tum", "pattern", "numbers", "times"])
def test_model_is_moved_into_the_world_of_known_poses(source: Path, how: str) -> None:
    write_model(source / "sparse/0", model(POSES, PER_UNIT))
    from scipy.spatial.transform import Rotation

    rows = [(*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()) for pose in POSES]
    align_to = "known.txt"
    if how == "json":
        align_to = "known.json"
        (source / align_to).write_text(json.dumps({f"{i:04d}.png": POSES[i].tolist() for i in range(1, 5)}))
    elif how == "pattern":
        align_to = "known/pose_*.txt"
        (source / "known").mkdir()
        for i in range(6):
            np.savetxt(source / f"known/pose_{i}.txt", POSES[i])
    else:
        keys = {"tum": "{:04d}.png", "numbers": "{}", "times": "{}.0"}[how]
        lines = [" ".join(map(repr, map(float, row))) for row in rows]
        (source / align_to).write_text("".join(f"{keys.format(i)} {line}\n" for i, line in enumerate(lines)))
    recording = read(source, align_to=align_to)
    assert recording.cameras[0].world_from_cameras == pytest.approx(POSES, abs=1e-3)
    n = 4 if how == "json" else 6
    assert f"that of {align_to}: {n} of {n} known poses agree, residuals median 0." in recording.assumptions["world"]
    assert "scale would be 0.25 m per unit" in recording.assumptions["world"]


def test_wrong_known_pose_is_rejected_and_named(source: Path) -> None:
    write_model(source / "sparse/0", model(POSES, PER_UNIT))
    known = {f"{i:04d}": invert_rigid(POSES[i]) for i in range(6)}
    known["0002"] = known["0002"] @ np.diag([-1.0, -1, 1, 1])
    (source / "known.json").write_text(json.dumps({name: pose.tolist() for name, pose in known.items()}))
    recording = read(source, align_to="known.json", pose_is="camera_from_world")
    assert recording.cameras[0].world_from_cameras == pytest.approx(POSES, abs=1e-3)
    assert "5 of 6 known poses agree (not 0002.png)" in recording.assumptions["world"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "expected poses of 3 images or more, got 0"),
        ('{"0000.png": [1, 2]}', "0000.png: expected 4 x 4"),
        ('{"a": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', "begin each entry with an image's name"),
    ],
)
def test_known_poses_of_no_image_are_refused(source: Path, content: str, message: str) -> None:
    write_model(source / "sparse/0", model(POSES, PER_UNIT))
    (source / "known.json").write_text(content)
    with pytest.raises(BadData, match=message):
        read(source, align_to="known.json")


def test_images_that_the_model_lacks_are_left_out_and_counted(source: Path) -> None:
    reconstruction = model(POSES, PER_UNIT)
    reconstruction.deregister_frame(reconstruction.image(2).frame_id)
    write_model(source / "sparse/0", reconstruction)
    write_image(source / "images/extra.png", np.zeros((*SIZE, 3), np.uint8))
    recording = read(source)
    assert recording.cameras[0].n_frames == 5
    assert (
        "5 of 7; 2 left out: 0001.png (not registered), extra.png (not registered)" in recording.assumptions["frames"]
    )


def test_largest_of_several_models_is_taken(source: Path) -> None:
    write_model(source / "sparse/0", model(POSES[:3], PER_UNIT))
    write_model(source / "sparse/1", model(POSES, PER_UNIT))
    recording = read(source)
    assert recording.cameras[0].n_frames == 6
    assert recording.assumptions["models"] == "sparse/1, the largest of 2; not sparse/0 with 3 images"
    assert read(source, model="sparse/0").cameras[0].n_frames == 3


def test_lens_of_the_model_is_taken_out(source: Path) -> None:
    write_model(source / "sparse/0", model(POSES, PER_UNIT, [camera("SIMPLE_RADIAL", 0.05)] * 6))
    [ready] = read(source).cameras
    assert ready.distortion is not None and ready.distortion.model == "SIMPLE_RADIAL"
    assert ready.distortion.parameters == (0.05,)


def test_camera_of_each_image_gives_each_its_own_lens(source: Path) -> None:
    cameras = [camera("SIMPLE_RADIAL", 1e-6 * i) for i in range(6)]
    for i, each in enumerate(cameras):
        each.params = [*(300.0 + i, *each.params[1:])]
    write_model(source / "sparse/0", model(POSES, PER_UNIT, cameras))
    recording = read(source)
    [ready] = recording.cameras
    assert ready.Ks[:, 0, 0].tolist() == [300, 301, 302, 303, 304, 305]
    assert "one K per image" in recording.assumptions["intrinsics"]
    assert "own lens distortion was taken out" in recording.assumptions["intrinsics"]
    assert ready.distortion is None


def test_cameras_of_different_sizes_are_refused_with_their_images(source: Path) -> None:
    cameras = [camera(), *[camera(size=(480, 640)) for _ in range(5)]]
    write_model(source / "sparse/0", model(POSES, PER_UNIT, cameras))
    with pytest.raises(BadData, match=r"320 x 240: 0000.png; 640 x 480: 0001.png, 0002.png and 3 more"):
        read(source)


def test_images_of_another_size_than_the_models_are_refused(source: Path) -> None:
    write_model(source / "sparse/0", model(POSES, PER_UNIT, [camera(size=(480, 640)) for _ in POSES]))
    with pytest.raises(BadData, match="expected 640 x 480 as in the model, got 320 x 240"):
        read(source)


def test_sphere_has_no_pinhole_image(source: Path) -> None:
    sphere = pycolmap.Camera(model="EQUIRECTANGULAR", width=SIZE[1], height=SIZE[0], params=[320, 240])
    write_model(source / "sparse/0", model(POSES, PER_UNIT, [sphere, *[camera() for _ in range(5)]]))
    with pytest.raises(BadData, match="expected a camera that has a pinhole image, got EQUIRECTANGULAR"):
        read(source)


def test_depth_of_other_images_is_refused(source: Path) -> None:
    write_model(source / "sparse/0", model(POSES, PER_UNIT))
    rng = np.random.default_rng(0)
    for i in range(6):
        slope = np.linspace(400, 1500, SIZE[1])[:: 1 if i % 2 else -1]
        depth = np.rint(slope + rng.normal(0, 3, SIZE)).astype(np.uint16)
        (source / f"depth/{i:04d}.png").unlink()
        write_image(source / f"depth/{i:04d}.png", depth)
    with pytest.raises(BadData, match="depth and model do not agree"):
        read(source)


def test_known_poses_in_another_unit_are_refused(source: Path) -> None:
    write_model(source / "sparse/0", model(POSES, PER_UNIT))
    known = POSES.copy()
    known[:, :3, 3] *= 1000
    (source / "known.json").write_text(json.dumps({f"{i:04d}": known[i].tolist() for i in range(6)}))
    with pytest.raises(BadData, match="a world 1e.03 times as large by the known poses as by depth.*--pose-unit"):
        read(source, align_to="known.json")
    aligned = read(source, align_to="known.json", pose_unit="mm").cameras[0].world_from_cameras
    assert aligned == pytest.approx(POSES, abs=1e-3)


def test_depth_in_floating_point_is_metres(source: Path) -> None:
    write_model(source / "sparse/0", model(POSES, PER_UNIT))
    for i in range(6):
        np.save(source / f"depth/{i:04d}.npy", rendered(POSES[i])[1])
    assert scale_of(read(source, depth="depth/*.npy")) == pytest.approx(PER_UNIT, rel=5e-4)


def test_depth_without_points_is_refused(source: Path) -> None:
    reconstruction = model(POSES, PER_UNIT)
    reconstruction.delete_all_points2D_and_points3D()
    write_model(source / "sparse/0", reconstruction)
    with pytest.raises(BadData, match="expected depth at 15 points of the model in an image"):
        read(source)


def test_image_without_depth_is_named_and_left_out_on_request(source: Path) -> None:
    write_model(source / "sparse/0", model(POSES, PER_UNIT))
    (source / "depth/0003.png").unlink()
    with pytest.raises(BadData, match=r"depth of 0003.png: expected a file depth/\*.png, got none for 1 of 6"):
        read(source)
    recording = read(source, skip_bad=True)
    assert recording.cameras[0].n_frames == 5
    assert recording.left_out.keys() == {"camera/0003.png"}


def test_names_with_folders_find_their_depth(source: Path) -> None:
    (source / "images/left").mkdir()
    for i in range(6):
        (source / f"images/{i:04d}.png").rename(source / f"images/left/{i:04d}.png")
    reconstruction = model(POSES, PER_UNIT)
    for i in range(6):
        reconstruction.image(i + 1).name = f"left/{i:04d}.png"
    write_model(source / "sparse/0", reconstruction)
    assert read(source).cameras[0].n_frames == 6


def test_half_of_a_model_and_wrong_counts_are_refused(source: Path) -> None:
    for name, data in {
        "images": lambda data: data[: len(data) // 2],
        "points3D": lambda data: struct.pack("<Q", 10**9) + data[8:],
        "cameras": lambda data: data[:5],
        "frames": lambda data: data[:20],
    }.items():
        write_model(source / "sparse/0", model(POSES, PER_UNIT))
        file = source / f"sparse/0/{name}.bin"
        file.write_bytes(data(file.read_bytes()))
        with pytest.raises(BadData, match="truncated or corrupted|does not read") as caught:
            read(source)
        assert "sparse/0" in str(caught.value)


def test_names_that_lead_out_of_the_source_are_refused(source: Path) -> None:
    reconstruction = model(POSES, PER_UNIT)
    reconstruction.image(1).name = "../../secret.png"
    write_model(source / "sparse/0", reconstruction)
    with pytest.raises(BadData, match="expected a path inside the source folder"):
        read(source)


def test_options_that_the_model_answers_are_refused(source: Path) -> None:
    write_model(source / "sparse/0", model(POSES, PER_UNIT))
    with pytest.raises(UsageError, match="expected nothing: the model in sparse/0 states it"):
        read(source, intrinsics="300,300,158,121")
    with pytest.raises(BadData, match="got no such folder"):
        read(source, model="elsewhere")
    with pytest.raises(BadData, match="expected the model's images, such as 0000.png, got none in colour"):
        read(source, images="colour")
