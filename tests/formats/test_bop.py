from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS, bop
from bask_data.formats.options.bop import BopOptions
from bask_data.formats.recording import PreparedRecording
from tests.formats.folders import HEIGHT, WIDTH, K, images, rigid, write_image

IDS = (0, 5, 20, 100)
RNG = np.random.default_rng(0)
POSES = np.stack([rigid(RNG) for _ in IDS])
COLOR, DEPTH = images(len(IDS))
OBJECTS = {5: rigid(RNG), 7: rigid(RNG)}
TWIN = rigid(RNG)
"""world_from_object of two objects, and of a second instance of object 5."""


def read(source: Path, **options: object) -> PreparedRecording:
    return next(item for item in FORMATS if item.name == "bop").read(source, BopOptions(**options))


def millimetres(a_from_b: np.ndarray, names: tuple[str, str]) -> dict[str, Any]:
    return dict(zip(names, (a_from_b[:3, :3].ravel().tolist(), (1000 * a_from_b[:3, 3]).tolist()), strict=True))


def write_scene(folder: Path, suffix: str = "", poses: bool = True, scales: tuple[float, ...] = (0.5,) * 4) -> None:
    cameras, annotated = {}, {}
    for i, i_image in enumerate(IDS):
        write_image(folder / f"rgb{suffix}/{i_image:06d}.png", COLOR[i])
        write_image(folder / f"depth{suffix}/{i_image:06d}.png", DEPTH[i])
        camera_from_world = invert_rigid(POSES[i])
        cameras[i_image] = {"cam_K": K.ravel().tolist(), "depth_scale": scales[i], "view_level": 2}
        if poses:
            cameras[i_image] |= millimetres(camera_from_world, ("cam_R_w2c", "cam_t_w2c"))
        # Which of the two alike objects comes first changes from image to image.
        twins = [OBJECTS[5], TWIN] if i % 2 == 0 else [TWIN, OBJECTS[5]]
        placed = [(5, twins[0]), (7, OBJECTS[7]), (5, twins[1])]
        annotated[i_image] = [
            {"obj_id": i_object, **millimetres(camera_from_world @ world_from_object, ("cam_R_m2c", "cam_t_m2c"))}
            for i_object, world_from_object in placed
        ]
        for k, (_, world_from_object) in enumerate(placed):
            mask = np.zeros((HEIGHT, WIDTH), np.uint8)
            row = 0 if world_from_object is OBJECTS[5] else 1 if world_from_object is TWIN else 2
            mask[row] = 255
            write_image(folder / f"mask_visib{suffix}/{i_image:06d}_{k:06d}.png", mask)
    (folder / f"scene_camera{suffix}.json").write_text(json.dumps(cameras))
    (folder / f"scene_gt{suffix}.json").write_text(json.dumps(annotated))


def edit(path: Path, change: Any) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def test_a_scene_is_read_in_metres_with_the_inverse_of_its_poses(tmp_path: Path) -> None:
    write_scene(tmp_path)
    recording = read(tmp_path)
    [camera] = recording.cameras
    np.testing.assert_allclose(camera.world_from_cameras, POSES, atol=1e-12)
    np.testing.assert_allclose(camera.time, np.array(IDS) / 30)
    assert np.array_equal(camera.K, K) and camera.depth_scale == pytest.approx(0.0005)
    for i in range(4):
        rgb, depth = camera.read(i)
        assert np.array_equal(rgb, COLOR[i]) and np.array_equal(depth, DEPTH[i])
    assert len(recording.files) == 2 + 2 * 4 + 3 * 4


def test_each_image_may_have_its_own_intrinsics_and_unit_of_depth(tmp_path: Path) -> None:
    write_scene(tmp_path, scales=(0.5, 1.0, 0.5, 0.5))

    def moved(cameras: dict) -> None:
        cameras["5"]["cam_K"][2] += 7

    edit(tmp_path / "scene_camera.json", moved)
    [camera] = read(tmp_path).cameras
    # As in T-LESS, whose images are cropped: the principal point may be far from the middle.
    assert (camera.Ks[:, 0, 2] - K[0, 2]).tolist() == [0, 7, 0, 0]
    for i, scale in enumerate((0.5, 1.0, 0.5, 0.5)):
        np.testing.assert_allclose(camera.read(i)[1] * camera.depth_scale, DEPTH[i] * scale / 1000, atol=5.1e-5)


