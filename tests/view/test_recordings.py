from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid, project, transform, unproject
from bask_data.core.tsdf import Mesh
from bask_data.dataset import Dataset
from bask_data.drawing.colours import palette
from bask_data.drawing.pictures import heat_picture
from bask_data.errors import BadData, BaskError, UsageError, WouldOverwrite
from bask_data.evaluation.finder import Finder
from bask_data.evaluation.lookup import find_recording
from bask_data.evaluation.reference_points import TruePlaces
from bask_data.kinds import (
    CameraFrames,
    Correspondences,
    Demonstration,
    DescriptorNet,
    InstanceRow,
    KeypointTrack,
    ObjectInstances,
    PairRow,
    Reconstruction,
    ReferenceKeypoints,
    Robot,
    Scan,
    Truth,
    VisibleMasks,
)
from bask_data.view import saving
from bask_data.view.choice import Choice, Shown
from bask_data.view.saving import save_recording
from tests.datasets import copied, publish_artifact, publish_recording
from tests.report.filled import HEIGHT, WIDTH, filled_dataset, publish_network
from tests.view.recordings import Recording, colours, publish_demonstration

SCENE = {
    *(
        "world",
        "world/surface",
        "world/instances",
        "world/boxes",
        "world/workspace",
        "world/workspace/axes",
        "world/workspace/corners",
        "world/camera_paths/wrist",
        "world/cameras/wrist",
    ),
    *(f"world/cameras/wrist/{layer}" for layer in ("rgb", "depth", "masks", "inferred", "truth")),
    *("world/matches", "matches/images", "matches/lines", "matches/points"),
}
DEMONSTRATION = {
    *("world/camera_paths/wrist", "world/cameras/wrist"),
    *(f"world/cameras/wrist/{layer}" for layer in ("rgb", "depth", "truth", "keypoints")),
    *("world/keypoints", "world/spread", "world/keypoint_paths", "plots/spread"),
}
WRIST = "/scan-a/world/cameras/wrist"


@pytest.fixture(scope="module")
def shown(filled: Dataset, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Shown], Recording]:
    file = tmp_path_factory.mktemp("saved") / "deep" / "all.rrd"
    shown = save_recording(filled, file, Choice(filled.items("recording")))
    assert [one.name for one in file.parent.iterdir()] == ["all.rrd"]
    return shown, Recording(file)


@pytest.fixture(scope="module")
def saved(shown) -> Recording:
    return shown[1]


def save(dataset: Dataset, folder: Path, *items: str, **choice) -> tuple[dict[str, Shown], Recording]:
    found = save_recording(dataset, folder / "a.rrd", Choice(items, **choice), force=True)
    return found, Recording(folder / "a.rrd")


def alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two images differ only as JPEG makes them differ, in the finest grain."""
    blurred = [cv2.blur(image.astype(np.float32), (8, 8)) for image in (a, b)]
    return a.shape == b.shape and float(np.abs(blurred[0] - blurred[1]).mean()) < 3


# Layers ---------------------------------------------------------------------------------------------------------------


def test_every_artifact_is_an_entity_and_missing_ones_are_named(shown):
    found, saved = shown
    expected = {f"/scan-a/{name}" for name in SCENE} | {f"/demo-a/{name}" for name in DEMONSTRATION}
    assert saved.entities - {"/__properties"} == expected
    assert found["scan-a"] == Shown(
        {"wrist": 6},
        ["surface", "instances", "frames", "masks", "truth", "matches of 3 of 3 pairs"],
        ["heat maps (bask-data train)"],
    )
    assert found["demo-a"] == Shown(
        {"wrist": 5},
        ["frames", "truth", "keypoints"],
        ["gripper (only cameras were recorded)", "heat maps (bask-data train)"],
    )


def test_missing_artifacts_are_named_with_the_command_that_makes_them(tmp_path):
    dataset = Dataset.create(tmp_path / "d")
    image = np.zeros((4, 6, 3), np.uint8)
    for item, kind in (("a", Scan), ("b", Demonstration)):
        publish_recording(
            dataset,
            item,
            rgb=[image],
            depth=[np.zeros((4, 6))],
            K=np.array([[5.0, 0, 2.5], [0, 5, 1.5], [0, 0, 1]]),
            world_from_cameras=np.eye(4)[None],
            kind=kind,
        )
    found, _ = save(dataset, tmp_path, "a", "b")
    assert found["a"].layers == found["b"].layers == ["frames"]
    assert found["a"].missing == [
        "surface (bask-data reconstruct)",
        "instances (bask-data objects)",
        "masks (bask-data masks)",
        "matches (bask-data correspondences)",
        "heat maps (bask-data train)",
    ]
    assert found["b"].missing == [
        "gripper (only cameras were recorded)",
        "keypoints (bask-data encode)",
        "heat maps (bask-data train)",
    ]


@pytest.mark.parametrize(("every", "frames"), [(1, [0, 1, 2, 3, 4, 5]), (2, [0, 2, 4]), (4, [0, 4]), (99, [0])])
def test_every_nth_frame_is_shown(filled, tmp_path, every, frames):
    found, saved = save(filled, tmp_path, "scan-a", every=every)
    assert found["scan-a"].frames == {"wrist": len(frames)}
    for path, component in (
        (WRIST, "Transform3D:mat3x3"),
        (f"{WRIST}/rgb", "EncodedImage:blob"),
        (f"{WRIST}/depth", "DepthImage:buffer"),
        (f"{WRIST}/masks", "SegmentationImage:buffer"),
        (f"{WRIST}/truth", "SegmentationImage:buffer"),
    ):
        assert sorted(saved.all(path, component)) == frames
        assert saved.times[path] - {"log_time"} == {"frame", "time"}


def test_only_the_chosen_items_are_shown(filled, tmp_path):
    found, saved = save(filled, tmp_path, "demo-a")
    assert list(found) == ["demo-a"]
    assert {path.split("/")[1] for path in saved.entities} == {"demo-a", "__properties"}


# Cameras --------------------------------------------------------------------------------------------------------------


def test_the_stored_camera_takes_world_points_to_the_pixels_that_show_them(filled, saved):
    """Rerun: a child's transform takes its coordinates to its parent's, and pixel centres lie at +0.5."""
    camera = Scan(filled.path(Scan, "scan-a")).cameras[0]
    K = saved.array(WRIST, "Pinhole:image_from_camera")[0].reshape(3, 3, order="F")
    assert saved.array(WRIST, "Pinhole:resolution")[0].tolist() == [WIDTH, HEIGHT]
    for i_frame in range(camera.n_frames):
        parent_from_child = np.eye(4)
        parent_from_child[:3, :3] = saved.array(WRIST, "Transform3D:mat3x3", i_frame)[0].reshape(3, 3, order="F")
        parent_from_child[:3, 3] = saved.array(WRIST, "Transform3D:translation", i_frame)[0]
        np.testing.assert_allclose(parent_from_child, camera.world_from_cameras[i_frame], atol=1e-6)
        depth = camera.depth(i_frame).astype(float)
        v, u = (index[::500] for index in np.nonzero(depth > 0))
        uv = np.stack([u, v], axis=1).astype(float)
        world = transform(camera.world_from_cameras[i_frame], unproject(uv, depth[v, u], camera.Ks[i_frame]))
        seen, _ = project(transform(invert_rigid(parent_from_child), world), K)
        np.testing.assert_allclose(seen, uv + 0.5, atol=1e-3)
    path = saved.array("/scan-a/world/camera_paths/wrist", "LineStrips3D:strips")[0]
    np.testing.assert_allclose(path, camera.world_from_cameras[:, :3, 3], atol=1e-6)


def test_images_are_as_recorded(filled, saved):
    camera = Scan(filled.path(Scan, "scan-a")).cameras[0]
    masks = VisibleMasks(filled.path(VisibleMasks, "scan-a")).camera("wrist")
    truth = Truth(filled.path(Truth, "scan-a"))
    for i in range(camera.n_frames):
        decoded = cv2.imdecode(saved.bytes(f"{WRIST}/rgb", "EncodedImage:blob", i), cv2.IMREAD_COLOR)
        assert decoded.shape == (HEIGHT, WIDTH, 3)
        assert alike(decoded[..., ::-1], camera.rgb(i))
        depth = saved.bytes(f"{WRIST}/depth", "DepthImage:buffer", i).view(np.uint16).reshape(HEIGHT, WIDTH)
        np.testing.assert_array_equal(depth, camera.depth_raw(i))
        assert saved.array(f"{WRIST}/depth", "DepthImage:meter", i)[0] == pytest.approx(1 / camera.depth_scale)
        inferred = ~masks.measured(i)
        assert inferred.any()
        for layer, labels in (
            ("masks", masks.instance(i)),
            ("inferred", inferred),
            ("truth", truth.instance("wrist", i)),
        ):
            stored = saved.bytes(f"{WRIST}/{layer}", "SegmentationImage:buffer", i).reshape(HEIGHT, WIDTH)
            np.testing.assert_array_equal(stored, labels)


def classes(saved: Recording, path: str) -> dict[int, tuple[str, int]]:
    infos = [entry["class_description"]["info"] for entry in saved.all(path, "AnnotationContext:context")[None][0]]
    return {info["id"]: (info["label"], info["color"]) for info in infos}


def test_labels_have_the_names_and_colours_of_their_objects(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    names = {3: "lid", 255: "gripper", 300: "no image holds it"}
    size = (6, (HEIGHT, WIDTH), lambda i: labels)
    publish_artifact(dataset, Truth, "scan-a", lambda out: Truth.write(out, names, {"wrist": size}))
    _, saved = save(dataset, tmp_path, "scan-a")
    objects = classes(saved, "/scan-a/world")
    assert {i: name for i, (name, _) in objects.items()} == {0: "background", 1: "object 1", 2: "object 2"}
    assert colours([objects[i][1] for i in (1, 2)]) == palette(2)
    assert objects[0][1] & 255 == 0, "background hides nothing"
    assert {i: name for i, (name, _) in classes(saved, f"{WRIST}/truth").items()} == {
        0: "background",
        3: "lid",
        255: "gripper",
    }


# Surfaces -------------------------------------------------------------------------------------------------------------


def test_the_surface_has_its_colours_and_the_instances_theirs(filled, saved):
    mesh = Reconstruction(filled.path(Reconstruction, "scan-a"))
    instance = ObjectInstances(filled.path(ObjectInstances, "scan-a")).vertex_instance
    for layer in ("surface", "instances"):
        path = f"/scan-a/world/{layer}"
        np.testing.assert_array_equal(saved.array(path, "Mesh3D:vertex_positions"), mesh.vertices)
        np.testing.assert_array_equal(saved.array(path, "Mesh3D:triangle_indices"), mesh.triangles)
    of_surface = np.array(colours(saved.array("/scan-a/world/surface", "Mesh3D:vertex_colors")))
    np.testing.assert_array_equal(of_surface, mesh.colors)
    of_instances = np.array(colours(saved.array("/scan-a/world/instances", "Mesh3D:vertex_colors")))
    for i in (1, 2):
        assert (of_instances[instance == i] == palette(2)[i - 1]).all()
    background = of_instances[instance == 0]
    assert (background == background[:, :1]).all(), "grey"


def test_normals_point_out_of_the_table(saved):
    normals = saved.array("/scan-a/world/instances", "Mesh3D:vertex_normals")
    positions = saved.array("/scan-a/world/instances", "Mesh3D:vertex_positions")
    flat = (np.abs(positions[:, 2]) < 1e-3) & (np.linalg.norm(normals, axis=1) > 0.5)
    assert flat.sum() > 100
    assert (np.median(normals[flat], axis=0) @ [0, 0, 1]) == pytest.approx(1, abs=0.01)


def test_boxes_hold_their_objects(filled, saved):
    mesh = Reconstruction(filled.path(Reconstruction, "scan-a"))
    instance = ObjectInstances(filled.path(ObjectInstances, "scan-a")).vertex_instance
    path = "/scan-a/world/boxes"
    centres, halves = saved.array(path, "Boxes3D:centers"), saved.array(path, "Boxes3D:half_sizes")
    assert saved.all(path, "Boxes3D:labels")[None] == ["object 1", "object 2"]
    for i in (1, 2):
        points = mesh.vertices[instance == i]
        np.testing.assert_allclose(centres[i - 1] - halves[i - 1], points.min(axis=0), atol=1e-6)
        np.testing.assert_allclose(centres[i - 1] + halves[i - 1], points.max(axis=0), atol=1e-6)


def test_instances_of_another_reconstruction_are_named_and_not_drawn(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    row = InstanceRow(id=1, n_vertices=9, area_m2=0.01, centroid=(0, 0, 0), extents=(0.1, 0.1, 0.1))
    publish_artifact(dataset, ObjectInstances, "scan-a", lambda out: _write_objects(out, np.ones(7, np.int32), [row]))
    found, saved = save(dataset, tmp_path, "scan-a")
    assert "instances (made from another reconstruction; bask-data run)" in found["scan-a"].missing
    assert "/scan-a/world/instances" not in saved.entities


def _write_objects(out: Path, instance: np.ndarray, rows: list[InstanceRow]) -> None:
    ObjectInstances.write(
        out, vertex_instance=instance, support_plane=np.array([0.0, 0, 1, 0]), instances=rows, warnings=[]
    )


# Matches --------------------------------------------------------------------------------------------------------------


def test_lines_join_matches_and_their_points_are_seen_by_both_views(filled, saved):
    camera = Scan(filled.path(Scan, "scan-a")).cameras[0]
    found = Correspondences(filled.path(Correspondences, "scan-a"))
    shift = WIDTH + 8
    for row in found.pairs().to_pylist():
        table = found.matches([row["pair"]]).to_pydict()
        stored = {
            (round(u_a, 3), round(v_a, 3)): (u_b, v_b)
            for u_a, v_a, u_b, v_b in zip(table["u_a"], table["v_a"], table["u_b"], table["v_b"], strict=True)
        }
        lines = saved.array("/scan-a/matches/lines", "LineStrips2D:strips", row["pair"])
        assert 0 < len(lines) <= 60
        points = saved.array("/scan-a/world/matches", "Points3D:positions", row["pair"])
        assert len(points) == len(lines)
        in_b = transform(invert_rigid(camera.world_from_cameras[row["frame_b"]]), points.astype(float))
        for (start, end), seen in zip(lines, project(in_b, camera.Ks[row["frame_b"]])[0], strict=True):
            uv_b = stored[round(float(start[0]) - 0.5, 3), round(float(start[1]) - 0.5, 3)]
            np.testing.assert_allclose(end - [shift + 0.5, 0.5], uv_b, atol=1e-3)
            np.testing.assert_allclose(seen, uv_b, atol=0.2)
        image = saved.bytes("/scan-a/matches/images", "EncodedImage:blob", row["pair"])
        beside = cv2.imdecode(image, cv2.IMREAD_COLOR)[..., ::-1]
        assert beside.shape == (HEIGHT, shift + WIDTH, 3)
        assert alike(beside[:, :WIDTH], camera.rgb(row["frame_a"]))
        assert alike(beside[:, shift:], camera.rgb(row["frame_b"]))


def test_no_more_pairs_than_asked_for_are_shown(filled, tmp_path):
    found, saved = save(filled, tmp_path, "scan-a", n_pairs=2)
    assert "matches of 2 of 3 pairs" in found["scan-a"].layers
    assert sorted(saved.all("/scan-a/matches/lines", "LineStrips2D:strips")) == [0, 2]
    found, saved = save(filled, tmp_path, "scan-a", n_pairs=0)
    assert "/scan-a/matches/lines" not in saved.entities


# Demonstrations -------------------------------------------------------------------------------------------------------


def test_keypoints_are_at_the_means_of_the_track_with_one_sigma_ellipsoids(filled, saved):
    track = KeypointTrack(filled.path(KeypointTrack, "demo-a"))
    assert sorted(saved.all("/demo-a/world/keypoints", "Points3D:positions")) == list(range(5))
    for i in range(5):
        mean = saved.array("/demo-a/world/keypoints", "Points3D:positions", i)
        np.testing.assert_allclose(mean, track.mean[i], atol=1e-6)
        assert saved.all("/demo-a/world/keypoints", "Points3D:labels")[i] == ["corner", "side"]
        np.testing.assert_allclose(saved.array("/demo-a/world/spread", "Ellipsoids3D:centers", i), track.mean[i])
        halves = np.sort(saved.array("/demo-a/world/spread", "Ellipsoids3D:half_sizes", i), axis=1)
        np.testing.assert_allclose(halves, np.sqrt([[1e-4, 1e-4, 2e-4]] * 2), rtol=1e-4)
        pixel = saved.array("/demo-a/world/cameras/wrist/keypoints", "Points2D:positions", i)
        np.testing.assert_allclose(pixel, track.pixel("wrist")[i] + 0.5, atol=1e-4)
        spread = saved.array("/demo-a/plots/spread", "Scalars:scalars", i)
        np.testing.assert_allclose(spread, [0.02, 0.02], rtol=1e-5)
    paths = saved.array("/demo-a/world/keypoint_paths", "LineStrips3D:strips")
    np.testing.assert_allclose(paths, np.swapaxes(track.mean, 0, 1), atol=1e-6)


def test_turned_ellipsoids_have_the_covariance_they_show():
    from scipy.spatial.transform import Rotation

    from bask_data.view.demonstrations import _axes

    rng = np.random.default_rng(0)
    roots = rng.normal(size=(20, 3, 3))
    covariance = roots @ np.swapaxes(roots, 1, 2)
    sizes, quat_xyzw = _axes(covariance)
    turned = Rotation.from_quat(quat_xyzw).as_matrix()
    again = turned @ (sizes[:, :, None] ** 2 * np.eye(3)) @ np.swapaxes(turned, 1, 2)
    np.testing.assert_allclose(again, covariance, atol=1e-9)


def test_keypoints_that_are_not_localised_are_left_out(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    mean = np.zeros((5, 2, 3), np.float32)
    mean[:, :, 0] = np.arange(5)[:, None]
    mean[2, 0] = np.nan

    def write(out: Path) -> None:
        with KeypointTrack.writer(out, names=["a", "b"], filter="particle", cameras=["wrist"]) as writer:
            for at in mean:
                pixel = np.array([[10.0, 20.0], [np.nan, np.nan]], np.float32)
                writer.append(
                    mean=at,
                    covariance=np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)),
                    mode=at,
                    n_eff=np.ones(2),
                    log_evidence=np.zeros(2),
                    cameras={"wrist": (pixel, np.array([True, True]))},
                )

    publish_artifact(dataset, KeypointTrack, "demo-a", write)
    _, saved = save(dataset, tmp_path, "demo-a")
    labels = saved.all("/demo-a/world/keypoints", "Points3D:labels")
    assert [labels[i] for i in range(5)] == [["a", "b"], ["a", "b"], ["b"], ["a", "b"], ["a", "b"]]
    strips = saved.all("/demo-a/world/keypoint_paths", "LineStrips3D:strips")[None]
    assert [[point[0] for point in strip] for strip in strips] == [[0, 1], [3, 4], [0, 1, 2, 3, 4]]
    shown = saved.all("/demo-a/world/cameras/wrist/keypoints", "Points2D:labels")
    assert all(shown[i] == ["a"] for i in range(5)), "behind the camera"


def test_the_gripper_moves_and_its_width_and_actions_are_plotted(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = np.arange(15).reshape(5, 3) / 10
    poses[:, :3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    robot = Robot(poses, np.linspace(0, 0.08, 5), np.arange(10.0).reshape(5, 2), ("dx", "grasp"))
    publish_demonstration(dataset, "demo-a", "demo-a", robot)
    found, saved = save(dataset, tmp_path, "demo-a")
    assert found["demo-a"].missing == ["heat maps (bask-data train)"]
    for i in range(5):
        turn = saved.array("/demo-a/world/gripper", "Transform3D:mat3x3", i)[0].reshape(3, 3, order="F")
        np.testing.assert_allclose(turn, poses[i, :3, :3])
        where = saved.array("/demo-a/world/gripper", "Transform3D:translation", i)[0]
        np.testing.assert_allclose(where, poses[i, :3, 3], atol=1e-6)
        assert saved.array("/demo-a/plots/gripper_width", "Scalars:scalars", i)[0] == pytest.approx(0.02 * i)
        assert saved.all("/demo-a/plots/action", "Scalars:scalars")[i] == [2 * i, 2 * i + 1]
    assert saved.all("/demo-a/plots/action", "SeriesLines:names")[None] == ["dx", "grasp"]
    path = saved.array("/demo-a/world/gripper_path", "LineStrips3D:strips")[0]
    np.testing.assert_allclose(path, poses[:, :3, 3], atol=1e-6)


# Heat maps ------------------------------------------------------------------------------------------------------------


def test_each_keypoint_has_its_heat_map_best_match_and_ground_truth(filled_with_network, tmp_path):
    found, saved = save(filled_with_network, tmp_path, "scan-a", "demo-a")
    picks = ReferenceKeypoints(filled_with_network.path(ReferenceKeypoints)).picks
    finder = Finder(filled_with_network, "main", DescriptorNet(filled_with_network.path(DescriptorNet)), picks)
    states = set()
    for item, n_frames in (("scan-a", 6), ("demo-a", 5)):
        assert "heat maps" in found[item].layers
        recording = find_recording(filled_with_network, item)
        assert recording is not None
        (camera,), places = recording.cameras, TruePlaces(filled_with_network, picks, item)
        for i_frame in range(n_frames):
            sight, truth = finder.look(camera.rgb(i_frame), [0, 1]), places.pixels(camera, i_frame)
            for i, name in enumerate(("1 corner", "2 side")):
                place = f"/{item}/heat/wrist/{escaped(name)}"
                picture = saved.bytes(f"{place}/map", "EncodedImage:blob", i_frame)
                drawn = heat_picture(camera.rgb(i_frame), sight.heat[i], [], WIDTH)
                assert alike(cv2.imdecode(picture, cv2.IMREAD_COLOR)[..., ::-1], drawn)
                (best,) = saved.array(f"{place}/best", "Points2D:positions", i_frame)
                np.testing.assert_allclose(best, sight.best[i] + 0.5, atol=1e-4)
                true = saved.all(f"{place}/truth", "Points2D:positions")[i_frame]
                lines = saved.all(f"{place}/error", "LineStrips2D:strips")[i_frame]
                states.add(truth.states[i])
                if truth.states[i] == "out of view":
                    assert (true, lines) == ([], [])
                    continue
                np.testing.assert_allclose(true, [truth.uv[i] + 0.5], atol=1e-3)
                assert len(lines) == (truth.states[i] == "visible")
                if lines:
                    np.testing.assert_allclose(lines[0], [best, true[0]], atol=1e-3)
    assert {"visible", "occluded"} <= states
    reference = saved.all("/scan-a/heat/reference", "EncodedImage:blob")[None]
    assert cv2.imdecode(np.array(reference[0], np.uint8), cv2.IMREAD_COLOR).shape == (480, 640, 3)


def escaped(name: str) -> str:
    return name.replace(" ", "\\ ")


def test_long_recordings_have_heat_maps_of_some_frames(filled_with_network, tmp_path, monkeypatch):
    monkeypatch.setattr("bask_data.view.heat.N_HEATED_FRAMES", 2)
    _, saved = save(filled_with_network, tmp_path, "scan-a", every=2)
    assert sorted(saved.all(f"/scan-a/heat/wrist/{escaped('1 corner')}/map", "EncodedImage:blob")) == [0, 4]


def test_keypoints_on_absent_objects_have_no_heat_maps(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    publish_network(dataset)
    size = {"wrist": (5, (HEIGHT, WIDTH), lambda _: np.zeros((HEIGHT, WIDTH), np.uint8))}
    for names, points in (({1: "tissue box"}, ["2 side"]), ({}, [])):
        publish_artifact(dataset, Truth, "demo-a", lambda out, names=names: Truth.write(out, names, size))
        found, saved = save(dataset, tmp_path, "demo-a")
        there = {path.split("/")[4] for path in saved.entities if path.startswith("/demo-a/heat/wrist/")}
        assert there == {escaped(point) for point in points}
    assert "heat maps (none of the keypoints' objects is in this recording)" in found["demo-a"].missing


# Files ----------------------------------------------------------------------------------------------------------------


def test_a_file_is_replaced_only_if_asked_to_and_at_once(filled, tmp_path):
    file = tmp_path / "a.rrd"
    file.write_text("mine")
    with pytest.raises(WouldOverwrite, match="--force replaces it"):
        save_recording(filled, file, Choice(["scan-a"]))
    assert file.read_text() == "mine"
    save_recording(filled, file, Choice(["scan-a"], every=9), force=True)
    assert len(Recording(file).entities) > 5
    assert [one.name for one in tmp_path.iterdir()] == ["a.rrd"]


def test_a_failure_leaves_the_old_file_and_nothing_else(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    (tmp_path / "out").mkdir()
    file = tmp_path / "out" / "a.rrd"
    file.write_text("mine")
    for shard in (dataset.path(Scan, "scan-a") / "wrist" / "rgb" / "c").rglob("*"):
        if shard.is_file():
            shard.write_bytes(shard.read_bytes()[:-100])
    with pytest.raises(BadData, match="frame 0: expected a readable chunk"):
        save_recording(dataset, file, Choice(["scan-a"]), force=True)
    assert [(one.name, one.read_text()) for one in file.parent.iterdir()] == [("a.rrd", "mine")]


@pytest.mark.parametrize(
    ("name", "message"), [("a.txt", "expected a name that ends in .rrd"), ("d.rrd", "expected a file, got a directory")]
)
def test_a_file_that_the_viewer_could_not_open_is_refused(filled, tmp_path, name, message):
    (tmp_path / "d.rrd").mkdir()
    with pytest.raises(UsageError, match=message):
        save_recording(filled, tmp_path / name, Choice(["scan-a"]), force=True)


def test_nothing_to_show_is_an_error(tmp_path):
    from bask_data.dataset import Source

    dataset = Dataset.create(tmp_path / "d")
    dataset.add("scene", "a", Source(format="test", path="none"))
    with pytest.raises(UsageError, match="expected something to show, got nothing of a"):
        save_recording(dataset, tmp_path / "a.rrd", Choice(["a"]))
    assert not (tmp_path / "a.rrd").exists()


def test_rerun_switched_off_is_an_error(filled, tmp_path):
    code = f"""
