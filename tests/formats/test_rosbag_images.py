from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from bask_data.errors import BadData
from bask_data.formats import rosbag
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.recording import SourceCamera
from tests.formats.bags import (
    COLOR,
    COLOR_TOPIC,
    DEPTH,
    DEPTH_TOPIC,
    INFO_TOPIC,
    OPTICAL,
    START,
    BagWriter,
    write_tf,
)
from tests.formats.folders import HEIGHT, WIDTH, K

RGB, RAW = COLOR[0], DEPTH[0]


def camera_of(
    folder: Path,
    color: object = None,
    depth: object = None,
    *,
    kind: str = "mcap",
    color_topic: str = COLOR_TOPIC,
    depth_topic: str = DEPTH_TOPIC,
    info: dict[str, object] | None = None,
    infos: dict[str, dict[str, object]] | None = None,
    **options: object,
) -> SourceCamera:
    """A bag of one frame, with messages that are made by functions of its writer."""
    folder.mkdir(exist_ok=True)
    bag = BagWriter(folder / "scan", kind)
    write_tf(bag)
    for topic, fields in {INFO_TOPIC: info or {}, **(infos or {})}.items():
        values = {name: value(bag) if callable(value) else value for name, value in fields.items()}
        bag.write(topic, START, bag.info(START, **values))
    bag.write(color_topic, START, color(bag) if callable(color) else bag.image(START, OPTICAL, "rgb8", RGB))
    bag.write(depth_topic, START, depth(bag) if callable(depth) else bag.image(START, OPTICAL, "16UC1", RAW))
    [camera] = rosbag.read(bag.close(), RosbagOptions(**options)).cameras
    return camera


@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize(
    ("encoding", "channels"),
    [("rgb8", (0, 1, 2)), ("bgr8", (2, 1, 0)), ("8UC3", (2, 1, 0)), ("rgba8", (0, 1, 2, 1)), ("bgra8", (2, 1, 0, 0))],
)
def test_colours_are_put_in_order_and_padding_is_dropped(
    tmp_path: Path, kind: str, encoding: str, channels: tuple[int, ...]
) -> None:
    pixels = RGB[..., list(channels)]
    camera = camera_of(tmp_path, lambda bag: bag.image(START, OPTICAL, encoding, pixels, padding=5), kind=kind)
    assert np.array_equal(camera.color(0), RGB)
    assert np.array_equal(camera.depth(0), RAW)


def test_grey_is_repeated_and_yuv_converted(tmp_path: Path) -> None:
    grey = RGB[..., 0]
    camera = camera_of(tmp_path, lambda bag: bag.image(START, OPTICAL, "mono8", grey))
    assert np.array_equal(camera.color(0), np.repeat(grey[..., None], 3, axis=2))
    yuv = np.full((HEIGHT, WIDTH, 2), 128, np.uint8)
    yuv[..., 1] = 235  # U and V before Y: white.
    camera = camera_of(tmp_path / "yuv", lambda bag: bag.image(START, OPTICAL, "yuv422", yuv))
    assert (camera.color(0) == 255).all()
    camera = camera_of(tmp_path / "yuy2", lambda bag: bag.image(START, OPTICAL, "yuv422_yuy2", yuv[..., ::-1]))
    assert (camera.color(0) == 255).all()


def test_bayer_patterns_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="image_raw 000000: encoding: expected one of rgb8.*got bayer_rggb8.*debayers"):
        camera_of(tmp_path, lambda bag: bag.image(START, OPTICAL, "bayer_rggb8", RGB[..., 0]))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"step": 10}, "data: expected 12 rows of 48 bytes or more, for 16 x 12 in rgb8, got 576 bytes in rows of 10"),
        ({"height": 13}, "expected 13 rows of 48 bytes or more"),
        ({"height": 60000, "width": 60000}, "size: expected 1 to 100000000 pixels, got 60000 x 60000"),
        ({"width": 0}, "size: expected 1 to 100000000 pixels, got 0 x 12"),
    ],
)
def test_images_that_are_not_as_large_as_they_say_are_refused(
    tmp_path: Path, fields: dict[str, int], message: str
) -> None:
    with pytest.raises(BadData, match=message):
        camera_of(tmp_path, lambda bag: bag.image(START, OPTICAL, "rgb8", RGB, **fields))


