"""PyTorch datasets for `torch.utils.data.DataLoader`: `Frames(ds)` and `Matches(ds)`."""

from __future__ import annotations

from bask_data.notebook.loaders import FrameLoader as Frames
from bask_data.notebook.loaders import MatchLoader as Matches

__all__ = ["Frames", "Matches"]
