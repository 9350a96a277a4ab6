from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from bask_data.nn.backbones import BACKBONES
from bask_data.nn.efficientnet import DenseEfficientNet
from bask_data.nn.network import DescriptorNetwork, NetworkSettings, create, distance_maps, load, maps_of_cells
from bask_data.nn.resnet import upsampled
from bask_data.nn.vit import DenseViT, Sizes


def small_network(height: int = 48, dim: int = 8) -> DescriptorNetwork:
    torch.manual_seed(0)
    return DescriptorNetwork(NetworkSettings("resnet18", descriptor_dim=dim, height=height)).eval()


def image(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_descriptors_cover_the_resized_image():
    network = small_network()
    assert network.input_size((96, 128)) == (48, 64)
    assert network.describe(image(96, 128)).shape == (8, 48, 64)
    both = network.describe(np.stack([image(96, 128), image(96, 128, 1)]))
    assert both.shape == (2, 8, 48, 64)
    torch.testing.assert_close(both[1], network.describe(image(96, 128, 1)), atol=1e-4, rtol=1e-4)


def test_a_descriptor_at_a_pixel_is_that_of_the_map():
    network = small_network()
    rgb = image(48, 64)
    uv = np.array([[10.0, 20.0], [63.0, 0.0]], np.float32)
    found, dense = network.descriptors_at(rgb, uv), network.describe(rgb)
    torch.testing.assert_close(found[0], dense[:, 20, 10], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(found[1], dense[:, 0, 63], atol=1e-5, rtol=1e-5)


def test_distance_maps_equal_distances_computed_one_by_one():
    torch.manual_seed(0)
    descriptors, references = torch.randn(16, 6, 7) * 5 + 30, torch.randn(3, 16) * 5 + 30
    found = distance_maps(descriptors, references)
    for k in range(3):
        slow = (descriptors - references[k, :, None, None]).norm(dim=0) / 4.0
        torch.testing.assert_close(found[k], slow, atol=1e-4, rtol=1e-4)


def test_maps_of_cells_equal_those_of_up_sampled_descriptors():
    torch.manual_seed(0)
    cells, references = torch.randn(2, 16, 5, 7) * 5 + 30, torch.randn(3, 16) * 5 + 30
    references[0] = cells[1, :, 2, 3]
    found = maps_of_cells(cells, references)
    assert found.shape == (2, 3, 40, 56)
    for maps, one in zip(found, upsampled(cells, (40, 56)), strict=True):
        torch.testing.assert_close(maps, distance_maps(one, references), atol=2e-4, rtol=1e-4)


def test_distance_maps_of_several_images_are_those_of_each():
    network = small_network()
    images, references = np.stack([image(48, 64), image(48, 64, 1)]), np.eye(2, 8, dtype=np.float32)
    found = network.distance_maps(images, references)
    assert found.shape == (2, 2, 48, 64)
    for one, maps in zip(images, found, strict=True):
        np.testing.assert_allclose(maps, network.distance_maps(one, references), atol=1e-4)


def test_a_pixel_has_distance_zero_to_its_own_descriptor():
    network = small_network()
    rgb = image(48, 64)
    reference = network.describe(rgb)[:, 30, 12].numpy()[None].copy()
    maps = network.distance_maps(rgb, reference)
    assert maps.shape == (1, 48, 64)
    assert np.unravel_index(maps[0].argmin(), maps[0].shape) == (30, 12)
    assert maps[0, 30, 12] == pytest.approx(0.0, abs=2e-3)


def test_a_loaded_network_gives_the_same_descriptors(tmp_path):
    network = small_network()
    network.save(tmp_path)
    again = load(tmp_path, "cpu")
    rgb = image(60, 90)
    torch.testing.assert_close(again.describe(rgb), network.describe(rgb), atol=0, rtol=0)
    assert json.loads((tmp_path / "model.json").read_text())["descriptor_dim"] == 8
    assert not again.training


def test_weights_that_do_not_fit_model_json_are_refused(tmp_path):
    small_network().save(tmp_path)
    content = json.loads((tmp_path / "model.json").read_text())
    (tmp_path / "model.json").write_text(json.dumps({**content, "descriptor_dim": 5}))
    with pytest.raises(ValueError, match=r"weights.safetensors does not fit model.json"):
        load(tmp_path, "cpu")


def test_describing_does_not_change_the_training_mode():
    network = small_network().train()
    network.describe(image(48, 64))
    assert network.training


def a_vit() -> dict[str, torch.Tensor]:
    """Weights of a small ViT, as in a file."""
    torch.manual_seed(1)
    sizes = Sizes(14, 64, 1, 17, 0, 64, gated=False, scaled=True)
    state = DenseViT(sizes, 1).state_dict()
    return {name: value for name, value in state.items() if not name.startswith("head.")}


def an_encoder(backbone: str, tmp_path: Path) -> DescriptorNetwork:
    """A network with that backbone, from weights made here if it needs some."""
    states = {"vit": a_vit, "efficientnet-lite0": lambda: DenseEfficientNet(1).state_dict()}
    if backbone.removesuffix("-tuned") not in states:
        return create(NetworkSettings(backbone, 8, 48), seed=0)
    state = states[backbone.removesuffix("-tuned")]()
    save_file({name: v for name, v in state.items() if not name.startswith("head.")}, tmp_path / "w.safetensors")
    return create(NetworkSettings(backbone, 8, 48), seed=0, weights=tmp_path / "w.safetensors")


SMALL = ["resnet18", "efficientnet-lite0", "efficientnet-lite0-tuned", "vit"]


@pytest.mark.parametrize("backbone", SMALL)
def test_a_network_on_any_backbone_describes_and_is_saved_and_loaded(tmp_path, backbone):
    network = an_encoder(backbone, tmp_path).eval()
    rgb = image(60, 90)
    assert network.describe(rgb).shape == (8, 48, 72)
    assert network.cells(np.stack([rgb, rgb])).shape == (2, 8, 6, 9)
    network.save(tmp_path)
    again = load(tmp_path, "cpu")
    assert again.settings == network.settings
    torch.testing.assert_close(again.describe(rgb), network.describe(rgb), atol=1e-5, rtol=1e-5)
    assert json.loads((tmp_path / "model.json").read_text())["backbone"] == backbone


@pytest.mark.parametrize("backbone", SMALL)
def test_training_changes_only_the_head_of_a_frozen_encoder_and_every_parameter_of_others(tmp_path, backbone):
    network = an_encoder(backbone, tmp_path)
    before = {name: value.clone() for name, value in network.encoder.state_dict().items()}
    optimiser = torch.optim.SGD(network.trainable_parameters(), lr=1.0)
    network.train()
    for _ in range(2):
        optimiser.zero_grad()
        # The square, since the sum of normalised values is constant.
        network(torch.from_numpy(image(48, 64)[None])).square().mean().backward()
        optimiser.step()
    changed = {name for name, value in network.encoder.state_dict().items() if not torch.equal(value, before[name])}
    is_frozen = backbone in ("efficientnet-lite0", "vit")
    expected = {name for name in before if name.startswith("head.")} if is_frozen else set(before)
    assert changed == expected
    assert {p for p in network.parameters() if p.requires_grad} == set(network.trainable_parameters())


@pytest.mark.parametrize("backbone", ["efficientnet-lite0", "vit"])
def test_a_frozen_encoder_stays_in_evaluation_mode_while_its_head_trains(tmp_path, backbone):
    network = an_encoder(backbone, tmp_path).train()
    modes = {module.training for name, module in network.encoder.named_modules() if name and "head" not in name}
    assert modes == {False}
    assert network.training
    assert network.encoder.head.training
    assert not network.eval().encoder.head.training


def test_the_same_seed_makes_the_same_network_and_leaves_global_randomness_alone():
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    first, second = (create(NetworkSettings("resnet18", 8, 48), seed=5).state_dict() for _ in range(2))
    assert torch.equal(torch.rand(1), expected)
    assert all(torch.equal(first[name], second[name]) for name in first)
    other = create(NetworkSettings("resnet18", 8, 48), seed=6).state_dict()
    assert not torch.equal(first["encoder.conv1.weight"], other["encoder.conv1.weight"])


def test_images_are_normalised_as_in_the_training_of_the_weights():
    grey = torch.full((1, 8, 8, 3), 127, dtype=torch.uint8)
    network = DescriptorNetwork(NetworkSettings("efficientnet-lite0", 8, 48))
    torch.testing.assert_close(network.normalised(grey), torch.zeros(1, 3, 8, 8), atol=1e-6, rtol=0)
    network = DescriptorNetwork(NetworkSettings("resnet18", 8, 48, mean=(0.0, 0.0, 0.0), std=(1.0, 0.5, 1.0)))
    torch.testing.assert_close(network.normalised(grey)[0, :, 0, 0], torch.tensor([127, 254, 127]) / 255)


def test_an_unknown_backbone_is_refused_with_the_choices():
    for make in (DescriptorNetwork, lambda settings: create(settings, 0)):
        with pytest.raises(
            ValueError, match="backbone: expected one of resnet18, .*, efficientnet-lite0, .*got alexnet"
        ):
            make(NetworkSettings("alexnet", 8, 48))


def test_a_vit_without_a_file_is_refused():
    with pytest.raises(ValueError, match="no file, and a vit has no weights of its own"):
        create(NetworkSettings("vit", 8, 48), 0)


def test_a_file_of_another_backbone_is_refused(tmp_path):
    save_file(a_vit(), tmp_path / "vit.safetensors")
    with pytest.raises(ValueError, match="names such as blocks.0.attn.proj.bias, not conv1.weight"):
        create(NetworkSettings("resnet18", 8, 48), 0, tmp_path / "vit.safetensors")


def test_every_backbone_has_a_head_and_a_description():
    for name in set(BACKBONES) - {"vit"}:
        with torch.device("meta"):
            network = DescriptorNetwork(NetworkSettings(name, 8, 48))
        assert network.encoder.get_submodule("head")
        assert len(BACKBONES[name].description) > 10


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"height": 33}, "model.json: height: expected a multiple of 8, got 33"),
        ({"height": "a"}, "model.json: height: expected a multiple of 8, got a"),
        ({"mean": [0.5, 0.5]}, "model.json: mean, std: expected three numbers each"),
        ({"std": None}, "model.json: std: expected a value, got none"),
    ],
)
def test_a_damaged_model_json_is_refused(tmp_path, changed, message):
    DescriptorNetwork(NetworkSettings("resnet18", 4, 32)).save(tmp_path)
    file = tmp_path / "model.json"
    content = json.loads(file.read_text()) | changed
    file.write_text(json.dumps({name: value for name, value in content.items() if value is not None}))
    with pytest.raises(ValueError, match=message):
        load(tmp_path)
