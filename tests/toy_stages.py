"""Two stages too small to be slow, for tests of the machinery. Importable, so that tasks cross processes."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from pydantic import Field

from bask_data.core.tsdf import Mesh
from bask_data.engine import Params, Splits, is_follower, stage
from bask_data.errors import BadData
from bask_data.kinds import DescriptorNet, InstanceRow, ObjectInstances, Pick, Reconstruction, ReferenceKeypoints, Scan


class FuseParams(Params):
    """Parameters of the toy reconstruction."""

    voxel_size: float = Field(0.1, gt=0, description="Edge of a voxel, metres.")
    fail: str = Field("", description="Text of an error to raise.")
    ignored: int = Field(0, description="Changes the key, but not the result.")
    file: str | None = Field(None, description="A file that is read.", json_schema_extra={"file": True})


@stage(makes=Reconstruction, version=1)
def fuse(scan: Scan, params: FuseParams, out: Path) -> None:
    """One triangle per frame."""
    if params.fail:
        raise BadData("frame", expected="something else", got=params.fail)
    n_frames = scan.camera("wrist").n_frames
    vertices = np.full((3 * n_frames, 3), params.voxel_size, dtype=np.float32)
    Reconstruction.write(
        out,
        Mesh(
            vertices,
            np.arange(3 * n_frames, dtype=np.int32).reshape(-1, 3),
            np.zeros((3 * n_frames, 3), dtype=np.uint8),
        ),
        voxel_size=params.voxel_size,
        bounds=(0, 0, 0, 1, 1, 1),
    )


@stage(makes=ObjectInstances, version=1)
def pick(reconstruction: Reconstruction, out: Path) -> None:
    """Everything is one object."""
    n_vertices = len(reconstruction.vertices)
    row = InstanceRow(id=1, n_vertices=n_vertices, area_m2=1.0, centroid=(0, 0, 0), extents=(1, 1, 1))
    ObjectInstances.write(
        out,
        vertex_instance=np.ones(n_vertices, dtype=np.int32),
        support_plane=np.zeros(4),
        instances=[row],
        warnings=[],
    )


@stage(makes=DescriptorNet, version=1, resumable=True, together=True)
def learn(scans: list[Scan], objects: list[ObjectInstances], splits: Splits, out: Path, log: Path) -> None:
    """Counts to three, failing once on the way."""
    log.mkdir(parents=True, exist_ok=True)
    (log / f"process{os.environ.get('RANK', 0)}").write_text(out.name)
    if is_follower():
        return
    progress_file = out / "state"
    n_done = int(progress_file.read_text()) if progress_file.exists() else 0
    for n in range(n_done + 1, 4):
        progress_file.write_text(str(n))
        if n == 2 and (scans[0].path.parent.parent / "interrupt").exists():
            raise KeyboardInterrupt
    progress_file.unlink()
    (out / "weights.safetensors").write_bytes(b"weights")
    (out / "model.json").write_text("{}")
    metrics = {"n_scans": float(len(scans)), "n_train": float(len(splits.train)), "resumed_at": float(n_done)}
    DescriptorNet.write(out, validated_on="nothing", metrics=metrics, curve=[(1, "loss", 0.5)])


class NameParams(Params):
    """Which scans are named, and whether a network is asked."""

    scans: tuple[str, ...] | None = Field(None, description="Those to name.")
    described: bool = Field(True, description="Whether a network is needed.")

    def reads(self, kind: str) -> tuple[str, ...] | None:
        """The named scans; no network if none is needed."""
        if kind == "scan":
            return self.scans
        return None if self.described else ()


@stage(makes=ReferenceKeypoints, version=1)
def label(scans: list[Scan], descriptor: DescriptorNet | None, params: NameParams, out: Path) -> None:
    """A keypoint in each scan; its descriptor says whether there was a network."""
    picks = [Pick(name=scan.path.name, recording=scan.path.name, camera="wrist", frame=0, u=0, v=0) for scan in scans]
    descriptors = np.full((len(scans), 1), descriptor is not None, np.float32)
    ReferenceKeypoints.write(out, descriptors=descriptors, picks=picks)


class WeighParams(Params):
    """The file that is read."""

    file: str | None = Field(None, description="A file that is read.", json_schema_extra={"file": True})


@stage(makes=ReferenceKeypoints, version=1)
def weigh(scans: list[Scan], params: WeighParams, out: Path) -> None:
    """A keypoint whose descriptor is the size of a file."""
    size = Path(params.file).stat().st_size if params.file else 0
    picks = [Pick(name="point", recording=scans[0].path.name, camera="wrist", frame=0, u=0, v=0)]
    ReferenceKeypoints.write(out, descriptors=np.full((1, 1), size, np.float32), picks=picks)
