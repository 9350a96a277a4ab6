"""Options of `ingest record3d`."""

from __future__ import annotations

from bask_data.formats.options.common import OneCameraOptions


class Record3dOptions(OneCameraOptions):
    """A recording of the app Record3D."""
