"""Each fault of a dataset is found by its code, and clean datasets have none."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from bask_data.dataset import Dataset, Source, Splits
from bask_data.doctor.dataset_checks import dataset_findings
from bask_data.findings import Finding
from bask_data.kinds import (
    CameraFrames,
    Demonstration,
    InstanceRow,
    KeypointTrack,
    ObjectInstances,
    Robot,
    Scan,
    VisibleMasks,
)
from tests.datasets import copied, publish_artifact, publish_recording
from tests.report.filled import HEIGHT, WIDTH, make_views, publish_frames
from tests.scenes import View, intrinsics, orbit, tabletop


@pytest.fixture
def clean(filled: Dataset, tmp_path: Path) -> Dataset:
    """The test's own copy of a dataset without faults."""
    return copied(filled, tmp_path / "dataset")


def found(dataset: Dataset) -> list[Finding]:
    dataset = Dataset(dataset.root)
    return dataset_findings(dataset, dataset.items("recording"))[0]


def codes(dataset: Dataset) -> list[str]:
    return [finding.code for finding in found(dataset)]


def test_a_clean_dataset_has_no_finding_and_says_what_was_checked(filled: Dataset) -> None:
    findings, right = dataset_findings(filled, filled.items("recording"))
    assert findings == []
    assert right == [
        "files, versions and inputs of all artifacts",
        "no two of 2 recordings show the same",
        "objects and masks of 1 scan",
        "motion of 1 demonstration, and keypoints of 1",
    ]


# Recordings that show the same ----------------------------------------------------------------------------------------


@cache
def views_of(n_frames: int = 12, seed: int = 0) -> tuple[np.ndarray, list[View]]:
    scene, cameras = tabletop(3, seed=seed), orbit(n_frames, n_turns=0.6)
    return cameras, [scene.render(intrinsics(HEIGHT, WIDTH), camera, HEIGHT, WIDTH) for camera in cameras]


def add(dataset: Dataset, name: str, cameras: np.ndarray, rgb: list[np.ndarray], depth: list[np.ndarray]) -> None:
    K = intrinsics(*depth[0].shape)
    publish_recording(dataset, name, rgb=rgb, depth=depth, K=K, world_from_cameras=cameras)


def jpeg(rgb: np.ndarray) -> np.ndarray:
    data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]


def nudged(cameras: np.ndarray) -> np.ndarray:
    """The poses as if they had been refined."""
    moved = cameras.copy()
    moved[:, :3, 3] += [0.008, -0.005, 0.004]
    return moved


def halved(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[::2, ::2])


@pytest.fixture
def scanned(tmp_path: Path) -> tuple[Dataset, np.ndarray, list[View]]:
    """A dataset with the scan `table`, and its poses and images."""
    dataset = Dataset.create(tmp_path / "scanned")
    cameras, views = views_of()
    add(dataset, "table", cameras, [view.rgb for view in views], [view.depth for view in views])
    return dataset, cameras, views


@pytest.mark.parametrize(
    ("part", "change_image", "change_poses"),
    [
        pytest.param(slice(None), lambda rgb: rgb, lambda poses: poses, id="a copy"),
        pytest.param(slice(None), jpeg, nudged, id="encoded and refined"),
        pytest.param(slice(None, None, 3), jpeg, lambda poses: poses, id="every third frame"),
        pytest.param(slice(2, 9), lambda rgb: rgb, lambda poses: poses, id="a part"),
        pytest.param(slice(None), lambda rgb: rgb, np.linalg.inv, id="read with inverse poses"),
        pytest.param(slice(None), lambda rgb: (rgb * 0.9).astype(np.uint8) + 20, lambda poses: poses, id="brighter"),
    ],
)
def test_a_scan_under_another_name_is_found(scanned, part, change_image, change_poses) -> None:
    dataset, cameras, views = scanned
    rgb = [change_image(view.rgb) for view in views[part]]
    add(dataset, "other", change_poses(cameras[part]), rgb, [view.depth for view in views[part]])
    [finding] = found(dataset)
    assert (finding.code, finding.place) == ("scene-twice", "table and other")


