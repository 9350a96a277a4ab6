"""The backbones that a descriptor network can be built on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from torch import Tensor, nn

from bask_data.nn import efficientnet, vit
from bask_data.nn.resnet import DEPTHS, DenseResNet

Triple = tuple[float, float, float]
IMAGENET_MEAN: Triple = (0.485, 0.456, 0.406)
"""Mean of the colour channels in [0, 1] with which torchvision's ResNets and DINO's ViTs were trained."""

IMAGENET_STD: Triple = (0.229, 0.224, 0.225)
"""Their standard deviation; like the mean it belongs to the published weights and is not a setting."""


@dataclass(frozen=True)
class Backbone:
    """A kind of encoder, and how to build it.

    An encoder takes normalised images to descriptors at stride 8; the part after its features is named `head`.

    Args:
        description: one line for the user, also written to `model.json`.
        build: the encoder for a number of outputs; sizes that the name leaves open are read from the weights.
        frozen: only the head is trained; all other weights keep their pretrained values.
        weights: the default file of pretrained weights; None starts from random weights.
        renamed: converts a file's names of tensors to the encoder's.
        ignored: prefixes of names of weights that the encoder does not use.
        mean, std: of the colour channels in [0, 1], as in the training of the published weights.
        gains_by_bfloat16: whether bfloat16 is faster than float32 on a CPU that supports it. Depthwise convolutions
            are not: a step of an EfficientNet takes 1.6 times as long.
    """

    description: str
    build: Callable[[int, Mapping[str, Tensor]], nn.Module]
    frozen: bool = False
    weights: Callable[[], Path] | None = None
    renamed: Callable[[Mapping[str, Tensor]], Mapping[str, Tensor]] = dict
    ignored: tuple[str, ...] = ()
    mean: Triple = IMAGENET_MEAN
    std: Triple = IMAGENET_STD
    gains_by_bfloat16: bool = True


def _resnet(depth: int, n_outputs: int, state: Mapping[str, Tensor]) -> nn.Module:
    return DenseResNet(depth, n_outputs)


def _efficientnet(n_outputs: int, state: Mapping[str, Tensor]) -> nn.Module:
    return efficientnet.DenseEfficientNet(n_outputs)


def _vit(n_outputs: int, state: Mapping[str, Tensor]) -> nn.Module:
    return vit.DenseViT(vit.sizes_of(state), n_outputs)


def _no_weights() -> Path:
    raise ValueError("no file, and a vit has no weights of its own")


_EFFICIENTNET = Backbone(
    "EfficientNet-Lite0, features of strides 2 to 16 at stride 8",
    _efficientnet,
    weights=efficientnet.installed_weights,
    ignored=(*(f"_blocks.{i}." for i in range(efficientnet.N_BLOCKS, 16)), "_conv_head.", "_bn1.", "_fc."),
    mean=efficientnet.MEAN,
    std=efficientnet.STD,
    gains_by_bfloat16=False,
)

BACKBONES: dict[str, Backbone] = {
    **{
        f"resnet{depth}": Backbone(f"ResNet-{depth}, dilated to stride 8", partial(_resnet, depth), ignored=("fc.",))
        for depth in DEPTHS
    },
    "efficientnet-lite0": replace(_EFFICIENTNET, frozen=True),
    "efficientnet-lite0-tuned": _EFFICIENTNET,
    "vit": Backbone(
        "DINOv2-style ViT, a token for each block of 8x8 pixels",
        _vit,
        frozen=True,
        weights=_no_weights,
        renamed=vit.renamed,
        ignored=("mask_token", "head.", "fc_norm."),
    ),
}
"""By name, as in `model.json`."""


def named(name: str) -> Backbone:
    """The backbone of that name.

    Raises:
        ValueError: no backbone has this name.
    """
    if name not in BACKBONES:
        raise ValueError(f"backbone: expected one of {', '.join(BACKBONES)}, got {name}")
    return BACKBONES[name]