from pathlib import Path
from types import SimpleNamespace
from bask_data.dataset import Dataset
from bask_data.view.choice import Choice
from bask_data.view.saving import save_recording
save_recording(Dataset({str(filled.root)!r}), Path({str(tmp_path / "a.rrd")!r}), Choice(["scan-a"]))
"""
    ended = subprocess.run([sys.executable, "-c", code], env={"RERUN": "off"}, capture_output=True, text=True)
    assert "RERUN: environment: expected on, or not set, got off.  fix: unset RERUN" in ended.stderr


def test_a_full_disk_is_an_error_and_leaves_nothing(filled, tmp_path):
    code = f"""
import resource
from pathlib import Path
from types import SimpleNamespace
from bask_data.dataset import Dataset
from bask_data.view.choice import Choice
from bask_data.view.saving import save_recording
dataset = Dataset({str(filled.root)!r})
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
save_recording(dataset, Path({str(tmp_path / "a.rrd")!r}), Choice(["scan-a"]))
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240)
    assert f"{BaskError.__name__}: {tmp_path / 'a.rrd'}: expected a writable file and enough disk space" in ended.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_writer_that_never_finishes_is_abandoned(monkeypatch):
    import rerun

    released, unregistered = threading.Event(), []
    monkeypatch.setattr(rerun, "unregister_shutdown", lambda: unregistered.append(True))
    assert not saving._closed(SimpleNamespace(disconnect=released.wait), seconds=0.05)
    assert unregistered == [True]
    released.set()
    assert saving._closed(SimpleNamespace(disconnect=lambda: None), seconds=10)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peaks are read from /proc")
