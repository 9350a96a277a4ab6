"""Descriptor networks: trained weights and what is needed to run them."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.artifact import Artifact, Metadata, TableSpec, read_json
from bask_data.kinds.arrays import start
from bask_data.kinds.tables import read_table, write_table

if TYPE_CHECKING:
    import pyarrow as pa


class DescriptorMetadata(Metadata):
    """How well the network did.

    Args:
        validated_on: what the validation metrics were measured on, in words.
        metrics: validation metrics by name.
    """

    validated_on: str
    metrics: dict[str, float]


class DescriptorNet(Artifact):
    """A trained Dense Object Net: `weights.safetensors` and `model.json`."""

    kind = "descriptor"
    scope = "dataset"
    has_variants = True
    metadata_model = DescriptorMetadata
    tables = {
        "curve.parquet": TableSpec(
            {
                "step": ("int32", "optimiser steps done"),
                "name": ("string", "name of the term or metric"),
                "value": ("float32", "its value"),
            }
        )
    }
    files = {
        "weights.safetensors": "parameters by name",
        "model.json": "backbone, descriptor_dim, input size, normalisation",
    }

    @cached_property
    def model(self) -> dict[str, Any]:
        """The content of `model.json`."""
        return read_json(self.path / "model.json")

    def curve(self) -> pa.Table:
        """The training curve as (step, name, value) rows."""
        return read_table(self, "curve.parquet")

    @staticmethod
    def write(out: Path, *, validated_on: str, metrics: dict[str, float], curve: list[tuple[int, str, float]]) -> None:
        """Write metadata and curve; `weights.safetensors` and `model.json` are written beside them by the network."""
        start(out, DescriptorNet, {"validated_on": validated_on, "metrics": metrics})
        columns = {
            "step": [row[0] for row in curve],
            "name": [row[1] for row in curve],
            "value": [row[2] for row in curve],
        }
        write_table(out, DescriptorNet, "curve.parquet", columns)
