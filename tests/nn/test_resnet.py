from __future__ import annotations

import numpy as np
import pytest
import torch

from bask_data.core.geometry import scale_pixels
from bask_data.nn.resnet import DenseResNet, sampled, upsampled

# Numbers of parameters of torchvision's networks without `fc`: the published totals less 1000 x (features + 1).
N_PARAMETERS = {18: 11_176_512, 34: 21_284_672, 50: 23_508_032, 101: 42_500_160}

# Names of a ResNet's parameters in torchvision: conv1, bn1, then layers of blocks.
N_BLOCKS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}


def torchvision_shapes(depth: int) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}

    def convolution(name: str, n_out: int, n_in: int, size: int, norm: str) -> None:
        shapes[f"{name}.weight"] = (n_out, n_in, size, size)
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{norm}.{part}"] = (n_out,)
        shapes[f"{norm}.num_batches_tracked"] = ()

    convolution("conv1", 64, 3, 7, "bn1")
    n_in = 64
    for i_layer, n_blocks in enumerate(N_BLOCKS[depth], start=1):
        n_middle = 32 * 2**i_layer
        n_out = n_middle if depth < 50 else 4 * n_middle
        for i_block in range(n_blocks):
            block = f"layer{i_layer}.{i_block}"
            if depth < 50:
                convolution(f"{block}.conv1", n_middle, n_in, 3, f"{block}.bn1")
                convolution(f"{block}.conv2", n_middle, n_middle, 3, f"{block}.bn2")
            else:
                convolution(f"{block}.conv1", n_middle, n_in, 1, f"{block}.bn1")
                convolution(f"{block}.conv2", n_middle, n_middle, 3, f"{block}.bn2")
                convolution(f"{block}.conv3", n_out, n_middle, 1, f"{block}.bn3")
            if i_block == 0 and n_in != n_out:
                convolution(f"{block}.downsample.0", n_out, n_in, 1, f"{block}.downsample.1")
            n_in = n_out
    return shapes


@pytest.mark.parametrize("depth", N_PARAMETERS)
def test_names_shapes_and_count_of_parameters_are_those_of_torchvision(depth):
    with torch.device("meta"):
        network = DenseResNet(depth, 16)
    found = {name: tuple(v.shape) for name, v in network.state_dict().items() if not name.startswith("head.")}
    assert found == torchvision_shapes(depth)
    parameters = {name: p for name, p in network.named_parameters() if not name.startswith("head.")}
    assert sum(p.numel() for p in parameters.values()) == N_PARAMETERS[depth]


def test_an_unknown_depth_is_refused_with_the_choices():
    with pytest.raises(ValueError, match="depth: expected one of 18, 34, 50, 101, got 19"):
        DenseResNet(19, 16)


@pytest.mark.parametrize("depth", [18, 50])
@pytest.mark.parametrize(("size", "cells"), [((64, 96), (8, 12)), ((60, 90), (8, 12)), ((8, 8), (1, 1))])
def test_one_cell_describes_eight_by_eight_pixels(depth, size, cells):
    network = DenseResNet(depth, 4).eval()
    with torch.no_grad():
        assert network(torch.zeros(1, 3, *size)).shape == (1, 4, *cells)


def test_a_cell_is_centred_on_its_block_to_half_a_pixel(monkeypatch):
    # Positive weights and mean instead of maximum, so that every pixel of the receptive field contributes; the dilated
    # layers are symmetric and only widen it.
    monkeypatch.setattr("torch.nn.functional.max_pool2d", torch.nn.functional.avg_pool2d)
    network = DenseResNet(18, 1).double().eval()
    network.layer3, network.layer4 = torch.nn.Identity(), torch.nn.Identity()
    network.head = torch.nn.Conv2d(128, 1, 1).double()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.fill_(1.0) if parameter.ndim > 1 else None
    size = 160
    x = torch.full((1, 3, size, size), 1.0, dtype=torch.float64, requires_grad=True)
    network(x)[0, 0, 10, 9].backward()
    reached = torch.nonzero(x.grad[0].abs().sum(0)).double()
    middle = ((reached.min(0).values + reached.max(0).values) / 2).numpy()
    np.testing.assert_allclose(middle, [8 * 10 + 3.5, 8 * 9 + 3.5], atol=0.5)


def test_dilated_layers_compute_what_strided_ones_would_at_every_second_position():
    # A dilated layer is a strided one evaluated everywhere: at even cells both read the same inputs.
    torch.manual_seed(0)
    network = DenseResNet(18, 4).eval()
    strided = torch.nn.Conv2d(128, 256, 3, stride=2, padding=1, bias=False)
    dilated_layer = network.layer3
    strided.weight = dilated_layer[0].conv1.weight
    x = torch.randn(1, 128, 12, 12)
    with torch.no_grad():
        dense = dilated_layer[0].conv1(x)
        coarse = strided(x)
        second = dilated_layer[1].conv1
        plain = torch.nn.functional.conv2d(coarse, second.weight, padding=1)
        spread = second(dense)
    torch.testing.assert_close(dense[..., ::2, ::2], coarse)
    torch.testing.assert_close(spread[..., ::2, ::2], plain)


def test_up_sampling_agrees_with_scale_pixels():
    # A ramp along u: after up-sampling, the value of pixel u is its cell coordinate by scale_pixels.
    cells = torch.arange(10.0).expand(1, 1, 6, 10)
    full = upsampled(cells, (48, 80))[0, 0].numpy()
    uv = np.stack([np.arange(80.0), np.zeros(80)], axis=-1)
    expected = scale_pixels(uv, (48, 80), (6, 10))[:, 0].clip(0, 9)
    np.testing.assert_allclose(full[20], expected, atol=1e-5)


def test_sampling_at_pixel_centres_is_up_sampling():
    torch.manual_seed(0)
    cells = torch.randn(2, 5, 6, 10)
    full = upsampled(cells, (48, 80))
    uv = torch.tensor([[[0.0, 0.0], [79.0, 47.0], [13.0, 30.0], [40.0, 7.0]]]).expand(2, -1, -1)
    found = sampled(cells, uv)
    for i, (u, v) in enumerate(uv[0].long().tolist()):
        torch.testing.assert_close(found[:, i], full[:, :, v, u], atol=1e-5, rtol=1e-5)
