from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData
from bask_data.formats import FORMATS
from bask_data.formats.matlab import read_arrays
from bask_data.formats.options.bop import BopOptions
from bask_data.formats.recording import PreparedRecording
from tests.formats.folders import HEIGHT, WIDTH, K, images, rigid, write_image

RNG = np.random.default_rng(0)
POSES = np.stack([rigid(RNG) for _ in range(3)])
OBJECTS = {8: rigid(RNG), 21: rigid(RNG)}
COLOR, DEPTH = images(3)
LABELS = np.random.default_rng(1).choice(np.array([0, 8, 21], np.uint8), (3, HEIGHT, WIDTH))


def read(source: Path, **options: object) -> PreparedRecording:
    return next(item for item in FORMATS if item.name == "bop").read(source, BopOptions(**options))


def meta(i: int, labels: tuple[int, ...] = (8, 21), **changes: Any) -> dict[str, Any]:
    camera_from_world = invert_rigid(POSES[i])
    placed = [(camera_from_world @ OBJECTS[label])[:3] for label in labels]
    content = {
        "intrinsic_matrix": K,
        "factor_depth": np.uint16([[1000]]),
        "rotation_translation_matrix": camera_from_world[:3],
        "cls_indexes": np.uint8([[label] for label in labels]),
        "poses": np.stack(placed, axis=-1) if len(placed) > 1 else placed[0],
        "vertmap": np.zeros((600, 600, 3), np.float32),
        "center": np.zeros((2, 2)),
    }
    return {name: value for name, value in (content | changes).items() if value is not None}


def write_scene(folder: Path) -> None:
    for i in range(3):
        write_image(folder / f"{i + 1:06d}-color.png", COLOR[i])
        write_image(folder / f"{i + 1:06d}-depth.png", DEPTH[i])
        write_image(folder / f"{i + 1:06d}-label.png", LABELS[i])
        scipy.io.savemat(folder / f"{i + 1:06d}-meta.mat", meta(i), do_compression=True)


def test_a_scene_is_read_with_its_classes_and_objects_as_truth(tmp_path: Path) -> None:
    write_scene(tmp_path)
    recording = read(tmp_path)
    [camera] = recording.cameras
    np.testing.assert_allclose(camera.world_from_cameras, POSES, atol=1e-9)
    np.testing.assert_allclose(camera.time, np.array([1, 2, 3]) / 30)
    assert camera.depth_scale == pytest.approx(0.001) and np.array_equal(camera.K, K)
    assert recording.label_names == {8: "009_gelatin_box", 21: "061_foam_brick"}
    assert camera.labels is not None
    for i in range(3):
        assert np.array_equal(camera.read(i)[0], COLOR[i]) and np.array_equal(camera.read(i)[1], DEPTH[i])
        assert np.array_equal(camera.labels(i), LABELS[i])
    for label, expected in OBJECTS.items():
        np.testing.assert_allclose(recording.object_poses[label].world_from_object, expected, atol=1e-9)
    assert len(recording.files) == 3 * 4


def test_scenes_of_the_data_set_are_episodes(tmp_path: Path) -> None:
    for name in ("0000", "0001"):
        (tmp_path / name).mkdir()
        write_scene(tmp_path / name)
    (tmp_path / "0001/000002-label.png").unlink()
    recording = read(tmp_path, episode="0001")
    assert not recording.has_labels and not recording.object_poses
    assert recording.assumptions["labels"] == "none: frames 000002 lack them"


def test_a_scene_of_one_object_has_no_third_dimension_of_poses(tmp_path: Path) -> None:
    write_scene(tmp_path)
    for i in range(3):
        scipy.io.savemat(tmp_path / f"{i + 1:06d}-meta.mat", meta(i, (21,)))
    recording = read(tmp_path)
    np.testing.assert_allclose(recording.object_poses[21].world_from_object, OBJECTS[21], atol=1e-9)


def test_a_frame_may_have_its_own_intrinsics_and_unit_of_depth(tmp_path: Path) -> None:
    write_scene(tmp_path)
    own = np.array([[30.0, 0, 7.5], [0, 30, 5.5], [0, 0, 1]])
    scipy.io.savemat(tmp_path / "000002-meta.mat", meta(1, factor_depth=2000, intrinsic_matrix=own))
    [camera] = read(tmp_path).cameras
    np.testing.assert_allclose(camera.Ks, [K, own, K])
    for i, units in enumerate((1000, 2000, 1000)):
        np.testing.assert_allclose(camera.read(i)[1] * camera.depth_scale, DEPTH[i] / units, atol=5.1e-5)


def test_a_frame_without_its_file_is_refused_unless_it_may_be_left_out(tmp_path: Path) -> None:
    write_scene(tmp_path)
    (tmp_path / "000002-meta.mat").unlink()
    with pytest.raises(BadData, match="frame 000002: expected a meta file for every frame"):
        read(tmp_path)
    assert read(tmp_path, skip_bad=True).cameras[0].n_frames == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rotation_translation_matrix": None}, "rotation_translation_matrix: expected 12 numbers, got none.*data_syn"),
        ({"rotation_translation_matrix": np.zeros((3, 4))}, "pose: expected a rigid transform"),
        ({"cls_indexes": np.array([np.nan, 8])}, "cls_indexes: expected whole numbers from 1 to 254, got nan, 8"),
        ({"factor_depth": 0.0}, "factor_depth: expected units per metre"),
        ({"intrinsic_matrix": np.eye(2)}, "intrinsic_matrix: expected 9 numbers, got 4"),
        (
            {"intrinsic_matrix": "focal length"},
            "expected an array of numbers, got an array of class 4",
        ),
        ({"intrinsic_matrix": np.zeros((600, 600))}, "intrinsic_matrix: expected at most 1048576 bytes"),
        ({"poses": np.zeros((3, 4, 5))}, r"poses: expected 3x4x2, as cls_indexes, got \(3, 4, 5\)"),
    ],
)
@pytest.mark.parametrize("do_compression", [False, True])
def test_what_a_file_lacks_is_named(
    tmp_path: Path, changes: dict[str, Any], message: str, do_compression: bool
) -> None:
    write_scene(tmp_path)
    scipy.io.savemat(tmp_path / "000001-meta.mat", meta(0, **changes), do_compression=do_compression)
    with pytest.raises(BadData, match=message):
        read(tmp_path)


def test_a_damaged_mat_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, meta(0), do_compression=True)
    content = path.read_bytes()
    for damaged, message in (
        (content[: len(content) // 2], "truncated file"),
        (content[:136] + b"\x00" * 40 + content[176:], "readable .mat file"),
        (b"MATLAB 7.3 MAT-file" + content[19:], "got 7.3, which is HDF5.*save -v7"),
        (b"\x89HDF" + content[4:], "got 7.3"),
        (b"nothing", "got another file"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(BadData, match=message):
            read_arrays(path, ("poses", "intrinsic_matrix"))


def test_only_the_arrays_that_are_asked_for_are_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    large = {"vertmap": np.zeros((4000, 1000))}
    scipy.io.savemat(path, meta(0) | large, do_compression=True)
    assert set(read_arrays(path, ("poses", "gone"))) == {"poses"}