def test_a_refined_copy_is_said_to_be_one(scanned) -> None:
    dataset, cameras, views = scanned
    add(dataset, "better", nudged(cameras), [view.rgb for view in views], [view.depth for view in views])
    digest = json.loads((dataset.path(Scan, "table") / "artifact.json").read_text())["digest"]
    change_manifest(dataset.path(Scan, "better"), stage="refine", inputs={"scan/table": digest})
    [finding] = found(dataset)
    assert "better is table with refined poses" in finding.evidence
    assert finding.fix.startswith("train on better only")


def test_a_scan_of_half_the_size_is_found(scanned) -> None:
    dataset, cameras, views = scanned
    rgb = [cv2.resize(view.rgb, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA) for view in views]
    add(dataset, "other", cameras, rgb, [halved(view.depth) for view in views])
    assert codes(dataset) == ["scene-twice"]


def test_the_same_scan_in_two_splits_is_an_error(scanned) -> None:
    dataset, cameras, views = scanned
    add(dataset, "other", cameras, [jpeg(view.rgb) for view in views], [view.depth for view in views])
    dataset.set_splits(Splits(train=("table",), test=("other",)))
    [finding] = found(dataset)
    assert finding.code == "split-leak" and finding.severity == "error"
    assert "table is for train, other for test" in finding.evidence


def test_a_scan_that_is_listed_in_two_splits_is_an_error(scanned) -> None:
    dataset, _, _ = scanned
    file = dataset.root / "dataset.json"
    document = json.loads(file.read_text())
    document["splits"] = {"train": ["table"], "validation": ["table"]}
    file.write_text(json.dumps(document))
    [finding] = found(dataset)
    assert (finding.code, finding.place) == ("split-leak", "table")


def test_scans_of_other_objects_from_the_same_places_are_not_the_same(scanned) -> None:
    dataset, _, _ = scanned
    cameras, views = views_of(seed=1)
    add(dataset, "other", cameras, [view.rgb for view in views], [view.depth for view in views])
    assert codes(dataset) == []


def test_scans_of_one_arrangement_with_a_box_moved_by_a_few_centimetres_are_not_the_same(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "moved")
    for name, angle in (("one", 0.3), ("other", 0.45)):
        publish_frames(dataset, name, make_views(angle, 6))
    assert codes(dataset) == []


def test_images_without_texture_are_compared_with_none(two_scans: Dataset) -> None:
    assert codes(two_scans) == []


# Objects and masks ----------------------------------------------------------------------------------------------------


def row(i: int, **changes: object) -> InstanceRow:
    usual = {"id": i, "n_vertices": 9, "area_m2": 0.01, "centroid": (0, 0, 0), "extents": (0.1, 0.1, 0.1)}
    return InstanceRow.model_validate({**usual, **changes})


def put_objects(dataset: Dataset, name: str, rows: list[InstanceRow]) -> None:
    publish_artifact(
        dataset,
        ObjectInstances,
        name,
        lambda out: ObjectInstances.write(
            out, vertex_instance=np.zeros(4, np.int32), support_plane=np.zeros(4), instances=rows, warnings=[]
        ),
    )


def put_masks(dataset: Dataset, shown: list[list[bool]]) -> None:
    """Masks of `scan-a` in which all objects are in view of all frames, and shown as said: by frame and object."""

    def fill(out: Path) -> None:
        with VisibleMasks.writer(out, len(shown[0])) as writer:
            camera = writer.camera("wrist", len(shown), HEIGHT, WIDTH)
            for frame in shown:
                instance = np.zeros((HEIGHT, WIDTH), np.uint8)
                for i, is_shown in enumerate(frame):
                    instance[:, 10 * i : 10 * i + 10] = (i + 1) * is_shown
                camera.append(instance, np.full(len(frame), 0.5, np.float32))

    publish_artifact(dataset, VisibleMasks, "scan-a", fill)


@pytest.mark.parametrize(
    ("rows", "code"),
    [
        ([], "instance-empty"),
        ([row(1), row(2, n_vertices=0)], "instance-empty"),
        ([row(1), row(2, area_m2=1e-4, extents=(0.02, 0.01, 0.01))], "instance-tiny"),
        ([row(1), row(2, extents=(0.009, 0.008, 0.01))], "instance-tiny"),
    ],
)
def test_objects_that_are_none_are_found(clean: Dataset, rows: list[InstanceRow], code: str) -> None:
    shutil.rmtree(clean.path(VisibleMasks, "scan-a"))
    put_objects(clean, "scan-a", rows)
    assert codes(clean) == [code]


