from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bask_data.nn.vit import DenseViT, Sizes, renamed, sizes_of
from tests.nn.encoders import cells_of, turned

PLAIN = Sizes(patch=14, width=128, depth=2, n_positions=17, n_registers=0, n_hidden=256, gated=False, scaled=True)
KINDS = {
    "dinov2": PLAIN,
    "with registers": Sizes(14, 192, 3, 26, 4, 96, gated=False, scaled=True),
    "gated": Sizes(14, 64, 1, 17, 4, 88, gated=True, scaled=True),
    "dino": Sizes(8, 64, 2, 10, 0, 128, gated=False, scaled=False),
    "no position of the class token": Sizes(16, 64, 1, 9, 0, 64, gated=False, scaled=True),
}


def network(sizes: Sizes = PLAIN, n_outputs: int = 4) -> DenseViT:
    """A network with random parameters, so that an omitted one is noticed."""
    torch.manual_seed(0)
    net = DenseViT(sizes, n_outputs).eval()
    with torch.no_grad():
        for name, parameter in net.named_parameters():
            is_factor = ("norm" in name and name.endswith("weight")) or "gamma" in name
            parameter.copy_(torch.randn_like(parameter) * 0.1 + is_factor)
    return net


def body(net: DenseViT) -> dict[str, Tensor]:
    return {name: value for name, value in net.state_dict().items() if not name.startswith("head.")}


