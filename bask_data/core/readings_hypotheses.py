"""What poses, depth, intrinsics and clock of a recording might mean, relative to how they were read."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

RayIs = Literal["as read", "ray", "z"]
"""What depth values are: as read; read as z, but lengths of the ray; read as lengths of the ray, but z."""


@dataclass(frozen=True)
class Hypothesis:
    """One way to read a camera's recording, relative to the way it was read; the default is "as read".

    Args:
        inverted: poses are those of the other direction, camera_from_world for world_from_camera or the reverse.
        flipped: the camera's y and z axes point the other way: OpenGL for OpenCV, or the reverse.
        mirrored: poses are of a left-handed world and camera, y mirrored, as in Unity.
        otherwise: poses read by these options of the format, for instance in the other order of quaternions.
        depth_factor: depth in metres is so many times as large.
        pose_factor: positions of the poses in metres are so many times as large.
        K_factor: intrinsics along u and v are for images of another size and to be scaled by this, about the corner of
            the pixel grid.
        lag: frame i has the pose that was read for frame i + lag.
        ray: what depth values are.
    """

    inverted: bool = False
    flipped: bool = False
    mirrored: bool = False
    otherwise: str = ""
    depth_factor: float = 1.0
    pose_factor: float = 1.0
    K_factor: tuple[float, float] = (1.0, 1.0)
    lag: int = 0
    ray: RayIs = "as read"

    @property
    def reading(self) -> tuple[bool, bool, bool, str]:
        """How poses are meant, apart from units."""
        return (self.inverted, self.flipped, self.mirrored, self.otherwise)

    @property
    def scale(self) -> float:
        """How much larger depth is in comparison with poses: all that depth can tell of units."""
        return self.depth_factor / self.pose_factor

    @property
    def departures(self) -> tuple[str, ...]:
        """Names of the fields that differ from "as read"."""
        told = Hypothesis()
        return tuple(each.name for each in fields(self) if getattr(self, each.name) != getattr(told, each.name))

    @property
    def words(self) -> str:
        """What differs from "as read", in words."""
        kx, ky = self.K_factor
        said = {
            "otherwise": self.otherwise,
            "inverted": "the other direction of the poses",
            "flipped": "the other camera axes (OpenCV or OpenGL)",
            "mirrored": "a left-handed world (y mirrored)",
            "depth_factor": f"depth {self.depth_factor:.4g} times as large",
            "pose_factor": f"distances between the poses {self.pose_factor:.4g} times as large",
            "K_factor": f"intrinsics {kx:.3g} times as large"
            + (f" along u and {ky:.3g} times along v" if kx != ky else ""),
            "lag": f"poses of the frames {abs(self.lag)} {'later' if self.lag > 0 else 'earlier'}",
            "ray": "depth along z" if self.ray == "z" else "depth along the ray",
        }
        return ", ".join(said[name] for name in said if name in self.departures) or "as read"
