"""Tracking of keypoints on a running robot, frame by frame, as `bask-data encode` does in a demonstration.

    tracker = KeypointTracker(descriptor, reference)
    keypoints = tracker.step(images, depths, intrinsics, world_from_cameras, world_from_gripper)

`docs/runtime.md` shows a complete loop.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from bask_data.artifact import MANIFEST
from bask_data.core.filters.belief_arrays import from_arrays, to_arrays
from bask_data.core.filters.observation import Motion, Observation, PixelMaps, WeightedPoints, fitted
from bask_data.core.filters.step import step
from bask_data.core.filters.table import DEFAULT, FilterSettings, filter_of, settings_named
from bask_data.core.geometry import rigid_fault, scale_pixels
from bask_data.errors import BadData
from bask_data.kinds import Camera, DescriptorNet, ReferenceKeypoints

Kind = TypeVar("Kind", DescriptorNet, ReferenceKeypoints)

if TYPE_CHECKING:
    import torch

    from bask_data.nn.network import DescriptorNetwork

    Described = list[tuple[list[str], torch.Tensor]]
    """Descriptors at stride 8 of the images of one size, and the names of their cameras."""


@dataclass(frozen=True)
class TrackedKeypoints:
    """The belief of k keypoints after a frame, metres, world frame; NaN where not localised yet.

    Args:
        mean: (k, 3).
        covariance: (k, 3, 3), square metres: the uncertainty.
        mode: (k, 3), most likely positions.
        n_eff: (k,) effective sample size.
        log_evidence: (k,) log of the evidence of this frame under the belief before it.
        pixel: by camera, (k, 2) projected means, which may be outside the image; NaN behind the camera, and for a
            camera without a frame.
        observed: by camera, (k,), whether it more likely than not sees the keypoint.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray
    mode: np.ndarray
    n_eff: np.ndarray
    log_evidence: np.ndarray
    pixel: dict[str, np.ndarray]
    observed: dict[str, np.ndarray]


class Moment(NamedTuple):
    """Images, depths, intrinsics and poses of one time by camera: the arguments of `KeypointTracker.step`."""

    images: dict[str, np.ndarray]
    depths: dict[str, np.ndarray]
    intrinsics: dict[str, np.ndarray]
    world_from_cameras: dict[str, np.ndarray]


def moment_of(cameras: Iterable[Camera], i_frame: int) -> Moment:
    """A frame of recorded cameras, as the arguments of `KeypointTracker.look` and `step`."""
    cameras = list(cameras)
    return Moment(
        images={camera.name: camera.rgb(i_frame) for camera in cameras},
        depths={camera.name: camera.depth(i_frame) for camera in cameras},
        intrinsics={camera.name: camera.K for camera in cameras},
        world_from_cameras={camera.name: camera.world_from_cameras[i_frame] for camera in cameras},
    )


@dataclass(frozen=True)
class FrameObservations:
    """Observations of the keypoints in one frame.

    Args:
        observations: by camera.
        sizes: by camera, (height, width) of its image, pixels.
    """

    observations: dict[str, Observation]
    sizes: dict[str, tuple[int, int]]


