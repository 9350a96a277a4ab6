"""Vision transformers like DINOv2 for dense prediction, with sizes inferred from the weights.

Parameter names are those of Meta's published weights; `renamed` converts from Hugging Face's names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bask_data.nn.head import DescriptorHead
from bask_data.nn.resnet import STRIDE

CHANNELS_PER_HEAD = 64
"""Channels per attention head of every published DINO and DINOv2; the only size that weights do not reveal."""


@dataclass(frozen=True)
class Sizes:
    """Sizes of a vision transformer.

    Args:
        patch: edge of a patch, pixels.
        width: channels of a token.
        depth: number of blocks.
        n_positions: position embeddings, of a square of patches, with or without one for the class token.
        n_registers: register tokens, which belong to no patch.
        n_hidden: hidden channels of a block's MLP.
        gated: whether the MLP is gated (SwiGLU), as in the largest networks.
        scaled: whether blocks have a layer scale, as in DINOv2 but not in DINO.
    """

    patch: int
    width: int
    depth: int
    n_positions: int
    n_registers: int
    n_hidden: int
    gated: bool
    scaled: bool

    @property
    def n_side(self) -> int:
        """Patches along a side of the square of training images."""
        return math.isqrt(self.n_positions)


def sizes_of(state: Mapping[str, Tensor]) -> Sizes:
    """Sizes of the transformer that the weights belong to.

    Raises:
        ValueError: the weights are not those of a supported transformer.
    """
    expected = ("patch_embed.proj.weight", "cls_token", "pos_embed", "blocks.0.attn.qkv.weight")
    missing = [name for name in expected if name not in state]
    if missing:
        raise ValueError(f"names such as {min(state, default='none')}, not {missing[0]}")
    gated = "blocks.0.mlp.w12.weight" in state
    width, _, patch, _ = state["patch_embed.proj.weight"].shape
    if width % CHANNELS_PER_HEAD:
        raise ValueError(f"{width} channels, not a multiple of {CHANNELS_PER_HEAD}")
    n_positions = state["pos_embed"].shape[1]
    if n_positions - math.isqrt(n_positions) ** 2 > 1:
        raise ValueError(f"{n_positions} position embeddings, not those of a square of patches and a class token")
    registers = state.get("register_tokens")
    hidden = state["blocks.0.mlp.w3.weight" if gated else "blocks.0.mlp.fc2.weight"]
    return Sizes(
        patch=patch,
        width=width,
        depth=1 + max(int(name.split(".")[1]) for name in state if name.startswith("blocks.")),
        n_positions=n_positions,
        n_registers=0 if registers is None else registers.shape[1],
        n_hidden=hidden.shape[1],
        gated=gated,
        scaled="blocks.0.ls1.gamma" in state,
    )


def renamed(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights under Meta's names, from Meta's, timm's or Hugging Face's; the latter splits queries, keys and values."""
    if "embeddings.cls_token" not in state:
        return {name.replace("reg_token", "register_tokens"): value for name, value in state.items()}
    converted: dict[str, Tensor] = {}
    for name, value in state.items():
        if ".attention.attention.query." in name:
            three = [name.replace(".query.", f".{part}.") for part in ("query", "key", "value")]
            # If one is missing, loading fails by the shape.
            value = torch.cat([state[part] for part in three if part in state])
        elif ".attention.attention." in name:
            continue
        for theirs, ours in _HUGGING_FACE.items():
            name = name.replace(theirs, ours)
        converted[name] = value
    return converted


_HUGGING_FACE = {
    "embeddings.patch_embeddings.projection": "patch_embed.proj",
    "embeddings.position_embeddings": "pos_embed",
    "embeddings.": "",
    "encoder.layer.": "blocks.",
    "attention.attention.query": "attn.qkv",
    "attention.output.dense": "attn.proj",
    "layer_scale1.lambda1": "ls1.gamma",
    "layer_scale2.lambda1": "ls2.gamma",
    "mlp.weights_in": "mlp.w12",
    "mlp.weights_out": "mlp.w3",
    "layernorm.": "norm.",
}