def test_depth_in_big_endian_and_in_metres(tmp_path: Path) -> None:
    swapped = RAW.astype(">u2")
    camera = camera_of(
        tmp_path, depth=lambda bag: bag.image(START, OPTICAL, "16UC1", swapped, padding=3, is_bigendian=1)
    )
    assert np.array_equal(camera.depth(0), RAW) and camera.depth(0).dtype == np.uint16
    metres = RAW.astype(np.float32) / 1000
    metres[RAW == 0] = np.nan
    camera = camera_of(tmp_path / "again", depth=lambda bag: bag.image(START, OPTICAL, "32FC1", metres))
    assert camera.depth_scale == 1
    assert np.array_equal(camera.depth(0), metres, equal_nan=True)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


@pytest.mark.parametrize("format", ["rgb8; png compressed bgr8", "png", "bgr8; png compressed rgb8"])
def test_compressed_colour_has_its_channels_as_its_format_says(tmp_path: Path, format: str) -> None:
    stored = RGB if "compressed rgb8" in format else RGB[..., ::-1]
    camera = camera_of(
        tmp_path,
        lambda bag: bag.compressed(START, OPTICAL, format, png(stored)),
        color_topic=f"{COLOR_TOPIC}/compressed",
    )
    assert np.array_equal(camera.color(0), RGB)


@pytest.mark.parametrize(
    ("format", "n_before"), [("16UC1; compressedDepth png", 12), ("16UC1; png compressed ", 0), ("png", 0)]
)
def test_compressed_depth_is_a_png_after_a_header_or_without(tmp_path: Path, format: str, n_before: int) -> None:
    camera = camera_of(
        tmp_path,
        depth=lambda bag: bag.compressed(START, OPTICAL, format, b"\0" * n_before + png(RAW)),
        depth_topic=f"{DEPTH_TOPIC}/compressedDepth",
    )
    assert np.array_equal(camera.depth(0), RAW) and camera.depth_scale == 0.001


def test_compressed_depth_in_metres_is_an_inverse(tmp_path: Path) -> None:
    metres = RAW.astype(np.float64) / 1000
    # compressed_depth_image_transport: a = z0 (z0 + 1), b = 1 - a / largest depth.
    a = 100.0 * 101.0
    b = 1 - a / 10
    raw = np.where(RAW > 0, a / np.where(RAW > 0, metres, 1) + b, 0).astype(np.uint16)
    header = struct.pack("<iff", 1, a, b)
    camera = camera_of(
        tmp_path,
        depth=lambda bag: bag.compressed(START, OPTICAL, "32FC1; compressedDepth", header + png(raw)),
        depth_topic=f"{DEPTH_TOPIC}/compressedDepth",
    )
    read = camera.depth(0)
    assert camera.depth_scale == 1 and np.array_equal(read > 0, RAW > 0)
    # One step of the quantisation is z^2 / a metres, 0.2 mm at 1.5 m.
    assert np.abs(read - metres)[RAW > 0].max() < 1.5**2 / a


@pytest.mark.parametrize(
    ("format", "data", "message"),
    [
        ("16UC1; compressedDepth rvl", b"\0" * 40, "expected compressedDepth with PNG, got 16UC1; compressedDepth rvl"),
        ("16UC1; compressedDepth", b"\0" * 5, "expected a PNG after 12 bytes, got 5 bytes"),
        ("16UC1; compressedDepth", b"\0" * 12 + png(RAW)[:-9], "expected a PNG that ends in IEND"),
        ("16UC1; compressedDepth", b"\0" * 12 + png(RGB), "expected one channel of 16 bits"),
    ],
)
def test_compressed_depth_that_cannot_be_read_is_refused(
    tmp_path: Path, format: str, data: bytes, message: str
) -> None:
    with pytest.raises(BadData, match=message):
        camera_of(
            tmp_path,
            depth=lambda bag: bag.compressed(START, OPTICAL, format, data),
            depth_topic=f"{DEPTH_TOPIC}/compressedDepth",
        )


def test_raw_images_have_K_and_its_distortion(tmp_path: Path) -> None:
    matrix = np.array([[30.0, 0, 7, 0], [0, 30, 6, 0], [0, 0, 1, 0]])
    camera = camera_of(tmp_path, info={"d": np.array([0.1, -0.02, 0.001, 0.002, 0.0]), "p": matrix.ravel()})
    assert np.array_equal(camera.lens.K, K)
    assert camera.lens.distortion is not None
    assert camera.lens.distortion.name == "OPENCV"
    assert camera.lens.distortion.parameters == (0.1, -0.02, 0.001, 0.002, 0.0)


