"""Encoded demonstrations as a policy learns from them: episodes with the same columns, read one at a time."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data import __version__
from bask_data.dataset import Dataset
from bask_data.errors import BadData, UsageError
from bask_data.export.columns import CONVENTIONS, STATE, Column, checked, columns_of, robot_values
from bask_data.export.settings import ExportSettings
from bask_data.formats.files import listed
from bask_data.kinds import Camera, Demonstration, KeypointTrack, ReferenceKeypoints

if TYPE_CHECKING:
    import numpy as np

SPLITS = ("train", "validation", "test")

SINGLE_FILE = "file"
"""Name of an export that is a single file, until it has its own."""


@dataclass(frozen=True)
class Entry:
    """A demonstration before its frames are read.

    Args:
        fps: frames per second: the inverse of the median time between frames.
        n_gaps: times between frames that are longer than one and a half of the median.
        digest: of the keypoints.
        filter: that tracked them.
    """

    name: str
    split: str
    task: str
    n_frames: int
    fps: float
    n_gaps: int
    digest: str
    filter: str


@dataclass(frozen=True)
class Episode:
    """A demonstration's frames: for each column (t, width), single numbers (t,)."""

    entry: Entry
    values: dict[str, np.ndarray]
    cameras: dict[str, Camera]

    @property
    def state(self) -> np.ndarray:
        """What a policy observes, (t, s) float32: the columns of `Episodes.state` side by side."""
        import numpy as np

        there = [name for name in STATE if name in self.values]
        return np.concatenate([self.values[name].reshape(self.entry.n_frames, -1) for name in there], axis=1)


