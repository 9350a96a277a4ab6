"""Options of `ingest rlbench`."""

from __future__ import annotations

from bask_data.formats.options.simulated import SimulatedOptions


class RlbenchOptions(SimulatedOptions):
    """An episode saved by RLBench."""
