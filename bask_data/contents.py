"""What a dataset holds: each artifact with its size, its digest and what it states of itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bask_data.artifact import Artifact, read_json
from bask_data.dataset import Dataset
from bask_data.kinds import Recording
from bask_data.validate import artifacts_on_disk, total_bytes


@dataclass(frozen=True)
class Holding:
    """One artifact.

    Args:
        artifact: its path in the dataset.
        made_by: stage and version.
        cameras: of a recording, `frames x WIDTHxHEIGHT` by name.
    """

    artifact: str
    made_by: str
    bytes: int
    digest: str
    metadata: dict[str, Any]
    cameras: dict[str, str]


def contents(dataset: Dataset) -> list[Holding]:
    """Every artifact that the dataset lists and that exists, in the order of the kinds."""
    return [_holding(artifact, dataset) for artifact in artifacts_on_disk(dataset)]


def _holding(artifact: Artifact, dataset: Dataset) -> Holding:
    manifest = artifact.manifest
    return Holding(
        artifact=artifact.path.relative_to(dataset.root).as_posix(),
        made_by=f"{manifest.stage} v{manifest.stage_version}",
        bytes=total_bytes(manifest.files),
        digest=manifest.digest,
        metadata={key: value for key, value in artifact.attributes.items() if key not in ("kind", "schema")},
        cameras=_camera_sizes(artifact),
    )


def _camera_sizes(artifact: Artifact) -> dict[str, str]:
    if not isinstance(artifact, Recording):
        return {}
    # Off the documents: opening thousands of arrays with Zarr would take ten times as long.
    shapes = {name: read_json(artifact.path / name / "depth" / "zarr.json")["shape"] for name in artifact.camera_names}
    return {name: f"{n_frames} x {width}x{height}" for name, (n_frames, height, width) in shapes.items()}