def test_rectified_images_have_P_and_no_distortion(tmp_path: Path) -> None:
    matrix = np.array([[30.0, 0, 7, 0], [0, 30, 6, 0], [0, 0, 1, 0]])
    fields = {"d": np.array([0.1, -0.02, 0.001, 0.002, 0.0]), "p": matrix.ravel()}
    camera = camera_of(tmp_path, info=fields, color_topic="/camera/color/image_rect_color")
    assert np.array_equal(camera.lens.K, matrix[:, :3])
    assert camera.lens.distortion is None


@pytest.mark.parametrize(
    ("model", "d", "name"),
    [
        ("rational_polynomial", np.full(8, 0.01), "OPENCV"),
        ("equidistant", np.full(4, 0.01), "OPENCV_FISHEYE"),
        ("fisheye", np.full(4, 0.01), "OPENCV_FISHEYE"),
        ("plumb_bob", np.zeros(5), None),
        ("", np.zeros(0), None),
    ],
)
def test_lens_models_by_their_names_in_ros(tmp_path: Path, model: str, d: np.ndarray, name: str | None) -> None:
    distortion = camera_of(tmp_path, info={"distortion_model": model, "d": d}).lens.distortion
    assert (distortion and distortion.name) == name


def test_cropping_and_binning_move_the_intrinsics(tmp_path: Path) -> None:
    fields = {"width": 64, "height": 48, "binning_x": 2, "binning_y": 2}
    fields["k"] = np.array([[40.0, 0, 25], [0, 42, 19], [0, 0, 1]]).ravel()
    camera = camera_of(tmp_path, info={**fields, "roi": lambda bag: bag.roi(10, 8, 32, 24)})
    assert np.array_equal(camera.lens.K, [[20, 0, 7.5], [0, 21, 5.5], [0, 0, 1]])
    assert camera.intrinsics_size == f"{WIDTH}x{HEIGHT}"


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"k": np.zeros(9)}, r"K: expected focal lengths above 0, got \(0, 0\).*pass --intrinsics fx,fy,cx,cy"),
        ({"distortion_model": "polynomial", "d": np.ones(3)}, "distortion_model: expected plumb_bob"),
    ],
)
def test_calibrations_that_say_nothing_are_refused(tmp_path: Path, info: dict[str, object], message: str) -> None:
    with pytest.raises(BadData, match=message):
        camera_of(tmp_path, info=info)


def test_intrinsics_may_come_from_elsewhere(tmp_path: Path) -> None:
    camera = camera_of(tmp_path, info={"k": np.zeros(9)}, intrinsics="20,21,7.5,5.5")
    assert np.array_equal(camera.lens.K, K)


def test_a_calibration_under_another_name_is_found_by_frame_and_size(tmp_path: Path) -> None:
    camera = camera_of(tmp_path, color_topic="/rgb/image")
    assert np.array_equal(camera.lens.K, K)
    with pytest.raises(BadData, match=r"CameraInfo of /rgb/image, got /camera/color/camera_info.*--camera-info-topic"):
        camera_of(tmp_path / "again", color_topic="/rgb/image", info={"width": 640})


def test_depth_of_another_resolution_has_the_calibration_beside_it(tmp_path: Path) -> None:
    half = np.diag([0.5, 0.5, 1]) @ K
    camera = camera_of(
        tmp_path,
        depth=lambda bag: bag.image(START, OPTICAL, "16UC1", RAW[::2, ::2]),
        infos={"/camera/aligned_depth_to_color/camera_info": {"matrix": half, "width": 8, "height": 6}},
    )
    assert camera.depth_lens is not None and np.array_equal(camera.depth_lens.K, half)
    assert camera.depth_lens.size == (6, 8)
    assert camera.color_from_depth is None


def test_a_calibration_that_changes_is_each_frames_own(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "mcap")
    write_tf(bag)
    matrices = [K, K + np.diag([1.0, 1, 0])]
    for i in range(2):
        stamp = START + i * 100_000_001
        bag.write(INFO_TOPIC, stamp, bag.info(stamp, matrix=matrices[i]))
        bag.write(COLOR_TOPIC, stamp, bag.image(stamp, OPTICAL, "rgb8", COLOR[i]))
        bag.write(DEPTH_TOPIC, stamp, bag.image(stamp, OPTICAL, "16UC1", DEPTH[i]))
    recording = rosbag.read(bag.close(), RosbagOptions())
    assert np.array_equal(recording.cameras[0].lens.K, matrices)
    assert "it changes" in recording.assumptions["intrinsics"]
