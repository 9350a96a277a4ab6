"""What `--cameras` adds to a robomimic file: depth as robomimic stores it, and all that `ingest robomimic` reads back.

robomimic's own `camera_info` has one K and one pose for each camera and demonstration, in float64 as text, so it cannot
hold cameras that move otherwise than in a hand, or zoom. It is written for the first frame; all frames are in
`cameras/<camera>`, beside `obs`, where robomimic does not look.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from bask_data.core.geometry import invert_rigid
from bask_data.export.calibration import calibration_values
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from bask_data.export.episodes import Episode

HAND = "eye_in_hand"
"""What names of cameras in the hand contain: robomimic relates their extrinsics to the gripper."""


def write_cameras(group: Any, episode: Episode) -> None:
    """Write depth, intrinsics, poses and times of the episode's cameras, and the robot as recorded, into its group."""
    values = calibration_values(episode)
    n = episode.entry.n_frames
    info = {}
    grippers = values.get("recorded_world_from_gripper")
    for name, camera in episode.cameras.items():
        _write_depth(group, name, episode)
        cameras = values[f"camera.{name}.world_from_camera"].reshape(n, 4, 4)
        intrinsics = values[f"camera.{name}.intrinsics"].reshape(n, 3, 3)
        beside = group.create_group(f"cameras/{name}")
        beside["world_from_camera"], beside["intrinsics"], beside["time"] = cameras, intrinsics, camera.time
        first = cameras[0]
        if HAND in name and grippers is not None:
            first = first @ invert_rigid(grippers[0].reshape(4, 4))
        info[name] = {"intrinsics": intrinsics[0].tolist(), "extrinsics": first.tolist()}
    group.attrs["camera_info"] = json.dumps(info)
    recorded = group.create_group("recorded")
    for name, shape in {"world_from_gripper": (n, 4, 4), "gripper_width": (n,), "action": (n, -1)}.items():
        if (stored := values.get(f"recorded_{name}")) is not None:
            recorded[name] = stored.reshape(shape)
    if episode.robot is not None and episode.robot.action_names:
        recorded.attrs["action_names"] = json.dumps(list(episode.robot.action_names))


def _write_depth(group: Any, name: str, episode: Episode) -> None:
    """Depth in metres, float32, of which the attribute `scale` is the unit: 16-bit integers are found again by it."""
    import numpy as np

    camera = episode.cameras[name]
    size = (camera.height, camera.width, 1)
    depth = group.create_dataset(
        f"obs/{name}_depth",
        (camera.n_frames, *size),
        "float32",
        chunks=(1, *size),
        compression="gzip",
        shuffle=True,
    )
    depth.attrs["scale"] = camera.depth_scale
    for i in progress(range(camera.n_frames), f"exporting depth of {name} of {episode.entry.name}"):
        metres: np.ndarray = camera.depth_raw(i) * np.float64(camera.depth_scale)
        depth[i] = metres[..., None]
