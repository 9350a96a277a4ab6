"""What poses, depth, intrinsics and clock of a recording might mean, relative to how they were read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.core.readings_evidence import Trial

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


FLIPPED = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's camera axes to OpenGL's, and back."""

MIRRORED = np.diag([1.0, -1.0, 1.0, 1.0])
"""From a left-handed world and camera to right-handed ones."""


@dataclass(frozen=True)
class Readings:
    """World_from_cameras under each way that poses might be meant, the one as read first.

    Args:
        names: the fields of `Hypothesis` that say which.
        options: options of the format for a reading, and for another unit of its positions, by reading and factor.
    """

    poses: tuple[Float[ndarray, "t 4 4"], ...]
    names: tuple[Hypothesis, ...]
    options: dict[tuple[int, float], str]

    @classmethod
    def of(cls, told: Float[ndarray, "t 4 4"], otherwise: Mapping[str, Float[ndarray, "t 4 4"]]) -> Readings:
        """Those in general, and those of the format that are not among them."""
        poses, names = [], []
        for inverted, flipped, mirrored in product((False, True), repeat=3):
            meant = invert_rigid(told) if inverted else told
            meant = meant @ FLIPPED if flipped else meant
            poses.append(MIRRORED @ meant @ MIRRORED if mirrored else meant)
            names.append(Hypothesis(inverted, flipped, mirrored))
        options: dict[tuple[int, float], str] = {}
        for option, other in otherwise.items():
            known = [(i, factor) for i, each in enumerate(poses) if (factor := _pose_factor(each, other))]
            new = [key for key in known if key not in options]
            if new:
                options[new[0]] = option
            elif not known:
                options[len(poses), 1.0] = option
                poses.append(other)
                names.append(Hypothesis(otherwise=option))
        return cls(tuple(poses), tuple(names), options)

    def option(self, reading: int, pose_factor: float) -> tuple[str, bool]:
        """Options for a reading, and whether they state the unit of its positions, too."""
        for (i, factor), text in self.options.items():
            if i == reading and factor != 1 and abs(factor / pose_factor - 1) < 0.01:
                return text, True
        return self.options.get((reading, 1.0), ""), False


SAME_MOTION = 1e-5
"""Difference of rotations, and share of the distances, up to which two readings of poses are the same."""


def _pose_factor(told: Float[ndarray, "t 4 4"], other: Float[ndarray, "t 4 4"]) -> float:
    """Factor by which positions are larger under another reading that is the same otherwise; 0 if it is not."""
    a, b = invert_rigid(told[:1]) @ told, invert_rigid(other[:1]) @ other
    if np.abs(a[:, :3, :3] - b[:, :3, :3]).max() > SAME_MOTION:
        return 0.0
    along = float((a[:, :3, 3] ** 2).sum())
    factor = float((a[:, :3, 3] * b[:, :3, 3]).sum()) / along if along > 0 else 1.0
    apart = np.abs(factor * a[:, :3, 3] - b[:, :3, 3]).max()
    return round(factor, 6) if factor > 0 and apart <= SAME_MOTION * max(np.abs(b[:, :3, 3]).max(), 1e-9) else 0.0


PLAUSIBLE_SCENE = (0.05, 20.0)
"""Median depth, metres, of scenes that are recorded."""

POSE_FACTORS = (1e-3, 1e-2, 1e2, 1e3)
"""Units of positions that are mixed up: millimetres, centimetres and metres."""


NOT_A_UNIT = 0.04
"""Share by which the scale at which depth fits best is off that of a unit, from which on poses are rather without one,
as those of structure from motion. Noise of 2 % of depth and 5 mm of the poses moves it by 0.025."""


def hypothesis_of(trial: Trial, readings: Readings, median_depth: float, fine: float = 1.0) -> Hypothesis:
    """A trial in the terms of users. Whether depth or poses are in another unit is told by how far the scene is.

    Args:
        fine: factor of the scale at which depth fits best.
    """
    nearest, farthest = PLAUSIBLE_SCENE
    is_near = nearest <= median_depth <= farthest
    pose_factor = 1 / trial.scale
    is_pose = is_near and any(abs(pose_factor / each - 1) < 0.01 for each in POSE_FACTORS)
    if is_near and not nearest <= median_depth * trial.scale <= farthest:
        is_pose = True
    if trial.scale != 1 and is_near and abs(np.log(fine)) > NOT_A_UNIT:
        pose_factor, is_pose = pose_factor / fine, True
    return replace(
        readings.names[trial.reading],
        depth_factor=1.0 if is_pose else trial.scale,
        pose_factor=float(pose_factor) if is_pose else 1.0,
        K_factor=trial.K_factor,
        lag=trial.lag,
        ray={0: "as read", 1: "ray", -1: "z"}[trial.ray],  # type: ignore[arg-type]
    )