def test_memory_does_not_grow_with_the_frames(tmp_path):
    """Noise cannot be compressed, so what is not written at once stays in memory."""
    rng = np.random.default_rng(0)
    noise = [rng.integers(1, 60000, (240, 320)).astype(np.uint16) for _ in range(4)]
    colour = [rng.integers(0, 255, (240, 320, 3)).astype(np.uint8) for _ in range(4)]
    dataset = Dataset.create(tmp_path / "d")
    for item, n in (("short", 30), ("long", 150)):
        publish_recording(
            dataset,
            item,
            rgb=[colour[i % 4] for i in range(n)],
            depth=[noise[i % 4] * 0.0001 for i in range(n)],
            K=np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]),
            world_from_cameras=np.tile(np.eye(4), (n, 1, 1)),
        )
    peak, size = {}, {}
    for item in ("short", "long"):
        file = tmp_path / f"{item}.rrd"
        code = f"""
from pathlib import Path
from types import SimpleNamespace
from bask_data.dataset import Dataset
from bask_data.view.choice import Choice
from bask_data.view.saving import save_recording
save_recording(Dataset({str(dataset.root)!r}), Path({str(file)!r}), Choice([{item!r}]))
# The peak that getrusage reports for a child starts from its parent's size.
print(next(line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line[:6] == "VmHWM:"))
"""
        ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        peak[item], size[item] = int(ended.stdout) * 1024, file.stat().st_size
    written = size["long"] - size["short"]
    assert written > 20e6
    assert peak["long"] - peak["short"] < 0.4 * written, (peak, written)


