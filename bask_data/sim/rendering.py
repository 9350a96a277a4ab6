"""Rendering of the world: colour, exact z-depth, labels, and camera poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray

from bask_data.sim import gripper
from bask_data.sim.engine import drawing, import_mujoco
from bask_data.sim.world import FAR, NEAR, World

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Camera axes: y down and z forward become y up and z backward."""


@dataclass(frozen=True)
class RenderedView:
    """An image of one camera without defects.

    Args:
        depth: z-depth, metres; 0 where no surface is visible.
        instance: label of the visible body; 0 for table and floor, 255 for the gripper.
        is_glass: whether the visible surface is transparent.
    """

    rgb: UInt8[ndarray, "h w 3"]
    depth: Float32[ndarray, "h w"]
    instance: UInt8[ndarray, "h w"]
    is_glass: Bool[ndarray, "h w"]
    world_from_camera: Float[ndarray, "4 4"]


def intrinsics(fov_deg: float, height: int, width: int) -> Float[ndarray, "3 3"]:
    """Pinhole matrix, pixels, for a vertical field of view in degrees; pixel (0, 0) is a centre."""
    focal = height / 2 / np.tan(np.radians(fov_deg) / 2)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])


class Renderer:
    """Renderer of a world, with two passes per image into one off-screen buffer for cameras of any size."""

    def __init__(self, world: World) -> None:
        mujoco = import_mujoco()
        self._mujoco, self._world = mujoco, world
        model = world.model
        self._gl, self._context = drawing(model)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 50)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        # Reversed depth stays precise at large distances.
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._option = mujoco.MjvOption()
        self._tables: tuple[UInt8[ndarray, " s"], Bool[ndarray, " s"]] | None = None

    @property
    def shows_gripper(self) -> bool:
        """Whether the gripper is rendered."""
        return bool(self._option.geomgroup[gripper.GROUP])

    @shows_gripper.setter
    def shows_gripper(self, shown: bool) -> None:
        self._option.geomgroup[gripper.GROUP] = shown

    def close(self) -> None:
        """Free the graphics memory."""
        self._context.free()
        self._gl.free()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def K(self, camera: str) -> Float[ndarray, "3 3"]:
        """Exact intrinsics (3, 3) of a camera at its image size, pixels."""
        return intrinsics(float(self._world.model.camera(camera).fovy[0]), *self._world.options.size(camera))

    def view(self, camera: str) -> RenderedView:
        """Image of a camera in the world's current state."""
        mujoco, scene = self._mujoco, self._scene
        height, width = self._world.options.size(camera)
        rect = mujoco.MjrRect(0, 0, width, height)
        self._gl.make_current()
        self._update(camera)
        rgb, ids = np.empty((2, height, width, 3), dtype=np.uint8)
        depth = np.empty((height, width), dtype=np.float32)
        mujoco.mjr_render(rect, scene, self._context)
        mujoco.mjr_readPixels(rgb, None, rect, self._context)
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            scene.flags[flag] = True
        # This pass renders glass opaque, so that depth and labels are of the same surface.
        mujoco.mjr_render(rect, scene, self._context)
        mujoco.mjr_readPixels(ids, depth, rect, self._context)
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            scene.flags[flag] = False
        # Colours are the numbers of the scene's geoms, low byte in red; they are assigned for each image.
        i_drawn = ids[::-1, :, 0].astype(np.uint16) + 256 * ids[::-1, :, 1].astype(np.uint16)
        labels, is_glass = self._lookup()
        return RenderedView(
            np.ascontiguousarray(rgb[::-1]),
            metric(depth[::-1]),
            labels[i_drawn],
            is_glass[i_drawn],
            self.world_from_camera(camera),
        )

    def _update(self, camera: str) -> None:
        mujoco = self._mujoco
        eye = mujoco.MjvCamera()
        eye.type, eye.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, self._world.model.camera(camera).id
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._world.model, self._world.data, self._option, None, eye, everything, self._scene)

    def _lookup(self) -> tuple[UInt8[ndarray, " s"], Bool[ndarray, " s"]]:
        """Label and transparency by a geom's number in the scene; every image has the same geoms."""
        if self._tables is None or len(self._tables[0]) != self._scene.ngeom + 1:
            labels = np.zeros(self._scene.ngeom + 1, dtype=np.uint8)
            is_glass = np.zeros(self._scene.ngeom + 1, dtype=bool)
            for drawn in self._scene.geoms[: self._scene.ngeom]:
                if drawn.objtype == self._mujoco.mjtObj.mjOBJ_GEOM and drawn.segid >= 0:
                    labels[drawn.segid + 1] = self._world.geom_labels[drawn.objid]
                    is_glass[drawn.segid + 1] = self._world.geom_is_glass[drawn.objid]
            self._tables = labels, is_glass
        return self._tables

    def world_from_camera(self, camera: str) -> Float[ndarray, "4 4"]:
        """Exact pose (4, 4) of a camera, metres; x right, y down, z forward."""
        eye: Any = self._world.data.camera(camera)
        transform = np.eye(4)
        transform[:3, :3] = eye.xmat.reshape(3, 3) @ OPENGL_FROM_OPENCV
        transform[:3, 3] = eye.xpos
        return transform


def metric(buffer: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """z-depth, metres, from the depth buffer, which is linear in 1 / z: 1 at the near plane, 0 at the far one."""
    near, far = np.float64(np.float32(NEAR)), np.float64(np.float32(FAR))
    inverse = buffer.astype(np.float64) * (1 / near - 1 / far) + 1 / far
    return np.where(buffer > 0, 1 / inverse, 0).astype(np.float32)
