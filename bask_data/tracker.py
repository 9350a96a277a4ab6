"""Tracking of keypoints on a running robot, frame by frame, as `bask-data encode` does in a demonstration.

    tracker = KeypointTracker(descriptor, reference)
    keypoints = tracker.step(images, depths, intrinsics, world_from_cameras, world_from_gripper)

`docs/runtime.md` shows a complete loop.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from bask_data.artifact import MANIFEST
from bask_data.core.filters.belief_arrays import from_arrays, to_arrays
from bask_data.core.filters.calibrated import calibrated_settings
from bask_data.core.filters.observation import Estimate, Motion, Observation, PixelMaps, WeightedPoints
from bask_data.core.filters.step import step
from bask_data.core.filters.table import DEFAULT, FilterSettings, filter_of
from bask_data.core.geometry import in_image, scale_pixels
from bask_data.errors import BadData
from bask_data.kinds import DescriptorNet, ReferenceKeypoints
from bask_data.observing import FrameObservations, FrameObserver, Moment, check_moment, transform_fault

Kind = TypeVar("Kind", DescriptorNet, ReferenceKeypoints)

if TYPE_CHECKING:
    import torch

    from bask_data.nn.network import DescriptorNetwork
    from bask_data.observing import Described


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
        observed: by camera, (k,), whether it more likely than not sees the keypoint. In a frame that did not go
            through the network (`every`): whether it did in the last one that went, if it is still inside the image.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray
    mode: np.ndarray
    n_eff: np.ndarray
    log_evidence: np.ndarray
    pixel: dict[str, np.ndarray]
    observed: dict[str, np.ndarray]


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
        every: int = 1,
        scale: float = 1.0,
    ) -> None:
        """Load the network.

        Args:
            descriptor: network, or its path in a dataset, `ROOT/descriptor/main`.
            reference: reference keypoints, or their path in a dataset, `ROOT/reference/main`.
            settings: settings of a filter, whose type selects it; see `core.filters.calibrated.calibrated_settings`.
                Default: the particle filter's, with alpha and tau as measured for the references, if they were.
            seed: seed of the filter's random numbers.
            device: device of the network. Default: the GPU if there is one.
            cameras: names in the filter's order. Default: in the order of their first frames, then by name.
            every: only every so many-th frame of a camera goes through the network, and counts twice; between them, the
                belief follows the filter's motion model and the gripper. Cameras take turns.
            scale: height of the network's input, as a share of the one it was trained for; a half is a quarter of the
                arithmetic. Positions stay sub-pixel ones of the whole image.

        Raises:
            BadData: a path holds no such artifact, the network does not load, or its descriptors have another
                dimension than the references.
            ValueError: `every` is not a whole number of at least 1, `scale` is not above 0 and at most 1, or `cameras`
                is a single name.
        """
        if isinstance(descriptor, str | Path):
            descriptor = _existing(DescriptorNet, descriptor)
        if not isinstance(reference, ReferenceKeypoints):
            reference = _existing(ReferenceKeypoints, reference)
        network = descriptor.network() if isinstance(descriptor, DescriptorNet) else descriptor
        if isinstance(cameras, str):
            raise ValueError(f"cameras: expected a list of names, got {cameras!r}")
        self.names = tuple(reference.names)
        self._every = every
        self._observer = FrameObserver(network if device is None else network.to(device), reference, every, scale)
        self._settings = settings or calibrated_settings(DEFAULT, reference.calibration)
        self._seed, self._given = seed, tuple(cameras or ())
        self.reset()

    def __repr__(self) -> str:
        settings, cameras = type(self._settings).__name__, ", ".join(self.cameras) or "none yet"
        return f"KeypointTracker({len(self.names)} keypoints, {settings}, cameras: {cameras}, steps: {self.n_steps})"

    def reset(self) -> None:
        """Return to the state before the first frame."""
        self._rng = np.random.default_rng(self._seed)
        self._world_from_gripper: np.ndarray | None = None
        self._sizes: dict[str, tuple[int, int]] = {}
        self._observed: dict[str, np.ndarray] = {}
        self.n_steps = 0
        """Number of steps."""
        self.cameras = list(self._given)
        """Names of the cameras so far."""
        self.belief: Any = None
        """The filter's belief; None before the first step."""
        self.observations: dict[str, Observation] = {}
        """Observations of the last step, by camera; none by a camera whose frame did not go through the network."""

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

    def describe(self, images: Mapping[str, np.ndarray], i_step: int | None = None) -> Described:
        """Descriptors of the images, which take nearly all of a step's time.

        Args:
            i_step: number of steps before this one, which decides whose turn it is with `every`. Default: `n_steps`.
        """
        return self._observer.describe(images, self.cameras, self.n_steps if i_step is None else i_step)

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
        moment = Moment(images, depths, intrinsics, world_from_cameras)
        check_moment(moment)
        return self._observer.look(moment, self.describe(images) if described is None else described)

    def update(self, look: FrameObservations, world_from_gripper: np.ndarray | None = None) -> TrackedKeypoints:
        """The second half of a step: update of the belief, without the network.

        Raises:
            ValueError: the gripper's transform is not rigid, or the size of a camera's images has changed.
        """
        gripper = None if world_from_gripper is None else np.array(world_from_gripper, dtype=np.float64)
        fault = "" if gripper is None else transform_fault(gripper)
        if fault:
            raise ValueError(f"world_from_gripper: expected a rigid transform (4, 4), got {fault}")
        for name, size in look.sizes.items():
            if self._sizes.setdefault(name, size) != size:
                raise ValueError(f"camera {name}: image: expected {self._sizes[name]} as before, got {size}")
        self.cameras += [name for name in sorted(look.sizes) if name not in self.cameras]
        self.observations = look.observations
        self.n_steps += 1
        seen = [look.observations.get(name) for name in self.cameras]
        self.belief, estimate = step(
            self.belief, seen, self._moved(gripper), self._rng, self._settings, len(self.names)
        )
        if self._every > 1 and look.observations:
            # It stands for the frames between, too. Twice, not n times: it is one view with one error.
            self.belief, again = step(self.belief, seen, None, self._rng, self._settings, len(self.names))
            estimate = replace(again, log_evidence=estimate.log_evidence)
        pixel, observed = self._in_cameras(estimate, look)
        return TrackedKeypoints(
            names=self.names,
            mean=estimate.mean,
            covariance=estimate.covariance,
            mode=estimate.mode,
            n_eff=estimate.n_eff,
            log_evidence=estimate.log_evidence,
            pixel=pixel,
            observed=observed,
        )

    def _in_cameras(
        self, estimate: Estimate, look: FrameObservations
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """`pixel` and `observed` of `TrackedKeypoints`."""
        pixel, observed = {}, {}
        for i, name in enumerate(self.cameras):
            pixel[name], observed[name] = estimate.pixel[i], estimate.observed[i]
            if name in look.between:
                pixel[name] = look.between[name].pixels(estimate.mean)
                observed[name] = self._observed.get(name, observed[name]) & in_image(pixel[name], *look.sizes[name])
            elif name in look.observations:
                pixel[name] = scale_pixels(pixel[name], look.observations[name].depth.shape, look.sizes[name])
                self._observed[name] = observed[name]
        return pixel, observed

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
        words = {
            "n_steps": self.n_steps,
            "cameras": self.cameras,
            "rng": self._rng.bit_generator.state,
            "observed": {name: observed.tolist() for name, observed in self._observed.items()},
        }
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
            k = len(self.names)
            self._observed = {name: np.array(one, bool).reshape(k) for name, one in words.get("observed", {}).items()}
        except (SafetensorError, OSError, AttributeError, KeyError, TypeError, ValueError) as error:
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
