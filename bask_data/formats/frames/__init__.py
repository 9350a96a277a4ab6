"""A folder of colour, depth and pose files: 7-Scenes, 3DMatch, and custom dumps, of one camera or several."""

from __future__ import annotations

from pathlib import Path

from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData, UsageError
from bask_data.formats.choices import CAMERA
from bask_data.formats.files import Folder, source_folder
from bask_data.formats.frames.camera import CameraOfFrames, read_camera
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.recording import RobotRecording, SourceRecording
from bask_data.formats.robot_table import read_robot_table


def read(source: Path, options: FramesOptions) -> SourceRecording:
    """The recording in `source`; see `FramesOptions` for how the files are interpreted."""
    folder = source_folder(source, options.follow_links)
    names = options.camera.split(",")
    if len(set(names)) < len(names):
        raise UsageError("--camera", expected="different names", got=options.camera, fix="name each camera once.")
    cameras = [read_camera(folder, _of_camera(folder, options, name)) for name in names]
    robot, robot_files = _robot(folder, options, cameras)
    return SourceRecording(
        cameras=tuple(each.camera for each in cameras),
        robot=robot,
        label_names={},
        assumptions=_assumptions(cameras),
        files=tuple(dict.fromkeys([*(file for each in cameras for file in each.files), *robot_files])),
    )


def _of_camera(folder: Folder, options: FramesOptions, name: str) -> FramesOptions:
    """The options of one camera, whose name stands in the place of `{camera}`."""
    filled = {
        field: value.replace(CAMERA, name) for field, value in options if isinstance(value, str) and CAMERA in value
    }
    hand_eye = filled.get("gripper_from_camera")
    if hand_eye and not Path(hand_eye).is_file() and not folder.has(hand_eye):
        filled["gripper_from_camera"] = ""  # A camera that the robot does not carry.
    return options.model_copy(update={**filled, "camera": name})


def _robot(
    folder: Folder, options: FramesOptions, cameras: list[CameraOfFrames]
) -> tuple[RobotRecording | None, tuple[Path, ...]]:
    """Robot states from hand-eye poses and from the table."""
    carried = [each for each in cameras if each.world_from_gripper is not None]
    if options.gripper_from_camera and not carried:
        raise BadData(
            folder.path,
            "--gripper-from-camera",
            expected="a calibration of at least one camera",
            got=f"none for {options.camera}",
            fix="check the file's name, or leave the option out.",
        )
    if not carried and not options.robot:
        return None, ()
    n_frames = {each.camera.name: len(each.camera.frames) for each in cameras}
    if len(set(n_frames.values())) > 1:
        raise BadData(
            folder.path,
            "frames",
            expected="as many of each camera, for the robot's states",
            got=", ".join(f"{n} of {name}" for name, n in n_frames.items()),
            fix="remove the frames that not all cameras have, or ingest one camera at a time.",
        )
    world_from_gripper: Float[ndarray, "t 4 4"] | None = carried[0].world_from_gripper if carried else None
    if not options.robot:
        return RobotRecording(world_from_gripper), ()
    table = read_robot_table(folder, options.robot, next(iter(n_frames.values())))
    return table.recording(world_from_gripper), (table.path,)


def _assumptions(cameras: list[CameraOfFrames]) -> dict[str, str]:
    """Those of all cameras: once where they agree, otherwise under each camera's name."""
    merged: dict[str, str] = {}
    for key in cameras[0].assumptions:
        texts = {each.camera.name: each.assumptions[key] for each in cameras}
        if len(set(texts.values())) == 1:
            merged[key] = cameras[0].assumptions[key]
        else:
            merged |= {f"{name}: {key}": text for name, text in texts.items()}
    return merged
