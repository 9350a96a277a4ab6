"""Frames and matches as map-style PyTorch datasets. They cross to workers by path, and each opens its files itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

# Before torch, which reads the limit of its threads' spinning when it is loaded.
import bask_data.nn  # noqa: F401  # isort: skip
import torch
from torch.utils.data import Dataset as TorchDataset

from bask_data.errors import UsageError
from bask_data.kinds import Scan, VisibleMasks
from bask_data.notebook.opened import OpenDataset
from bask_data.notebook.recordings import RecordedFrame, RecordedFrames
from bask_data.notebook.results import MatchArrays

Sample = dict[str, Any]


class _Opened(TorchDataset[Sample]):
    """What both share: the dataset, and its scans opened once in each process."""

    def __init__(self, dataset: OpenDataset | Path | str, scans: str | Sequence[str]) -> None:
        self._dataset = dataset if isinstance(dataset, OpenDataset) else OpenDataset(dataset)
        self.root = self._dataset.root
        chosen, known = (scans,) if isinstance(scans, str) else tuple(scans), tuple(self._dataset.scans)
        unknown = [name for name in chosen if name not in known]
        if unknown:
            expected = f"some of {', '.join(known) or 'none'}"
            raise UsageError(self.root, "scans", expected=expected, got=", ".join(unknown))
        self.scans = tuple(dict.fromkeys(chosen)) or known
        self._recordings: dict[tuple[str, str], RecordedFrames] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_recordings": {}}

    def _frames(self, scan: str, camera: str) -> RecordedFrames:
        if (scan, camera) not in self._recordings:
            self._recordings[scan, camera] = self._dataset.scans[scan].camera(camera)
        return self._recordings[scan, camera]


class FrameLoader(_Opened):
    """Every frame of every camera of the scans, as tensors.

    A sample has `rgb` (3, h, w) uint8, `depth` (h, w) float32 metres, `K` (3, 3) and `world_from_camera` (4, 4)
    float64, `scan`, `camera`, `frame`, and with `masks` `mask` (h, w) uint8.
    """

    def __init__(self, dataset: OpenDataset | Path | str, scans: str | Sequence[str] = (), masks: bool = False) -> None:
        """List the frames.

        Args:
            scans: names; by default all.
            masks: give masks, too.

        Raises:
            UsageError: there is no such scan, or it has no masks yet.
        """
        super().__init__(dataset, scans)
        self.masks = masks
        for scan in self.scans if masks else ():
            self._dataset.artifact(VisibleMasks, scan)  # Refuses a scan without masks before the first epoch.
        self._places = [
            (scan, camera, i_frame)
            for scan in self.scans
            for camera, (n_frames, *_) in self._dataset.artifact(Scan, scan).camera_shapes().items()
            for i_frame in range(n_frames)
        ]

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, i: int) -> Sample:
        scan, camera, i_frame = self._places[i]
        frame = self._frames(scan, camera)[i_frame]
        sample = {**_tensors(frame), "scan": scan, "camera": camera, "frame": i_frame}
        return {**sample, "mask": torch.from_numpy(frame.mask)} if self.masks else sample

    def __repr__(self) -> str:
        return f"<{len(self)} frames of {', '.join(self.scans)}{', with masks' if self.masks else ''}>"


class MatchLoader(_Opened):
    """Pairs of frames with `n` matches each, as tensors.

    A sample has for both frames, `_a` and `_b`, what one of `FrameLoader` has without masks, `uv_a` and `uv_b` (n, 2)
    float32 pixels, and `instance` (n,) of the object that each match is on. Which matches depends on the seed and the
    sample alone, not on workers or on the order of reading.
    """

    def __init__(
        self, dataset: OpenDataset | Path | str, scans: str | Sequence[str] = (), n: int = 256, seed: int = 0
    ) -> None:
        """List the pairs that have matches.

        Args:
            scans: names; by default all.
            n: matches of each pair, drawn with replacement where it has fewer.

        Raises:
            UsageError: there is no such scan, or it has no matches yet.
        """
        super().__init__(dataset, scans)
        self.n, self.seed = n, seed
        self._pairs = [(scan, int(pair)) for scan in self.scans for pair in self._dataset.matches(scan).pairs]

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, i: int) -> Sample:
        scan, pair = self._pairs[i]
        found = self._dataset.matches(scan, pair)
        rng = np.random.default_rng((self.seed, i % len(self)))
        chosen = rng.choice(len(found), self.n, replace=len(found) < self.n)
        sample: Sample = {"scan": scan, "pair": pair, "instance": torch.from_numpy(found.instance[chosen])}
        for side, uv, frame in zip("ab", (found.uv_a, found.uv_b), self._views(scan, found, pair), strict=True):
            sample |= {f"{name}_{side}": value for name, value in _tensors(frame).items()}
            sample[f"uv_{side}"] = torch.from_numpy(uv[chosen])
        return sample

    def _views(self, scan: str, found: MatchArrays, pair: int) -> tuple[RecordedFrame, RecordedFrame]:
        return (
            self._frames(scan, str(found.camera_a[pair]))[int(found.frame_a[pair])],
            self._frames(scan, str(found.camera_b[pair]))[int(found.frame_b[pair])],
        )

    def __repr__(self) -> str:
        return f"<{len(self)} pairs of frames with {self.n} matches each, of {', '.join(self.scans)}, seed {self.seed}>"


def _tensors(frame: RecordedFrame) -> Sample:
    return {
        "rgb": torch.from_numpy(frame.rgb.transpose(2, 0, 1).copy()),
        "depth": torch.from_numpy(frame.depth),
        "K": torch.from_numpy(frame.K),
        "world_from_camera": torch.from_numpy(frame.world_from_camera),
    }
