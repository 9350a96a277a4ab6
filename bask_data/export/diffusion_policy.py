"""Diffusion policy: a replay buffer, a Zarr v2 hierarchy with the concatenated frames of all demonstrations in `data`
and their ends in `meta/episode_ends`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.artifact import read_json
from bask_data.errors import BadData
from bask_data.export.columns import Column
from bask_data.export.episodes import SPLITS, Episodes
from bask_data.export.images import blocks
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np
    import zarr

CHUNK_BYTES = 2**21
"""Largest size of a chunk before compression, bytes: ten images of 256x256. Training reads random windows of some 16
frames: larger chunks would be read mostly in vain, smaller ones would be many files. Changes no value."""


def write(out: Path, episodes: Episodes) -> list[str]:
    """Write the folder; there are no notes."""
    import numpy as np
    import zarr

    root = zarr.open_group(str(out), mode="w", zarr_format=2)
    data, meta = root.create_group("data"), root.create_group("meta")
    root.attrs["bask"] = episodes.described("diffusion-policy")
    state = Column("state", tuple(name for column in episodes.state for name in column.values), "float32", _STATE)
    appenders = {column.name: _appender(data, column, episodes.n_frames) for column in [*episodes.columns, state]}
    for name, size in episodes.cameras.items():
        appenders[name] = Appender(
            data, name, (episodes.n_frames, *size, 3), "uint8", {"description": "Red, green, blue."}
        )
    for episode in progress(episodes, "exporting demonstrations", len(episodes)):
        for name, values in {**episode.values, "state": episode.state}.items():
            appenders[name].append(values)
        for name, camera in episode.cameras.items():
            for block in blocks(camera, episode.entry.name, 32):
                appenders[name].append(block)
    for appender in appenders.values():
        appender.close()
    ends = np.cumsum([entry.n_frames for entry in episodes.entries])
    _write_whole(meta, "episode_ends", ends.astype(np.int64), "Number of the first frame after the episode.")
    splits = np.array([SPLITS.index(entry.split) for entry in episodes.entries], dtype=np.int64)
    _write_whole(meta, "episode_split", splits, f"Number of the episode's split among {', '.join(SPLITS)}.")
    return []


def description(folder: Path) -> object:
    """The description in the group's attributes, as Zarr has no place for other files; None if there is none."""
    file = folder / ".zattrs"
    with suppress(BadData):
        attributes = read_json(file) if file.is_file() else None
        return attributes.get("bask") if isinstance(attributes, dict) else None
    return None


_STATE = "A policy's observation: keypoints, their spread, gripper, as named in `values`."


class Appender:
    """Writer of an array in whole chunks, from parts of any length.

    Args:
        shape: of the whole array, frames first.
    """

    def __init__(
        self, group: zarr.Group, name: str, shape: tuple[int, ...], dtype: str, attributes: dict[str, Any]
    ) -> None:
        import numpy as np
        from numcodecs import Blosc

        frame = int(np.prod(shape[1:])) * np.dtype(dtype).itemsize
        self._chunk = max(1, min(shape[0], CHUNK_BYTES // max(1, frame)))
        self._array = group.create_array(
            name,
            shape=shape,
            chunks=(self._chunk, *shape[1:]),
            dtype=dtype,
            # Images take half the space of diffusion policy's default, lz4; every Blosc reads zstd.
            compressors=[Blosc("zstd", clevel=5, shuffle=Blosc.BITSHUFFLE)],
            attributes=attributes,
        )
        self._parts: list[np.ndarray] = []
        self._n_waiting = self._n_written = 0

    def append(self, values: np.ndarray) -> None:
        """Append frames."""
        self._parts.append(values)
        self._n_waiting += len(values)
        if self._n_waiting >= self._chunk:
            self._flush(self._n_waiting - self._n_waiting % self._chunk)

    def close(self) -> None:
        """Write the last chunk."""
        self._flush(self._n_waiting)
        assert self._n_written == self._array.shape[0], "zarr would fill what is missing with zeros"

    def _flush(self, n: int) -> None:
        import numpy as np

        if n:
            values = np.concatenate(self._parts)
            self._array[self._n_written : self._n_written + n] = values[:n]
            self._parts, self._n_waiting = [values[n:]], len(values) - n
            self._n_written += n


def _appender(data: zarr.Group, column: Column, n_frames: int) -> Appender:
    shape = (n_frames, column.width) if column.values else (n_frames,)
    attributes = {"description": column.description, "units": column.units, "values": list(column.values)}
    return Appender(data, column.name, shape, column.dtype, attributes)


def _write_whole(group: zarr.Group, name: str, values: np.ndarray, description: str) -> None:
    array = group.create_array(
        name, shape=values.shape, chunks=values.shape, dtype=values.dtype, attributes={"description": description}
    )
    array[...] = values
