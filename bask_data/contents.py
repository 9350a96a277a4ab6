"""Contents of a dataset: each artifact with its size, digest and metadata."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from bask_data.artifact import Artifact
from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.kinds import Recording
from bask_data.kinds.cameras import RecordingMetadata
from bask_data.spelling import number_of
from bask_data.validate import artifacts_on_disk, total_bytes


@dataclass(frozen=True)
class Holding:
    """An artifact of a dataset.

    Args:
        artifact: path relative to the dataset.
        made_by: stage and version.
        cameras: cameras of a recording, as `frames x WIDTHxHEIGHT` by name.
        stated: what a recording says of its reading beyond the assumptions, in short lines.
        fault: why the artifact cannot be read; then all other fields but its path are empty.
    """

    artifact: str
    made_by: str
    bytes: int
    digest: str
    metadata: dict[str, Any]
    cameras: dict[str, str]
    fault: str = ""
    stated: tuple[str, ...] = ()


def contents(dataset: Dataset) -> list[Holding]:
    """Every artifact that is listed in the dataset and exists, in order of kinds; damaged ones with the fault."""
    return [_holding_or_fault(artifact, dataset) for artifact in artifacts_on_disk(dataset)]


def _holding_or_fault(artifact: Artifact, dataset: Dataset) -> Holding:
    place = artifact.path.relative_to(dataset.root).as_posix()
    try:
        return _holding(artifact, place)
    except BadData as error:
        return Holding(place, made_by="", bytes=0, digest="", metadata={}, cameras={}, fault=str(error))


def _holding(artifact: Artifact, place: str) -> Holding:
    manifest = artifact.manifest
    return Holding(
        artifact=place,
        made_by=f"{manifest.stage} v{manifest.stage_version}",
        bytes=total_bytes(manifest.files),
        digest=manifest.digest,
        metadata={key: value for key, value in artifact.attributes.items() if key not in ("kind", "schema")},
        cameras=_camera_sizes(artifact),
        stated=tuple(_stated(artifact.metadata)) if isinstance(artifact, Recording) else (),
    )


def _camera_sizes(artifact: Artifact) -> dict[str, str]:
    if not isinstance(artifact, Recording):
        return {}
    shapes = artifact.camera_shapes()
    return {name: f"{n_frames} x {width}x{height}" for name, (n_frames, height, width) in shapes.items()}


def _stated(metadata: RecordingMetadata) -> Iterator[str]:
    if any(metadata.origin):
        yield f"origin {', '.join(f'{value:.12g}' for value in metadata.origin)} m in the source's world frame"
    if metadata.left_out:
        first, why = next(iter(metadata.left_out.items()))
        yield f"{number_of(len(metadata.left_out), 'frame')} left out, the first {first}: {why}"
    for camera, lens in metadata.lenses.items():
        yield f"{camera} undistorted from {' '.join([lens.model, *(f'{number:.6g}' for number in lens.parameters)])}"
