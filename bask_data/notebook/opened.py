"""A dataset as its user sees it: recordings by name, results as arrays, stages to run."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from bask_data.artifact import MANIFEST, Artifact
from bask_data.dataset import DATASET, Dataset
from bask_data.errors import UsageError
from bask_data.kinds import (
    Correspondences,
    Demonstration,
    KeypointTrack,
    ObjectInstances,
    Scan,
    VisibleMasks,
)
from bask_data.notebook.recordings import RecordedFrames, RecordingTable
from bask_data.notebook.results import MatchArrays, ObjectArrays, TrackArrays
from bask_data.spelling import choices, suggestion

if TYPE_CHECKING:
    import numpy as np

    from bask_data.kinds.masks import CameraMasks
    from bask_data.notebook.running import Outcomes, Standings

A = TypeVar("A", bound=Artifact)


class OpenDataset:
    """A dataset on disk, opened for reading; nothing is read before it is asked for."""

    def __init__(self, root: Path | str) -> None:
        """Open an existing dataset.

        Raises:
            BadData: there is none.
        """
        # A notebook may change its working directory, and nobody expands `~` for it.
        self.root = Path(root).expanduser().absolute()
        """Its directory."""
        # The stamp first: what is written between the two is then read again.
        self._stamp = self._stamp_of_file()
        self._read = Dataset(self.root)

    @property
    def _dataset(self) -> Dataset:
        """As it is: a command beside the notebook may have changed what it lists."""
        stamp = self._stamp_of_file()
        if stamp != self._stamp:
            self._read, self._stamp = Dataset(self.root), stamp
        return self._read

    def _stamp_of_file(self) -> tuple[int, ...]:
        file = self.root / DATASET
        found = file.stat() if file.exists() else None
        return (found.st_ino, found.st_size, found.st_mtime_ns) if found else ()

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
        return RecordingTable(self.root, "scan", names, partial(self._recording, Scan))

    @property
    def demonstrations(self) -> RecordingTable:
        """Demonstrations by name."""
        names = self._dataset.items("demonstration")
        return RecordingTable(self.root, "demonstration", names, partial(self._recording, Demonstration))

    def objects(self, scene: str) -> ObjectArrays:
        """The objects of a scene.

        Raises:
            UsageError: there is no such scene, or its objects have not been found yet.
        """
        import numpy as np

        found = self.artifact(ObjectInstances, scene)
        rows = tuple(found.instances)
        return ObjectArrays(
            id=np.array([row.id for row in rows], dtype=np.int64),
            centroid=np.array([row.centroid for row in rows], dtype=np.float64).reshape(-1, 3),
            extents=np.array([row.extents for row in rows], dtype=np.float64).reshape(-1, 3),
            rows=rows,
            vertex_instance=found.vertex_instance,
            support_plane=found.support_plane,
        )

    def matches(self, scene: str, pairs: int | Sequence[int] | None = None) -> MatchArrays:
        """Matches of a scene: of some pairs of frames, or of all.

        Raises:
            UsageError: there is no such scene or pair, or no matches have been made of it yet.
        """
        import numpy as np

        found = self.artifact(Correspondences, scene)
        if pairs is not None:
            pairs, n_pairs = _whole_numbers(pairs, found), found.pairs().num_rows
            unknown = [str(pair) for pair in pairs if not 0 <= pair < n_pairs]
            if unknown:
                expected = f"some of 0 to {n_pairs - 1}"
                raise UsageError(found.path, "pairs", expected=expected, got=", ".join(unknown))
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
        track = self.artifact(KeypointTrack, demonstration, variant)
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
        self, stage: str = "", only: str | Sequence[str] = (), variant: str = "main", force: bool = False, **params: Any
    ) -> Outcomes:
        """Make what is missing or stale, as `bask-data run` or `bask-data STAGE` does, and show how it goes on stderr.

        A parameter that is not given is as the dataset has it, in its params.yaml or from an earlier request. What is
        given is recorded with the dataset.

        Args:
            stage: the only one to run; by default all run, in order, for every variant that the dataset lists.
            only: names of scenes or demonstrations; by default all.
            variant: name of the stage's result, where there are to be several.
            force: make again what is up to date.
            params: the stage's, by name; and `descriptor="big"`, say, for the variant of an input.

        Raises:
            UsageError: there is no such stage, item or parameter, or an input is missing.
            BaskError: what the first task that failed raised, after the others.
        """
        from bask_data.notebook.running import made

        return made(self._dataset, stage, only, variant, force, params)

    def status(self, stages: str | Sequence[str] = (), only: str | Sequence[str] = ()) -> Standings:
        """What is up to date, missing, stale or blocked, and why.

        Args:
            stages: names; by default all.
            only: names of scenes or demonstrations; by default all.

        Raises:
            UsageError: there is no such stage or item.
        """
        from bask_data.notebook.running import standings_of

        return standings_of(self._dataset, stages, only)

    def __repr__(self) -> str:
        inside = ", ".join(repr(table)[1:-1] for table in (self.scans, self.demonstrations) if table)
        return f"<dataset {self.name} at {self.root}: {inside or 'no recordings'}>"

    def _repr_html_(self) -> str:
        shown = "".join(table._repr_html_() for table in (self.scans, self.demonstrations) if table)
        return f"<p><b>{escape(repr(self))}</b></p>{shown}"

    def artifact(self, kind: type[A], item: str = "", variant: str = "main") -> A:
        """An artifact of the dataset, as its kind reads it.

        Args:
            kind: class of `bask_data.kinds`.
            item: name of the scene or demonstration; empty for kinds with one artifact for the whole dataset.

        Raises:
            UsageError: there is no such item or variant, or the artifact has not been made yet.
        """
        from bask_data.pipeline import STAGES

        if kind.scope != "dataset":
            self._check(kind.scope, item, self._dataset.items(kind.scope))
        self._check("variant", variant, self._dataset.variants(kind))
        path = self._dataset.path(kind, item, variant)
        if not (path / MANIFEST).exists():
            makers = [stage.name for stage in STAGES if stage.makes is kind]
            only = f', only="{item}"' if item else ""
            fix = f'ds.run("{makers[0]}"{only})' if makers else "ingest it again."
            raise UsageError(path, "", expected=kind.kind, got="none", fix=fix)
        return kind(path)

    def _check(self, field: str, name: str, known: Iterable[str]) -> None:
        if name not in (known := list(known)):
            expected, fix = f"one of {choices(known) or 'none'}", suggestion(str(name), known)
            raise UsageError(self.root, field, expected=expected, got=name, fix=fix)

    def _recording(self, kind: type[Scan] | type[Demonstration], name: str) -> RecordedFrames:
        return RecordedFrames(self.artifact(kind, name), _MaskReader(self, kind, name))


class _MaskReader:
    """The masks of a recording, opened when one is asked for. It crosses to other processes by the recording's name."""

    def __init__(self, dataset: OpenDataset, kind: type[Scan] | type[Demonstration], name: str) -> None:
        self._dataset, self._kind, self._name = dataset, kind, name
        self._cameras: dict[str, CameraMasks] = {}

    def __call__(self, camera: str, i_frame: int) -> np.ndarray:
        if self._kind is Demonstration:
            got = f"the demonstration {self._name}"
            raise UsageError(self._dataset.root, "mask", expected="a frame of a scan", got=got)
        if camera not in self._cameras:
            self._cameras[camera] = self._dataset.artifact(VisibleMasks, self._name).camera(camera)
        return self._cameras[camera].instance(i_frame)

    def __reduce__(self) -> tuple[Any, ...]:
        return _MaskReader, (self._dataset, self._kind, self._name)


def _whole_numbers(pairs: Any, found: Correspondences) -> list[int]:
    """Numbers of pairs, one or several; `UsageError` for anything else: 1.7 is no pair, and not pair 1 either."""
    import numpy as np

    try:
        return [operator.index(pair) for pair in ([pairs] if np.ndim(pairs) == 0 else pairs)]
    except (TypeError, ValueError):
        raise UsageError(found.path, "pairs", expected="whole numbers", got=repr(pairs)) from None


def open(root: Path | str) -> OpenDataset:
    """Open the dataset at `root`.

    Raises:
        BadData: there is none.
    """
    return OpenDataset(root)
