"""Correspondences: pixels of two frames that show the same point of a surface."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from bask_data.artifact import REMAKE, Artifact, Metadata, write_group
from bask_data.errors import BadData
from bask_data.kinds.tables import arrow_schema, read_table
from bask_data.specs import TableSpec

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq

Rejection = Literal[
    "outside_b",
    "no_depth_in_b",
    "hidden_in_b",
    "other_surface_in_b",
    "other_instance_in_b",
    "doubtful_in_b",
    "cycle",
    "edge_in_b",
]
"""Why a candidate pixel is not a match: the first test that it failed.

- `outside_b`: its point is outside the second image.
- `no_depth_in_b`: the second frame has no depth there.
- `hidden_in_b`: an occluder is in front of the point.
- `other_surface_in_b`: the visible surface is farther away.
- `other_instance_in_b`: the pixel shows another object, or none.
- `doubtful_in_b`: the same object, but at the edge of its mask or of a surface, seen too obliquely, or contradicted by
  the measurement.
- `cycle`: the way back by the depth of the second frame does not return to the pixel.
- `edge_in_b`: an occluder is so close to the pixel that it may hide the point.
"""
ROWS_PER_GROUP = 1 << 16
"""Rows per row group, buffered until written: 1 MB of matches."""
TABLES_KEPT = 256
"""Small tables buffered before they are concatenated: each takes kilobytes, however few its rows."""


class CorrespondencesMetadata(Metadata):
    """Numbers of candidate pixels, of matches and of rejections by reason; warnings for the user."""

    n_pairs: int
    n_attempts: int
    n_matches: int
    rejections: dict[Rejection, int]
    warnings: list[str] = []


class PairRow(Metadata):
    """Two frames, with distance (metres) and angle (radians) between their cameras."""

    camera_a: str
    frame_a: int
    camera_b: str
    frame_b: int
    n_attempts: int
    distance: float
    angle: float


class Correspondences(Artifact):
    """Matches between pairs of frames of one scan."""

    kind = "correspondences"
    scope = "scene"
    schema_version = 2
    metadata_model = CorrespondencesMetadata
    tables = {
        "pairs.parquet": TableSpec(
            {
                "pair": ("int32", "number of the pair"),
                "camera_a": ("string", "camera of the first frame"),
                "frame_a": ("int32", "number of the first frame"),
                "camera_b": ("string", "camera of the second frame"),
                "frame_b": ("int32", "number of the second frame"),
                "n_attempts": ("int32", "pixels of the first frame that were tried"),
                "n_matches": ("int32", "pixels that passed every test"),
                "distance": ("float32", "metres between the camera centres"),
                "angle": ("float32", "radians between the camera orientations"),
            }
        ),
        "matches.parquet": TableSpec(
            {
                "pair": ("int32", "number of the pair"),
                "instance": ("uint8", "object that both pixels show"),
                "u_a": ("float32", "pixel in the first frame; integers are pixel centres"),
                "v_a": ("float32", "pixel in the first frame"),
                "u_b": ("float32", "pixel in the second frame"),
                "v_b": ("float32", "pixel in the second frame"),
            }
        ),
        "rejections.parquet": TableSpec(
            {
                "pair": ("int32", "number of the pair"),
                "instance": ("uint8", "object that the pixel of the first frame shows"),
                "reason": ("string", "first test that it failed"),
                "n": ("int32", "number of such pixels, never 0"),
            }
        ),
    }

    def pairs(self) -> pa.Table:
        """All pairs, in order."""
        return read_table(self, "pairs.parquet")

    def matches(self, pairs: Sequence[int] | None = None) -> pa.Table:
        """Matches of all pairs, or of the given ones, sorted by pair."""
        filters = None if pairs is None else [("pair", "in", [int(pair) for pair in pairs])]
        return read_table(self, "matches.parquet", filters=filters)

    def matches_of_pair(self, pair: int) -> pa.Table:
        """Matches of one pair, from the row group that holds them: for readers of single pairs in any order.

        Raises:
            BadData: the tables are unreadable, or contradict each other.
        """
        import numpy as np
        import pyarrow as pa
        import pyarrow.parquet as pq

        file, (rows_begin, groups_begin, footer) = self.path / "matches.parquet", self._layout
        begin, end = rows_begin[pair], rows_begin[pair + 1]
        if begin == end:
            return arrow_schema(self.tables[file.name]).empty_table()
        i_group = int(np.searchsorted(groups_begin, begin, side="right")) - 1
        try:
            with pq.ParquetFile(file, metadata=footer, page_checksum_verification=True) as stored:
                group = stored.read_row_group(i_group, use_threads=False)
        except (OSError, pa.ArrowException) as error:
            raise BadData(file, "", expected="a Parquet table", got=str(error), fix=REMAKE) from error
        rows = group.slice(begin - groups_begin[i_group], end - begin)
        if rows.num_rows != end - begin or not (rows["pair"].to_numpy() == pair).all():
            raise BadData(file, "pair", expected=f"{end - begin} rows of pair {pair}", got="others", fix=REMAKE)
        return rows

    @cached_property
    def _layout(self) -> tuple[np.ndarray, np.ndarray, pq.FileMetaData]:
        """First row of each pair and of each row group, both with the end, and the footer of the matches."""
        import numpy as np
        import pyarrow as pa
        import pyarrow.parquet as pq

        file, n_by_pair = self.path / "matches.parquet", self.pairs()["n_matches"].to_numpy()
        try:
            footer = pq.read_metadata(file)
        except (OSError, pa.ArrowException) as error:
            raise BadData(file, "", expected="a Parquet table", got=str(error), fix=REMAKE) from error
        if not footer.schema.to_arrow_schema().equals(arrow_schema(self.tables[file.name])):
            raise BadData(file, "columns", expected=str([*self.tables[file.name].columns]), got="others", fix=REMAKE)
        if footer.num_rows != n_by_pair.sum():
            raise BadData(file, "", expected=f"{n_by_pair.sum()} rows", got=str(footer.num_rows), fix=REMAKE)
        n_by_group = [footer.row_group(i).num_rows for i in range(footer.num_row_groups)]
        return np.cumsum([0, *n_by_pair]), np.cumsum([0, *n_by_group]), footer

    def rejections(self) -> pa.Table:
        """Numbers of rejected pixels by pair, object and reason."""
        return read_table(self, "rejections.parquet")

    def summary(self) -> list[str]:
        """Outcomes of the candidate pixels, one per line, the most frequent first."""
        numbers = self.metadata
        outcomes = [("match", numbers.n_matches), *sorted(numbers.rejections.items(), key=lambda row: -row[1])]
        return [f"{numbers.n_pairs} pairs of frames, {numbers.n_attempts} pixels tried"] + [
            f"{n:>9}  {n / numbers.n_attempts:6.1%}  {name}" for name, n in outcomes if n
        ]

    @staticmethod
    @contextmanager
    def writer(out: Path) -> Iterator[CorrespondencesWriter]:
        """Open a writer of pairs; `warnings` may be appended to until it closes."""
        out.mkdir(parents=True, exist_ok=True)
        writer = CorrespondencesWriter(out)
        yield writer
        writer.close()


class CorrespondencesWriter:
    """Writer of pairs; a row group holds whole pairs."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._pairs, self._matches, self._rejections = (
            TableWriter(out, name) for name in ("pairs.parquet", "matches.parquet", "rejections.parquet")
        )
        self._n_pairs = self._n_attempts = self._n_matches = 0
        self._totals: Counter[str] = Counter()
        self.warnings: list[str] = []

    def append(
        self,
        row: PairRow,
        matches: Mapping[str, np.ndarray],
        rejections: Mapping[tuple[int, str], int] | None = None,
    ) -> None:
        """Append a pair.

        Args:
            matches: `instance` (m,) uint8 and `u_a`, `v_a`, `u_b`, `v_b` (m,) float32, pixels.
            rejections: number of pixels by object and reason.
        """
        n = len(matches["instance"])
        pair = self._n_pairs
        self._pairs.append(
            {name: [value] for name, value in ({"pair": pair} | row.model_dump() | {"n_matches": n}).items()}
        )
        self._matches.append({"pair": [pair] * n, **matches})
        counted = {key: count for key, count in (rejections or {}).items() if count}
        instances, reasons = [instance for instance, _ in counted], [reason for _, reason in counted]
        self._rejections.append(
            {"pair": [pair] * len(counted), "instance": instances, "reason": reasons, "n": list(counted.values())}
        )
        for reason, count in zip(reasons, counted.values(), strict=True):
            self._totals[reason] += count
        self._n_pairs += 1
        self._n_attempts += row.n_attempts
        self._n_matches += n

    def close(self) -> None:
        """Write the buffers and the metadata."""
        for table in (self._pairs, self._matches, self._rejections):
            table.close()
        metadata = CorrespondencesMetadata(
            n_pairs=self._n_pairs,
            n_attempts=self._n_attempts,
            n_matches=self._n_matches,
            rejections=dict(self._totals),  # type: ignore[arg-type]
            warnings=self.warnings,
        )
        attributes = {"kind": Correspondences.kind, "schema": Correspondences.schema_version}
        write_group(self._out, {"bask": {**attributes, **metadata.model_dump(mode="json")}})