def test_visible_masks_and_object_poses_are_truth_and_alike_objects_are_told_apart(tmp_path: Path) -> None:
    write_scene(tmp_path)
    recording = read(tmp_path)
    assert recording.label_names == {5: "obj 5", 7: "obj 7", 8: "obj 5 (2)"}
    assert recording.cameras[0].labels is not None
    for i in range(4):
        labels = recording.cameras[0].labels(i)
        assert [set(labels[row].tolist()) for row in range(4)] == [{5}, {8}, {7}, {0}]
    for label, expected in ((5, OBJECTS[5]), (7, OBJECTS[7]), (8, TWIN)):
        np.testing.assert_allclose(recording.object_poses[label].world_from_object, expected, atol=1e-9)
        assert recording.object_poses[label].error < 1e-9
    (tmp_path / "mask_visib/000005_000001.png").unlink()
    assert not (lacking := read(tmp_path)).has_labels
    assert "masks 000005_000001 are missing" in lacking.assumptions["labels"]


def test_an_object_that_moves_has_labels_but_no_pose(tmp_path: Path) -> None:
    write_scene(tmp_path)

    def moved(annotated: dict) -> None:
        annotated["20"][1]["cam_t_m2c"][0] += 300

    edit(tmp_path / "scene_gt.json", moved)
    recording = read(tmp_path)
    assert set(recording.object_poses) == {5, 8} and 7 in recording.label_names
    assert "without poses of obj 7, which move" in recording.assumptions["labels"]


def test_object_ids_beyond_the_labels_get_other_numbers(tmp_path: Path) -> None:
    write_scene(tmp_path)

    def renamed(annotated: dict) -> None:
        for entries in annotated.values():
            entries[1]["obj_id"] = 1000

    edit(tmp_path / "scene_gt.json", renamed)
    assert read(tmp_path).label_names == {5: "obj 5", 6: "obj 5 (2)", 7: "obj 1000"}


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    write_scene(tmp_path)
    write_image(tmp_path / "mask_visib/000000_000000.png", np.zeros((3, 4), np.uint8))
    labels = read(tmp_path).cameras[0].labels
    assert labels is not None
    with pytest.raises(BadData, match="size: expected 16 x 12 as the images, got 4 x 3"):
        labels(0)


def test_a_scene_without_poses_is_refused_with_an_object_that_may_be_the_world(tmp_path: Path) -> None:
    write_scene(tmp_path, poses=False)
    with pytest.raises(BadData, match=r"cam_R_w2c, cam_t_w2c: .* none: of 4 images.*--world-object 5"):
        read(tmp_path)
    with pytest.raises(UsageError, match="--world-object: .*got 5, of which some have several.*objects are 5, 7"):
        read(tmp_path, world_object=5)
    with pytest.raises(UsageError, match="got 3, which no image has"):
        read(tmp_path, world_object=3)
    recording = read(tmp_path, world_object=7)
    np.testing.assert_allclose(recording.cameras[0].world_from_cameras, invert_rigid(OBJECTS[7]) @ POSES, atol=1e-9)
    np.testing.assert_allclose(recording.object_poses[7].world_from_object, np.eye(4), atol=1e-9)
    (tmp_path / "scene_gt.json").unlink()
    with pytest.raises(BadData, match="this scene cannot be read"):
        read(tmp_path)


def test_scenes_of_a_split_or_of_a_data_set_are_episodes(tmp_path: Path) -> None:
    for name in ("000002", "000010"):
        write_scene(tmp_path / "test" / name)
    options = BopOptions()
    assert bop.episodes(tmp_path / "test", options) == ("000002", "000010")
    assert bop.episodes(tmp_path, options) == ("test/000002", "test/000010")
    assert bop.episodes(tmp_path / "test/000002", options) == ()
    with pytest.raises(UsageError, match="--episode: expected one of 000002, 000010"):
        read(tmp_path / "test")
    edit(tmp_path / "test/000010/scene_gt.json", lambda annotated: annotated.clear())
    recording = read(tmp_path / "test", episode="10")
    assert recording.cameras[0].n_frames == 4 and not recording.has_labels