def test_an_object_that_no_frame_shows_is_found(clean: Dataset) -> None:
    put_masks(clean, [[True, False]] * 6)
    [finding] = found(clean)
    assert (finding.code, finding.place) == ("instance-empty", "masks of scan-a")
    assert "the mask of object 2 is empty in all frames, 6 of which have it in view" in finding.evidence


def test_a_mask_that_vanishes_is_found_and_one_that_is_hidden_now_and_then_is_not(clean: Dataset) -> None:
    put_masks(clean, [[i % 2 == 0, i == 0] for i in range(6)])
    [finding] = found(clean)
    assert finding.code == "masks-vanish"
    assert "object 2 is empty in 5 of 6 frames" in finding.evidence


@pytest.mark.parametrize(("counts", "different"), [((3, 4, 12), 1), ((9, 8, 1), 1), ((3, 4, 6), 0), ((1, 9), 0)])
def test_a_scan_with_far_more_or_fewer_objects_than_others_is_found(tmp_path: Path, counts, different) -> None:
    dataset = Dataset.create(tmp_path / "counted")
    for i, n in enumerate(counts):
        cameras, views = views_of(2, seed=i)
        add(dataset, f"scan{i}", cameras, [view.rgb for view in views], [view.depth for view in views])
        put_objects(dataset, f"scan{i}", [row(k + 1) for k in range(n)])
    assert codes(dataset) == ["objects-differ"] * different


# Demonstrations and keypoints -----------------------------------------------------------------------------------------


def put_robot(dataset: Dataset, path_m: float, opening_m: float) -> None:
    """A demonstration `moved` of five frames whose gripper moves and opens by so much."""
    seen = make_views(0.5, 5)
    raw = [np.round(view.depth * 1e4).astype(np.uint16) for view in seen.views]
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.linspace(0, path_m, 5)

    def fill(out: Path) -> None:
        group = Demonstration.start(out, "test", {})
        camera = CameraFrames(
            K=seen.K,
            world_from_cameras=seen.world_from_cameras,
            time=np.arange(5) / 30.0,
            depth_scale=1e-4,
            size=(HEIGHT, WIDTH),
            read=lambda i: (seen.views[i].rgb, raw[i]),
        )
        Demonstration.write_camera(group, "wrist", camera)
        Demonstration.write_robot(out, group, Robot(poses, np.linspace(0, opening_m, 5)))

    dataset.add("demonstration", "moved", Source(format="test", path="none"))
    publish_artifact(dataset, Demonstration, "moved", fill)


@pytest.mark.parametrize(
    ("path_m", "opening_m", "expected"),
    [(0.3, 0.04, []), (0.004, 0.0, ["demonstration-still"]), (0.3, 0.0002, ["gripper-still"]), (0.004, 0.04, [])],
)
def test_a_demonstration_in_which_nothing_moves_is_found(clean: Dataset, path_m, opening_m, expected) -> None:
    put_robot(clean, path_m, opening_m)
    assert codes(clean) == expected


def put_track(
    dataset: Dataset, change: Callable[[np.ndarray], np.ndarray], deviation: float = 0.01, k: int = 4
) -> None:
    """Keypoints of `demo-a` on the table around its boxes, changed."""
    rng = np.random.default_rng(0)
    places = change(np.concatenate([rng.uniform(-0.12, 0.12, (k, 2)), np.full((k, 1), 0.05)], axis=1))

    def fill(out: Path) -> None:
        names = [f"p{i}" for i in range(k)]
        with KeypointTrack.writer(out, names=names, filter="particle", cameras=["wrist"]) as writer:
            for _ in range(5):
                writer.append(
                    mean=places.astype(np.float32),
                    covariance=np.tile(np.eye(3) * deviation**2, (k, 1, 1)).astype(np.float32),
                    mode=places.astype(np.float32),
                    n_eff=np.full(k, 100, np.float32),
                    log_evidence=np.zeros(k, np.float32),
                    cameras={"wrist": (np.zeros((k, 2), np.float32), np.ones(k, bool))},
                )

    publish_artifact(dataset, KeypointTrack, "demo-a", fill)


