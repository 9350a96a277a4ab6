"""Residual networks for dense prediction: output stride 8, torchvision's parameter names and shapes.

torchvision is not needed; its published ImageNet weights load unchanged.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

STRIDE = 8
"""Input pixels per cell of the output, in each direction."""

_LAYERS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}
DEPTHS = tuple(_LAYERS)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions with a skip connection."""

    expansion = 1

    def __init__(self, n_in: int, n_middle: int, stride: int, dilation: int) -> None:
        super().__init__()
        self.conv1 = _conv3x3(n_in, n_middle, stride, dilation)
        self.bn1 = nn.BatchNorm2d(n_middle)
        self.conv2 = _conv3x3(n_middle, n_middle, 1, dilation)
        self.bn2 = nn.BatchNorm2d(n_middle)
        self.downsample = _shortcut(n_in, n_middle, stride)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        """The block's output."""
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = self.bn2(self.conv2(y))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)), inplace=True)


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 convolutions with a skip connection; the 3x3 has the stride, as in torchvision."""

    expansion = 4

    def __init__(self, n_in: int, n_middle: int, stride: int, dilation: int) -> None:
        super().__init__()
        n_out = n_middle * self.expansion
        self.conv1 = nn.Conv2d(n_in, n_middle, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(n_middle)
        self.conv2 = _conv3x3(n_middle, n_middle, stride, dilation)
        self.bn2 = nn.BatchNorm2d(n_middle)
        self.conv3 = nn.Conv2d(n_middle, n_out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(n_out)
        self.downsample = _shortcut(n_in, n_out, stride)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        """The block's output."""
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = F.relu(self.bn2(self.conv2(y)), inplace=True)
        y = self.bn3(self.conv3(y))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)), inplace=True)


class DenseResNet(nn.Module):
    """A ResNet with its last two layers dilated, not strided, and a 1x1 convolution, `head`, instead of `fc`.

    Raises:
        ValueError: the depth is none of `DEPTHS`.
    """

    def __init__(self, depth: int, n_outputs: int) -> None:
        super().__init__()
        if depth not in _LAYERS:
            raise ValueError(f"depth: expected one of {', '.join(map(str, DEPTHS))}, got {depth}")
        block = BasicBlock if depth < 50 else Bottleneck
        n1, n2, n3, n4 = _LAYERS[depth]
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = _layer(block, 64, 64, n1)
        self.layer2 = _layer(block, 64 * block.expansion, 128, n2, stride=2)
        # A layer that would halve the resolution dilates its kernels instead. Its first block still has the dilation of
        # the layer before.
        self.layer3 = _layer(block, 128 * block.expansion, 256, n3, dilations=(1, 2))
        self.layer4 = _layer(block, 256 * block.expansion, 512, n4, dilations=(2, 4))
        self.head = nn.Conv2d(512 * block.expansion, n_outputs, 1)
        assert self.head.bias is not None
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        # Initialised by its few outputs, the head would start with descriptors tens of units apart, beyond all margins.
        nn.init.normal_(self.head.weight, std=self.head.in_channels**-0.5)
        nn.init.zeros_(self.head.bias)

    def forward(self, x: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d h8 w8"]:
        """The output at stride 8; cell (i, j) describes the block of pixels from (8i, 8j) to (8i + 7, 8j + 7).

        Each of the three strided layers is centred on the first of the two pixels it joins, so that cell i would be
        centred on pixel 8i, the corner of its block. Padding by half a block and dropping the extra cell moves the
        centre to 8i + 4, half a pixel from the block's centre, which bilinear up-sampling assumes. Without this,
        descriptors shift by seven pixels when the image is rotated by 180 degrees.
        """
        height, width = x.shape[-2:]
        rest = (-height % STRIDE, -width % STRIDE)
        half = STRIDE // 2
        x = F.pad(x, (half, half + rest[1], half, half + rest[0]))
        x = F.relu(self.bn1(self.conv1(x)), inplace=True)
        x = F.max_pool2d(x, 3, stride=2, padding=1)
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return self.head(x[..., 1:, 1:])


def upsampled(descriptors: Float[Tensor, "b d h8 w8"], size: tuple[int, int]) -> Float[Tensor, "b d h w"]:
    """Descriptors at every pixel of the image of `size` (height, width) from which they were computed.

    Bilinear between the centres of the cells, in the convention of `core.geometry.scale_pixels`. A size that is not a
    multiple of the stride is rounded up to one, and the result cropped.
    """
    height, width = descriptors.shape[-2] * STRIDE, descriptors.shape[-1] * STRIDE
    full = F.interpolate(descriptors, size=(height, width), mode="bilinear", align_corners=False)
    return full[..., : size[0], : size[1]]


def sampled(descriptors: Float[Tensor, "b d h8 w8"], uv: Float[Tensor, "b m 2"]) -> Float[Tensor, "b m d"]:
    """Descriptors at sub-pixel positions (u, v) of the image, without up-sampling all of it.

    Equal to `upsampled` at pixel centres.
    """
    cells = (uv + 0.5) / STRIDE
    size = torch.tensor([descriptors.shape[-1], descriptors.shape[-2]], dtype=uv.dtype, device=uv.device)
    grid = (2.0 * cells / size - 1.0)[:, None]
    values = F.grid_sample(descriptors, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return values[:, :, 0].transpose(1, 2)


def _conv3x3(n_in: int, n_out: int, stride: int, dilation: int) -> nn.Conv2d:
    return nn.Conv2d(n_in, n_out, 3, stride=stride, padding=dilation, dilation=dilation, bias=False)


def _shortcut(n_in: int, n_out: int, stride: int) -> nn.Sequential | None:
    if stride == 1 and n_in == n_out:
        return None
    return nn.Sequential(nn.Conv2d(n_in, n_out, 1, stride=stride, bias=False), nn.BatchNorm2d(n_out))


def _layer(
    block: type[BasicBlock] | type[Bottleneck],
    n_in: int,
    n_middle: int,
    n_blocks: int,
    stride: int = 1,
    dilations: tuple[int, int] = (1, 1),
) -> nn.Sequential:
    first = block(n_in, n_middle, stride, dilations[0])
    rest = [block(n_middle * block.expansion, n_middle, 1, dilations[1]) for _ in range(n_blocks - 1)]
    return nn.Sequential(first, *rest)