def test_one_of_several_sensors_is_chosen(tmp_path: Path) -> None:
    for name in ("_cam1", "_cam2"):
        write_scene(tmp_path, name)
    with pytest.raises(UsageError, match=r"--sensor: expected one of cam1, cam2, got none\.  fix: pass --sensor cam1"):
        read(tmp_path)
    assert read(tmp_path, sensor="cam2").has_labels
    (tmp_path / "scene_camera_cam1.json").unlink()
    assert read(tmp_path).cameras[0].n_frames == 4


def test_grey_images_stand_in_for_colour(tmp_path: Path) -> None:
    write_scene(tmp_path)
    (tmp_path / "rgb").rename(tmp_path / "gray")
    assert np.array_equal(read(tmp_path).cameras[0].read(0)[0], COLOR[0])


def test_an_image_without_a_camera_is_refused_unless_it_may_be_left_out(tmp_path: Path) -> None:
    write_scene(tmp_path)
    edit(tmp_path / "scene_camera.json", lambda cameras: cameras.pop("5"))
    with pytest.raises(BadData, match=r"scene_camera\.json: image 5: expected its camera, got none"):
        read(tmp_path)
    np.testing.assert_allclose(read(tmp_path, skip_bad=True).cameras[0].time, np.array([0, 20, 100]) / 30)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("cam_K", [1, 2, 3], "image 5: intrinsics: expected 4 numbers"),
        ("cam_K", "x", "image 5: expected cam_K, depth_scale, cam_R_w2c and cam_t_w2c as numbers"),
        ("depth_scale", 0, "depth_scale: expected millimetres per unit, more than 0"),
        ("depth_scale", 10**400, "image 5: expected cam_K"),
        ("cam_R_w2c", [1, 2], "image 5: expected cam_K"),
        ("cam_R_w2c", [1] * 9, "image 5: pose: expected a rigid transform"),
    ],
)
def test_cameras_that_cannot_be_are_refused(tmp_path: Path, key: str, value: Any, message: str) -> None:
    write_scene(tmp_path)
    edit(tmp_path / "scene_camera.json", lambda cameras: cameras["5"].update({key: value}))
    with pytest.raises(BadData, match=message):
        read(tmp_path)


def test_files_with_another_content_are_refused(tmp_path: Path) -> None:
    write_scene(tmp_path)
    (tmp_path / "scene_gt.json").write_text('{"0": [{"obj_id": 1}]}')
    with pytest.raises(BadData, match="expected obj_id, cam_R_m2c and cam_t_m2c"):
        read(tmp_path)
    (tmp_path / "scene_gt.json").unlink()
    for text, message in (
        ("[]", "expected a JSON object"),
        ("{}", "expected cameras of the images beside it, got none of 4"),
        ('{"a": {"cam_K": [1, 1, 1, 1]}}', "image id: expected a number"),
    ):
        (tmp_path / "scene_camera.json").write_text(text)
        with pytest.raises(BadData, match=message):
            read(tmp_path)
    (tmp_path / "scene_camera.json").write_text('{"1": {"cam_K": [1, 1, 1, 1]}}')
    with pytest.raises(BadData, match="expected cameras of the images beside it, got none of 4"):
        read(tmp_path)
    write_image(tmp_path / "rgb/cover.png", COLOR[0])
    with pytest.raises(BadData, match="names of images: expected numbers, got cover"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("name", "got"),
    [("000001_000002.camera.json", "BOP-imagewise"), ("shard-000000.tar", "archives"), ("x", "neither")],
)
def test_other_layouts_are_refused_by_name(tmp_path: Path, name: str, got: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(BadData, match=f"BOP-scenewise.* got {got}"):
        read(tmp_path)
