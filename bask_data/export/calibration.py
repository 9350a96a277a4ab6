"""What `--cameras` adds to an export: all that `ingest` needs to read a demonstration back with the same numbers.

Depth goes beside the images, in the way of each format.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bask_data.export.columns import Column

if TYPE_CHECKING:
    import numpy as np

    from bask_data.export.episodes import Episode, Episodes

_MATRIX_4 = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
_MATRIX_3 = tuple(f"m{row}{column}" for row in range(3) for column in range(3))

_OF_CAMERA = (
    ("world_from_camera", _MATRIX_4, "Camera to the source's world, row by row; x right, y down, z forward.", "metre"),
    ("intrinsics", _MATRIX_3, "Pinhole matrix, row by row; pixel (0, 0) is the centre of the top-left one.", "pixel"),
    ("depth_scale", (), "Metres per unit of the depth images; 0 in them means no measurement.", "metre"),
    ("time", (), "Time of the camera's frame, as recorded.", "second"),
)

_OF_ROBOT = (
    ("world_from_gripper", _MATRIX_4, "Gripper to the source's world, row by row.", "metre"),
    ("gripper_width", (), "Opening of the gripper.", "metre"),
    ("action", None, "Commanded action; units as recorded.", ""),
)


def calibration_columns(episodes: Episodes) -> list[Column]:
    """Columns of each camera, and the robot's states and actions in float64; none without `--cameras`."""
    if not episodes.settings.cameras:
        return []
    columns = [
        Column(f"camera.{camera}.{name}", values, "float64", description, units)
        for camera in episodes.cameras
        for name, values, description, units in _OF_CAMERA
    ]
    exported = {"world_from_gripper": "gripper_position", "gripper_width": "gripper_width", "action": "action"}
    for name, values, description, units in _OF_ROBOT:
        if episodes.has(exported[name]):
            names = episodes.column("action").values if values is None else values
            columns.append(Column(f"recorded_{name}", names, "float64", description, units))
    return columns


def calibration_values(episode: Episode) -> dict[str, np.ndarray]:
    """The values of `calibration_columns`, (t, width) or (t,) each."""
    import numpy as np

    n = episode.entry.n_frames

    def in_source(world_from_any: np.ndarray) -> np.ndarray:
        moved = world_from_any.copy()
        moved[:, :3, 3] += episode.origin
        return moved.reshape(n, 16)

    values: dict[str, np.ndarray] = {}
    for name, camera in episode.cameras.items():
        values[f"camera.{name}.world_from_camera"] = in_source(camera.world_from_cameras)
        values[f"camera.{name}.intrinsics"] = camera.Ks.reshape(n, 9)
        values[f"camera.{name}.depth_scale"] = np.full(n, camera.depth_scale)
        values[f"camera.{name}.time"] = camera.time
    robot = episode.robot
    if robot is not None and robot.world_from_gripper is not None:
        values["recorded_world_from_gripper"] = in_source(robot.world_from_gripper)
    if robot is not None and robot.gripper_width is not None:
        values["recorded_gripper_width"] = robot.gripper_width
    if robot is not None and robot.action is not None:
        values["recorded_action"] = robot.action
    return values
