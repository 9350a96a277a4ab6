"""RGB-D scans in; object masks, dense correspondence and Bayesian scene keypoints out."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bask_data.tracker import KeypointTracker as KeypointTracker

__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    # Everything imports this package, and only a robot's loop needs the filters behind this name.
    if name == "KeypointTracker":
        from bask_data.tracker import KeypointTracker

        return KeypointTracker
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
