"""Publishing of recordings, for all sources: checks first, scratch next, ground truth before the recording."""

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
    """Raise `UsageError` if a scan's name belongs to a demonstration, or the other way round."""
    other = "demonstration" if makes is Scan else "scene"
    if dataset is not None and item in dataset.items(other):
        raise UsageError(dataset.root / DATASET, item, expected="a new name", got=f"the name of a {other}", fix=fix)


def is_current(root: Path, makes: type[Recording], item: str, key: str, fix: str, has_truth: bool) -> bool:
    """Whether the recording is up to date, and has its ground truth if it should.

    Raises:
        WouldOverwrite: the recording exists with other content, or an older version made it: whether its source and
            options are the same cannot be told from its key, which covers the version.
    """
    target = root / makes.kind / item
    if not target.exists():
        return False
    manifest = read_manifest(target)
    if manifest.key != key and manifest.schema_version < makes.schema_version and makes.can_open(manifest):
        raise WouldOverwrite(
            target,
            "",
            expected=f"no recording of that name, or one of {makes.kind} v{makes.schema_version}",
            got=f"{makes.kind} v{manifest.schema_version}, made by an older version of bask-data",
            fix="keep it, as it opens as it is; or --force reads the source again: what was made of it is stale then.",
        )
    if manifest.key != key:
        raise WouldOverwrite(
            target,
            "",
            expected="no recording of that name",
            got="one from another source or with other options",
            fix=fix,
        )
    return not has_truth or (root / Truth.kind / item).exists()


def up_to_date(root: Path, makes: type[Artifact], item: str) -> Outcome:
    """Outcome of a recording that is up to date."""
    target = root / makes.kind / item
    digest = read_manifest(target).digest
    return Outcome(f"ingest {makes.kind} {item}", makes.kind, item, "main", str(target), "up to date", digest=digest)


@contextmanager
def undone_if_new(root: Path) -> Iterator[None]:
    """Remove a dataset that the block created if the block fails."""
    is_new = not root.exists()
    try:
        yield
    except BaseException:
        # Another process may have ingested into the same new dataset meanwhile.
        if is_new and not ((root / DATASET).exists() and Dataset(root).items("recording")):
            shutil.rmtree(root, ignore_errors=True)
        raise


def published_recording(
    dataset: Dataset, item: str, written: dict[type[Artifact], Path], origin: Origin, begun: float
) -> list[Outcome]:
    """Publish artifacts in their order, and return their outcomes in reverse.

    Ground truth is published first, so that a kill never leaves a recording without its own.

    Args:
        written: scratch folder by artifact type.
        begun: `time.perf_counter()` at the start of the work.
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
