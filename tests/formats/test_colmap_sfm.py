from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bask_data.core.geometry import rotation_angle
from bask_data.core.lens import Distortion, Lens
from bask_data.core.similarity import similarity
from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS
from bask_data.formats.colmap.lens import colmap_camera
from bask_data.formats.colmap.sfm import MOST_IMAGES
from bask_data.formats.options.colmap import ColmapOptions
from bask_data.kinds import Scan
from bask_data.progress import listened_by
from bask_data.sources.ingest import ingest
from tests.formats.corner import INTRINSICS, SIZE, K, poses, write_corner
from tests.formats.folders import write_image

[COLMAP] = [format for format in FORMATS if format.name == "colmap"]
N = 8


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images along an arc, with a gripper in view, and depth; and one image more that shows nothing."""
    folder = tmp_path_factory.mktemp("corner")
    write_corner(folder, poses(N), gripper=True)
    write_image(folder / "images/0100.png", np.full((*SIZE, 3), 90, np.uint8))
    write_image(folder / "depth/0100.png", np.full(SIZE, 1000, np.uint16))
    return folder


def ingested(source: Path, root: Path, **options: Any) -> tuple[str, dict[str, str], set[str]]:
    """What became of the recording, the assumptions, and the labels of the progress that was reported."""
    labels: set[str] = set()
    with listened_by(lambda label, done, total: labels.add(label)):
        given = ColmapOptions(intrinsics=INTRINSICS, **options)
        [outcome], assumptions = ingest(root, "corner", format=COLMAP, source=source, options=given)
    return outcome.status, assumptions, labels


def test_poses_are_found_from_images_and_only_once(source: Path, tmp_path: Path) -> None:
    status, assumptions, labels = ingested(source, tmp_path / "d")
    assert status == "made"
    assert {"finding features", "matching images", "registering images"} <= labels
    assert assumptions["pose"].startswith("found from the images by COLMAP's structure from motion: 8 of 9 registered")
    assert "1 left out: 0100.png (not registered)" in assumptions["frames"]
    assert "no other reading does as well" in assumptions["agreement"]
    camera = Scan(tmp_path / "d" / "scan" / "corner").camera("camera")
    ours, true = np.array(camera.world_from_cameras), poses(N)
    assert np.allclose(camera.Ks, K)
    fit = similarity(ours, true, scale=1.0)
    assert similarity(ours, true).scale == pytest.approx(1, abs=2e-3)
    moved = fit.moved(ours)
    assert np.linalg.norm(moved[:, :3, 3] - true[:, :3, 3], axis=1).max() < 2e-3
    assert np.degrees(rotation_angle(np.swapaxes(moved[:, :3, :3], 1, 2) @ true[:, :3, :3])).max() < 0.2
    # What takes long is not done again to find out that the recording is up to date.
    status, _, labels = ingested(source, tmp_path / "d")
    assert (status, labels) == ("up to date", set())


def test_lens_is_estimated_if_none_is_given_and_poses_are_the_same_each_time(source: Path) -> None:
    options = ColmapOptions(frames="::2", skip_bad=True)
    first, second = (COLMAP.read(source, options) for _ in range(2))
    [ready] = first.cameras
    assert ready.n_frames == 4
    assert np.array_equal(ready.world_from_cameras, second.cameras[0].world_from_cameras)
    assert ready.Ks[0, 0, 0] == pytest.approx(300, rel=0.03)
    assert ready.Ks[0, :2, 2].tolist() == [159.5, 119.5]
    assert "estimated from the images" in first.assumptions["intrinsics"]


def test_images_without_anything_in_common_do_not_register(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for i in range(3):
        write_image(tmp_path / f"images/{i}.png", rng.integers(0, 256, (64, 80, 3), dtype=np.uint8))
        write_image(tmp_path / f"depth/{i}.png", np.full((64, 80), 1000, np.uint16))
    with pytest.raises(BadData, match="expected images that register, got none of 3"):
        COLMAP.read(tmp_path, ColmapOptions())


def test_images_are_checked_before_poses_are_found(tmp_path: Path) -> None:
    write_corner(tmp_path, poses(3))
    with pytest.raises(UsageError, match="--distortion: expected the intrinsics it belongs to"):
        COLMAP.read(tmp_path, ColmapOptions(distortion="opencv:0.1,0,0,0"))
    with pytest.raises(BadData, match="principal point near the middle"):
        COLMAP.read(tmp_path, ColmapOptions(intrinsics="300,300,20,20"))
    write_image(tmp_path / "images/0001.png", np.zeros((20, 30, 3), np.uint8))
    with pytest.raises(BadData, match="expected 320 x 240 as the images before, got 30 x 20"):
        COLMAP.read(tmp_path, ColmapOptions())
    (tmp_path / "images/0002.png").write_bytes((tmp_path / "images/0000.png").read_bytes()[:-20])
    with pytest.raises(UsageError, match=f"expected 3 to {MOST_IMAGES} to find poses from, got 1"):
        COLMAP.read(tmp_path, ColmapOptions(skip_bad=True))


@pytest.mark.parametrize(
    "distortion",
    [
        None,
        Distortion("OPENCV", (0.1, -0.02, 0.001, 0.002)),
        Distortion("OPENCV", (0.1, -0.02, 0.001, 0.002, 0.01)),
        Distortion("OPENCV_FISHEYE", (0.1, -0.02, 0.01, 0.002)),
        Distortion("SIMPLE_RADIAL", (0.1,)),
    ],
)
def test_camera_of_colmap_maps_rays_as_our_lens(distortion: Distortion | None) -> None:
    import cv2

    rays = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0], [0.0, 0.0, 1.0]])
    pixels = colmap_camera(Lens(K, SIZE, distortion)).img_from_cam(rays) - 0.5
    numbers = np.array(distortion.parameters if distortion else [0.0] * 4)
    if distortion is not None and distortion.name == "OPENCV_FISHEYE":
        expected = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), K, numbers)[0][:, 0]
    else:
        numbers = np.append(numbers, [0.0] * 4)[: max(4, len(numbers))]
        expected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, numbers)[0][:, 0]
    assert pixels == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (Lens(K + np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]]), SIZE), "skew in K"),
        (Lens(K, SIZE, Distortion("OPENCV", (0.1,) * 12)), "OPENCV with 12 numbers"),
    ],
)
def test_lens_that_colmap_lacks_is_refused(lens: Lens, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        colmap_camera(lens)
