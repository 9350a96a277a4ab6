"""Options of `ingest maniskill`."""

from __future__ import annotations

from bask_data.formats.options.simulated import SimulatedOptions


class ManiskillOptions(SimulatedOptions):
    """A trajectory recorded or replayed by ManiSkill with images."""
