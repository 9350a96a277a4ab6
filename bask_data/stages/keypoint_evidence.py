"""Calibration of reference keypoints in the scans that they were picked in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from bask_data.core.filters.calibrated import range_text
from bask_data.kinds import Camera, Pick, Recording, Scan
from bask_data.progress import note, progress

if TYPE_CHECKING:
    import numpy as np
    import torch

    from bask_data.core.calibration import Calibration
    from bask_data.core.filters.observation import Observation
    from bask_data.nn.network import DescriptorNetwork

N_MEASURED_VIEWS = 32
"""Frames of a scan that distances are measured in, evenly over its cameras and time. Each costs a forward pass. Chosen;
with half or three times as many, alpha and tau of 7-Scenes `redkitchen` change by a tenth."""


class ScanViews:
    """Some frames of a scan as observations of keypoints, whose distance maps are computed each time they are read."""

    def __init__(self, scan: Scan, descriptors: np.ndarray, network: DescriptorNetwork) -> None:
        self.frames = measured_frames(scan.cameras, N_MEASURED_VIEWS)
        self._descriptors, self._network = descriptors, network
        self._cells: list[torch.Tensor] = [
            network.cells(camera.rgb(i)) for camera, i in progress(self.frames, "measuring distances")
        ]

    def __iter__(self) -> Iterator[Observation]:
        from bask_data.core.filters.observation import Observation

        for (camera, i), cells in zip(self.frames, self._cells, strict=True):
            maps = self._network.maps(cells, self._descriptors)
            yield Observation(maps, camera.depth(i), camera.Ks[i], camera.world_from_cameras[i])


def measured_frames(cameras: Sequence[Camera], n: int) -> list[tuple[Camera, int]]:
    """About n frames, as many of each camera, evenly over its time; all where there are fewer."""
    n_each = -(-n // len(cameras))
    return [
        (camera, i * camera.n_frames // min(n_each, camera.n_frames))
        for camera in cameras
        for i in range(min(n_each, camera.n_frames))
    ]


def measured(
    picks: Sequence[Pick], descriptors: np.ndarray, recordings: Mapping[str, Recording], network: DescriptorNetwork
) -> Calibration | None:
    """The calibration of keypoints in their scans; None where there is nothing to measure: no pick is in a scan and has
    depth, or too few views show them.

    Args:
        descriptors: of the picks (k, d).
        recordings: by name, those of the picks at least. Objects may move in demonstrations, which are left out.
    """
    import numpy as np

    from bask_data.core.calibration import LEAST_SIGHTINGS, calibrated, joined
    from bask_data.core.rivals import measured_evidence

    parts = []
    for name, scan in recordings.items():
        mine = [pick.recording == name and pick.point_world is not None for pick in picks]
        n_frames = sum(camera.n_frames for camera in scan.cameras) if any(mine) else 0
        if not isinstance(scan, Scan) or n_frames < LEAST_SIGHTINGS:
            continue
        points = np.array([pick.point_world if own else (np.nan,) * 3 for pick, own in zip(picks, mine, strict=True)])
        views = ScanViews(scan, descriptors, network)
        at = {(camera.name, i): index for index, (camera, i) in enumerate(views.frames)}
        picked_in = np.array([at.get((pick.camera, pick.frame), -1) for pick in picks])
        parts.append(measured_evidence(points, views, picked_in))
    calibration = calibrated(joined(parts), len(picks)) if parts else None
    note(calibration_text(calibration))
    return calibration


def calibration_text(calibration: Calibration | None) -> str:
    """A calibration in a line."""
    if calibration is None:
        return "alpha and tau: not measured, as too few frames of scans show the keypoints; filters use their defaults"
    alpha, ratio = range_text(calibration.alpha), range_text(calibration.tau_ratio)
    return f"alpha and tau: measured, alpha {alpha}, tau {ratio} times the likelihood of an image's average pixel"
