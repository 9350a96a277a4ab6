"""Parquet tables of the kinds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bask_data.artifact import REMAKE, Artifact
from bask_data.errors import BadData
from bask_data.specs import TableSpec

if TYPE_CHECKING:
    import pyarrow as pa


def arrow_schema(spec: TableSpec) -> pa.Schema:
    """The Arrow schema of a table, with descriptions in the fields' metadata."""
    import pyarrow as pa

    return pa.schema(
        [
            pa.field(name, pa.type_for_alias(alias), metadata={"description": description}, nullable=False)
            for name, (alias, description) in spec.columns.items()
        ]
    )


def read_table(artifact: Artifact, name: str, filters: Any = None) -> pa.Table:
    """A table of the artifact; `BadData` if it is unreadable or has other columns."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = artifact.path / name
    try:
        table = pq.read_table(file, filters=filters, page_checksum_verification=True)
    except (OSError, pa.ArrowException) as error:
        raise BadData(file, "", expected="a Parquet table", got=str(error), fix=REMAKE) from error
    expected = arrow_schema(artifact.tables[name])
    if not table.schema.equals(expected):
        raise BadData(file, "columns", expected=str(expected.names), got=str(table.schema.names), fix=REMAKE)
    return table


def write_table(out: Any, artifact: type[Artifact], name: str, columns: dict[str, Any]) -> None:
    """Write a whole table."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = arrow_schema(artifact.tables[name])
    pq.write_table(pa.table(columns, schema=schema), out / name, compression="zstd", write_page_checksum=True)
