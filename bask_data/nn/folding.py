"""A network for inference: batch normalisation becomes part of the convolution before it, and all are oneDNN's."""

from __future__ import annotations

from copy import deepcopy
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from bask_data.nn.network import DescriptorNetwork


class FoldedConvolution(nn.Module):
    """A convolution and the batch normalisation after it, if there is one, in evaluation mode, as one convolution."""

    def __init__(self, convolution: nn.Conv2d, norm: nn.BatchNorm2d | None = None) -> None:
        super().__init__()
        # Fused in double precision, as rounding is then that of the result alone.
        weight = convolution.weight.detach().double()
        bias = None if convolution.bias is None else convolution.bias.detach().double()
        if norm is not None:
            assert norm.running_mean is not None and norm.running_var is not None
            mean, variance = norm.running_mean.double(), norm.running_var.double()
            gain, offset = norm.weight.detach().double(), norm.bias.detach().double()
            weight, bias = fuse_conv_bn_weights(weight, bias, mean, variance, norm.eps, gain, offset)
        dtype = convolution.weight.dtype
        self.weight = nn.Parameter(weight.to(dtype, memory_format=torch.channels_last), requires_grad=False)
        self.bias = None if bias is None else nn.Parameter(bias.to(dtype), requires_grad=False)
        self._stride = tuple(convolution.stride)
        self._padding = tuple(map(int, convolution.padding))
        self._dilation, self._groups = tuple(convolution.dilation), convolution.groups

    def forward(self, x: Tensor) -> Tensor:
        """The convolution's output, normalised."""
        if x.device.type == "cpu" and x.dtype == torch.float32 and torch.backends.mkldnn.is_available():
            # `conv2d` computes 1x1 convolutions on a single thread without oneDNN, which is slower.
            return torch.mkldnn_convolution(
                x, self.weight, self.bias, self._padding, self._stride, self._dilation, self._groups
            )
        return F.conv2d(x, self.weight, self.bias, self._stride, self._padding, self._dilation, self._groups)


def folded(network: DescriptorNetwork) -> DescriptorNetwork:
    """The network for inference: the same descriptors up to rounding, in less time. The argument stays as it is.

    In every encoder, a batch normalisation is registered right after the convolution whose output it takes. A folded
    network is returned itself.
    """
    if network.is_folded:
        return network
    network = deepcopy(network).eval()
    for module in list(network.encoder.modules()):
        for (name, child), (name_after, after) in pairwise([*module.named_children(), ("", None)]):
            if isinstance(child, nn.Conv2d):
                norm = after if isinstance(after, nn.BatchNorm2d) else None
                setattr(module, name, FoldedConvolution(child, norm))
                if norm is not None:
                    setattr(module, name_after, nn.Identity())
    network.encoder.requires_grad_(False)
    network.is_folded = True
    return network