@pytest.mark.parametrize(
    ("change", "deviation", "expected"),
    [
        (lambda places: places, 0.01, []),
        (lambda places: places * 0.02, 0.01, ["keypoints-collapsed"]),
        (lambda places: places, 0.4, ["keypoints-exploded"]),
        (lambda places: places + np.array([0, 0, 3.0]), 0.01, ["keypoints-outside"]),
        (lambda places: places * 1000, 0.01, ["keypoints-outside"]),
        (lambda places: places * np.nan, 0.01, []),
    ],
)
def test_keypoints_at_one_place_or_anywhere_or_outside_are_found(clean: Dataset, change, deviation, expected) -> None:
    put_track(clean, change, deviation)
    assert codes(clean) == expected


# Files ----------------------------------------------------------------------------------------------------------------


def change_manifest(path: Path, **changes: object) -> None:
    document = json.loads((path / "artifact.json").read_text())
    (path / "artifact.json").write_text(json.dumps({**document, **changes}))


@pytest.mark.parametrize(("version", "code"), [(1, "version-old"), (0, "version-unreadable"), (99, "damaged")])
def test_a_scan_of_another_version_is_found(clean: Dataset, version: int, code: str) -> None:
    change_manifest(clean.path(Scan, "scan-a"), schema_version=version)
    [finding] = found(clean)
    assert (finding.code, finding.place) == (code, "scan/scan-a")


def test_an_artifact_of_other_inputs_is_stale(clean: Dataset) -> None:
    change_manifest(clean.path(VisibleMasks, "scan-a"), inputs={"scan/scan-a": "0" * 64})
    [finding] = found(clean)
    assert (finding.code, finding.place) == ("stale", "masks/scan-a")
    assert "another scan/scan-a" in finding.evidence


@pytest.mark.parametrize("place", ["old_scan.zip", "frames/0001.png.part", "scan/forgotten/x", "keypoints/trial/x"])
def test_files_of_no_artifact_are_found(clean: Dataset, place: str) -> None:
    (clean.root / place).parent.mkdir(parents=True, exist_ok=True)
    (clean.root / place).write_bytes(b"0")
    [finding] = found(clean)
    assert finding.code == "unlisted-file" and place.startswith(finding.place)


def test_a_file_in_an_artifact_that_is_in_no_manifest_is_found(clean: Dataset) -> None:
    (clean.path(Scan, "scan-a") / "notes.txt").write_text("x")
    [finding] = found(clean)
    assert (finding.code, finding.place) == ("unlisted-file", "scan/scan-a")
    assert "notes.txt" in finding.evidence


@pytest.mark.parametrize("place", ["report.html", "README.md", "params.yaml", "notes/todo.txt", ".dvc/config"])
def test_documents_beside_the_data_are_not(clean: Dataset, place: str) -> None:
    (clean.root / place).parent.mkdir(parents=True, exist_ok=True)
    (clean.root / place).write_text("x: {}")
    assert codes(clean) == []


def damage_by_size(root: Path) -> None:
    file = next(each for each in (root / "scan" / "scan-a" / "wrist" / "rgb" / "c").rglob("*") if each.is_file())
    file.write_bytes(file.read_bytes()[:-100])


@pytest.mark.parametrize(
    ("damage", "evidence"),
    [
        (lambda root: shutil.rmtree(root / "scan" / "scan-a"), "no such folder"),
        (lambda root: (root / "masks" / "scan-a" / "zarr.json").unlink(), "files are missing, as zarr.json"),
        (lambda root: (root / "objects" / "scan-a" / "artifact.json").write_text("{"), "syntax error"),
        (damage_by_size, "another size than recorded"),
    ],
)
def test_damage_is_an_error_that_points_to_validate(clean: Dataset, damage, evidence: str) -> None:
    damage(clean.root)
    findings = [finding for finding in found(clean) if finding.code == "damaged"]
    assert any(evidence in finding.evidence for finding in findings)
    assert all(f"bask-data validate {clean.root}" in finding.fix for finding in findings)