# Other people's data --------------------------------------------------------------------------------------------------


def test_odd_names_are_names(tmp_path):
    dataset = filled_dataset(tmp_path / "d", names=("a/b <i>", "ü\u202e ${x}"), label_name="*/..")
    source = Scan(dataset.path(Scan, "scan-a")).cameras[0]
    publish_recording(
        dataset,
        "odd",
        rgb=[source.rgb(0)],
        depth=[source.depth(0)],
        K=source.Ks[0],
        world_from_cameras=source.world_from_cameras[:1],
        camera="left eye (ü) + *",
    )
    found, saved = save(dataset, tmp_path, "odd", "demo-a")
    assert found["odd"].frames == {"left eye (ü) + *": 1}
    assert len([path for path in saved.entities if path.endswith("/rgb")]) == 2
    assert saved.all("/demo-a/world/keypoints", "Points3D:labels")[0] == ["a/b <i>", "ü\u202e ${x}"]


def test_intrinsics_that_change_are_shown_with_their_frames(filled, tmp_path):
    dataset = Dataset.create(tmp_path / "d")
    source = Scan(filled.path(Scan, "scan-a")).cameras[0]
    Ks = source.Ks[:3].copy()
    Ks[:, 0, 2] += [0.0, 2.0, -3.0]
    publish_recording(
        dataset,
        "phone",
        rgb=[source.rgb(i) for i in range(3)],
        depth=[source.depth(i) for i in range(3)],
        K=Ks,
        world_from_cameras=source.world_from_cameras[:3],
    )
    _, saved = save(dataset, tmp_path, "phone")
    for i_frame, K in enumerate(Ks):
        shown = saved.array("/phone/world/cameras/wrist", "Pinhole:image_from_camera", i_frame)[0]
        np.testing.assert_allclose(shown.reshape(3, 3, order="F")[:2, 2], K[:2, 2] + 0.5, rtol=1e-6)