def reference(state: dict[str, Tensor], sizes: Sizes, x: Tensor) -> Tensor:
    """An independent implementation of the transformer, patch by patch, with torch's own attention."""
    width, patch = sizes.width, sizes.patch
    n_rows, n_columns = x.shape[-2] // patch, x.shape[-1] // patch
    kernel = state["patch_embed.proj.weight"].flatten(1)
    tokens = []
    for row in range(n_rows):
        for column in range(n_columns):
            block = x[0, :, row * patch : (row + 1) * patch, column * patch : (column + 1) * patch]
            tokens.append(kernel @ block.flatten() + state["patch_embed.proj.bias"])
    assert (n_rows * n_columns) == sizes.n_side**2, "positions are not interpolated"
    first, patches = state["cls_token"][0, 0], torch.stack(tokens)
    if sizes.n_positions > sizes.n_side**2:
        first, patches = first + state["pos_embed"][0, 0], patches + state["pos_embed"][0, 1:]
    else:
        patches = patches + state["pos_embed"][0]
    registers = [state["register_tokens"][0]] if sizes.n_registers else []
    y = torch.cat([first[None], *registers, patches])
    for i in range(sizes.depth):
        part = {n.removeprefix(f"blocks.{i}."): v for n, v in state.items() if n.startswith(f"blocks.{i}.")}
        attention = nn.MultiheadAttention(width, width // 64, batch_first=True).eval()
        attention.load_state_dict(
            {
                "in_proj_weight": part["attn.qkv.weight"],
                "in_proj_bias": part["attn.qkv.bias"],
                "out_proj.weight": part["attn.proj.weight"],
                "out_proj.bias": part["attn.proj.bias"],
            }
        )
        z = F.layer_norm(y, (width,), part["norm1.weight"], part["norm1.bias"], eps=1e-6)[None]
        y = y + part.get("ls1.gamma", 1.0) * attention(z, z, z)[0][0]
        z = F.layer_norm(y, (width,), part["norm2.weight"], part["norm2.bias"], eps=1e-6)
        if sizes.gated:
            z = F.linear(z, part["mlp.w12.weight"], part["mlp.w12.bias"])
            gate, values = z[:, : sizes.n_hidden], z[:, sizes.n_hidden :]
            z = F.linear(gate * torch.sigmoid(gate) * values, part["mlp.w3.weight"], part["mlp.w3.bias"])
        else:
            z = F.linear(z, part["mlp.fc1.weight"], part["mlp.fc1.bias"])
            z = z * 0.5 * (1 + torch.erf(z / 2**0.5))
            z = F.linear(z, part["mlp.fc2.weight"], part["mlp.fc2.bias"])
        y = y + part.get("ls2.gamma", 1.0) * z
    y = F.layer_norm(y, (width,), state["norm.weight"], state["norm.bias"], eps=1e-6)
    return y[1 + sizes.n_registers :].T.reshape(1, width, n_rows, n_columns)


@pytest.mark.parametrize("kind", KINDS)
def test_features_equal_those_of_an_independent_implementation(kind):
    sizes = KINDS[kind]
    net, side = network(sizes), sizes.n_side * sizes.patch
    x = torch.randn(1, 3, side, side)
    with torch.no_grad():
        torch.testing.assert_close(net.features(x), reference(body(net), sizes, x), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_sizes_are_read_from_the_weights(kind):
    state = {**body(network(KINDS[kind])), "mask_token": torch.zeros(1, 64)}
    assert sizes_of(state) == KINDS[kind]


@pytest.mark.parametrize("kind", ["dinov2", "with registers", "gated"])
def test_weights_with_the_names_of_hugging_face_give_the_same_network(kind):
    state = body(network(KINDS[kind]))
    theirs: dict[str, Tensor] = {"embeddings.mask_token": torch.zeros(1, 64)}
    for name, value in state.items():
        start, _, rest = name.removeprefix("blocks.").partition(".")
        if ".attn.qkv." in name:
            for part, third in zip(("query", "key", "value"), value.chunk(3), strict=True):
                theirs[f"encoder.layer.{start}.attention.attention.{part}.{name.split('.')[-1]}"] = third
        elif name.startswith("blocks."):
            rest = rest.replace("attn.proj", "attention.output.dense").replace("gamma", "lambda1")
            rest = rest.replace("ls", "layer_scale").replace("mlp.w12", "mlp.weights_in").replace("w3", "weights_out")
            theirs[f"encoder.layer.{start}.{rest}"] = value
        elif name.startswith("norm."):
            theirs[f"layernorm.{start if start != 'norm' else rest}"] = value
        else:
            name = name.replace("patch_embed.proj", "patch_embeddings.projection")
            theirs[f"embeddings.{name.replace('pos_embed', 'position_embeddings')}"] = value
    found = renamed(theirs)
    assert found.pop("mask_token").shape == (1, 64)
    assert found.keys() == state.keys()
    for name, value in state.items():
        torch.testing.assert_close(found[name], value, atol=0, rtol=0)


def test_registers_with_timms_name_are_known():
    state = body(network(KINDS["with registers"]))
    state["reg_token"] = state.pop("register_tokens")
    assert sizes_of(renamed(state)).n_registers == 4


@pytest.mark.parametrize(("size", "cells"), [((64, 96), (8, 12)), ((60, 90), (8, 12)), ((8, 8), (1, 1))])
@pytest.mark.parametrize("kind", KINDS)
def test_one_cell_describes_eight_by_eight_pixels(kind, size, cells):
    assert cells_of(network(KINDS[kind]), size) == (1, 4, *cells)


@pytest.mark.parametrize("kind", ["dinov2", "dino", "no position of the class token"])
def test_a_patch_covers_the_block_of_its_cell(kind):
    """Without attention a token depends on its block's pixels only and, by interpolation, their neighbours."""
    net = network(KINDS[kind])
    net.blocks = nn.ModuleList()
    net.head = nn.Conv2d(KINDS[kind].width, 1, 1)
    x = torch.zeros(1, 3, 64, 64, requires_grad=True)
    net(x)[0, 0, 3, 5].backward()
    assert x.grad is not None
    rows, columns = np.nonzero(x.grad[0].abs().sum(0).numpy())
    reach = 0 if KINDS[kind].patch == 8 else 1
    assert (rows.min(), rows.max()) == (24 - reach, 31 + reach)
    assert (columns.min(), columns.max()) == (40 - reach, 47 + reach)


def test_a_network_without_positions_is_equivariant_to_half_turns_of_the_image():
    net = network()
    with torch.no_grad():
        net.pos_embed.zero_()
        weight = net.patch_embed["proj"].weight
        weight.add_(turned(weight).clone()).div_(2)
        net.head.mix.weight.add_(turned(net.head.mix.weight).clone()).div_(2)
        x = torch.randn(1, 3, 64, 96)
        torch.testing.assert_close(net(x), turned(net(turned(x))), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", ["dinov2", "with registers"])
def test_interpolated_positions_keep_their_place(kind):
    # Learned positions that rise linearly from left to right give the place of a patch in the image on any grid.
    sizes = KINDS[kind]
    net = network(sizes)
    centres = (torch.arange(sizes.n_side) + 0.5) / sizes.n_side
    with torch.no_grad():
        ramp = centres.expand(sizes.n_side, -1).flatten()[:, None].expand(-1, sizes.width)
        net.pos_embed[0, 1:] = ramp
        for n_columns in (sizes.n_side, 3 * sizes.n_side):
            found = net.positions(4, n_columns)[0, :, 0].unflatten(0, (4, n_columns))
            expected = (torch.arange(n_columns) + 0.5) / n_columns
            # Positions beyond the edges cannot be interpolated.
            edge = n_columns // 4
            torch.testing.assert_close(found[1, edge:-edge], expected[edge:-edge], atol=0.03, rtol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"conv1.weight": torch.zeros(3)},
            "names such as conv1.weight, not patch_embed.proj.weight",
        ),
        (
            {"pos_embed": torch.zeros(1, 19, 128)},
            "19 position embeddings, not those of a square of patches and a class token",
        ),
        (
            {"patch_embed.proj.weight": torch.zeros(96, 3, 8, 8)},
            "96 channels, not a multiple of 64",
        ),
    ],
)
def test_weights_of_another_network_are_refused(change, message):
    state = change if "conv1.weight" in change else {**body(network()), **change}
    with pytest.raises(ValueError, match=message):
        sizes_of(state)
