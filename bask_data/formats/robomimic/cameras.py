"""Cameras of a robomimic demonstration: images and depth in `obs`, calibration in the attribute `camera_info`.

For a camera in the hand, `extrinsics` is not gripper_from_camera, as the comment in robomimic's `get_camera_info` says:
the code computes world_from_camera @ inverse(world_from_gripper) at the first frame, which is undone here. The gripper
is the site of the controller, whose rotation is `robot0_eef_quat_site`; `robot0_eef_quat` is that of the hand's body.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import invert_rigid
from bask_data.core.lens import Lens, one_if_same
from bask_data.errors import BadData
from bask_data.formats.hdf5 import Hdf5File
from bask_data.formats.options.robomimic import RobomimicOptions
from bask_data.formats.poses import parse_transform
from bask_data.formats.recording import SourceCamera
from bask_data.formats.robomimic.depth import robomimic_depth
from bask_data.formats.simulated import at_pixel_centres

HAND = "eye_in_hand"
"""What names of cameras in the hand contain, by which robomimic tells them from fixed ones."""


def unusable(file: Hdf5File, demo: str, info: dict[str, Any], options: RobomimicOptions) -> dict[str, str]:
    """For each camera why it cannot be used; empty if it can."""
    there = file.members(f"{demo}/obs")
    reasons = {}
    for camera in [name.removesuffix("_image") for name in there if name.endswith("_image")]:
        is_exported = file.is_group(f"{demo}/cameras/{camera}")
        lacking = [] if f"{camera}_depth" in there else [f"{camera}_depth"]
        lacking += [] if is_exported or isinstance(info.get(camera), dict) else ["camera_info"]
        if lacking:
            reason = f"no {' and '.join(lacking)}: extract the observations with robomimic 0.4 or later and --depth"
        else:
            reason = _without_hand(camera, there, options) if HAND in camera and not is_exported else ""
        reasons[camera] = reason
    return reasons


def _without_hand(camera: str, there: list[str], options: RobomimicOptions) -> str:
    """Why the hand's pose is unknown, to which the camera's refers; empty if it is known."""
    prefix = _robot_of(camera)
    site, body = f"{prefix}eef_quat_site", f"{prefix}eef_quat"
    known = site in there or (options.site_turn is not None and body in there)
    lacking = [
        name for name, is_there in ((f"{prefix}eef_pos", f"{prefix}eef_pos" in there), (site, known)) if not is_there
    ]
    if not lacking:
        return ""
    reason = f"no {' and '.join(lacking)}, the pose of the hand that camera_info refers to"
    if known or body not in there:
        return reason
    return (
        f"{reason}: robosuite 1.5 and later write it; {body} is of the hand's body, a Panda's by a quarter turn about "
        "z away: pass --site-turn 90 or -90; depth agrees with one of them"
    )


def _robot_of(camera: str) -> str:
    """Prefix of the states of the robot that carries a camera: robot0_ for robot0_eye_in_hand."""
    return camera.split("_")[0] + "_"


def hand_poses(
    file: Hdf5File, demo: str, prefix: str, n_frames: int, options: RobomimicOptions
) -> tuple[Float[ndarray, "t 4 4"] | None, str]:
    """world_from_gripper at the controller's site, and a statement on it.

    Without the site's rotation, that of the hand's body, turned by `--site-turn` if given.
    """
    there = file.members(f"{demo}/obs")
    is_site = f"{prefix}eef_quat_site" in there
    quaternion = f"{prefix}eef_quat_site" if is_site else f"{prefix}eef_quat"
    if not {f"{prefix}eef_pos", quaternion} <= set(there):
        return None, f"no {prefix}eef_pos and {prefix}eef_quat_site"
    position = file.array(f"{demo}/obs/{prefix}eef_pos", (n_frames, 3)).astype(np.float64)
    quat_xyzw = file.array(f"{demo}/obs/{quaternion}", (n_frames, 4)).astype(np.float64)
    where = f"{file.path}: {demo}/obs/{quaternion}"
    poses = np.stack([parse_transform(where, [*p, *q]) for p, q in zip(position, quat_xyzw, strict=True)])
    about = f"world_from_gripper from {prefix}eef_pos and {quaternion} (x y z w)"
    if is_site:
        return poses, f"{about}, the controller's site"
    if options.site_turn is None:
        return poses, f"{about}: rotation of the hand's body, not of the controller's site"
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_euler("z", options.site_turn, degrees=True).as_matrix()
    return poses, f"{about}, turned about z by {options.site_turn:g} degrees to the controller's site (--site-turn)"


class RobomimicCamera:
    """One camera of a demonstration."""

    def __init__(self, file: Hdf5File, demo: str, name: str, info: dict[str, Any], options: RobomimicOptions) -> None:
        self._file, self._demo, self.name, self._options = file, demo, name, options
        self._color = file.color(f"{demo}/obs/{name}_image")
        self.n_frames, height, width, _ = self._color.shape
        self._size = (height, width)
        place = f"{demo}/obs/{name}_depth"
        flat = (self.n_frames, height, width)
        self._depth = file.frames(place, (*flat, 1) if len(file.shape(place)) == 4 else flat, "fu")
        scale = file.attribute(place, "scale")
        self._scale = scale if isinstance(scale, float) and 0 < scale < np.inf else None
        self._calibration = f"{demo}/cameras/{name}"
        self.otherwise: dict[str, Float[ndarray, "t 4 4"]] = {}
        if file.is_group(self._calibration):
            self._poses = file.array(f"{self._calibration}/world_from_camera", (self.n_frames, 4, 4))
            K = file.array(f"{self._calibration}/intrinsics", (self.n_frames, 3, 3))
            self._K = one_if_same(K)
            self.about_K, self.about_poses = "as they were exported", "world_from_camera as it was exported"
        else:
            K = np.tile(self._matrix(info, "intrinsics", 3), (self.n_frames, 1, 1))
            self._K, self.about_K = at_pixel_centres(K, self._size)
            self._poses, self.about_poses = self._by_info(self._matrix(info, "extrinsics", 4))
        self._read_depth, self._unit, self.about_depth = robomimic_depth(file.path, self._depth, self._scale, options)

    def read(self, time: Float[ndarray, " t"]) -> SourceCamera:
        if self._file.has(place := f"{self._calibration}/time"):
            time = self._file.array(place, (self.n_frames,))
        return SourceCamera(
            name=self.name,
            frames=tuple(map(str, range(self.n_frames))),
            lens=Lens(self._K, self._size),
            world_from_cameras=self._poses,
            time=time,
            color=self._color,
            depth=self._read_depth,
            depth_scale=self._unit,
            pose_places=tuple(f"{self._file.path}: {self._demo}: {self.name} frame {i}" for i in range(self.n_frames)),
            otherwise=self.otherwise,
        )

    def _matrix(self, info: dict[str, Any], key: str, n: int) -> Float[ndarray, "n n"]:
        try:
            matrix = np.array(info.get(key), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.zeros(0)
        if matrix.shape != (n, n) or not np.isfinite(matrix).all():
            field = f"{self._demo} attribute camera_info: {self.name}: {key}"
            raise BadData(self._file.path, field, expected=f"a {n}x{n} matrix", got=f"shape {matrix.shape}")
        return matrix

    def _by_info(self, extrinsics: Float[ndarray, "4 4"]) -> tuple[Float[ndarray, "t 4 4"], str]:
        """world_from_camera of each frame, and a statement on it."""
        if HAND not in self.name:
            return np.tile(extrinsics, (self.n_frames, 1, 1)), "extrinsics of a fixed camera is world_from_camera"
        taken = self._options
        other = "robomimic" if taken.hand_extrinsics == "gripper_from_camera" else "gripper_from_camera"
        readings: dict[str, dict[str, Any]] = {f"--hand-extrinsics {other}": {"hand_extrinsics": other}}
        if taken.site_turn:
            readings[f"--site-turn {-taken.site_turn:g}"] = {"site_turn": -taken.site_turn}
        for name, changed in readings.items():
            self.otherwise[name] = self._in_hand(extrinsics, taken.model_copy(update=changed))
        about = "extrinsics of a camera in the hand is " + (
            "world_from_camera @ inverse(world_from_gripper) of the first frame, as robomimic computes it; undone"
            if taken.hand_extrinsics == "robomimic"
            else "gripper_from_camera (--hand-extrinsics)"
        )
        return self._in_hand(extrinsics, taken), about

    def _in_hand(self, extrinsics: Float[ndarray, "4 4"], options: RobomimicOptions) -> Float[ndarray, "t 4 4"]:
        """world_from_camera of a camera in the hand, as the options read `extrinsics`."""
        grippers, _ = hand_poses(self._file, self._demo, _robot_of(self.name), self.n_frames, options)
        assert grippers is not None, "unusable() has looked"
        if options.hand_extrinsics == "gripper_from_camera":
            return grippers @ extrinsics
        return grippers @ (invert_rigid(grippers[0]) @ extrinsics @ grippers[0])
