"""Small bags of ROS, written by `rosbags`, with images, calibrations and transforms of a camera on a robot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from tests.formats.folders import HEIGHT, WIDTH, K, images, rigid

KINDS = ("bag", "bag-bz2", "bag-lz4", "mcap", "mcap-zstd", "db3", "db3-zstd")
"""Storages, and how they are compressed."""

START = 1_700_000_000_123_456_789
STAMPS = [START + i * 100_000_001 for i in range(4)]
"""Nanoseconds since 1970 of the colour images."""

COLOR, DEPTH = images(4)
COLOR_TOPIC = "/camera/color/image_raw"
DEPTH_TOPIC = "/camera/aligned_depth_to_color/image_raw"
INFO_TOPIC = "/camera/color/camera_info"
OPTICAL = "camera_color_optical_frame"
TOOL_FROM_CAMERA = rigid(np.random.default_rng(100))
WORLD_FROM_TOOLS = np.stack([rigid(np.random.default_rng(200 + i)) for i in range(4)])
WORLD_FROM_CAMERAS = WORLD_FROM_TOOLS @ TOOL_FROM_CAMERA
TIME = "builtin_interfaces/msg/Time"


class BagWriter:
    """A bag that is being written, and makers of its messages.

    Args:
        path: without suffix.
        little_endian: how ROS 2 writes numbers.
    """

    def __init__(self, path: Path, kind: str, little_endian: bool = True) -> None:
        self.little_endian = little_endian
        storage, _, compression = kind.partition("-")
        self.is_ros1 = storage == "bag"
        self.types = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        if self.is_ros1:
            self.types.register(
                get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
            )
            self.types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf/msg/tfMessage"))
            self.path = path.with_suffix(".bag")
            self.writer: Any = Writer1(self.path)
            if compression:
                self.writer.set_compression(Writer1.CompressionFormat[compression.upper()])
        else:
            self.path = path
            plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(path, version=9, storage_plugin=plugin)
            if compression:
                mode = CompressionMode.STORAGE if storage == "mcap" else CompressionMode.MESSAGE
                self.writer.set_compression(mode, CompressionFormat.ZSTD)
        self.writer.open()
        self._connections: dict[str, Any] = {}

    def make(self, type: str, **fields: Any) -> Any:
        """A message, with fields as ROS 2 writes them."""
        made = self.types.types[type]
        if self.is_ros1 and type == "sensor_msgs/msg/CameraInfo":
            fields = {name.upper() if name in "dkrp" else name: value for name, value in fields.items()}
        return made(**fields)

    def header(self, stamp: int, frame: str) -> Any:
        sec, nanosec = divmod(stamp, 10**9)
        sequence = {"seq": 0} if self.is_ros1 else {}
        return self.make(
            "std_msgs/msg/Header", stamp=self.make(TIME, sec=sec, nanosec=nanosec), frame_id=frame, **sequence
        )

    def image(self, stamp: int, frame: str, encoding: str, pixels: np.ndarray, padding: int = 0, **fields: Any) -> Any:
        """`sensor_msgs/Image`; rows are padded with a value that no pixel may take."""
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
        stated = {"height": pixels.shape[0], "width": pixels.shape[1], "is_bigendian": 0, "step": rows.shape[1]}
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp, frame),
            encoding=encoding,
            data=rows.ravel(),
            **{**stated, **fields},
        )

    def compressed(self, stamp: int, frame: str, format: str, data: bytes) -> Any:
        values = np.frombuffer(data, np.uint8)
        return self.make(
            "sensor_msgs/msg/CompressedImage", header=self.header(stamp, frame), format=format, data=values
        )

    def info(self, stamp: int, frame: str = OPTICAL, matrix: np.ndarray = K, **fields: Any) -> Any:
        stated = {"height": HEIGHT, "width": WIDTH, "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
        stated |= {"d": np.zeros(5), "k": matrix.ravel(), "r": np.eye(3).ravel()}
        stated |= {"p": np.hstack([matrix, np.zeros((3, 1))]).ravel(), "roi": self.roi(0, 0, 0, 0)}
        return self.make("sensor_msgs/msg/CameraInfo", header=self.header(stamp, frame), **{**stated, **fields})

    def roi(self, x: int, y: int, width: int, height: int) -> Any:
        return self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=x, y_offset=y, height=height, width=width, do_rectify=False
        )

    def transforms(self, *parts: tuple[int, str, str, np.ndarray], type: str = "tf2_msgs/msg/TFMessage") -> Any:
        """A message of tf: (stamp, parent, child, parent_from_child) of each transform."""
        return self.make(type, transforms=[self.transform(*part) for part in parts])

    def transform(self, stamp: int, parent: str, child: str, matrix: np.ndarray) -> Any:
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
        place = dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp, parent),
            child_frame_id=child,
            transform=self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make("geometry_msgs/msg/Vector3", **place),
                rotation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
            ),
        )

    def pose(self, matrix: np.ndarray) -> Any:
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
        place = dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", **place),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )

    def write(self, topic: str, arrival: int, message: Any) -> None:
        type = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self.writer.add_connection(topic, type, typestore=self.types)
        if self.is_ros1:
            data = self.types.serialize_ros1(message, type)
        else:
            data = self.types.serialize_cdr(message, type, little_endian=self.little_endian)
        self.writer.write(self._connections[topic], arrival, data)

    def close(self) -> Path:
        self.writer.close()
        return self.path


def write_tf(bag: BagWriter, stamps: Iterable[int] = STAMPS, poses: Sequence[np.ndarray] = WORLD_FROM_TOOLS) -> None:
    """base -> tool0 at each stamp, and tool0 -> camera_link -> the optical frame, static."""
    link = rigid(np.random.default_rng(7))
    parts = [(0, "tool0", "camera_link", link), (0, "camera_link", OPTICAL, np.linalg.inv(link) @ TOOL_FROM_CAMERA)]
    bag.write("/tf_static", START, bag.transforms(*parts))
    for stamp, pose in zip(stamps, poses, strict=True):
        bag.write("/tf", stamp, bag.transforms((stamp, "base", "tool0", pose)))


def write_images(bag: BagWriter, late: int = 3_000_000, depth_offset: int = 2_000_000, frame: str = OPTICAL) -> None:
    """Colour, depth and calibration as a RealSense publishes them, which arrive late."""
    for i, stamp in enumerate(STAMPS):
        bag.write(INFO_TOPIC, stamp + late, bag.info(stamp, frame))
        bag.write(COLOR_TOPIC, stamp + late, bag.image(stamp, frame, "rgb8", COLOR[i]))
        depth = bag.image(stamp + depth_offset, frame, "16UC1", DEPTH[i])
        bag.write(DEPTH_TOPIC, stamp + late, depth)


def write_recording(path: Path, kind: str = "mcap") -> Path:
    """A whole bag of four frames."""
    bag = BagWriter(path, kind)
    write_tf(bag)
    write_images(bag)
    return bag.close()
