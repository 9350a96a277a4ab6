"""Options of `ingest stray`."""

from __future__ import annotations

from bask_data.formats.options.common import OneCameraOptions


class StrayOptions(OneCameraOptions):
    """A recording of the app Stray Scanner."""
