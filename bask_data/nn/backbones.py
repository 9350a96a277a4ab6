"""What a descriptor network can be built on."""

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
"""Mean of the colour channels in [0, 1] that torchvision's ResNets and the ViTs of DINO were trained with."""

IMAGENET_STD: Triple = (0.229, 0.224, 0.225)
"""Their standard deviation, from the same source: part of the published weights, nothing to choose."""


@dataclass(frozen=True)
class Backbone:
    """An encoder that images can be described with.

    An encoder takes normalised images to descriptors at stride 8, and what comes after its features is its `head`.

    Args:
        description: for a user who chooses.
        build: the encoder for a number of outputs. The weights it is built for tell what the name leaves open.
        frozen: only the head is trained, and the rest stays as it was given.
        weights: the file that is used where none is given; None starts from random weights.
        renamed: the weights under the encoder's names.
        ignored: beginnings of names of weights that the encoder has no use for.
        mean, std: of the colour channels in [0, 1], as the published weights were trained with.
        gains_by_bfloat16: on a CPU that computes in it. Convolutions of one channel each do not: a step of an
            EfficientNet takes 1.6 times as long in it as in float32.
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
"""By the name that `model.json` gives them."""


def named(name: str) -> Backbone:
    """The backbone of that name.

    Raises:
        ValueError: there is none.
    """
    if name not in BACKBONES:
        raise ValueError(f"backbone: expected one of {', '.join(BACKBONES)}, got {name}")
    return BACKBONES[name]
