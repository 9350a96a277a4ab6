"""Options of `ingest scannet`."""

from __future__ import annotations

from bask_data.formats.options.common import OneCameraOptions, TimeOptions


class ScannetOptions(OneCameraOptions, TimeOptions):
    """A scan of ScanNet, exported or as it was downloaded."""
