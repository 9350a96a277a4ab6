"""What every encoder must do, whatever it is inside."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def cells_of(encoder: nn.Module, size: tuple[int, int]) -> tuple[int, ...]:
    """Shape of the answer to an image of that size."""
    with torch.no_grad():
        return tuple(encoder.eval()(torch.zeros(1, 3, *size)).shape)


def turned(x: Tensor) -> Tensor:
    """Half a turn."""
    return x.flip(-1, -2)
