"""A camera's recording from image files, poses and intrinsics, checked for the faults that occur in practice."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from bask_data.core.geometry import nearest_rigid, rigid_fault
from bask_data.errors import BadData, UsageError
from bask_data.formats.files import listed, member, numbers, read_lines
from bask_data.formats.images import (
    ImageHeader,
    check_color,
    check_depth,
    check_labels,
    image_header,
    read_color,
    read_depth,
    read_labels,
)
from bask_data.formats.recording import CameraRecording

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes: y up and z backward become y down and z forward."""

QUATERNION_TOLERANCE = 0.01
"""Largest deviation from 1 of a quaternion's length. TUM's files have four digits, an error of 1e-4; other numbers
deviate far more."""

PLAUSIBLE_DEPTH = (0.001, 100.0)
"""Range of the median depth of an image, metres; outside it the unit must be wrong. Wrong units differ by a factor of
1000, and rooms measure metres."""


@dataclass(frozen=True)
class ImageFiles:
    """The image files of one camera, by frame.

    Args:
        label: label images, or empty.
        invalid_depth: raw values besides 0 that mean no measurement.
        rotated_depth: whether raw depth is rotated left by three bits, as in APC recordings.
    """

    color: tuple[Path, ...]
    depth: tuple[Path, ...]
    label: tuple[Path, ...] = ()
    invalid_depth: tuple[int, ...] = ()
    rotated_depth: bool = False

    def read(self, i: int) -> tuple[UInt8[ndarray, "h w 3"], UInt16[ndarray, "h w"]]:
        return read_color(self.color[i]), self.read_depth(i)

    def read_depth(self, i: int) -> UInt16[ndarray, "h w"]:
        raw = read_depth(self.depth[i])
        if self.invalid_depth:
            raw = np.where(np.isin(raw, self.invalid_depth), np.uint16(0), raw)
        return (raw >> np.uint16(3)) | (raw << np.uint16(13)) if self.rotated_depth else raw

    def read_labels(self, i: int) -> UInt8[ndarray, "h w"]:
        return read_labels(self.label[i])


def camera_recording(
    name: str,
    images: ImageFiles,
    K: Float[ndarray, "3 3"],
    intrinsics_size: str,
    depth_scale: float,
    world_from_cameras: Float[ndarray, "t 4 4"],
    time: Float[ndarray, " t"],
) -> CameraRecording:
    """A camera's recording, after checking its files.

    Args:
        intrinsics_size: WIDTHxHEIGHT as stated by the user, or empty.
        depth_scale: metres per unit.
        time: seconds.

    Raises:
        BadData: images differ in size or kind, intrinsics are of another size, times do not increase, or depth is
            invalid throughout or implausible at this scale.
    """
    size = _common_size(images)
    check_intrinsics(images.color[0], K, size, intrinsics_size)
    if not (np.isfinite(time).all() and (np.diff(time) > 0).all()):
        late = int(np.argmin(np.diff(time) > 0)) + 1 if len(time) > 1 else 0
        raise BadData(
            images.color[late], "time", expected="finite times that increase with the frames", got=f"{time[late]} s"
        )
    _check_depth_values(images, depth_scale)
    return CameraRecording(
        name=name,
        K=K,
        height=size.height,
        width=size.width,
        depth_scale=depth_scale,
        world_from_cameras=world_from_cameras,
        time=time,
        read=images.read,
        labels=images.read_labels if images.label else None,
    )


def _common_size(images: ImageFiles) -> ImageHeader:
    """Header of the first colour image, after checking that every file is intact and has its kind and size."""
    first: ImageHeader | None = None
    for paths, check in ((images.color, check_color), (images.depth, check_depth), (images.label, check_labels)):
        for path in paths:
            header = image_header(path)
            check(path, header)
            first = first or header
            if (header.height, header.width) != (first.height, first.width):
                raise BadData(
                    path,
                    "size",
                    expected=f"{first.width} x {first.height} as in {images.color[0].name}",
                    got=f"{header.width} x {header.height}",
                    fix="export depth registered to colour, at the size of the colour images.",
                )
    assert first is not None
    return first


