"""A dataset as its user sees it: recordings by name, results as arrays, stages to run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from bask_data.artifact import MANIFEST, Artifact
from bask_data.dataset import Dataset
from bask_data.engine import Config, Outcome, Stage, plan, run, state_told
from bask_data.errors import BaskError, UsageError
from bask_data.kinds import (
    Correspondences,
    Demonstration,
    InstanceRow,
    KeypointTrack,
    ObjectInstances,
    Scan,
    VisibleMasks,
)
from bask_data.notebook.recordings import RecordedFrames, RecordingTable

if TYPE_CHECKING:
    import numpy as np

    from bask_data.kinds.masks import CameraMasks

A = TypeVar("A", bound=Artifact)


@dataclass(frozen=True)
class ObjectArrays:
    """The objects of a scene, in the order of their ids.

    Attributes:
        id: (k,) as in masks.
        centroid: (k, 3) metres, world frame.
        extents: (k, 3) metres.
        rows: all that is known of each.
        vertex_instance: (n,) int32, of each vertex of the reconstruction; 0 is background.
        support_plane: (4,) nx, ny, nz, d: n.x + d = 0, n towards the objects; zeros: no plane.
    """

    id: np.ndarray
    centroid: np.ndarray
    extents: np.ndarray
    rows: tuple[InstanceRow, ...]
    vertex_instance: np.ndarray
    support_plane: np.ndarray

    def __repr__(self) -> str:
        return f"<{len(self.id)} objects of {len(self.vertex_instance)} vertices>"


@dataclass(frozen=True)
class MatchArrays:
    """Matches between frames of a scan, a row each.

    Attributes:
        pair: (n,) number of the pair of frames.
        instance: (n,) object that both pixels show.
        uv_a, uv_b: (n, 2) float32 pixels in the first and the second frame; integers are pixel centres.
        camera_a, camera_b: (n_pairs,) names, by pair.
        frame_a, frame_b: (n_pairs,) numbers of the frames, by pair.
    """

    pair: np.ndarray
    instance: np.ndarray
    uv_a: np.ndarray
    uv_b: np.ndarray
    camera_a: np.ndarray
    camera_b: np.ndarray
    frame_a: np.ndarray
    frame_b: np.ndarray

    def __len__(self) -> int:
        return len(self.pair)

    def __repr__(self) -> str:
        return f"<{len(self)} matches in {len(self.frame_a)} pairs of frames>"


@dataclass(frozen=True)
class TrackArrays:
    """The keypoints of a demonstration over time; positions in metres and the world frame, NaN: not localised.

    Attributes:
        names: (k) of the keypoints.
        mean, mode: (t, k, 3) float32.
        covariance: (t, k, 3, 3) float32, square metres.
        pixel: by camera (t, k, 2) float32, where its images have the mean.
        observed: by camera (t, k) bool.
    """

    names: tuple[str, ...]
    filter: str
    mean: np.ndarray
    mode: np.ndarray
    covariance: np.ndarray
    pixel: dict[str, np.ndarray]
    observed: dict[str, np.ndarray]

    def __repr__(self) -> str:
        t, k = self.mean.shape[:2]
        return f"<{k} keypoints over {t} frames, {self.filter} filter: {', '.join(self.names)}>"


class StatusRows(tuple[tuple[str, str, str], ...]):
    """What is up to date: (task, state, why), one a line."""

    def __repr__(self) -> str:
        return "\n".join(f"{label:<32} {state}{': ' if why else ''}{why}" for label, state, why in self)

    def _repr_html_(self) -> str:
        rows = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in self)
        return f"<table><tr><th>task</th><th>state</th><th>why</th></tr>{rows}</table>"


class OpenDataset:
    """A dataset on disk, opened for reading; nothing is read before it is asked for."""

    def __init__(self, root: Path | str) -> None:
        """Open an existing dataset.

        Raises:
            BadData: there is none.
        """
        self._dataset = Dataset(root)
        self.root = self._dataset.root
        """Its directory."""

    def __reduce__(self) -> tuple[Any, ...]:
        return OpenDataset, (self.root,)

    @property
    def name(self) -> str:
        """Its name."""
        return self._dataset.file.name

    @property
    def scans(self) -> RecordingTable:
        """Scans by the name of their scene."""
        names = self._dataset.items("scene")
        return RecordingTable(self.root, "scan", names, lambda name: self._recording(Scan, name))

    @property
    def demonstrations(self) -> RecordingTable:
        """Demonstrations by name."""
        names = self._dataset.items("demonstration")
        return RecordingTable(self.root, "demonstration", names, lambda name: self._recording(Demonstration, name))

    def objects(self, scene: str) -> ObjectArrays:
        """The objects of a scene.

        Raises:
            UsageError: there is no such scene, or its objects have not been found yet.
        """
        import numpy as np

        found = self._artifact(ObjectInstances, scene)
        rows = tuple(found.instances)
        return ObjectArrays(
            id=np.array([row.id for row in rows], dtype=np.int64),
            centroid=np.array([row.centroid for row in rows], dtype=np.float64).reshape(-1, 3),
            extents=np.array([row.extents for row in rows], dtype=np.float64).reshape(-1, 3),
            rows=rows,
            vertex_instance=found.vertex_instance,
            support_plane=found.support_plane,
        )

    def matches(self, scene: str, pairs: Sequence[int] | None = None) -> MatchArrays:
        """Matches of a scene: of some pairs of frames, or of all.

        Raises:
            UsageError: there is no such scene, or no matches have been made of it yet.
        """
        import numpy as np

        found = self._artifact(Correspondences, scene)
        table, of_pairs = found.matches(pairs), found.pairs()
        column = {name: table[name].to_numpy() for name in table.column_names}
        by_pair = {name: np.asarray(of_pairs[name].to_pylist()) for name in of_pairs.column_names}
        return MatchArrays(
            pair=column["pair"],
            instance=column["instance"],
            uv_a=np.stack([column["u_a"], column["v_a"]], axis=1),
            uv_b=np.stack([column["u_b"], column["v_b"]], axis=1),
            **{name: by_pair[name] for name in ("camera_a", "camera_b", "frame_a", "frame_b")},
        )

    def keypoints(self, demonstration: str, variant: str = "main") -> TrackArrays:
        """The keypoints tracked through a demonstration.

        Raises:
            UsageError: there is no such demonstration, or it has not been encoded yet.
        """
        track = self._artifact(KeypointTrack, demonstration, variant)
        return TrackArrays(
            names=tuple(track.names),
            filter=track.metadata.filter,
            mean=track.mean,
            mode=track.mode,
            covariance=track.covariance,
            pixel={name: track.pixel(name) for name in track.camera_names},
            observed={name: track.observed(name) for name in track.camera_names},
        )

    def run(
        self, stage: str, only: str | Sequence[str] = (), variant: str = "main", force: bool = False, **params: Any
    ) -> list[Outcome]:
        """Make what one stage has to make, as `bask-data STAGE` does, with the dataset's own params.yaml.

        Args:
            only: names of scenes or demonstrations; by default all.
            force: make again what is up to date.
            params: the stage's, by name.

        Raises:
            UsageError: there is no such stage, item or parameter, or an input is missing.
            BaskError: what made the first task fail.
        """
        chosen = self._stage(stage)
        names = (only,) if isinstance(only, str) else tuple(only)
        config = {section: fields for section, fields in self._config().items() if section.split("@")[0] == stage}
        tasks = plan(self._dataset, chosen, config=config, options=params, only=names, variant=variant)
        outcomes = list(run(tasks, force=force))
        for outcome in outcomes:
            if outcome.status == "failed":
                raise outcome.error or BaskError(outcome.path, expected="to be made", got=outcome.why)
            if outcome.status == "blocked":
                raise UsageError(self.root, outcome.label, expected="its inputs", got=outcome.why)
        return outcomes

    def status(self) -> StatusRows:
        """What is up to date, missing, stale or blocked, and why."""
        from bask_data.pipeline import STAGES

        config, rows = self._config(), []
        for stage in STAGES:
            own = {section: fields for section, fields in config.items() if section.split("@")[0] == stage.name}
            for task in plan(self._dataset, stage, config=own):
                state = state_told(task)
                rows.append((task.label, state.status, state.why))
        return StatusRows(rows)

    def __repr__(self) -> str:
        counts = f"{len(self.scans)} scans, {len(self.demonstrations)} demonstrations"
        return f"<dataset {self.name} at {self.root}: {counts}>"

    def _repr_html_(self) -> str:
        found = [*self.scans.values(), *self.demonstrations.values()]
        pictures = "".join(f"<td>{one._repr_html_()}</td>" for one in found[:3])
        return f"<p><b>{escape(repr(self))}</b></p><table><tr>{pictures}</tr></table>"

    def _stage(self, name: str) -> Stage:
        from bask_data.pipeline import STAGES

        found = {stage.name: stage for stage in STAGES}
        if name not in found:
            raise UsageError(self.root, "stage", expected=f"one of {', '.join(found)}", got=name)
        return found[name]

    def _config(self) -> Config:
        from bask_data.config import load_config
        from bask_data.pipeline import STAGES

        own = self.root / "params.yaml"
        return load_config(own if own.exists() else None, (), STAGES)

    def _artifact(self, kind: type[A], item: str, variant: str = "main") -> A:
        from bask_data.pipeline import STAGES

        items = self._dataset.items(kind.scope)
        if item not in items:
            raise UsageError(self.root, kind.scope, expected=f"one of {', '.join(items) or 'none'}", got=item)
        variants = self._dataset.variants(kind)
        if variant not in variants:
            raise UsageError(self.root, "variant", expected=f"one of {', '.join(variants)}", got=variant)
        path = self._dataset.path(kind, item, variant)
        if not (path / MANIFEST).exists():
            makers = [stage.name for stage in STAGES if stage.makes is kind]
            fix = f'ds.run("{makers[0]}", only="{item}")' if makers else "ingest it again."
            raise UsageError(path, "", expected=kind.kind, got="none", fix=fix)
        return kind(path)

    def _recording(self, kind: type[Scan] | type[Demonstration], name: str) -> RecordedFrames:
        cameras: dict[str, CameraMasks] = {}

        def mask(camera: str, i_frame: int) -> np.ndarray:
            if kind is Demonstration:
                got = f"the demonstration {name}"
                raise UsageError(self.root, "mask", expected="a frame of a scan", got=got)
            if camera not in cameras:
                cameras[camera] = self._artifact(VisibleMasks, name).camera(camera)
            return cameras[camera].instance(i_frame)

        return RecordedFrames(self._artifact(kind, name), mask)


def open(root: Path | str) -> OpenDataset:
    """Open the dataset at `root`.

    Raises:
        BadData: there is none.
    """
    return OpenDataset(root)
