"""Frames and matches as map-style PyTorch datasets. They cross to workers by path, and each opens its files itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

# Before torch, which reads the limit of its threads' spinning when it is loaded.
import bask_data.nn  # noqa: F401  # isort: skip
import torch
from torch.utils.data import Dataset as TorchDataset

from bask_data.errors import UsageError
from bask_data.kinds import Correspondences, Scan, VisibleMasks
from bask_data.notebook.opened import OpenDataset
from bask_data.notebook.recordings import RecordedFrame, RecordedFrames
from bask_data.spelling import choices

if TYPE_CHECKING:
    import pyarrow as pa

Sample = dict[str, Any]


class _Opened(TorchDataset[Sample]):
    """What both share: the dataset, and its scans opened once in each process."""

    def __init__(self, dataset: OpenDataset | Path | str, scans: str | Sequence[str]) -> None:
        self._dataset = dataset if isinstance(dataset, OpenDataset) else OpenDataset(dataset)
        self.root = self._dataset.root
        chosen, known = (scans,) if isinstance(scans, str) else tuple(scans), tuple(self._dataset.scans)
        unknown = [name for name in chosen if name not in known]
        if unknown:
            expected = f"some of {choices(known) or 'none'}"
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

    A sample has `scan`, `pair`, `instance` (n,) uint8, the object that each match is on, and for both frames, `_a` and
    `_b`: `uv` (n, 2) float32 pixels, and `rgb`, `depth`, `K`, `world_from_camera`, `camera` and `frame` as one of
    `FrameLoader`. Which matches depends on the seed and the
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
        # Once in each process, and as arrays: a dataset may have a million pairs.
        self._stored = {scan: self._dataset.artifact(Correspondences, scan) for scan in self.scans}
        self._pair_rows = {scan: _columns(stored.pairs()) for scan, stored in self._stored.items()}
        with_matches = [np.flatnonzero(self._pair_rows[scan]["n_matches"]) for scan in self.scans]
        of_scan = np.repeat(np.arange(len(self.scans)), [len(pairs) for pairs in with_matches])
        self._pairs = np.stack([of_scan, np.concatenate([*with_matches, np.zeros(0, np.int64)])], axis=1)

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, i: int) -> Sample:
        i_scan, pair = (int(number) for number in self._pairs[i])
        scan = self.scans[i_scan]
        row, matches = self._pair_rows[scan], _columns(self._stored[scan].matches_of_pair(pair))
        n_matches = len(matches["pair"])
        rng = np.random.default_rng((self.seed, i % len(self)))
        chosen = rng.choice(n_matches, self.n, replace=n_matches < self.n)
        sample: Sample = {"scan": scan, "pair": pair, "instance": torch.from_numpy(matches["instance"][chosen])}
        for side in "ab":
            camera, i_frame = str(row[f"camera_{side}"][pair]), int(row[f"frame_{side}"][pair])
            uv = np.stack([matches[f"u_{side}"][chosen], matches[f"v_{side}"][chosen]], axis=1)
            view = {"uv": torch.from_numpy(uv), "camera": camera, "frame": i_frame}
            view |= _tensors(self._frames(scan, camera)[i_frame])
            sample |= {f"{name}_{side}": value for name, value in view.items()}
        return sample

    def __repr__(self) -> str:
        return f"<{len(self)} pairs of frames with {self.n} matches each, of {', '.join(self.scans)}, seed {self.seed}>"


def _columns(table: pa.Table) -> dict[str, np.ndarray]:
    return {name: table[name].to_numpy() for name in table.column_names}


def _tensors(frame: RecordedFrame) -> Sample:
    return {
        "rgb": torch.from_numpy(frame.rgb.transpose(2, 0, 1).copy()),
        "depth": torch.from_numpy(frame.depth),
        "K": torch.from_numpy(frame.K),
        "world_from_camera": torch.from_numpy(frame.world_from_camera),
    }