def _break_masks(dataset: Dataset) -> None:
    def write(out: Path) -> None:
        with VisibleMasks.writer(out, 1) as writer:
            camera = writer.camera("wrist", 6, HEIGHT, WIDTH + 1)
            for _ in range(6):
                camera.append(np.zeros((HEIGHT, WIDTH + 1), np.uint8), np.ones(1, np.float32))

    publish_artifact(dataset, VisibleMasks, "scan-a", write)


def _break_truth(dataset: Dataset) -> None:
    size = (2, (HEIGHT, WIDTH), lambda i: np.zeros((HEIGHT, WIDTH), np.uint8))
    publish_artifact(dataset, Truth, "scan-a", lambda out: Truth.write(out, {1: "x"}, {"wrist": size}))


def _break_mesh(dataset: Dataset) -> None:
    publish_artifact(
        dataset,
        Reconstruction,
        "scan-a",
        lambda out: Reconstruction.write(
            out,
            Mesh(np.full((3, 3), np.nan, np.float32), np.zeros((1, 3), np.int32), np.zeros((3, 3), np.uint8)),
            voxel_size=0.01,
            bounds=(0, 0, 0, 1, 1, 1),
        ),
    )


def _break_time(dataset: Dataset) -> None:
    source = Scan(dataset.path(Scan, "scan-a")).cameras[0]

    def write(out: Path) -> None:
        group = Scan.start(out, "test", {})
        Scan.write_camera(
            group,
            "wrist",
            CameraFrames(
                K=source.Ks[0],
                world_from_cameras=source.world_from_cameras,
                time=np.full(6, np.nan),
                depth_scale=0.001,
                size=(HEIGHT, WIDTH),
                read=lambda i: (source.rgb(i), source.depth_raw(i)),
            ),
        )

    publish_artifact(dataset, Scan, "scan-a", write)


