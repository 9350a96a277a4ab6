"""Organised point clouds as frames: the depth, the colour, and the intrinsics of the camera that they came from."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

from bask_data.core.geometry import pixel_grid
from bask_data.errors import BadData
from bask_data.formats.pcd import Cloud, read_pcd

LARGEST_RESIDUAL = 0.5
"""Pixels by which points may miss the pixel that they are in, as the 95th percentile. Drivers make the points from
pixels, so real files have 1e-4; distorted images have several. Chosen, sensitivity not measured."""

LEAST_POINTS = 100
"""Points that intrinsics are fitted to, at least. Chosen, sensitivity not measured."""


@dataclass(frozen=True)
class CloudFiles:
    """The clouds of one camera, by frame; None where a frame has none."""

    clouds: tuple[Path | None, ...]
    _last: dict[int, Cloud] = field(default_factory=dict, repr=False, compare=False)
    """The cloud read last: its colour and its depth are asked for one after the other."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that there are."""
        return tuple(path for path in self.clouds if path is not None)

    @cached_property
    def size(self) -> tuple[int, int]:
        """(height, width) of the first cloud, pixels."""
        cloud = read_organised(self.files[0])
        return cloud.height, cloud.width

    @cached_property
    def has_color(self) -> bool:
        """Whether the first cloud has colours."""
        return read_organised(self.files[0]).color is not None

    def read_color(self, i: int) -> UInt8[ndarray, "h w 3"]:
        cloud = self._cloud(i)
        color = cloud.color
        if color is None:
            path = self.clouds[i]
            assert path is not None
            raise BadData(path, "rgb", expected="colours as in the first cloud", got="none", fix="pass --color.")
        return color

    def read_depth(self, i: int) -> Float32[ndarray, "h w"]:
        cloud = self._cloud(i)
        z = cloud.columns["z"].reshape(cloud.height, cloud.width).astype(np.float32)
        return np.where(np.isfinite(z) & (z > 0), z, np.float32(0))

    def intrinsics(self) -> tuple[Float[ndarray, "3 3"], float]:
        """K that the points of the first cloud with enough points were made with, and by how many pixels they miss it
        (95th percentile).

        Raises:
            BadData: no cloud has enough points.
        """
        for path in self.files:
            cloud = read_organised(path)
            points = _points(cloud)
            good = np.isfinite(points).all(axis=2) & (points[..., 2] > 0)
            if good.sum() >= LEAST_POINTS:
                return _fitted(points[good], pixel_grid(cloud.height, cloud.width)[good])
        raise BadData(
            self.files[0],
            "cloud",
            expected=f"at least {LEAST_POINTS} points in some cloud, to find the intrinsics",
            got="fewer",
            fix="pass --intrinsics fx,fy,cx,cy.",
        )

    def residual(self, K: Float[ndarray, "3 3"]) -> float:
        """Pixels by which the first cloud's points miss their pixels with other intrinsics (95th percentile)."""
        cloud = read_organised(self.files[0])
        points = _points(cloud)
        good = np.isfinite(points).all(axis=2) & (points[..., 2] > 0)
        return _residual(points[good], pixel_grid(cloud.height, cloud.width)[good], K) if good.any() else 0.0

    def _cloud(self, i: int) -> Cloud:
        if (last := self._last.get(i)) is not None:
            return last
        path = self.clouds[i]
        assert path is not None  # Frames without a file are in the faults of the recording, and are not read.
        cloud = read_organised(path)
        if (cloud.height, cloud.width) != self.size:
            raise BadData(
                path,
                "size",
                expected=f"{self.size[1]} x {self.size[0]} as in {self.files[0].name}",
                got=f"{cloud.width} x {cloud.height}",
                fix="read the frames of one size: --frames FIRST:END, or --skip-bad.",
            )
        self._last.clear()
        self._last[i] = cloud
        return cloud


def read_organised(path: Path) -> Cloud:
    """A cloud that is an image: with a point for each pixel, row by row; `BadData` for another one."""
    cloud = read_pcd(path)
    missing = [axis for axis in "xyz" if axis not in cloud.columns or cloud.columns[axis].ndim != 1]
    if missing or min(cloud.height, cloud.width) < 2:
        raise BadData(
            path,
            "cloud",
            expected="an organised cloud with x, y and z, of HEIGHT above 1",
            got=f"no {', '.join(missing)}" if missing else f"{cloud.width} x {cloud.height}: a list of points",
            fix="save the cloud as the camera gave it, before points are removed or moved.",
        )
    return cloud


def _points(cloud: Cloud) -> Float[ndarray, "h w 3"]:
    columns = [cloud.columns[axis].astype(np.float64) for axis in "xyz"]
    return np.stack(columns, axis=-1).reshape(cloud.height, cloud.width, 3)


def _fitted(points: Float[ndarray, "n 3"], uv: Float[ndarray, "n 2"]) -> tuple[Float[ndarray, "3 3"], float]:
    K = np.eye(3)
    for axis in (0, 1):
        columns = np.stack([points[:, axis] / points[:, 2], np.ones(len(points))], axis=1)
        K[axis, axis], K[axis, 2] = np.linalg.lstsq(columns, uv[:, axis], rcond=None)[0]
    return K, _residual(points, uv, K)


def _residual(points: Float[ndarray, "n 3"], uv: Float[ndarray, "n 2"], K: Float[ndarray, "3 3"]) -> float:
    seen = points @ K.T
    return float(np.percentile(np.abs(seen[:, :2] / seen[:, 2:] - uv).max(axis=1), 95))
