"""The first half of a tracker's step: images in, observations of the keypoints out. It knows no earlier frame.

Nearly all of a step's time is the network's. `every` and `scale` save it: most frames without the network, or a smaller
image in it; `docs/runtime.md` says what they cost.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bask_data.core.filters.observation import Observation, fitted
from bask_data.core.geometry import invert_rigid, project, rigid_fault, transform
from bask_data.errors import BadData
from bask_data.kinds import Camera, ReferenceKeypoints

if TYPE_CHECKING:
    import torch

    from bask_data.nn.network import DescriptorNetwork

    Described = list[tuple[list[str], torch.Tensor]]
    """Descriptors at stride 8 of the images of one size, and the names of their cameras."""


class Moment(NamedTuple):
    """Images, depths, intrinsics and poses of one time by camera: the arguments of `KeypointTracker.step`."""

    images: Mapping[str, np.ndarray]
    depths: Mapping[str, np.ndarray]
    intrinsics: Mapping[str, np.ndarray]
    world_from_cameras: Mapping[str, np.ndarray]


def moment_of(cameras: Iterable[Camera], i_frame: int) -> Moment:
    """A frame of recorded cameras, as the arguments of `KeypointTracker.look` and `step`."""
    cameras = list(cameras)
    return Moment(
        images={camera.name: camera.rgb(i_frame) for camera in cameras},
        depths={camera.name: camera.depth(i_frame) for camera in cameras},
        intrinsics={camera.name: camera.Ks[i_frame] for camera in cameras},
        world_from_cameras={camera.name: camera.world_from_cameras[i_frame] for camera in cameras},
    )


@dataclass(frozen=True)
class View:
    """Where a camera looks, without what it sees."""

    K: np.ndarray
    world_from_camera: np.ndarray

    def pixels(self, points_world: np.ndarray) -> np.ndarray:
        """Pixels (k, 2) of points (k, 3), metres, world frame; NaN behind the camera."""
        return project(transform(invert_rigid(self.world_from_camera), points_world), self.K)[0]


@dataclass(frozen=True)
class FrameObservations:
    """Observations of the keypoints in one frame.

    Args:
        observations: by camera.
        sizes: by camera, (height, width) of its image, pixels.
        between: by camera, of those whose frame did not go through the network.
    """

    observations: dict[str, Observation]
    sizes: dict[str, tuple[int, int]]
    between: dict[str, View] = field(default_factory=dict)


class FrameObserver:
    """Observation of reference keypoints by a network, frame by frame."""

    def __init__(
        self, network: DescriptorNetwork, reference: ReferenceKeypoints, every: int = 1, scale: float = 1.0
    ) -> None:
        """Prepare the network for inference.

        Args:
            network: stays as it is.
            every, scale: of `KeypointTracker`.

        Raises:
            BadData: the network's descriptors have another dimension than the references.
            ValueError: `every` is not a whole number of at least 1, or `scale` is not above 0 and at most 1.
        """
        if not isinstance(every, int | np.integer) or every < 1:
            raise ValueError(f"every: expected a whole number of at least 1, got {every!r}")
        self._references = _fitting(reference, network)
        self._network = network if scale == 1 else network.at_scale(scale)
        self._every = every

    def describe(self, images: Mapping[str, np.ndarray], cameras: Sequence[str], i_step: int) -> Described:
        """Descriptors of the images whose turn it is; those of one size form a batch.

        Cameras take turns, so that with as many cameras as `every` each step takes about as long. In the first step
        all of them are described.

        Args:
            cameras: names of all cameras so far, in order.
            i_step: number of steps before.
        """
        check_dicts(images=images)
        order = [*cameras, *(name for name in sorted(images) if name not in cameras)]
        by_size: dict[tuple[int, ...], list[str]] = {}
        for name in sorted(images):
            if i_step == 0 or (i_step + order.index(name)) % self._every == 0:
                by_size.setdefault(images[name].shape, []).append(name)
        return [(names, self._network.cells(np.stack([images[name] for name in names]))) for names in by_size.values()]

    def look(self, moment: Moment, described: Described) -> FrameObservations:
        """Observations of a frame from its descriptors, by those cameras that are described."""
        # Copies, as a robot may reuse its arrays, and a belief refers to the previous frame.
        views = {
            name: View(
                K=np.array(moment.intrinsics[name], dtype=np.float64),
                world_from_camera=np.array(moment.world_from_cameras[name], dtype=np.float64),
            )
            for name in sorted(moment.images)
        }
        distances: dict[str, np.ndarray] = {}
        for names, cells in described:
            distances |= dict(zip(names, self._network.maps(cells, self._references), strict=True))
        return FrameObservations(
            observations={
                name: fitted(
                    Observation(
                        distance=distances[name],
                        depth=np.where(np.isfinite(moment.depths[name]), moment.depths[name], 0),
                        K=view.K,
                        world_from_camera=view.world_from_camera,
                    )
                )
                for name, view in views.items()
                if name in distances
            },
            sizes={name: (image.shape[0], image.shape[1]) for name, image in moment.images.items()},
            between={name: view for name, view in views.items() if name not in distances},
        )


def check_moment(moment: Moment) -> None:
    """Raise `ValueError` for inputs that would silently corrupt the belief."""
    check_dicts(**moment._asdict())
    for name, image in moment.images.items():
        K, world_from_camera = (
            None if values.get(name) is None else np.asarray(values[name], dtype=np.float64)
            for values in (moment.intrinsics, moment.world_from_cameras)
        )
        _check(name, image, moment.depths.get(name), K, world_from_camera)


def check_dicts(**arguments: object) -> None:
    """Raise `ValueError` for arguments that are not by camera name."""
    for name, value in arguments.items():
        if not isinstance(value, Mapping):
            got = f"an array {value.shape}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
            raise ValueError(f"{name}: expected a dict by camera name, got {got}")


def _fitting(reference: ReferenceKeypoints, network: DescriptorNetwork) -> np.ndarray:
    """Reference descriptors (k, d); `BadData` if the network's have another dimension."""
    descriptors, dimension = reference.descriptors, network.settings.descriptor_dim
    if descriptors.shape[1] != dimension:
        raise BadData(
            reference.path,
            "descriptors",
            expected=f"{dimension} values each, as from the network",
            got=f"{descriptors.shape[1]}",
            fix="run `bask-data reference` again with this network.",
        )
    return descriptors