class TableWriter:
    """Writer of a Parquet table; rows appended together stay in one row group."""

    def __init__(self, out: Path, name: str) -> None:
        import pyarrow.parquet as pq

        self._schema = arrow_schema(Correspondences.tables[name])
        self._file = pq.ParquetWriter(out / name, self._schema, compression="zstd", write_page_checksum=True)
        self._waiting: list[pa.Table] = []
        self._n_waiting = 0

    def append(self, columns: Mapping[str, Any]) -> None:
        """Append rows, given by column."""
        import pyarrow as pa

        self._waiting.append(pa.table({name: columns[name] for name in self._schema.names}, schema=self._schema))
        self._n_waiting += self._waiting[-1].num_rows
        if self._n_waiting >= ROWS_PER_GROUP:
            self._flush()
        elif len(self._waiting) >= TABLES_KEPT:
            self._waiting = [pa.concat_tables(self._waiting).combine_chunks()]

    def close(self) -> None:
        """Write the remaining rows and the table's footer."""
        self._flush()
        self._file.close()

    def _flush(self) -> None:
        import pyarrow as pa

        if self._n_waiting:
            self._file.write_table(pa.concat_tables(self._waiting).combine_chunks(), row_group_size=self._n_waiting)
        self._waiting, self._n_waiting = [], 0