class Episodes:
    """The chosen demonstrations, those for training first. What does not fit together is told before any is written."""

    def __init__(self, dataset: Dataset, settings: ExportSettings) -> None:
        """Look at every demonstration.

        Raises:
            UsageError: a name is no demonstration, or is in two splits; there is none; the noise is negative.
            BadData: a demonstration has no keypoints, or not the columns that the others have.
        """
        if not 0 <= settings.noise < float("inf"):
            raise UsageError("export", "--noise", expected="0 metres or more", got=settings.noise)
        self.dataset, self.settings = dataset, settings
        self._held: dict[str, int] = {}
        self.entries = [self._entry(name, split) for name, split in _divided(dataset, settings)]
        first = self.entries[0].name
        self.columns = self._columns(first)
        self.cameras = self._sizes(first)
        for entry in self.entries[1:]:
            self._check_alike(first, entry.name)

    @property
    def state(self) -> list[Column]:
        """The columns that make up a policy's observation."""
        return [column for column in self.columns if column.name in STATE]

    def column(self, name: str) -> Column:
        """One of the columns."""
        return next(column for column in self.columns if column.name == name)

    def has(self, name: str) -> bool:
        """Whether there is such a column."""
        return name in [column.name for column in self.columns]

    def path_of(self, entry: Entry) -> Path:
        """Where a demonstration lies."""
        return self._demonstration(entry.name).path

    def require(self, name: str) -> None:
        """Refuse demonstrations without a column that the format cannot do without; `BadData`."""
        if not self.has(name):
            path = self.path_of(self.entries[0])
            fix = "record what the robot does, or export to parquet."
            raise BadData(path, f"robot/{name}", expected="a record of it", got="none", fix=fix)

    @property
    def notes(self) -> list[str]:
        """What was done to the numbers; complete when all have been read."""
        by_filter: dict[str, list[str]] = {}
        for entry in self.entries:
            by_filter.setdefault(entry.filter, []).append(entry.name)
        told = "; ".join(f"{filter}: {listed(names)}" for filter, names in by_filter.items())
        mixed = [f"the keypoints are of different filters: {told}."] if len(by_filter) > 1 else []
        return mixed + [
            f"{name}: {n} positions are kept from other frames, in which the keypoint was localised."
            for name, n in self._held.items()
            if n
        ]

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[Episode]:
        """Each demonstration in turn; only one's numbers are in memory, and none of its images."""
        for entry in self.entries:
            yield self._read(entry)

    def in_split(self, split: str) -> list[int]:
        """Numbers of the episodes of a split."""
        return [i for i, entry in enumerate(self.entries) if entry.split == split]

    def described(self, format: str) -> dict[str, Any]:
        """What a reader must know: columns, frames, units, where the numbers come from."""
        return {
            "made_by": f"bask-data {__version__}",
            "format": format,
            "dataset": self.dataset.file.name,
            "licence": self.dataset.file.licence,
            "variant": self.settings.variant,
            "keypoints": self.track(self.entries[0].name).names,
            "noise": self.settings.noise,
            "seed": self.settings.seed,
            "conventions": CONVENTIONS,
            "columns": [vars(column) for column in self.columns],
            "cameras": {name: list(size) for name, size in self.cameras.items()},
            "episodes": [vars(entry) for entry in self.entries],
            "splits": {split: [self.entries[i].name for i in self.in_split(split)] for split in SPLITS},
        }

    @cached_property
    def n_frames(self) -> int:
        """Of all demonstrations."""
        return sum(entry.n_frames for entry in self.entries)

    def _demonstration(self, name: str) -> Demonstration:
        return Demonstration(self.dataset.path(Demonstration, name))

    def track(self, name: str) -> KeypointTrack:
        """The keypoints of a demonstration; `BadData` where there are none."""
        path = self.dataset.path(KeypointTrack, name, self.settings.variant)
        if not path.exists():
            option = "" if self.settings.variant == "main" else f" --variant {self.settings.variant}"
            fix = f"bask-data encode {self.dataset.root}{option} --only {name}"
            raise BadData(path, "", expected="keypoints of the demonstration", got="none", fix=fix)
        return KeypointTrack(path)

    def _entry(self, name: str, split: str) -> Entry:
        demonstration, track = self._demonstration(name), self.track(name)
        track.check_complete()
        demonstration.check_complete()
        n_frames = track.group["mean"].shape[0]  # type: ignore[union-attr]
        for camera in demonstration.cameras:
            if camera.n_frames != n_frames:
                raise BadData(
                    track.path,
                    "mean",
                    expected=f"{camera.n_frames} frames, as camera {camera.name} has",
                    got=n_frames,
                    fix="encode it again.",
                )
        fps, n_gaps = _rate(demonstration.cameras[0])
        options = self.dataset.file.demonstrations[name].options
        task = self.settings.task or str(options.get("task") or self.dataset.file.name)
        return Entry(name, split, task, n_frames, fps, n_gaps, track.manifest.digest, track.metadata.filter)

    def _columns(self, name: str) -> list[Column]:
        return columns_of(self._demonstration(name), self.track(name))

    def _sizes(self, name: str) -> dict[str, tuple[int, int]]:
        """(height, width) of each camera whose images are wanted."""
        cameras = self._demonstration(name).cameras if self.settings.videos else []
        return {camera.name: (camera.height, camera.width) for camera in cameras}

    def _check_alike(self, first: str, other: str) -> None:
        """Policies learn from all demonstrations at once: names and sizes must be the same in all of them."""
        here, there = self._columns(first), self._columns(other)
        names = {column.name: column.values for column in there}
        for column in here:
            if names.get(column.name) != column.values:
                got = ", ".join(names[column.name]) if column.name in names else "none"
                expected = f"{', '.join(column.values)}, as {first} has"
                raise BadData(self._demonstration(other).path, column.name, expected=expected, got=got, fix=_ALIKE)
        if extra := [name for name in names if name not in {column.name for column in here}]:
            path = self._demonstration(other).path
            raise BadData(path, extra[0], expected=f"none, as {first} has none", got="some", fix=_ALIKE)
        self._check_same_reference(first, other)
        if (sizes := self._sizes(other)) != self.cameras:
            expected = f"{_listed(self.cameras)}, as {first} has"
            raise BadData(self._demonstration(other).path, "cameras", expected=expected, got=_listed(sizes), fix=_ALIKE)

    def _check_same_reference(self, first: str, other: str) -> None:
        """A keypoint's name stands for one point of an object: that of the reference both were tracked by."""
        here, there = self._reference(first), self._reference(other)
        if here and there and here != there:
            option = "" if self.settings.variant == "main" else f" --variant {self.settings.variant}"
            raise BadData(
                self.track(other).path,
                "reference",
                expected=f"{here[:12]}, as {first} was tracked by",
                got=there[:12],
                fix=f"bask-data encode {self.dataset.root}{option}, or {_ALIKE}",
            )

    def _reference(self, name: str) -> str:
        """Digest of the reference keypoints that a track was made from; empty where it does not say."""
        inputs = self.track(name).manifest.inputs
        return next((of for path, of in inputs.items() if path.split("/")[0] == ReferenceKeypoints.kind), "")

    def _read(self, entry: Entry) -> Episode:
        import numpy as np

        from bask_data.core.scores import spread

        demonstration, track = self._demonstration(entry.name), self.track(entry.name)
        localised = np.isfinite(track.mean).all(axis=-1) & np.isfinite(track.covariance).all(axis=(-2, -1))
        for i in np.flatnonzero(~localised.any(axis=0)):
            fix = "export another --variant, or leave the demonstration out with --only."
            raise BadData(
                track.path, track.names[i], expected="a place in at least one frame", got="none in any", fix=fix
            )
        self._held[entry.name] = int((~localised).sum())
        noise = _generator(self.settings.seed, entry.name).normal(0.0, self.settings.noise, track.mean.shape)
        seen = [track.observed(camera) for camera in track.camera_names]
        values = {
            "time": demonstration.cameras[0].time,
            "keypoints": held(track.mean, localised) + noise,
            "spread": held(spread(track.covariance), localised),
            "observed": np.any(seen, axis=0) & localised,
            "localised": localised,
            **robot_values(demonstration),
        }
        cameras = {name: demonstration.camera(name) for name in self.cameras}
        return Episode(
            entry, {c.name: checked(values[c.name], c, demonstration, entry.n_frames) for c in self.columns}, cameras
        )


