"""RGB-D scans in; object masks, dense correspondence and Bayesian scene keypoints out."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bask_data import errors as errors
    from bask_data import torch as torch
    from bask_data.notebook.opened import open as open
    from bask_data.tracker import KeypointTracker as KeypointTracker

__version__ = "0.1.0"
# Without `open` and `torch`: a star must neither replace a builtin nor load torch.
__all__ = ["KeypointTracker", "__version__"]

# Every import of a module imports this package, and the modules behind these names are slow to import.
_LAZY = {"KeypointTracker": "bask_data.tracker", "errors": "", "open": "bask_data.notebook.opened", "torch": ""}


def __getattr__(name: str) -> object:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if not _LAZY[name]:
        return import_module(f"bask_data.{name}")
    return getattr(import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    # Without the submodules that happen to be imported, and what this file imports.
    return sorted({*_LAZY, *(name for name in globals() if name.startswith("__"))})
