"""Zarr arrays of the kinds: one chunk per frame, shards written as a whole, a checksum on every chunk."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.artifact import REMAKE, Artifact, write_group
from bask_data.errors import BadData
from bask_data.specs import ArraySpec

if TYPE_CHECKING:
    import numpy as np
    import zarr

SHARD_FRAMES = 64
"""Frames per shard. A shard is a file, written as a whole, and the unit of progress; writing single frames takes 10
times as long."""

_SHARD_BYTES = 96 * 2**20
"""Largest size of a shard before compression, bytes: it is in memory while it is written."""

CHUNK_ROWS = 256
"""Rows per chunk of a series: few enough to lose little, enough that an hour does not become thousands of files."""
_ROWS_PER_CHUNK = 2**18
"""Rows per chunk of a whole array: 3 MB of vertices, a few reads for a mesh."""


def start(out: Path, artifact: type[Artifact], metadata: dict[str, Any] | None = None) -> zarr.Group:
    """Create the root group of an artifact in `out`.

    The metadata is validated by the kind's model, so that a stage cannot publish what readers refuse.
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
        dimension_names=spec.dims_of(data.ndim),
    )
    if data.size:
        array[...] = np.ascontiguousarray(data, dtype=spec.dtype)


class FrameWriter:
    """Writer of an array of frames, shard by shard, so that memory does not grow with the number of frames.

    zarr silently truncates assignments of a wrong length; `close` therefore checks the number of frames.

    Args:
        n_frames: frames to come, or at most so many if `close` is told how many came.
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
        """Append a frame; `ValueError` for another shape or type, or too many frames."""
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
        """Write the buffer; `ValueError` if frames are missing."""
        self._flush()
        if self._n_written != self._n_frames:
            raise ValueError(f"{self._name}: {self._n_written} frames written, {self._n_frames} announced")

    def _flush(self) -> None:
        if self._n_buffered:
            end = self._n_written + self._n_buffered
            self._array[self._n_written : end] = self._buffer[: self._n_buffered]
            self._n_written, self._n_buffered = end, 0


class RowWriter:
    """Writer of an array of small rows of any number, chunk by chunk.

    Args:
        n_kept: rows to keep of an unfinished array, whole chunks; later ones are dropped.
    """

    def __init__(
        self, group: zarr.Group, artifact: type[Artifact], name: str, row_shape: tuple[int, ...], n_kept: int = 0
    ) -> None:
        import numpy as np
        import zarr.codecs

        assert n_kept % CHUNK_ROWS == 0, "only whole chunks can be kept"
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
        """Append a row; True if it completes a chunk, so that all rows so far are on disk."""
        if row.shape != self._buffer.shape[1:]:
            raise ValueError(f"{self._name}: expected a row {self._buffer.shape[1:]}, got {row.shape}")
        self._buffer[self._n_buffered] = row
        self._n_buffered += 1
        if self._n_buffered == CHUNK_ROWS:
            self.close()
            return True
        return False

    def close(self) -> None:
        """Write the buffer."""
        if not self._n_buffered:
            return
        begin = self._array.shape[0]
        self._array.resize((begin + self._n_buffered, *self._array.shape[1:]))
        self._array[begin:] = self._buffer[: self._n_buffered]
        self._n_buffered = 0
        _sync_chunk(self._array, begin // CHUNK_ROWS)


def _sync_chunk(array: zarr.Array, i_chunk: int) -> None:
    """Force a chunk and its folders to disk."""
    folder = Path(str(array.store_path.store.root)) / array.path  # type: ignore[attr-defined]
    chunk = folder / "c" / str(i_chunk)
    # zarr does not write chunks of zeros.
    paths = [*chunk.rglob("*"), chunk, folder / "c"] if chunk.exists() else []
    for path in (*paths, folder / "zarr.json", folder):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_frame(array: zarr.Array, i_frame: int, where: Path) -> np.ndarray:
    """One frame of an array; `BadData` if its chunk does not decode."""
    if not 0 <= i_frame < array.shape[0]:
        raise IndexError(f"{where}: frame {i_frame} of {array.shape[0]}")
    try:
        return array[i_frame]  # type: ignore[return-value]
    except Exception as error:
        raise BadData(where, f"frame {i_frame}", expected="a readable chunk", got=str(error), fix=REMAKE) from error


def read_all(group: zarr.Group, name: str, where: Path) -> np.ndarray:
    """A whole array in native byte order; `BadData` if it is missing or does not decode.

    zarr returns an explicit byte order, `<f8`, which Open3D refuses even if it is native.
    """
    try:
        array = group[name][...]  # type: ignore[index]
    except KeyError:
        raise BadData(where, name, expected="an array", got="none", fix=REMAKE) from None
    except Exception as error:
        raise BadData(where, name, expected="readable chunks", got=str(error), fix=REMAKE) from error
    return array.astype(array.dtype.newbyteorder("="))  # type: ignore[union-attr,return-value]


def spec_of(artifact: type[Artifact], name: str) -> ArraySpec:
    """The schema's entry for an array, with a camera's name in place of `{camera}`."""
    if name in artifact.arrays:
        return artifact.arrays[name]
    return artifact.arrays["{camera}/" + name.split("/", 1)[-1]]


def _attributes(spec: ArraySpec, attributes: dict[str, object]) -> dict[str, Any]:
    missing = set(spec.attributes) - set(attributes)
    assert not missing, f"the schema requires the attributes {missing}"
    return {"description": spec.description, **({"units": spec.units} if spec.units else {}), **attributes}
