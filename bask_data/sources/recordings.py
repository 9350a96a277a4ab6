"""How a recording comes into a dataset, whoever made it: looked at first, written aside, truth before recording."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bask_data.artifact import Artifact, read_manifest
from bask_data.dataset import DATASET, Dataset
from bask_data.engine import Origin, Outcome, published
from bask_data.errors import UsageError, WouldOverwrite
from bask_data.kinds import Recording, Scan, Truth


def refuse_other_scope(dataset: Dataset | None, makes: type[Recording], item: str, fix: str = "") -> None:
    """A name stands for a scan or a demonstration, never for both; `UsageError`."""
    other = "demonstration" if makes is Scan else "scene"
    if dataset is not None and item in dataset.items(other):
        raise UsageError(dataset.root / DATASET, item, expected="a new name", got=f"the name of a {other}", fix=fix)


def is_current(root: Path, makes: type[Recording], item: str, key: str, fix: str, has_truth: bool) -> bool:
    """Whether the recording is there already, just as asked for, and its truth where it has one.

    Raises:
        WouldOverwrite: it is there with other content.
    """
    target = root / makes.kind / item
    if not target.exists():
        return False
    if read_manifest(target).key != key:
        raise WouldOverwrite(
            target,
            "",
            expected="no recording of that name",
            got="one from another source or with other options",
            fix=fix,
        )
    return not has_truth or (root / Truth.kind / item).exists()


def up_to_date(root: Path, makes: type[Recording], item: str) -> Outcome:
    """The outcome for a recording that is there already."""
    target = root / makes.kind / item
    digest = read_manifest(target).digest
    return Outcome(f"ingest {makes.kind} {item}", makes.kind, item, "main", str(target), "up to date", digest=digest)


@contextmanager
def undone_if_new(root: Path) -> Iterator[None]:
    """Leave no new dataset behind when what should have filled it fails."""
    is_new = not root.exists()
    try:
        yield
    except BaseException:
        # Another process may have ingested into the same new directory meanwhile.
        if is_new and not ((root / DATASET).exists() and Dataset(root).items("recording")):
            shutil.rmtree(root, ignore_errors=True)
        raise


def published_recording(
    dataset: Dataset, item: str, written: dict[type[Artifact], Path], origin: Origin, begun: float
) -> list[Outcome]:
    """Publish artifacts in their order; the outcomes name the last one first.

    Truth goes first, so that no kill leaves a recording that has lost its own.
    """
    outcomes = []
    for artifact, scratch in written.items():
        target = dataset.path(artifact, item)
        dataset.prepare(artifact)
        manifest = published(dataset.root, target, scratch, artifact=artifact, origin=origin, begun=begun)
        seconds = time.perf_counter() - begun
        label = f"ingest {artifact.kind} {item}"
        outcomes.append(Outcome(label, artifact.kind, item, "main", str(target), "made", "", seconds, manifest.digest))
    return outcomes[::-1]
