from __future__ import annotations

import pytest
import torch
from safetensors.torch import save_file

from bask_data.nn.network import DescriptorNetwork, NetworkSettings, create
from bask_data.nn.resnet import DenseResNet
from bask_data.nn.weights import load_weights, read_weights


def published(seed: int = 1, depth: int = 18) -> dict[str, torch.Tensor]:
    """A classifier's weights as torchvision's files hold them."""
    torch.manual_seed(seed)
    state = DenseResNet(depth, 4).state_dict()
    state = {name: torch.randn_like(value) if value.is_floating_point() else value for name, value in state.items()}
    body = {name: value for name, value in state.items() if not name.startswith("head.")}
    return {**body, "fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_a_file_of_classifier_weights_loads_without_its_classifier(tmp_path, suffix):
    given, file = published(), tmp_path / f"resnet18{suffix}"
    save_file(given, file) if suffix == ".safetensors" else torch.save(given, file)
    network = DenseResNet(18, 16)
    head = network.head.weight.clone()
    load_weights(network, read_weights(file), ignored=("fc.",))
    state = network.state_dict()
    for name in given.keys() & state.keys():
        torch.testing.assert_close(state[name], given[name], atol=0, rtol=0)
    assert len(given.keys() & state.keys()) == len(given) - 2
    torch.testing.assert_close(network.head.weight, head)


def test_weights_in_half_precision_are_loaded_in_full(tmp_path):
    given = {name: value.half() if value.is_floating_point() else value for name, value in published().items()}
    network = DenseResNet(18, 16)
    load_weights(network, given, ignored=("fc.",))
    assert network.conv1.weight.dtype == torch.float32
    torch.testing.assert_close(network.conv1.weight.half(), given["conv1.weight"])


def test_a_head_in_the_weights_is_loaded():
    given = DenseResNet(18, 16).state_dict()
    network = DenseResNet(18, 16)
    load_weights(network, given)
    torch.testing.assert_close(network.head.weight, given["head.weight"], atol=0, rtol=0)


@pytest.mark.parametrize("backbone", ["resnet18", "efficientnet-lite0-tuned"])
def test_training_can_start_from_a_trained_network_at_another_size(tmp_path, backbone):
    trained = DescriptorNetwork(NetworkSettings(backbone, 8, 64))
    with torch.no_grad():
        for parameter in trained.parameters():
            parameter.add_(torch.randn_like(parameter))
    trained.save(tmp_path)
    network = create(NetworkSettings(backbone, 8, 128), 0, tmp_path / "weights.safetensors")
    state = network.encoder.state_dict()
    for name, value in trained.encoder.state_dict().items():
        torch.testing.assert_close(state[name], value, atol=0, rtol=0)


def test_files_without_counters_of_batches_load():
    given = {name: value for name, value in published().items() if not name.endswith("num_batches_tracked")}
    network = DenseResNet(18, 16)
    load_weights(network, given, ignored=("fc.",))
    torch.testing.assert_close(network.bn1.weight, given["bn1.weight"])


def test_a_file_that_wraps_its_weights_is_unwrapped(tmp_path):
    torch.save({"epoch": 3, "state_dict": {"a": torch.ones(2)}}, tmp_path / "checkpoint.pth")
    assert read_weights(tmp_path / "checkpoint.pth").keys() == {"a"}


def without(state: dict[str, torch.Tensor], start: str) -> dict[str, torch.Tensor]:
    return {name: value for name, value in state.items() if not name.startswith(start)}


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (
            {"layer1.0.conv1.weight": torch.zeros(64, 64, 1, 1)},
            r"layer1.0.conv1.weight: expected shape \(64, 64, 3, 3\), got \(64, 64, 1, 1\)",
        ),
        (
            {"layer1.0.conv1.weight": torch.zeros(64, 64, 3, 3, dtype=torch.int64)},
            r"layer1.0.conv1.weight: expected floating-point numbers, got int64",
        ),
        ({"blocks.0.weight": torch.zeros(3)}, r"names such as blocks.0.weight, not conv1.weight"),
        (without(published(), "layer4"), r"weights without layer4.0.conv1.weight \(25 tensors are missing\)"),
        # A ResNet-34 has all tensors of a ResNet-18.
        (published(depth=34), r"weights with layer1.2.conv1.weight \(96 tensors are unknown\)"),
    ],
)
def test_weights_of_another_network_are_refused_and_nothing_is_loaded(state, message):
    network = DenseResNet(18, 16)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    with pytest.raises(ValueError, match=message):
        load_weights(network, state, ignored=("fc.",))
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_code_in_a_torch_file_is_not_executed(tmp_path, capsys):
    class Evil:
        def __reduce__(self):
            return (print, ("code ran",))

    torch.save({"conv1.weight": Evil()}, tmp_path / "evil.pth")
    with pytest.raises(ValueError, match="a file that contains code or other objects; nothing in it was executed"):
        read_weights(tmp_path / "evil.pth")
    assert "code ran" not in capsys.readouterr().out


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_a_broken_file_is_refused(tmp_path, suffix):
    (tmp_path / f"broken{suffix}").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"a file that (cannot be read: |contains code or other objects)"):
        read_weights(tmp_path / f"broken{suffix}")


def test_sparse_tensors_are_refused(tmp_path):
    torch.save({"conv1.weight": torch.eye(3).to_sparse()}, tmp_path / "sparse.pth")
    with pytest.raises(ValueError, match=r"conv1.weight is sparse; expected dense tensors"):
        read_weights(tmp_path / "sparse.pth")


def test_a_torch_file_without_tensors_by_name_is_refused(tmp_path):
    torch.save([1, 2, 3], tmp_path / "list.pth")
    with pytest.raises(ValueError, match="expected tensors by name"):
        read_weights(tmp_path / "list.pth")


def test_numbers_that_are_not_finite_are_refused_by_name(tmp_path):
    torch.save({"a": torch.ones(2), "b": torch.tensor([1.0, float("nan")])}, tmp_path / "not_finite.pth")
    with pytest.raises(ValueError, match="b contains values that are not finite"):
        read_weights(tmp_path / "not_finite.pth")


def test_names_are_text(tmp_path):
    torch.save({1: torch.ones(2)}, tmp_path / "numbered.pth")
    with pytest.raises(ValueError, match="expected tensors by name"):
        read_weights(tmp_path / "numbered.pth")
