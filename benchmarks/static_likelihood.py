"""Settings of the filters for a static scene: their defaults, with what `reference` would measure in half of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from static_scenes import Points
from static_tracks import observation, references

from bask_data.core.calibration import Calibration, Evidence, calibrated
from bask_data.core.filters.calibrated import calibrated_settings
from bask_data.core.filters.observation import Observation
from bask_data.core.filters.table import DEFAULT, FILTERS, FilterSettings, settings_named
from bask_data.core.rivals import measured_evidence
from bask_data.kinds import Camera

EVERY = 2
"""Frames between those that are measured: neighbours are alike."""
OWN = "calibrated on the points themselves"
NOT = "not calibrated"


class Views:
    """Some frames as observations of points, whose distance maps are computed when they are asked for."""

    def __init__(self, camera: Camera, cells: Sequence[torch.Tensor], points: Points, frames: Sequence[int]) -> None:
        self._camera, self._cells, self._frames = camera, cells, frames
        self._wanted = references(camera, cells, points)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int, /) -> Observation:
        i = self._frames[index]
        return observation(self._camera, self._cells[i], i, self._wanted)


def evidence(
    camera: Camera, cells: Sequence[torch.Tensor], points: Points, frames: np.ndarray, tolerance: float
) -> Evidence:
    """Descriptor distances at points and at their rivals, in some of the chosen frames (t,)."""
    chosen = np.flatnonzero(frames)[::EVERY].tolist()
    picked_in = np.array([chosen.index(i) if i in chosen else -1 for i in points.picked_in.tolist()])
    return measured_evidence(points.world, Views(camera, cells, points, chosen), picked_in, tolerance)


def methods_of(fitted: Evidence, own: Evidence, k: int) -> dict[str, FilterSettings]:
    """What is compared, by name: the filters calibrated on other points than the k that are tracked, so that all of
    these are like the average one; the default filter calibrated on them in other frames, as `reference` does; and not
    calibrated.

    Args:
        fitted: of the points to fit.
        own: of the points to report, in the frames to fit.
    """
    pooled = calibrated(replace(fitted, true_of=fitted.true_of * 0, rival_of=fitted.rival_of * 0), 1)
    average = (
        None
        if pooled is None
        else Calibration(*(np.repeat(getattr(pooled, field.name), k) for field in fields(pooled)))
    )
    return {
        **{name: calibrated_settings(name, average) for name in FILTERS},
        f"{DEFAULT}, {OWN}": calibrated_settings(DEFAULT, calibrated(own, k)),
        f"{DEFAULT}, {NOT}": settings_named(DEFAULT),
    }


def likelihood(methods: Mapping[str, FilterSettings]) -> dict[str, Any]:
    """The temperature and the level of tau of the default filter, as measured on other points."""
    settings = methods[DEFAULT]
    return {name: np.ravel(getattr(settings, name)).astype(float).tolist()[0] for name in ("alpha", "tau_ratio")}
