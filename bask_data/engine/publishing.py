"""Publishing an artifact, for stages and sources alike: fill a scratch directory, seal it, move it, record it."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bask_data.artifact import Artifact, Manifest, new_scratch, publish, seal
from bask_data.engine.provenance import record


@dataclass(frozen=True)
class Origin:
    """What made an artifact, and from which inputs, as the manifest states it.

    Args:
        inputs: content digest by path relative to the dataset, or by name if it is not an artifact.
        key: SHA-256 over everything the result depends on.
    """

    stage: str
    version: int
    params: dict[str, Any]
    inputs: dict[str, str]
    key: str


@contextmanager
def scratches(root: Path, artifacts: Sequence[type[Artifact]]) -> Iterator[dict[type[Artifact], Path]]:
    """An empty scratch directory for each artifact, removed at the end."""
    made: dict[type[Artifact], Path] = {}
    try:
        for artifact in artifacts:
            made[artifact] = new_scratch(root, artifact.kind)
        yield made
    finally:
        for scratch in made.values():
            shutil.rmtree(scratch, ignore_errors=True)


def published(
    root: Path, target: Path, scratch: Path, *, artifact: type[Artifact], origin: Origin, begun: float
) -> Manifest:
    """Seal a filled scratch directory, move it into place, and record its provenance.

    Args:
        target: where the artifact will be; an existing one is replaced.
        begun: `time.perf_counter()` at the beginning of the work.
    """
    manifest = seal(
        scratch,
        artifact=artifact,
        stage=origin.stage,
        stage_version=origin.version,
        params=origin.params,
        inputs=origin.inputs,
        key=origin.key,
    )
    publish(scratch, target)
    record(root, target, time.perf_counter() - begun, origin.key)
    return manifest