def _break_pairs(camera: str, frame: int, u: float):
    def make(dataset: Dataset) -> None:
        row = PairRow(
            camera_a=camera, frame_a=frame, camera_b="wrist", frame_b=1, n_attempts=5, distance=0.1, angle=0.1
        )
        columns = {name: np.full(2, u, np.float32) for name in ("u_a", "v_a", "u_b", "v_b")}

        def write(out: Path) -> None:
            with Correspondences.writer(out) as writer:
                writer.append(row, {"instance": np.ones(2, np.uint8), **columns})

        publish_artifact(dataset, Correspondences, "scan-a", write)

    return make


def _break_labels(dataset: Dataset) -> None:
    file = dataset.path(ObjectInstances, "scan-a") / "zarr.json"
    content = json.loads(file.read_text())
    content["attributes"]["bask"]["instances"][0]["name"] = "\ud800"
    file.write_text(json.dumps(content))


def _break_robot(dataset: Dataset) -> None:
    publish_demonstration(dataset, "demo-a", "demo-a", Robot(np.full((5, 4, 4), 2.0)))


def _break_track(dataset: Dataset) -> None:
    def write(out: Path) -> None:
        with KeypointTrack.writer(out, names=["a", "b"], filter="particle", cameras=[]) as writer:
            zeros = np.zeros((2, 3), np.float32)
            writer.append(
                mean=zeros,
                covariance=np.zeros((2, 3, 3)),
                mode=zeros,
                n_eff=np.zeros(2),
                log_evidence=np.zeros(2),
                cameras={},
            )
        group = json.loads((out / "zarr.json").read_text())
        group["attributes"]["bask"]["names"] = ["a"]
        (out / "zarr.json").write_text(json.dumps(group))

    publish_artifact(dataset, KeypointTrack, "demo-a", write)