def check_intrinsics(where: Path, K: Float[ndarray, "3 3"], size: ImageHeader, stated: str) -> None:
    """Check that K fits images of this size.

    Intrinsics of another resolution are the most common mistake. The principal point reveals it, as it lies near the
    image's centre, except in crops; the user states the size of these.

    Args:
        where: place for messages.
        stated: WIDTHxHEIGHT of the images that K was calibrated with, or empty.

    Raises:
        BadData: the size differs, the principal point is off-centre, or the focal lengths are implausible.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    actual = f"{size.width}x{size.height}"
    if stated and stated != actual:
        raise BadData(
            where,
            "intrinsics",
            expected=f"images of {stated}",
            got=actual,
            fix="scale fx, fy, cx, cy to the images' size.",
        )
    low, high = (0.0, 1.0) if stated else (0.25, 0.75)
    if not (low * size.width <= cx <= high * size.width and low * size.height <= cy <= high * size.height):
        raise BadData(
            where,
            "intrinsics",
            expected=f"a principal point {'inside' if stated else 'near the middle of'} images of {actual}",
            got=f"({cx:g}, {cy:g})",
            fix="pass the intrinsics of this resolution"
            + ("." if stated else f"; if the images are a crop, state --intrinsics-size {actual}."),
        )
    if not 0.1 * size.width <= min(fx, fy) <= max(fx, fy) <= 20 * size.width:
        raise BadData(
            where,
            "intrinsics",
            expected=f"focal lengths in pixels, {0.1 * size.width:g} to {20 * size.width:g}",
            got=f"({fx:g}, {fy:g})",
            fix="pass fx, fy in pixels, not in millimetres.",
        )


def _check_depth_values(images: ImageFiles, depth_scale: float) -> None:
    """Check the first frame with depth; single frames may have none, the whole recording may not."""
    for i, path in enumerate(images.depth):
        depth = images.read_depth(i)
        measured = depth[depth > 0]
        if measured.size == 0:
            continue
        median = float(np.median(measured)) * depth_scale
        if not PLAUSIBLE_DEPTH[0] <= median <= PLAUSIBLE_DEPTH[1]:
            raise BadData(
                path,
                "depth",
                expected=f"a median between {PLAUSIBLE_DEPTH[0]:g} and {PLAUSIBLE_DEPTH[1]:g} m",
                got=f"{median:.4g} m at {depth_scale:g} m per unit",
                fix="pass --depth-scale: 0.001 for millimetres.",
            )
        return
    raise BadData(
        images.depth[0].parent,
        "depth",
        expected="a measurement somewhere in the recording",
        got=f"none in {len(images.depth)} frames",
        fix="check --invalid-depth and --depth.",
    )


def parse_intrinsics(source: Path, text: str) -> tuple[Float[ndarray, "3 3"], tuple[Path, ...]]:
    """K from `fx,fy,cx,cy` or from a text file (here or in `source`), and the files it came from."""
    if not text:
        raise UsageError(
            "--intrinsics",
            expected="fx,fy,cx,cy or a file",
            got="nothing",
            fix="take them from the camera's calibration; images do not contain them.",
        )
    words = text.split(",")
    if len(words) == 4:
        return _intrinsics_matrix(source, numbers(Path("--intrinsics"), text)), ()
    path = Path(text)
    if not path.is_file():
        if len(words) > 1 and not (source / text).exists():
            fix = "images do not contain them: take them from the camera's calibration."
            raise UsageError("--intrinsics", expected="4 numbers fx,fy,cx,cy", got=str(len(words)), fix=fix)
        path = member(source, text, "--intrinsics")
    values = [value for line in read_lines(path) for value in numbers(path, line)]
    return _intrinsics_matrix(path, values), (path,)


def _intrinsics_matrix(where: Path, values: list[float]) -> Float[ndarray, "3 3"]:
    array = np.array(values)
    if len(values) == 4:
        fx, fy, cx, cy = values
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)
    elif len(values) in (9, 16):
        side = 3 if len(values) == 9 else 4
        K = array.reshape(side, side)[:3, :3].astype(np.float64)
    else:
        raise BadData(
            where,
            "intrinsics",
            expected="4 numbers fx fy cx cy, or a 3x3 or 4x4 matrix",
            got=f"{len(values)} numbers",
            fix="correct the file, or pass --intrinsics fx,fy,cx,cy.",
        )
    pinhole = np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and K[1, 0] == 0 and (K[2] == [0, 0, 1]).all()
    if not pinhole:
        raise BadData(
            where,
            "intrinsics",
            expected="a pinhole matrix: fx, fy > 0, zero below the diagonal, last row 0 0 1",
            got=K.tolist(),
            fix=_fix_of_intrinsics(K),
        )
    return K


def _fix_of_intrinsics(K: Float[ndarray, "3 3"]) -> str:
    """What to do about a matrix that is no pinhole matrix: signs of focal lengths say which way the axes point."""
    if K[0, 0] < 0 and K[1, 1] < 0:
        # RLBench and CoppeliaSim: OpenCV's axes turned by 180 degrees about the viewing direction.
        return (
            "x points left and y up here: make fx and fy positive, and multiply each world_from_camera "
            "by diag(-1, -1, 1, 1) from the right."
        )
    if K[0, 0] < 0 < K[1, 1]:
        return "these are OpenGL axes: make fx positive and pass --axes opengl."
    return "check the file, or pass --intrinsics fx,fy,cx,cy."


def parse_pose(where: Path | str, values: list[float]) -> Float[ndarray, "4 4"]:
    """The transform in a pose file, made exactly rigid: a 4x4 or 3x4 matrix, or tx ty tz qx qy qz qw.

    Raises:
        BadData: another count of numbers, or not a rigid transform.
    """
    if len(values) == 7:
        matrix = _from_quaternion(where, np.array(values))
    elif len(values) in (12, 16):
        matrix = np.eye(4)
        matrix[: len(values) // 4] = np.array(values).reshape(-1, 4)
    else:
        raise BadData(
            where,
            "pose",
            expected="a 4x4 or 3x4 matrix or tx ty tz qx qy qz qw",
            got=f"{len(values)} numbers",
            fix="check the file, and the option that names it.",
        )
    if fault := rigid_fault(matrix):
        raise BadData(
            where,
            "pose",
            expected="a rigid transform",
            got=fault,
            fix="remove the frame if tracking was lost, or convert the poses if their convention differs.",
        )
    return nearest_rigid(matrix)


def _from_quaternion(where: Path | str, values: Float[ndarray, "7"]) -> Float[ndarray, "4 4"]:
    quat_xyzw = values[3:]
    length = float(np.linalg.norm(quat_xyzw))
    if not abs(length - 1) <= QUATERNION_TOLERANCE:
        raise BadData(
            where,
            "pose",
            expected="a quaternion of length 1",
            got=f"length {length:.4g}",
            fix="write each line as tx ty tz qx qy qz qw.",
        )
    x, y, z, w = quat_xyzw / length
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = values[:3]
    return matrix


def read_poses(paths: list[Path]) -> Float[ndarray, "t 4 4"]:
    """One transform per file. All files are read before the first fault is raised, so that its message lists all."""
    poses, faults = [], []
    for path in paths:
        try:
            poses.append(parse_pose(path, [value for line in read_lines(path) for value in numbers(path, line)]))
        except BadData as fault:
            faults.append((path, fault))
    if faults:
        first = faults[0][1]
        if len(faults) > 1:
            first.add_note(f"also: {listed([path.name for path, _ in faults[1:]])}")
        raise first
    return np.stack(poses)