class KeypointTracker:
    """Tracker of reference keypoints in the frames of any number of cameras."""

    def __init__(
        self,
        descriptor: DescriptorNet | DescriptorNetwork | Path | str,
        reference: ReferenceKeypoints | Path | str,
        settings: FilterSettings | None = None,
        seed: int = 0,
        device: torch.device | str | None = None,
        cameras: Sequence[str] | None = None,
    ) -> None:
        """Load the network.

        Args:
            descriptor: network, or its path in a dataset, `ROOT/descriptor/main`.
            reference: reference keypoints, or their path in a dataset, `ROOT/reference/main`.
            settings: settings of a filter, whose type selects it; see `core.filters.table.settings_named`. Default:
                the particle filter's.
            seed: seed of the filter's random numbers.
            device: device of the network. Default: the GPU if there is one.
            cameras: names in the filter's order. Default: in the order of their first frames, then by name.

        Raises:
            BadData: a path holds no such artifact, the network does not load, or its descriptors have another
                dimension than the references.
        """
        if isinstance(descriptor, str | Path):
            descriptor = _existing(DescriptorNet, descriptor)
        if not isinstance(reference, ReferenceKeypoints):
            reference = _existing(ReferenceKeypoints, reference)
        network = descriptor.network() if isinstance(descriptor, DescriptorNet) else descriptor
        self.names = tuple(reference.names)
        self._network = network if device is None else network.to(device)
        self._references = _fitting(reference, self._network)
        self._settings, self._seed, self._given = settings or settings_named(DEFAULT), seed, tuple(cameras or ())
        self.reset()

    def __repr__(self) -> str:
        settings, cameras = type(self._settings).__name__, ", ".join(self.cameras) or "none yet"
        return f"KeypointTracker({len(self.names)} keypoints, {settings}, cameras: {cameras}, steps: {self.n_steps})"

    def reset(self) -> None:
        """Return to the state before the first frame."""
        self._rng = np.random.default_rng(self._seed)
        self._world_from_gripper: np.ndarray | None = None
        self._sizes: dict[str, tuple[int, int]] = {}
        self.n_steps = 0
        """Number of steps."""
        self.cameras = list(self._given)
        """Names of the cameras so far."""
        self.belief: Any = None
        """The filter's belief; None before the first step."""
        self.observations: dict[str, Observation] = {}
        """Observations of the last step, by camera."""

    def step(
        self,
        images: Mapping[str, np.ndarray],
        depths: Mapping[str, np.ndarray],
        intrinsics: Mapping[str, np.ndarray],
        world_from_cameras: Mapping[str, np.ndarray],
        world_from_gripper: np.ndarray | None = None,
    ) -> TrackedKeypoints:
        """Update the belief with a frame. A camera without a frame is omitted from `images`.

        Args:
            images: by camera, (h, w, 3) uint8, RGB.
            depths: by camera, z-depth (h, w) metres, registered to the image; 0, NaN and infinity mean no measurement.
            intrinsics: by camera, (3, 3) pixels; pixel (0, 0) is the centre of the top-left pixel.
            world_from_cameras: by camera, (4, 4) metres; camera x right, y down, z forward.
            world_from_gripper: (4, 4) metres, if known: grasped objects move with it.

        Raises:
            ValueError: an argument is not a dict by camera name, or an input of a camera is missing or has another
                shape.
        """
        return self.update(self.look(images, depths, intrinsics, world_from_cameras), world_from_gripper)

    def describe(self, images: Mapping[str, np.ndarray]) -> Described:
        """Descriptors of the images, which take nearly all of a step's time; images of one size form a batch."""
        _check_dicts(images=images)
        by_size: dict[tuple[int, ...], list[str]] = {}
        for name in sorted(images):
            by_size.setdefault(images[name].shape, []).append(name)
        return [(names, self._network.cells(np.stack([images[name] for name in names]))) for names in by_size.values()]

    def look(
        self,
        images: Mapping[str, np.ndarray],
        depths: Mapping[str, np.ndarray],
        intrinsics: Mapping[str, np.ndarray],
        world_from_cameras: Mapping[str, np.ndarray],
        described: Described | None = None,
    ) -> FrameObservations:
        """The first half of a step: observations of a frame, independent of earlier ones. Arguments as for `step`.

        Args:
            described: result of `describe` for these images, if already computed.
        """
        _check_dicts(images=images, depths=depths, intrinsics=intrinsics, world_from_cameras=world_from_cameras)
        # Copies, as a robot may reuse its arrays, and a belief refers to the previous frame.
        K = {name: np.array(intrinsics[name], dtype=np.float64) for name in images if name in intrinsics}
        poses = {
            name: np.array(world_from_cameras[name], dtype=np.float64) for name in images if name in world_from_cameras
        }
        for name, image in images.items():
            _check(name, image, depths.get(name), K.get(name), poses.get(name))
        distances = self._distances(self.describe(images) if described is None else described)
        return FrameObservations(
            observations={
                name: fitted(
                    Observation(
                        distance=distances[name],
                        depth=np.where(np.isfinite(depths[name]), depths[name], 0),
                        K=K[name],
                        world_from_camera=poses[name],
                    )
                )
                for name in sorted(images)
            },
            sizes={name: (image.shape[0], image.shape[1]) for name, image in images.items()},
        )

    def update(self, look: FrameObservations, world_from_gripper: np.ndarray | None = None) -> TrackedKeypoints:
        """The second half of a step: update of the belief, without the network.

        Raises:
            ValueError: the gripper's transform is not rigid, or the size of a camera's images has changed.
        """
        gripper = None if world_from_gripper is None else np.array(world_from_gripper, dtype=np.float64)
        fault = "" if gripper is None else _fault(gripper)
        if fault:
            raise ValueError(f"world_from_gripper: expected a rigid transform (4, 4), got {fault}")
        for name, size in look.sizes.items():
            if self._sizes.setdefault(name, size) != size:
                raise ValueError(f"camera {name}: image: expected {self._sizes[name]} as before, got {size}")
        self.cameras += [name for name in sorted(look.observations) if name not in self.cameras]
        self.observations = look.observations
        self.n_steps += 1
        seen = [look.observations.get(name) for name in self.cameras]
        self.belief, estimate = step(
            self.belief, seen, self._moved(gripper), self._rng, self._settings, len(self.names)
        )
        pixel = {
            name: scale_pixels(estimate.pixel[i], view.depth.shape, look.sizes[name]) if view else estimate.pixel[i]
            for i, (name, view) in enumerate(zip(self.cameras, seen, strict=True))
        }
        return TrackedKeypoints(
            names=self.names,
            mean=estimate.mean,
            covariance=estimate.covariance,
            mode=estimate.mode,
            n_eff=estimate.n_eff,
            log_evidence=estimate.log_evidence,
            pixel=pixel,
            observed={name: estimate.observed[i] for i, name in enumerate(self.cameras)},
        )

    def hypotheses(self) -> WeightedPoints | PixelMaps:
        """The whole belief after the last step, as particles or pixel maps, these in the order of `cameras`."""
        seen = [self.observations.get(name) for name in self.cameras]
        belief: WeightedPoints | PixelMaps = filter_of(self._settings).hypotheses(self.belief, seen, self._settings)
        return belief

    def save(self, file: Path | str) -> None:
        """Write the state that the next step depends on, atomically."""
        from safetensors.numpy import save_file

        file = Path(file)
        arrays = to_arrays(self.belief)
        if self._world_from_gripper is not None:
            arrays["gripper"] = self._world_from_gripper
        words = {"n_steps": self.n_steps, "cameras": self.cameras, "rng": self._rng.bit_generator.state}
        part = file.with_name(f"{file.name}.part")
        whole = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        try:
            save_file(whole, part, {"state": json.dumps(words)})
            with part.open("rb") as handle:
                os.fsync(handle.fileno())
            part.replace(file)
        finally:
            part.unlink(missing_ok=True)

    def load(self, file: Path | str) -> None:
        """Restore a state written by `save`, with the same network, references, settings and seed.

        Raises:
            BadData: the file is not such a state.
        """
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(file, framework="np") as opened:
                words = json.loads(opened.metadata()["state"])
                arrays = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
            self.belief = from_arrays(arrays, self._settings)
            self._rng.bit_generator.state = words["rng"]
            self.n_steps, self.cameras = int(words["n_steps"]), list(words["cameras"])
        except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
            got, fix = f"{type(error).__name__}: {error}", "delete it, and start with a new tracker."
            raise BadData(file, "", expected="a tracker's state", got=got, fix=fix) from error
        self._world_from_gripper = arrays.get("gripper")
        self.observations = {}

    def _moved(self, world_from_gripper: np.ndarray | None) -> Motion | None:
        """The gripper's motion since its last known pose; None if its pose is unknown now, or was never known."""
        before = self._world_from_gripper
        if world_from_gripper is None:
            return None
        self._world_from_gripper = world_from_gripper
        return None if before is None else Motion(before, world_from_gripper)

    def _distances(self, described: Described) -> dict[str, np.ndarray]:
        """Distance maps (k, h', w') by camera."""
        distances: dict[str, np.ndarray] = {}
        for names, cells in described:
            distances |= dict(zip(names, self._network.maps(cells, self._references), strict=True))
        return distances