@pytest.mark.parametrize(
    ("corrupt", "message"),
    [
        (_break_masks, r"masks/scan-a/wrist: frame 0: expected shape 96 x 128, got \(96, 129\)"),
        (_break_truth, r"truth/scan-a: expected consistent arrays and names, got IndexError.*frame 2"),
        (_break_mesh, "reconstruction/scan-a: vertices: expected finite numbers, got NaN"),
        (_break_time, "scan/scan-a/wrist: time: expected finite numbers"),
        (_break_pairs("wrist", 77, 1.0), "pairs.parquet: pair 0: expected frames of the scan, got frame 77 of 'wrist'"),
        (_break_pairs("none", 0, 1.0), "pair 0: expected frames of the scan, got frame 0 of 'none'"),
        (_break_pairs("wrist", 0, np.nan), "matches.parquet: pair 0: expected finite pixels"),
        (_break_labels, "objects/scan-a.*expected"),
        (_break_robot, "robot: world_from_gripper 0: expected a rigid transform"),
        (_break_track, r"keypoints/main/demo-a: mean: expected shape 1 x 1 x 3, got \(1, 2, 3\)"),
    ],
)
def test_an_inconsistent_artifact_is_our_error(filled: Dataset, tmp_path, corrupt, message):
    dataset = copied(filled, tmp_path / "d")
    corrupt(dataset)
    with pytest.raises(BadData, match=message):
        save_recording(dataset, tmp_path / "a.rrd", Choice(dataset.items("recording")))
    assert not list(tmp_path.glob("*.rrd"))