def held(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values (t, k, ...) where unknown ones are those of the last frame before that is known, or else of the first.

    Args:
        known: (t, k) bool; each of the k somewhere.
    """
    import numpy as np

    n_frames, n = known.shape
    before = np.maximum.accumulate(np.where(known, np.arange(n_frames)[:, None], -1), axis=0)
    return values[np.where(before < 0, known.argmax(axis=0), before), np.arange(n)]


_ALIKE = "export those that are alike with --only."


def _divided(dataset: Dataset, settings: ExportSettings) -> list[tuple[str, str]]:
    """(demonstration, split), by split and then as the dataset lists them."""
    there = dataset.items("demonstration")
    for option, names in (("--only", settings.only), ("--validation", settings.validation), ("--test", settings.test)):
        if names:
            dataset.select(names, "demonstration", option=option)
    if both := [name for name in settings.validation if name in settings.test]:
        raise UsageError("export", "--test", expected="others than --validation", got=", ".join(both))
    selected = set(dataset.select(settings.only, "demonstration"))
    chosen = [name for name in there if name in selected]
    of = {**dict.fromkeys(settings.validation, "validation"), **dict.fromkeys(settings.test, "test")}
    return sorted(((name, of.get(name, "train")) for name in chosen), key=lambda pair: SPLITS.index(pair[1]))


def _rate(camera: Camera) -> tuple[float, int]:
    """Frames per second of a stream, and how often it paused."""
    import numpy as np

    steps = np.diff(camera.time)
    if len(steps) == 0:
        raise BadData(camera.path, "time", expected="two frames or more", got=len(camera.time))
    if not (np.isfinite(steps).all() and (steps > 0).all()):
        raise BadData(camera.path, "time", expected="each frame later than the one before", got="times that are not")
    step = float(np.median(steps))
    return 1.0 / step, int((steps > 1.5 * step).sum())


def _generator(seed: int, name: str) -> np.random.Generator:
    """A source of noise that is a demonstration's own, whichever others are exported along with it."""
    import numpy as np

    return np.random.default_rng([seed, *hashlib.sha256(name.encode()).digest()])


def _listed(sizes: dict[str, tuple[int, int]]) -> str:
    return ", ".join(f"{name} {width}x{height}" for name, (height, width) in sizes.items()) or "no cameras"
