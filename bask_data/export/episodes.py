"""Episodes of an export: encoded demonstrations with the same columns, read one at a time."""

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
from bask_data.export.columns import CONVENTIONS, POSITIONS, STATE, Column, checked, columns_of, robot_values
from bask_data.export.settings import ExportSettings
from bask_data.formats.files import listed
from bask_data.kinds import Camera, Demonstration, KeypointTrack, ReferenceKeypoints, Robot

if TYPE_CHECKING:
    import numpy as np

SPLITS = ("train", "validation", "test")

SINGLE_FILE = "file"
"""Temporary name of an export that is a single file."""


@dataclass(frozen=True)
class Entry:
    """A demonstration before its frames are read.

    Args:
        fps: frames per second, the inverse of the median interval between frames.
        n_gaps: number of intervals longer than one and a half times the median.
        digest: digest of the track.
        filter: filter that made the track.
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
    """Frames of a demonstration: values (t, width) by column, (t,) for scalars, and cameras by name.

    Args:
        robot: its states and actions as recorded, not rounded to the columns' types.
        origin: (3,) of its positions in the world frame of its source, metres.
    """

    entry: Entry
    values: dict[str, np.ndarray]
    cameras: dict[str, Camera]
    robot: Robot | None
    origin: np.ndarray

    @property
    def state(self) -> np.ndarray:
        """A policy's observation (t, s) float32: the concatenated columns of `Episodes.state`."""
        import numpy as np

        names = [name for name in STATE if name in self.values]
        return np.concatenate([self.values[name].reshape(self.entry.n_frames, -1) for name in names], axis=1)


