"""Zarr arrays as the kinds use them: one frame a chunk, whole shards written at once, a checksum on every chunk."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.artifact import REMAKE, ArraySpec, Artifact, write_group
from bask_data.errors import BadData

if TYPE_CHECKING:
    import numpy as np
    import zarr

SHARD_FRAMES = 64
"""Frames in a shard, which is a file, written whole and the unit of progress; single frames written into one cost 10
times as much."""

_SHARD_BYTES = 96 * 2**20
"""Size of a shard before compression, at most: it is kept in memory while it is written."""

CHUNK_ROWS = 256
"""Rows of a series in a chunk: few enough to wait for, many enough that an hour does not become thousands of files."""
_ROWS_PER_CHUNK = 2**18
"""Rows of a table-like array in a chunk: 3 MB of vertices, a few reads for a mesh."""


def start(out: Path, artifact: type[Artifact], metadata: dict[str, Any] | None = None) -> zarr.Group:
    """Make `out` the root group of an artifact and return it for writing.

    The metadata is checked against the kind's model here, so that a stage cannot publish what no reader accepts.
    """
    import zarr

    checked = artifact.metadata_model.model_validate(metadata or {}).model_dump(mode="json")
    write_group(out, {"bask": {"kind": artifact.kind, "schema": artifact.schema_version, **checked}})
    return zarr.open_group(str(out), mode="r+", zarr_format=3)


def write_array(group: zarr.Group, artifact: type[Artifact], name: str, data: np.ndarray, **attributes: object) -> None:
    """Write a whole array that is not a stream of frames."""
    import numpy as np
    import zarr.codecs

    spec = spec_of(artifact, name)
    array = group.create_array(
        name,
        shape=data.shape,
        dtype=spec.dtype,
        chunks=tuple(max(1, min(n, _ROWS_PER_CHUNK)) if i == 0 else max(1, n) for i, n in enumerate(data.shape)),
        compressors=[zarr.codecs.ZstdCodec(level=5, checksum=True)],
        fill_value=0,
        attributes=_attributes(spec, attributes),
        dimension_names=spec.dims,
    )
    if data.size:
        array[...] = np.ascontiguousarray(data, dtype=spec.dtype)


class FrameWriter:
    """Appends frames to one array, a shard at a time, so that memory does not grow with the number of frames.

    zarr truncates an assignment of the wrong length without a word; `close` therefore counts.
    """

    def __init__(
        self,
        group: zarr.Group,
        artifact: type[Artifact],
        name: str,
        n_frames: int,
        frame_shape: tuple[int, ...],
        **attributes: object,
    ) -> None:
        import numpy as np
        import zarr.codecs

        spec = spec_of(artifact, name)
        frame_bytes = int(np.prod(frame_shape, dtype=np.int64)) * np.dtype(spec.dtype).itemsize
        n_shard = max(1, min(SHARD_FRAMES, n_frames, _SHARD_BYTES // max(frame_bytes, 1)))
        self._array = group.create_array(
            name,
            shape=(n_frames, *frame_shape),
            dtype=spec.dtype,
            chunks=(1, *frame_shape),
            shards=(n_shard, *frame_shape),
            compressors=[zarr.codecs.ZstdCodec(level=3, checksum=True)],
            fill_value=0,
            attributes=_attributes(spec, attributes),
            dimension_names=spec.dims,
        )
        self._buffer = np.empty((n_shard, *frame_shape), dtype=spec.dtype)
        self._name, self._n_frames, self._n_written, self._n_buffered = name, n_frames, 0, 0

    def append(self, frame: np.ndarray) -> None:
        """Add the next frame."""
        if frame.shape != self._buffer.shape[1:] or frame.dtype != self._buffer.dtype:
            raise ValueError(
                f"{self._name}: expected a frame {self._buffer.shape[1:]} {self._buffer.dtype}, "
                f"got {frame.shape} {frame.dtype}"
            )
        if self._n_written + self._n_buffered >= self._n_frames:
            raise ValueError(f"{self._name}: more than the {self._n_frames} frames that were announced")
        self._buffer[self._n_buffered] = frame
        self._n_buffered += 1
        if self._n_buffered == len(self._buffer):
            self._flush()

    def close(self) -> None:
        """Write what is buffered. Every announced frame must have come."""
        self._flush()
        if self._n_written != self._n_frames:
            raise ValueError(f"{self._name}: {self._n_written} frames written, {self._n_frames} announced")

    def _flush(self) -> None:
        if self._n_buffered:
            end = self._n_written + self._n_buffered
            self._array[self._n_written : end] = self._buffer[: self._n_buffered]
            self._n_written, self._n_buffered = end, 0


class RowWriter:
    """Appends small rows to one array, a chunk at a time. Nobody needs to know how many there will be.

    Args:
        n_kept: rows to go on after, of what a killed writer left: whole chunks. What it wrote beyond goes.
    """

    def __init__(
        self, group: zarr.Group, artifact: type[Artifact], name: str, row_shape: tuple[int, ...], n_kept: int = 0
    ) -> None:
        import numpy as np
        import zarr.codecs

        assert n_kept % CHUNK_ROWS == 0, "only whole chunks can be gone on after"
        spec = spec_of(artifact, name)
        if n_kept:
            self._array: zarr.Array = group[name]  # type: ignore[assignment]
            self._array.resize((n_kept, *row_shape))
        else:
            self._array = group.create_array(
                name,
                shape=(0, *row_shape),
                dtype=spec.dtype,
                chunks=(CHUNK_ROWS, *(max(1, n) for n in row_shape)),
                compressors=[zarr.codecs.ZstdCodec(level=5, checksum=True)],
                fill_value=0,
                attributes=_attributes(spec, {}),
                dimension_names=spec.dims,
            )
        self._name, self._n_buffered = name, 0
        self._buffer = np.empty((CHUNK_ROWS, *row_shape), dtype=spec.dtype)

    def append(self, row: np.ndarray) -> bool:
        """Add a row; whether that was the last of a chunk, so that all rows so far are on disk."""
        if row.shape != self._buffer.shape[1:]:
            raise ValueError(f"{self._name}: expected a row {self._buffer.shape[1:]}, got {row.shape}")
        self._buffer[self._n_buffered] = row
        self._n_buffered += 1
        if self._n_buffered == CHUNK_ROWS:
            self.close()
            return True
        return False

    def close(self) -> None:
        """Write what is buffered."""
        if not self._n_buffered:
            return
        begin = self._array.shape[0]
        self._array.resize((begin + self._n_buffered, *self._array.shape[1:]))
        self._array[begin:] = self._buffer[: self._n_buffered]
        self._n_buffered = 0
        _sync_chunk(self._array, begin // CHUNK_ROWS)


def _sync_chunk(array: zarr.Array, i_chunk: int) -> None:
    """Force a chunk and what leads to it to disk, before anything relies on it."""
    folder = Path(str(array.store_path.store.root)) / array.path  # type: ignore[attr-defined]
    chunk = folder / "c" / str(i_chunk)
    # zarr writes no chunk that is zeros throughout.
    there = [*chunk.rglob("*"), chunk, folder / "c"] if chunk.exists() else []
    for path in (*there, folder / "zarr.json", folder):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_frame(array: zarr.Array, i_frame: int, where: Path) -> np.ndarray:
    """One frame of a stream; `BadData` when its chunk does not decode."""
    if not 0 <= i_frame < array.shape[0]:
        raise IndexError(f"{where}: frame {i_frame} of {array.shape[0]}")
    try:
        return array[i_frame]  # type: ignore[return-value]
    except Exception as error:
        raise BadData(where, f"frame {i_frame}", expected="a readable chunk", got=str(error), fix=REMAKE) from error


def read_all(group: zarr.Group, name: str, where: Path) -> np.ndarray:
    """A whole array; `BadData` when it is missing or does not decode.

    zarr gives an explicit byte order, `<f8`, which Open3D refuses even where it is the machine's own.
    """
    try:
        array = group[name][...]  # type: ignore[index]
    except KeyError:
        raise BadData(where, name, expected="an array", got="nothing", fix=REMAKE) from None
    except Exception as error:
        raise BadData(where, name, expected="readable chunks", got=str(error), fix=REMAKE) from error
    return array.astype(array.dtype.newbyteorder("="))  # type: ignore[union-attr,return-value]


def spec_of(artifact: type[Artifact], name: str) -> ArraySpec:
    """The schema's entry for an array, where the name of a camera stands for `{camera}`."""
    if name in artifact.arrays:
        return artifact.arrays[name]
    return artifact.arrays["{camera}/" + name.split("/", 1)[-1]]


def _attributes(spec: ArraySpec, attributes: dict[str, object]) -> dict[str, Any]:
    missing = set(spec.attributes) - set(attributes)
    assert not missing, f"attributes {missing} are promised by the schema"
    return {"description": spec.description, **({"units": spec.units} if spec.units else {}), **attributes}
