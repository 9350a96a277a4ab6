"""Schemas of the arrays and tables that a kind of artifact contains."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ArraySpec:
    """Schema of an array.

    Args:
        dims: names of the axes; equal names mean equal lengths (t, h, w: within a camera).
        other_dims: axes of the other shape that the array may have, if there is one.
        optional: the array may be absent.
    """

    dims: tuple[str, ...]
    dtype: str
    description: str
    units: str = ""
    attributes: tuple[str, ...] = ()
    optional: bool = False
    other_dims: tuple[str, ...] = ()

    def dims_of(self, n_axes: int) -> tuple[str, ...] | None:
        """Names of the axes of an array with so many; None if it may not have so many."""
        return next((dims for dims in (self.dims, self.other_dims) if dims and len(dims) == n_axes), None)


@dataclass(frozen=True)
class TableSpec:
    """Schema of a Parquet file: columns in order, each with an Arrow type and a description."""

    columns: dict[str, tuple[str, str]] = field(default_factory=dict)
