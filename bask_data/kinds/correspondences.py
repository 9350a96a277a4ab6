"""Correspondences: pixels of two frames that show the same point of a surface."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.artifact import Artifact, Metadata, TableSpec, write_group
from bask_data.errors import BadData
from bask_data.kinds.tables import arrow_schema, read_table

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa


class CorrespondencesMetadata(Metadata):
    """How many candidates failed which test, and what a person should know (`warnings`)."""

    n_pairs: int
    n_matches: int
    rejections: dict[str, int]
    warnings: list[str] = []


class PairRow(Metadata):
    """Two frames. `distance` in metres and `angle` in radians between the cameras."""

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
    metadata_model = CorrespondencesMetadata
    tables = {
        "pairs.parquet": TableSpec(
            {
                "pair": ("int32", "number of the pair"),
                "camera_a": ("string", "camera of the first frame"),
                "frame_a": ("int32", "number of the first frame"),
                "camera_b": ("string", "camera of the second frame"),
                "frame_b": ("int32", "number of the second frame"),
                "n_attempts": ("int32", "candidates tried"),
                "n_matches": ("int32", "candidates that passed every test"),
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
    }

    def pairs(self) -> pa.Table:
        """All pairs, in order."""
        return read_table(self, "pairs.parquet")

    def matches(self, pairs: Sequence[int] | None = None) -> pa.Table:
        """Matches of some pairs, or of all; sorted by pair."""
        filters = None if pairs is None else [("pair", "in", [int(pair) for pair in pairs])]
        return read_table(self, "matches.parquet", filters=filters)

    @staticmethod
    def write(
        out: Path,
        pairs: Iterable[tuple[PairRow, dict[str, np.ndarray]]],
        rejections: dict[str, int],
        warnings: Sequence[str] = (),
    ) -> None:
        """Write pairs as they come, a row group of matches each.

        Args:
            pairs: a pair's row and its matches: `instance` (m,) uint8 and `u_a`, `v_a`, `u_b`, `v_b` (m,) float32.
            rejections: filled by the time `pairs` is exhausted.
        """
        import numpy as np
        import pyarrow as pa
        import pyarrow.parquet as pq

        out.mkdir(parents=True, exist_ok=True)
        rows: list[dict[str, object]] = []
        n_matches = 0
        schema = arrow_schema(Correspondences.tables["matches.parquet"])
        with pq.ParquetWriter(out / "matches.parquet", schema, compression="zstd", write_page_checksum=True) as writer:
            for i_pair, (row, matches) in enumerate(pairs):
                n = len(matches["instance"])
                rows.append({"pair": i_pair, **row.model_dump(), "n_matches": n})
                n_matches += n
                if n:
                    table = {"pair": np.full(n, i_pair, dtype=np.int32), **matches}
                    writer.write_table(pa.table({name: table[name] for name in schema.names}, schema=schema))
        pair_schema = arrow_schema(Correspondences.tables["pairs.parquet"])
        pq.write_table(
            pa.Table.from_pylist(rows, schema=pair_schema),
            out / "pairs.parquet",
            compression="zstd",
            write_page_checksum=True,
        )
        metadata = CorrespondencesMetadata(
            n_pairs=len(rows), n_matches=n_matches, rejections=rejections, warnings=list(warnings)
        )
        attributes = {"kind": Correspondences.kind, "schema": Correspondences.schema_version}
        write_group(out, {"bask": {**attributes, **metadata.model_dump(mode="json")}})
        if n_matches != sum(int(row["n_matches"]) for row in rows):  # type: ignore[call-overload]
            raise BadData(out, "n_matches", expected="the sum over pairs", got=n_matches)
