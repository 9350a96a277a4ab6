"""One analytic recording, to be written in any convention: every reader must give back the same numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from tests.scenes import intrinsics, orbit, tabletop

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

FARTHEST = 2.5
"""Metres that the camera sees."""


@dataclass(frozen=True)
class Views:
    """Images of a tabletop with everything that is known of them.

    Args:
        poses: world_from_cameras in OpenCV axes, metres.
        depth_mm: z-depth, 0 where nothing is seen.
        time: seconds.
    """

    K: Float[ndarray, "3 3"]
    poses: Float[ndarray, "t 4 4"]
    color: UInt8[ndarray, "t h w 3"]
    depth_mm: UInt16[ndarray, "t h w"]
    time: Float[ndarray, " t"]

    @property
    def n(self) -> int:
        return len(self.poses)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width), pixels."""
        return self.color.shape[1], self.color.shape[2]

    @property
    def K_text(self) -> str:
        """fx,fy,cx,cy."""
        return ",".join(f"{value:.12g}" for value in (self.K[0, 0], self.K[1, 1], self.K[0, 2], self.K[1, 2]))

    @property
    def metres(self) -> Float[ndarray, "t h w"]:
        """Depth as float32, NaN where nothing is seen."""
        return np.where(self.depth_mm > 0, self.depth_mm / 1000, np.nan).astype(np.float32)

    @property
    def camera_from_world(self) -> Float[ndarray, "t 4 4"]:
        return np.linalg.inv(self.poses)


def rendered(n: int = 6, height: int = 72, width: int = 96) -> Views:
    """A camera that moves around a table with three objects, 10 images a second."""
    scene, K = tabletop(3, seed=3, spread=0.12), intrinsics(height, width)
    poses = orbit(n, radius=0.5, n_turns=0.5)
    views = [scene.render(K, pose, height, width) for pose in poses]
    color = np.stack([view.rgb for view in views])
    depth = np.stack([view.depth for view in views])
    depth_mm = np.rint(1000 * np.where(depth < FARTHEST, depth, 0)).astype(np.uint16)
    return Views(K, poses, color, depth_mm, 1700000000 + np.arange(n) / 10)
