"""Points of a static scene tracked by all filters, with XFeat's descriptors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from static_scenes import SPACING, Points, depth_of, pixels, runs, starts_again
from xfeat import XFeat, descriptors_at, upsampled

from bask_data.core.filters.observation import Estimate, Observation
from bask_data.core.filters.step import step
from bask_data.core.filters.table import FilterSettings
from bask_data.kinds import Camera
from bask_data.progress import progress

STEADY, RETURNED = 5, 5
"""Frames in a row that a point was seen before it counts as seen, and frames after its return that count as such."""


@dataclass(frozen=True)
class StaticTrack:
    """Where a method takes the points to be, metres, world frame.

    Attributes:
        mean: (t, k, 3).
        covariance: (t, k, 3, 3), square metres.
    """

    mean: np.ndarray
    covariance: np.ndarray


def described(camera: Camera) -> list[torch.Tensor]:
    """Every frame's descriptors at the network's stride: 1.2 MB each."""
    network = XFeat()
    return [network.cells(camera.rgb(i)) for i in progress(range(camera.n_frames), "describing frames")]


def references(camera: Camera, cells: Sequence[torch.Tensor], points: Points) -> torch.Tensor:
    """The descriptors (k, 64) of points, each in the frame it is picked in."""
    picked = zip(points.picked_in.tolist(), points.world, strict=True)
    return torch.cat([descriptors_at(cells[i], pixels(camera, i, point[None])) for i, point in picked])


def observation(camera: Camera, cells: torch.Tensor, i_frame: int, wanted: torch.Tensor) -> Observation:
    """A frame's distance maps, of descriptors of length one, and its depth at their resolution."""
    cosine = torch.einsum("kd,dhw->khw", wanted, upsampled(cells, SPACING))
    z = (2 - 2 * cosine).clamp(min=0).sqrt().numpy()
    depth, K = depth_of(camera, i_frame)
    return Observation(z, depth, K, camera.world_from_cameras[i_frame])


def tracked(
    camera: Camera,
    cells: Sequence[torch.Tensor],
    wanted: torch.Tensor,
    methods: Mapping[str, FilterSettings],
    seed: int,
) -> dict[str, StaticTrack]:
    """Each method's track of the points, in one pass over all frames."""
    beliefs: dict[str, Any] = dict.fromkeys(methods)
    rngs = {name: np.random.default_rng(seed) for name in methods}
    estimates: dict[str, list[Estimate]] = {name: [] for name in methods}
    for i in progress(range(camera.n_frames), f"tracking, seed {seed}"):
        seen = observation(camera, cells[i], i, wanted)
        for name, settings in methods.items():
            beliefs[name], estimate = step(beliefs[name], [seen], None, rngs[name], settings)
            estimates[name].append(estimate)
    return {
        name: StaticTrack(np.stack([one.mean for one in track]), np.stack([one.covariance for one in track]))
        for name, track in estimates.items()
    }


def phases(points: Points) -> dict[str, np.ndarray]:
    """Frames and points (t, k) of each part of the table."""
    seen = points.seen
    steady, returned = np.zeros_like(seen), np.zeros_like(seen)
    for i in range(seen.shape[1]):
        for a, b in runs(seen[:, i]):
            steady[a + STEADY : b, i] = True
        for a in starts_again(seen[:, i]):
            returned[a : a + RETURNED, i] = seen[a : a + RETURNED, i]
    known = np.logical_or.accumulate(seen, axis=0)
    return {"seen": steady, "gone": points.gone & known, "returned": returned}
