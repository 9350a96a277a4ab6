"""The descriptor head: from an encoder's features to descriptors; all that is trained on a frozen encoder."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

HEAD_WIDTH = 128
"""Channels of the hidden layers. Chosen; sensitivity not measured."""


class DescriptorHead(nn.Module):
    """Features at stride 8 to descriptors: a linear layer plus a small convolutional network.

    The linear layer keeps similar features similar, so training starts from what the encoder has learned.

    Args:
        n_channels: channels of each group of features; every group is normalised separately.
    """

    def __init__(self, n_channels: tuple[int, ...], n_outputs: int) -> None:
        super().__init__()
        self.n_channels = n_channels
        self.linear = nn.Conv2d(sum(n_channels), n_outputs, 1, bias=False)
        self.gather = nn.Conv2d(sum(n_channels), HEAD_WIDTH, 1)
        self.mix = nn.Conv2d(HEAD_WIDTH, HEAD_WIDTH, 3, padding=1)
        self.out = nn.Conv2d(HEAD_WIDTH, n_outputs, 1)
        assert self.out.bias is not None
        nn.init.normal_(self.linear.weight, std=sum(n_channels) ** -0.5)
        nn.init.normal_(self.out.weight, std=HEAD_WIDTH**-0.5)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Float[Tensor, "b c h8 w8"]) -> Float[Tensor, "b d h8 w8"]:
        """The descriptors."""
        groups = features.split(self.n_channels, dim=1)
        scaled = torch.cat([F.layer_norm(x, x.shape[1:]) for x in groups], dim=1)
        x = F.relu(self.gather(scaled))
        return self.linear(scaled) + self.out(F.relu(x + self.mix(x)))
