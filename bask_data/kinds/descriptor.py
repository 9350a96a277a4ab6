"""Descriptor networks: trained weights and their description."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.artifact import MANIFEST, REMAKE, Artifact, Metadata, file_digest, read_json
from bask_data.errors import BadData
from bask_data.kinds.arrays import start
from bask_data.kinds.tables import read_table, write_table
from bask_data.specs import TableSpec

if TYPE_CHECKING:
    import pyarrow as pa

    from bask_data.nn.network import DescriptorNetwork


class DescriptorMetadata(Metadata):
    """Training and validation of the network.

    Args:
        validated_on: data of the validation metrics, in words.
        metrics: loss terms and validation metrics of the published weights, by name.
        step: optimiser steps of the published weights.
        chosen_by: metric by which they were selected; null: they are the last ones.
        learned_from: training scenes; null: unknown.
        held_out: share of each camera's frames in these scenes, the last ones, that were excluded from training.
    """

    validated_on: str
    metrics: dict[str, float]
    step: int
    chosen_by: str | None
    learned_from: tuple[str, ...] | None = None
    held_out: float = 0.0


class DescriptorNet(Artifact):
    """A trained Dense Object Net: `weights.safetensors` and `model.json`."""

    kind = "descriptor"
    scope = "dataset"
    has_variants = True
    schema_version = 2
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

    def network(self) -> DescriptorNetwork:
        """The network, folded for inference (`bask_data.nn.folding`).

        Raises:
            BadData: description or weights are corrupted, or of another version.
        """
        from bask_data.nn.folding import folded
        from bask_data.nn.network import load

        try:
            self._check_weights()
            return folded(load(self.path))
        except BadData:
            raise
        except Exception as error:  # torch and safetensors raise their own exceptions for corrupted files.
            got = str(error)[:200]
            raise BadData(self.path, "", expected="a network that loads", got=got, fix=REMAKE) from error

    def _check_weights(self) -> None:
        """Refuse weights other than the published ones, as a network with a corrupted weight still runs.

        Without a manifest, the files are accepted unchecked.
        """
        name = "weights.safetensors"
        if not (self.path / MANIFEST).exists() or name not in self.manifest.files:
            return
        expected, got = self.manifest.files[name].sha256, file_digest(self.path / name)
        if got != expected:
            raise BadData(
                self.path / name, "", expected=f"SHA-256 {expected[:12]}...", got=f"{got[:12]}...", fix=REMAKE
            )

    def curve(self) -> pa.Table:
        """The training curve as rows of step, name and value."""
        return read_table(self, "curve.parquet")

    def summary(self) -> list[str]:
        """Data of the validation, step of the weights, and curves of the loss and the metric, as lines of text."""
        rows = self.curve().to_pylist()
        metadata = self.metadata
        n_steps = max((row["step"] for row in rows), default=0)
        why = "the last" if metadata.chosen_by is None else f"best {metadata.chosen_by}"
        lines = [f"validated on {metadata.validated_on}", f"weights of step {metadata.step} of {n_steps}: {why}"]
        for name in ("loss", metadata.chosen_by):
            points = [(row["step"], row["value"]) for row in rows if row["name"] == name]
            if len(points) > 1:
                lines += [f"{name} {metadata.metrics[name]:.4g}", *_drawn(points)]
        return lines

    @staticmethod
    def write(
        out: Path,
        *,
        validated_on: str,
        metrics: dict[str, float],
        curve: list[tuple[int, str, float]],
        step: int = 0,
        chosen_by: str | None = None,
        learned_from: tuple[str, ...] | None = None,
        held_out: float = 0.0,
    ) -> None:
        """Write metadata and curve; the network itself writes `weights.safetensors` and `model.json`."""
        metadata = {"validated_on": validated_on, "metrics": metrics, "step": step, "chosen_by": chosen_by}
        start(out, DescriptorNet, {**metadata, "learned_from": learned_from, "held_out": held_out})
        columns = {
            "step": [row[0] for row in curve],
            "name": [row[1] for row in curve],
            "value": [row[2] for row in curve],
        }
        write_table(out, DescriptorNet, "curve.parquet", columns)


def _drawn(points: list[tuple[int, float]], width: int = 60, height: int = 6) -> list[str]:
    """A curve as lines of text."""
    import plotille

    steps, values = zip(*points, strict=True)
    figure = plotille.Figure()
    figure.width, figure.height, figure.with_colors = width, height, False
    figure.set_x_limits(0, max(steps))
    low, high = min(values), max(values)
    margin = 0.05 * (high - low) or 0.5
    figure.set_y_limits(low - margin, high + margin)
    figure.y_ticks_fkt = lambda value, _: f"{value:9.3g}"
    figure.x_ticks_fkt = lambda value, _: f"{round(value)}"
    figure.x_label, figure.y_label = "step", ""
    figure.plot(steps, values)
    return figure.show().splitlines()[1:]
