from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from bask_data.core.geometry import scale_intrinsics
from bask_data.nn.network import DescriptorNetwork, NetworkSettings, distance_maps, load


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


def test_a_pixel_has_distance_zero_to_its_own_descriptor():
    network = small_network()
    rgb = image(48, 64)
    reference = network.describe(rgb)[:, 30, 12].numpy()[None].copy()
    maps = network.distance_maps(rgb, reference)
    assert maps.shape == (1, 48, 64)
    assert np.unravel_index(maps[0].argmin(), maps[0].shape) == (30, 12)
    assert maps[0, 30, 12] == pytest.approx(0.0, abs=2e-3)


def test_intrinsics_follow_the_resizing():
    K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    expected = scale_intrinsics(K, (480, 640), (48, 64))
    np.testing.assert_allclose(small_network().scaled_intrinsics(K, (480, 640)), expected)


def test_a_saved_network_describes_alike(tmp_path):
    network = small_network()
    network.save(tmp_path)
    again = load(tmp_path, "cpu")
    rgb = image(60, 90)
    torch.testing.assert_close(again.describe(rgb), network.describe(rgb), atol=0, rtol=0)
    assert json.loads((tmp_path / "model.json").read_text())["descriptor_dim"] == 8
    assert not again.training


def test_weights_of_another_description_are_refused(tmp_path):
    small_network().save(tmp_path)
    content = json.loads((tmp_path / "model.json").read_text())
    (tmp_path / "model.json").write_text(json.dumps({**content, "descriptor_dim": 5}))
    with pytest.raises(ValueError, match=r"weights.safetensors does not fit model.json"):
        load(tmp_path, "cpu")


def test_describing_leaves_the_mode_of_training_as_it_was():
    network = small_network().train()
    network.describe(image(48, 64))
    assert network.training
