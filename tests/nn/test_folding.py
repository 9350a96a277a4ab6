from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from bask_data.nn.backbones import BACKBONES
from bask_data.nn.efficientnet import DenseEfficientNet
from bask_data.nn.folding import FoldedConvolution, folded
from bask_data.nn.network import DescriptorNetwork, NetworkSettings

NORMALISED = [name for name in BACKBONES if name.startswith(("resnet", "efficientnet"))]


def a_network(backbone: str) -> DescriptorNetwork:
    """A network whose batch normalisations all do something else."""
    torch.manual_seed(0)
    state = DenseEfficientNet(1).state_dict() if backbone.startswith("efficientnet") else None
    network = DescriptorNetwork(NetworkSettings(backbone, 8, 64), state).eval()
    for module in network.encoder.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            for vector in (module.bias, module.running_mean):
                nn.init.normal_(vector, std=0.1)
            nn.init.uniform_(module.running_var, 0.5, 2)
    return network


def an_image(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("backbone", NORMALISED)
def test_a_folded_network_gives_the_same_descriptors(backbone):
    network = a_network(backbone)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    ready = folded(network)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in ready.encoder.modules())
    assert any(isinstance(module, FoldedConvolution) for module in ready.encoder.modules())
    for size in ((64, 64), (64, 96), (60, 90)):
        expected, got = network.cells(an_image(*size)), ready.cells(an_image(*size))
        torch.testing.assert_close(got, expected, atol=1e-5 * expected.abs().max().item(), rtol=0)
    assert before.keys() == network.state_dict().keys()
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_folding_without_onednn_and_in_double_precision_gives_the_same(monkeypatch):
    network = a_network("resnet18")
    ready = folded(network)
    expected = network.cells(an_image(64, 64))
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    torch.testing.assert_close(ready.cells(an_image(64, 64)), expected, atol=1e-5 * expected.abs().max().item(), rtol=0)
    x = torch.randn(1, 3, 32, 32, dtype=torch.float64)
    exact = folded(network.double())
    torch.testing.assert_close(exact.encoder(x), network.encoder(x), atol=1e-9, rtol=0)


def test_a_folded_network_is_folded_once_and_stays_in_evaluation():
    ready = folded(a_network("resnet18"))
    assert folded(ready) is ready
    assert ready.is_folded and not ready.training
    assert not any(parameter.requires_grad for parameter in ready.parameters())


def test_a_folded_network_is_not_saved(tmp_path):
    with pytest.raises(ValueError, match=r"network: expected a network with its batch normalisation.*fix: copy"):
        folded(a_network("resnet18")).save(tmp_path)
    assert not list(tmp_path.iterdir())