def _check(
    name: str,
    image: np.ndarray,
    depth: np.ndarray | None,
    K: np.ndarray | None,
    world_from_camera: np.ndarray | None,
) -> None:
    """Raise `ValueError` for inputs that would silently corrupt the belief."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise ValueError(f"camera {name}: image: expected (h, w, 3) uint8, got {image.shape} {image.dtype}")
    if depth is None or depth.shape != image.shape[:2] or not np.issubdtype(depth.dtype, np.floating):
        got = "none" if depth is None else f"{depth.shape} {depth.dtype}"
        raise ValueError(f"camera {name}: depth: expected {image.shape[:2]} in metres, as for the image, got {got}")
    if K is None or K.shape != (3, 3):
        raise ValueError(f"camera {name}: intrinsics: expected (3, 3), got {'none' if K is None else K.shape}")
    if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(
            f"camera {name}: intrinsics: expected finite numbers and positive focal lengths, got {K.tolist()}"
        )
    fault = "none" if world_from_camera is None else transform_fault(world_from_camera)
    if fault:
        raise ValueError(f"camera {name}: world_from_camera: expected a rigid transform (4, 4), got {fault}")


def transform_fault(matrix: np.ndarray) -> str:
    """Why a transform is not rigid; empty if it is."""
    return rigid_fault(matrix) if matrix.shape == (4, 4) else f"{matrix.shape}"