class Episodes:
    """The selected demonstrations, those for training first; inconsistent ones are refused before any is written."""

    def __init__(self, dataset: Dataset, settings: ExportSettings) -> None:
        """Check every demonstration.

        Raises:
            UsageError: a name is unknown or in two splits, there are no demonstrations, or the noise is negative.
            BadData: a demonstration has no keypoints, or columns that differ from the others'.
        """
        if not 0 <= settings.noise < float("inf"):
            raise UsageError(
                "export", "--noise", expected="0 metres or more", got=settings.noise, fix="for instance --noise 0.02"
            )
        self.dataset, self.settings = dataset, settings
        self._held: dict[str, int] = {}
        self._origins: dict[str, np.ndarray] = {}
        self.entries = [self._entry(name, split) for name, split in _divided(dataset, settings)]
        first = self.entries[0].name
        self.columns = self._columns(first)
        self.cameras = self._sizes(first)
        for entry in self.entries[1:]:
            self._check_alike(first, entry.name)

    @property
    def state(self) -> list[Column]:
        """Columns of a policy's observation."""
        return [column for column in self.columns if column.name in STATE]

    @property
    def origin(self) -> np.ndarray:
        """Origin (3,) of the positions of all episodes in the world frame of their source, metres: the first one's."""
        return self._origins[self.entries[0].name]

    @property
    def is_far(self) -> bool:
        """Whether a demonstration lies far from the origin of its source."""
        return any(origin.any() for origin in self._origins.values())

    def column(self, name: str) -> Column:
        """The column with a name."""
        return next(column for column in self.columns if column.name == name)

    def has(self, name: str) -> bool:
        """Whether there is a column with this name."""
        return name in [column.name for column in self.columns]

    def path_of(self, entry: Entry) -> Path:
        """Path of a demonstration."""
        return self._demonstration(entry.name).path

    def require(self, name: str) -> None:
        """Raise `BadData` if demonstrations lack a column that the format requires."""
        if not self.has(name):
            path = self.path_of(self.entries[0])
            fix = f"record the robot's {name}, or export to parquet."
            raise BadData(path, f"robot/{name}", expected=f"the robot's {name}", got="none", fix=fix)

    @property
    def notes(self) -> list[str]:
        """Notes for the user on the data; complete after all episodes have been read."""
        by_filter: dict[str, list[str]] = {}
        for entry in self.entries:
            by_filter.setdefault(entry.filter, []).append(entry.name)
        filters = "; ".join(f"{filter}: {listed(names)}" for filter, names in by_filter.items())
        mixed = [f"the keypoints are of different filters: {filters}."] if len(by_filter) > 1 else []
        return mixed + [
            f"{name}: {n} positions are from other frames, as the keypoint was not localised."
            for name, n in self._held.items()
            if n
        ]

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[Episode]:
        """Iterate over the episodes; only one is in memory at a time, without its images."""
        for entry in self.entries:
            yield self._read(entry)

    def in_split(self, split: str) -> list[int]:
        """Numbers of the episodes of a split."""
        return [i for i, entry in enumerate(self.entries) if entry.split == split]

    def described(self, format: str) -> dict[str, Any]:
        """The description of the export: columns, frames, units, and provenance."""
        return {
            "made_by": f"bask-data {__version__}",
            "format": format,
            "dataset": self.dataset.file.name,
            "licence": self.dataset.file.licence,
            "variant": self.settings.variant,
            "keypoints": self.track(self.entries[0].name).names,
            "noise": self.settings.noise,
            "seed": self.settings.seed,
            "origin": self.origin.tolist(),
            "conventions": CONVENTIONS,
            "columns": [vars(column) for column in self.columns],
            "cameras": {name: list(size) for name, size in self.cameras.items()},
            "episodes": [vars(entry) for entry in self.entries],
            "splits": {split: [self.entries[i].name for i in self.in_split(split)] for split in SPLITS},
        }

    @cached_property
    def n_frames(self) -> int:
        """Number of frames of all demonstrations."""
        return sum(entry.n_frames for entry in self.entries)

    def _demonstration(self, name: str) -> Demonstration:
        return Demonstration(self.dataset.path(Demonstration, name))

    def track(self, name: str) -> KeypointTrack:
        """The track of a demonstration; `BadData` if there is none."""
        path = self.dataset.path(KeypointTrack, name, self.settings.variant)
        if not path.exists():
            option = "" if self.settings.variant == "main" else f" --variant {self.settings.variant}"
            fix = f"bask-data encode {self.dataset.root}{option} --only {name}"
            raise BadData(path, "", expected="keypoints of the demonstration", got="none", fix=fix)
        return KeypointTrack(path)

    def _entry(self, name: str, split: str) -> Entry:
        import numpy as np

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
        self._origins[name] = np.array(demonstration.metadata.origin)
        fps, n_gaps = _rate(demonstration.cameras[0])
        options = self.dataset.file.demonstrations[name].options
        stated = options.get("task") or demonstration.metadata.assumptions.get("task")
        task = self.settings.task or str(stated or self.dataset.file.name)
        return Entry(name, split, task, n_frames, fps, n_gaps, track.manifest.digest, track.metadata.filter)

    def _columns(self, name: str) -> list[Column]:
        return columns_of(self._demonstration(name), self.track(name), self.is_far)

    def _sizes(self, name: str) -> dict[str, tuple[int, int]]:
        """(height, width) in pixels of each camera whose images are exported."""
        wanted = self.settings.videos or self.settings.cameras
        cameras = self._demonstration(name).cameras if wanted else []
        return {camera.name: (camera.height, camera.width) for camera in cameras}

    def _check_alike(self, first: str, other: str) -> None:
        """Check that columns, reference keypoints and image sizes are the same, as a policy learns from all at once."""
        columns = self._columns(first)
        names = {column.name: column.values for column in self._columns(other)}
        for column in columns:
            if names.get(column.name) != column.values:
                got = ", ".join(names[column.name]) if column.name in names else "none"
                expected = f"{', '.join(column.values)}, as {first} has"
                raise BadData(self._demonstration(other).path, column.name, expected=expected, got=got, fix=_ALIKE)
        if extra := [name for name in names if name not in {column.name for column in columns}]:
            path = self._demonstration(other).path
            raise BadData(path, extra[0], expected=f"none, as {first} has none", got="some", fix=_ALIKE)
        self._check_same_reference(first, other)
        if (sizes := self._sizes(other)) != self.cameras:
            expected = f"{_listed(self.cameras)}, as {first} has"
            raise BadData(self._demonstration(other).path, "cameras", expected=expected, got=_listed(sizes), fix=_ALIKE)

    def _check_same_reference(self, first: str, other: str) -> None:
        """Check that both have the same reference keypoints, as a name must stand for one point of an object."""
        expected, got = self._reference(first), self._reference(other)
        if expected and got and expected != got:
            option = "" if self.settings.variant == "main" else f" --variant {self.settings.variant}"
            raise BadData(
                self.track(other).path,
                "reference",
                expected=f"{expected[:12]}, as for {first}",
                got=got[:12],
                fix=f"bask-data encode {self.dataset.root}{option}, or {_ALIKE}",
            )

    def _reference(self, name: str) -> str:
        """Digest of the reference keypoints that a track was made from; empty if not recorded."""
        inputs = self.track(name).manifest.inputs
        return next((digest for path, digest in inputs.items() if path.split("/")[0] == ReferenceKeypoints.kind), "")

    def _read(self, entry: Entry) -> Episode:
        import numpy as np

        from bask_data.core.track_scores import spread

        demonstration, track = self._demonstration(entry.name), self.track(entry.name)
        localised = np.isfinite(track.mean).all(axis=-1) & np.isfinite(track.covariance).all(axis=(-2, -1))
        for i in np.flatnonzero(~localised.any(axis=0)):
            fix = "export another --variant, or leave the demonstration out with --only."
            raise BadData(
                track.path, track.names[i], expected="a position in at least one frame", got="none in any", fix=fix
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
        origin = self._origins[entry.name]
        for name in POSITIONS:
            if self.is_far and name in values:
                values[f"{name}_world"] = values[name] + origin
                # Origins may differ, but a policy learns from all demonstrations in one frame.
                values[name] = values[name] + (origin - self.origin)
        cameras = {name: demonstration.camera(name) for name in self.cameras}
        columns = {c.name: checked(values[c.name], c, demonstration, entry.n_frames) for c in self.columns}
        return Episode(entry, columns, cameras, demonstration.robot, origin)


def held(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values (t, k, ...) with unknown ones replaced by the last known one before, or else by the first known one.

    Args:
        known: (t, k) bool; each of the k is known in at least one frame.
    """
    import numpy as np

    n_frames, n = known.shape
    before = np.maximum.accumulate(np.where(known, np.arange(n_frames)[:, None], -1), axis=0)
    return values[np.where(before < 0, known.argmax(axis=0), before), np.arange(n)]


_ALIKE = "export demonstrations that match with --only."


def _divided(dataset: Dataset, settings: ExportSettings) -> list[tuple[str, str]]:
    """(demonstration, split) in the order of splits, then of the dataset."""
    demonstrations = dataset.items("demonstration")
    for option, names in (("--only", settings.only), ("--validation", settings.validation), ("--test", settings.test)):
        if names:
            dataset.select(names, "demonstration", option=option)
    if both := [name for name in settings.validation if name in settings.test]:
        raise UsageError("export", "--test", expected="no demonstrations of --validation", got=", ".join(both))
    selected = set(dataset.select(settings.only, "demonstration"))
    chosen = [name for name in demonstrations if name in selected]
    held_out = {**dict.fromkeys(settings.validation, "validation"), **dict.fromkeys(settings.test, "test")}
    return sorted(((name, held_out.get(name, "train")) for name in chosen), key=lambda pair: SPLITS.index(pair[1]))


def _rate(camera: Camera) -> tuple[float, int]:
    """Frames per second of a camera, and the number of gaps; see `Entry`."""
    import numpy as np

    steps = np.diff(camera.time)
    if len(steps) == 0:
        raise BadData(camera.path, "time", expected="two frames or more", got=len(camera.time))
    if not (np.isfinite(steps).all() and (steps > 0).all()):
        late = int(np.argmin(np.isfinite(steps) & (steps > 0))) + 1
        got = f"{camera.time[late]:g} s after {camera.time[late - 1]:g} s at frame {late}"
        raise BadData(camera.path, "time", expected="times that increase with the frames", got=got, fix=_ALIKE)
    step = float(np.median(steps))
    return 1.0 / step, int((steps > 1.5 * step).sum())


def _generator(seed: int, name: str) -> np.random.Generator:
    """Generator of a demonstration's noise, independent of the other exported demonstrations."""
    import numpy as np

    return np.random.default_rng([seed, *hashlib.sha256(name.encode()).digest()])


def _listed(sizes: dict[str, tuple[int, int]]) -> str:
    return ", ".join(f"{name} {width}x{height}" for name, (height, width) in sizes.items()) or "no cameras"
