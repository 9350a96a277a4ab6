"""One camera of `ingest frames`: which files its frames have, and what they mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float, UInt8
from numpy import ndarray

from bask_data.core.lens import Lens
from bask_data.errors import BadData
from bask_data.formats.cloud_files import LARGEST_RESIDUAL, CloudFiles
from bask_data.formats.depth_files import SCALE_OF_FLOAT, SCALE_OF_WHOLE_NUMBERS
from bask_data.formats.files import Folder, paired
from bask_data.formats.frames.poses import FramePoses, poses_of_files, poses_of_trajectory
from bask_data.formats.frames.times import BY_NAME, frame_times, in_order_of_time
from bask_data.formats.image_files import ImageFiles
from bask_data.formats.intrinsics import CameraIntrinsics, read_calibration, refuse_unnamed_lens
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.poses import LENGTH_NAMES, other_readings, to_world_from_camera
from bask_data.formats.recording import Depth, SourceCamera

DEFAULT_COLOR = FramesOptions.model_fields["color"].default


@dataclass(frozen=True)
class CameraOfFrames:
    """A camera, with what only this format knows of it.

    Args:
        world_from_gripper: the poses, where they are a gripper's.
        assumptions: what its files do not state.
        files: that were used.
    """

    camera: SourceCamera
    world_from_gripper: Float[ndarray, "t 4 4"] | None
    assumptions: dict[str, str]
    files: tuple[Path, ...]


def read_camera(folder: Folder, options: FramesOptions) -> CameraOfFrames:
    """The camera that the options describe, `{camera}` filled in; images are read later.

    Raises:
        BadData: a file is missing, or contradicts the options.
    """
    groups = _image_groups(folder, options)
    if "*" in options.pose:
        groups["pose"] = folder.matching(options.pose, "pose")
    names, missing = paired(folder.path, groups)
    if options.timestamps == BY_NAME:
        names = in_order_of_time(names)
    times = frame_times(folder, names, options)
    if "*" in options.pose:
        poses = poses_of_files([groups["pose"].get(name) for name in names], options)
    else:
        poses = poses_of_trajectory(folder, names, times, options)
    images = _images(folder, groups, names, options)
    world_from_cameras, world_from_gripper, hand_eye = to_world_from_camera(
        poses.at(poses.written, options), options, folder=folder
    )
    depth_scale = options.depth_scale or (SCALE_OF_FLOAT if images.is_float else SCALE_OF_WHOLE_NUMBERS)
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(names),
        lens=images.lens,
        world_from_cameras=world_from_cameras,
        time=times.time,
        color=images.color,
        depth=images.depth,
        depth_scale=depth_scale,
        depth_lens=images.depth_lens,
        faults={**poses.faults, **{names.index(name): fault for name, fault in missing.items()}},
        pose_places=poses.places,
        intrinsics_size=options.intrinsics_size or images.calibration.size,
        otherwise=other_readings(poses.written, options, folder=folder, quaternions=poses.quaternions, at=poses.at),
    )
    files = (*images.files, *poses.files, *images.calibration.files, *times.files, *hand_eye)
    assumptions = _assumptions(options, poses, times.statement, depth_scale, images.statement)
    return CameraOfFrames(camera, world_from_gripper, assumptions, files)


@dataclass(frozen=True)
class _Images:
    """Where a camera's colour and depth come from, and its lens.

    Args:
        depth_lens: if it is not colour's.
        is_float: whether depth is in floating point.
        statement: what the intrinsics are, in words.
    """

    color: Callable[[int], UInt8[ndarray, "h w 3"]]
    depth: Callable[[int], Depth]
    lens: Lens
    depth_lens: Lens | None
    is_float: bool
    calibration: CameraIntrinsics
    statement: str
    files: tuple[Path, ...]


def _image_groups(folder: Folder, options: FramesOptions) -> dict[str, dict[str, Path]]:
    """Files of colour and depth, or of clouds, by what they are and by frame."""
    if not options.cloud:
        return {"color": folder.matching(options.color, "color"), "depth": folder.matching(options.depth, "depth")}
    groups = {"cloud": folder.matching(options.cloud, "cloud")}
    if options.color != DEFAULT_COLOR or not CloudFiles(tuple(groups["cloud"].values())).has_color:
        groups["color"] = folder.matching(options.color, "color")
    return groups


def _images(folder: Folder, groups: dict[str, dict[str, Path]], names: list[str], options: FramesOptions) -> _Images:
    color, depth, cloud = (
        tuple(groups.get(kind, {}).get(name) for name in names) for kind in ("color", "depth", "cloud")
    )
    invalid = tuple(int(word) for word in options.invalid_depth.split(",") if word)
    files = ImageFiles(color, depth, invalid_depth=invalid)
    if "cloud" not in groups:
        calibration = read_calibration(folder, options.intrinsics)
        refuse_unnamed_lens(calibration, options.distortion)
        lens = Lens(calibration.K, files.size, calibration.distortion)
        return _Images(
            files.read_color,
            files.read_depth,
            lens,
            None,
            files.is_float,
            calibration,
            calibration.statement_with(options.distortion),
            files.files,
        )
    clouds = CloudFiles(cloud)
    size = files.size if "color" in groups else clouds.size
    calibration, depth_lens, statement = _calibration_of_clouds(folder, options, clouds, size)
    return _Images(
        files.read_color if "color" in groups else clouds.read_color,
        clouds.read_depth,
        Lens(calibration.K, size, calibration.distortion),
        depth_lens,
        True,
        calibration,
        statement,
        (*files.files, *clouds.files),
    )


def _calibration_of_clouds(
    folder: Folder, options: FramesOptions, clouds: CloudFiles, size: tuple[int, int]
) -> tuple[CameraIntrinsics, Lens | None, str]:
    """Intrinsics of colour, the lens of depth if it has another size, and both in words."""
    K, residual = clouds.intrinsics()
    fitted = ",".join(f"{value:.6g}" for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    if residual > LARGEST_RESIDUAL:
        raise BadData(
            clouds.files[0],
            "cloud",
            expected="points that a pinhole camera sees at their pixels, z forward",
            got=f"points up to {residual:.3g} pixels beside them",
            fix="save the cloud in the frame of the camera's image, undistorted, as its driver made it.",
        )
    statement = (
        f"{fitted}, fitted to the points of {clouds.files[0].name}, which miss their pixels by {residual:.2g} px"
    )
    if not options.intrinsics and size == clouds.size:
        return CameraIntrinsics(K), None, statement
    calibration = read_calibration(folder, options.intrinsics)
    refuse_unnamed_lens(calibration, options.distortion)
    if size != clouds.size:
        return (
            calibration,
            Lens(K, clouds.size),
            f"{calibration.statement_with(options.distortion)}; of depth {statement}",
        )
    if calibration.distortion is None and (missed := clouds.residual(calibration.K)) > LARGEST_RESIDUAL:
        raise BadData(
            clouds.files[0],
            "intrinsics",
            expected=f"those that the points were made with, {fitted}",
            got=f"others: points are up to {missed:.3g} pixels beside their pixels",
            fix="leave out --intrinsics.",
        )
    return calibration, None, calibration.statement_with(options.distortion)


def _assumptions(
    options: FramesOptions, poses: FramePoses, time: str, depth_scale: float, intrinsics: str
) -> dict[str, str]:
    invalid = f"0 and {options.invalid_depth}" if options.invalid_depth else "0"
    axes = {"opencv": "x right, y down, z forward", "opengl": "x right, y up, z backward; turned to OpenCV's"}
    whose = " of the gripper" if options.gripper_from_camera else ""
    order = " ".join(options.quat)
    return {
        "pose": f"files hold {options.pose_is}{whose}, {LENGTH_NAMES[options.pose_unit]}; "
        + ("matrices are column-major" if options.column_major else f"quaternions are {order}")
        + (f"; {poses.statement}" if poses.statement else ""),
        "camera axes": f"{options.axes}: {axes[options.axes]}",
        "depth": ("z of the clouds' points" if options.cloud else "z-depth registered to colour")
        + f", {depth_scale:g} m per unit, {invalid} = no measurement",
        "intrinsics": intrinsics,
        "time": time,
    }