class DenseViT(nn.Module):
    """A vision transformer whose patches cover 8x8 pixels of the image, with a descriptor head on its patch tokens."""

    def __init__(self, sizes: Sizes, n_outputs: int) -> None:
        super().__init__()
        width = sizes.width
        self.sizes = sizes
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, width, sizes.patch, stride=sizes.patch)})
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(0.02 * torch.randn(1, sizes.n_positions, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, sizes.n_registers, width)) if sizes.n_registers else None
        self.blocks = nn.ModuleList(Block(sizes) for _ in range(sizes.depth))
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.head = DescriptorHead((width,), n_outputs)

    def forward(self, x: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d h8 w8"]:
        """The output at stride 8; cell (i, j) describes the block of pixels from (8i, 8j) to (8i + 7, 8j + 7).

        The image is resized so that a patch covers exactly one such block, which gives descriptors the resolution of
        other backbones. With patches of 14, an image of 128 pixels becomes 224 pixels, the size in training.
        """
        height, width = x.shape[-2:]
        n_rows, n_columns = -(-height // STRIDE), -(-width // STRIDE)
        x = F.pad(x, (0, n_columns * STRIDE - width, 0, n_rows * STRIDE - height))
        if self.sizes.patch != STRIDE:
            size = (n_rows * self.sizes.patch, n_columns * self.sizes.patch)
            x = F.interpolate(x, size=size, mode="bilinear", align_corners=False)
        return self.head(self.features(x))

    def features(self, x: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c hp wp"]:
        """Normalised patch tokens of the last block."""
        tokens = self.patch_embed["proj"](x)
        n_rows, n_columns = tokens.shape[-2:]
        tokens = tokens.flatten(2).transpose(1, 2) + self.positions(n_rows, n_columns)
        first = [self.cls_token + self.class_position()]
        if self.register_tokens is not None:
            first.append(self.register_tokens)
        tokens = torch.cat([*(token.expand(len(x), -1, -1) for token in first), tokens], dim=1)
        for block in self.blocks:
            tokens = block(tokens)
        patches = self.norm(tokens)[:, -n_rows * n_columns :]
        return patches.transpose(1, 2).unflatten(2, (n_rows, n_columns))

    def positions(self, n_rows: int, n_columns: int) -> Float[Tensor, "1 n c"]:
        """Position embeddings of a grid of patches, interpolated from the learned ones."""
        n_side = self.sizes.n_side
        learned = self.pos_embed[:, -(n_side**2) :]
        if (n_rows, n_columns) == (n_side, n_side):
            return learned
        grid = learned.transpose(1, 2).unflatten(2, (n_side, n_side))
        # DINOv2 with registers was trained with antialiased interpolation, DINOv2 without was not.
        smooth = self.sizes.n_registers > 0
        resized = F.interpolate(grid, (n_rows, n_columns), mode="bicubic", align_corners=False, antialias=smooth)
        return resized.flatten(2).transpose(1, 2)

    def class_position(self) -> Float[Tensor, "1 k c"]:
        """The class token's position embedding; zero for networks without one."""
        if self.sizes.n_positions == self.sizes.n_side**2:
            return torch.zeros_like(self.cls_token)
        return self.pos_embed[:, :1]


class Block(nn.Module):
    """Attention between tokens, then an MLP on each token, both with skip connections."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(sizes.width, eps=1e-6)
        self.attn = Attention(sizes.width)
        self.ls1 = Scale(sizes.width) if sizes.scaled else nn.Identity()
        self.norm2 = nn.LayerNorm(sizes.width, eps=1e-6)
        self.mlp = (GatedLayers if sizes.gated else Layers)(sizes.width, sizes.n_hidden)
        self.ls2 = Scale(sizes.width) if sizes.scaled else nn.Identity()

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        """The block's output."""
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class Attention(nn.Module):
    """Multi-head self-attention."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        """The attention's output for each token."""
        n_heads = x.shape[-1] // CHANNELS_PER_HEAD
        query, key, value = self.qkv(x).unflatten(-1, (3, n_heads, CHANNELS_PER_HEAD)).permute(2, 0, 3, 1, 4)
        return self.proj(F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2))


class Layers(nn.Module):
    """An MLP of two linear layers."""

    def __init__(self, width: int, n_hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, n_hidden)
        self.fc2 = nn.Linear(n_hidden, width)

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        """The MLP's output for each token."""
        return self.fc2(F.gelu(self.fc1(x)))


class GatedLayers(nn.Module):
    """A gated MLP of two linear layers (SwiGLU)."""

    def __init__(self, width: int, n_hidden: int) -> None:
        super().__init__()
        self.w12 = nn.Linear(width, 2 * n_hidden)
        self.w3 = nn.Linear(n_hidden, width)

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        """The MLP's output for each token."""
        gate, values = self.w12(x).chunk(2, dim=-1)
        return self.w3(F.silu(gate) * values)


class Scale(nn.Module):
    """Layer scale: a learned factor for each channel."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        """Tokens, scaled."""
        return x * self.gamma
