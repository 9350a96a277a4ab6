"""Parquet: `frames.parquet` with one row per frame, `episodes.parquet`, and videos if requested."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.export.columns import Column
from bask_data.export.description import write_description
from bask_data.export.episodes import Episodes
from bask_data.export.images import frames
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa


def write(out: Path, episodes: Episodes) -> list[str]:
    """Write the folder; there are no notes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    described = episodes.described("parquet")
    schema = pa.schema(
        [
            pa.field("episode", pa.string(), nullable=False, metadata={"description": "Name of the demonstration."}),
            pa.field("split", pa.string(), nullable=False, metadata={"description": "train, validation or test."}),
            pa.field("frame", pa.int64(), nullable=False, metadata={"description": "Number in the demonstration."}),
            *(_field(column) for column in episodes.columns),
        ],
        metadata={"bask": json.dumps(described, ensure_ascii=False)},
    )
    options = {"compression": "zstd", "write_page_checksum": True}
    with pq.ParquetWriter(out / "frames.parquet", schema, **options) as writer:
        for episode in progress(episodes, "exporting demonstrations", len(episodes)):
            n = episode.entry.n_frames
            columns = [pa.array([episode.entry.name] * n), pa.array([episode.entry.split] * n), pa.array(range(n))]
            columns += [arrow(episode.values[column.name], column) for column in episodes.columns]
            # One row group per demonstration, so that each can be read without the others.
            writer.write_table(pa.Table.from_arrays(columns, schema=schema), row_group_size=n)
    pq.write_table(
        pa.Table.from_pylist([vars(entry) for entry in episodes.entries]), out / "episodes.parquet", **options
    )
    _write_videos(out, episodes)
    write_description(out, described)
    return []


def _write_videos(out: Path, episodes: Episodes) -> None:
    if not episodes.cameras:
        return
    from bask_data.formats.video import VideoWriter

    for episode in episodes:
        for name, camera in episode.cameras.items():
            file = out / "videos" / name / f"{episode.entry.name}.mp4"
            with VideoWriter(file, episode.entry.fps, episodes.cameras[name]) as video:
                for image in frames(camera, episode.entry.name):
                    video.append(image)


def arrow_type(column: Column) -> pa.DataType:
    """Arrow type of one frame's values: a scalar, or a list of fixed length."""
    import pyarrow as pa

    scalar = pa.type_for_alias(column.dtype)
    return pa.list_(scalar, column.width) if column.values else scalar


def arrow(values: np.ndarray, column: Column) -> pa.Array:
    """A column's values (t, width) or (t,) as an Arrow array."""
    import pyarrow as pa

    if not column.values:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), column.width)


def _field(column: Column) -> pa.Field:
    import pyarrow as pa

    metadata = {"description": column.description, "units": column.units, "values": json.dumps(column.values)}
    return pa.field(column.name, arrow_type(column), nullable=False, metadata=metadata)
