"""Checks that apply to every encoder."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def cells_of(encoder: nn.Module, size: tuple[int, int]) -> tuple[int, ...]:
    """Shape of the output for an image of `size` (height, width)."""
    with torch.no_grad():
        return tuple(encoder.eval()(torch.zeros(1, 3, *size)).shape)


def turned(x: Tensor) -> Tensor:
    """Images rotated by 180 degrees."""
    return x.flip(-1, -2)