def _existing(kind: type[Kind], path: Path | str) -> Kind:
    """The artifact at a path; `BadData` names those that exist if there is none of this kind."""
    artifact = kind(path)
    place: Path = Path(path)
    # The folders above an artifact are Zarr groups too, and a network may come without a manifest and a group.
    recorded = artifact.attributes.get("kind", "") if (place / "zarr.json").exists() else ""
    if recorded == kind.kind or (kind is DescriptorNet and not recorded and (place / "model.json").exists()):
        return artifact
    if recorded:
        got = f"one of kind {recorded!r}"
    else:
        got = "a folder without one" if place.is_dir() else "a file" if place.exists() else "no such folder"
    around: list[Path] = [place, place.parent, place.parent.parent]
    for above in around:
        folder = above if above.name == kind.kind else above / kind.kind
        if there := sorted(manifest.parent for manifest in folder.glob(f"*/{MANIFEST}")):
            fix = f"pass one of {', '.join(map(str, there))}."
            break
    else:
        fix = f"pass ROOT/{kind.kind}/VARIANT; `bask-data info ROOT` lists what a dataset has."
    raise BadData(place, "", expected=f"an artifact of kind {kind.kind!r}", got=got, fix=fix)


def _check_dicts(**arguments: object) -> None:
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
    fault = "none" if world_from_camera is None else _fault(world_from_camera)
    if fault:
        raise ValueError(f"camera {name}: world_from_camera: expected a rigid transform (4, 4), got {fault}")


def _fault(transform: np.ndarray) -> str:
    """Why a transform is not rigid; empty if it is."""
    return rigid_fault(transform) if transform.shape == (4, 4) else f"{transform.shape}"
