from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bask_data.nn.augment import AugmentSettings
from bask_data.nn.network import DescriptorNetwork, NetworkSettings
from bask_data.nn.sampling import SampleSettings
from bask_data.nn.training import (
    STATE,
    TrainingSettings,
    learning_rate,
    pixel_errors,
    remove_all_but_state,
    remove_state,
    train_network,
)
from tests.nn.pairs import ScenePairs

SAMPLE = SampleSettings(size=(32, 40), n_pairs=1, n_matches=24, n_non_matches=30)
SETTINGS = TrainingSettings(steps=6, learning_rate=1e-3, precision="float32", log_every=2, save_every=2)
AUGMENT = AugmentSettings(rotation=0.3)


def new_network(height: int = 32) -> DescriptorNetwork:
    torch.manual_seed(0)
    return DescriptorNetwork(NetworkSettings("resnet18", descriptor_dim=8, height=height))


def weights(network: DescriptorNetwork) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in network.state_dict().items()}


class Interrupted(Exception):
    pass


def stopping_before(step: int):
    def steps(numbers: range):
        for number in numbers:
            if number == step:
                raise Interrupted
            yield number

    return steps


@pytest.mark.parametrize("loss", ["contrastive", "infonce"])
def test_training_twice_gives_the_same_bits(loss):
    settings = replace(SETTINGS, steps=2, loss=loss)
    first, second = new_network(), new_network()
    curve = train_network(first, ScenePairs(), SAMPLE, AUGMENT, settings)
    assert train_network(second, ScenePairs(), SAMPLE, AUGMENT, settings) == curve
    for name, value in weights(first).items():
        assert torch.equal(value, weights(second)[name]), name


@pytest.mark.parametrize("stop", [3, 5])
def test_an_interrupted_training_ends_with_the_bits_of_an_uninterrupted_one(tmp_path, stop):
    whole = new_network()
    expected = train_network(whole, ScenePairs(), SAMPLE, AUGMENT, SETTINGS)
    cut = new_network()
    with pytest.raises(Interrupted):
        train_network(cut, ScenePairs(), SAMPLE, AUGMENT, SETTINGS, state_folder=tmp_path, steps=stopping_before(stop))
    assert (tmp_path / STATE).exists()
    resumed = new_network()
    numbers: list[int] = []

    def steps(chosen: range):
        for number in chosen:
            numbers.append(number)
            yield number

    curve = train_network(resumed, ScenePairs(), SAMPLE, AUGMENT, SETTINGS, state_folder=tmp_path, steps=steps)
    assert numbers[0] in (2, 4)
    assert curve == expected
    for name, value in weights(whole).items():
        assert torch.equal(value, weights(resumed)[name]), name
    nothing_left = train_network(
        new_network(), ScenePairs(), SAMPLE, AUGMENT, SETTINGS, state_folder=tmp_path, steps=steps
    )
    assert nothing_left == expected
    assert numbers[-1] == 5, "a training that is done is not done again"
    for left in ("state.part", ".tmpqWgRll"):
        (tmp_path / left).touch()
    remove_all_but_state(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == [STATE]
    remove_state(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("loss", "share_left"), [("contrastive", 0.5), ("infonce", 0.75)])
def test_training_lowers_the_loss(loss, share_left):
    settings = replace(SETTINGS, steps=24, loss=loss, learning_rate=1e-3, log_every=4)
    gentle = AugmentSettings(zoom=(1.0, 1.0), rotation=0.0, flip=0.0, background=0.0)
    curve = train_network(new_network(), ScenePairs(n_views=2), SAMPLE, gentle, settings)
    values = [value for _, name, value in curve if name == "loss"]
    assert values[-1] < share_left * values[0]


def test_the_curve_has_every_term_and_the_validation(tmp_path):
    curve = train_network(
        new_network(),
        ScenePairs(),
        SAMPLE,
        AUGMENT,
        replace(SETTINGS, steps=4, validate_every=4),
        validate=lambda network: {"validation_pck_4": 0.5},
    )
    names = {name for _, name, _ in curve}
    assert names == {
        "loss",
        "loss_match",
        "loss_foreground",
        "loss_background",
        "share_inside_margin",
        "learning_rate",
        "validation_pck_4",
    }
    assert [step for step, name, _ in curve if name == "loss"] == [2, 4]
    assert [step for step, name, _ in curve if name == "validation_pck_4"] == [4]


def test_frozen_batch_norm_keeps_its_statistics():
    network = new_network()
    before = weights(network)
    train_network(network, ScenePairs(), SAMPLE, AUGMENT, replace(SETTINGS, steps=2, frozen_batch_norm=True))
    after = weights(network)
    assert all(torch.equal(before[name], after[name]) for name in before if "running" in name)
    assert not torch.equal(before["encoder.conv1.weight"], after["encoder.conv1.weight"])


def test_rates_follow_their_schedule():
    step = TrainingSettings(steps=100, learning_rate=1.0, decay=0.5, decay_every=10)
    assert [learning_rate(i, step) for i in (0, 9, 10, 25)] == [1.0, 1.0, 0.5, 0.25]
    cosine = TrainingSettings(steps=100, learning_rate=1.0, schedule="cosine", warmup=3)
    assert learning_rate(0, cosine) == pytest.approx(0.25)
    assert learning_rate(50, cosine) == pytest.approx(0.5)
    assert learning_rate(99, cosine) < 0.001


def test_a_loss_that_is_no_number_stops_training():
    network = new_network()
    with torch.no_grad():
        network.encoder.head.weight.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="loss is nan at step 2; a smaller learning rate may help"):
        train_network(network, ScenePairs(), SAMPLE, AUGMENT, SETTINGS)


def test_pixel_errors_are_measured_in_pixels_of_the_image():
    # A network that describes each pixel by its position finds the position of the query, wherever the match is.
    network = new_network(height=96)

    class Positions(torch.nn.Module):
        def __init__(self, conv1):
            super().__init__()
            self.conv1 = conv1

        def forward(self, x):
            v, u = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
            return torch.stack([8 * u + 3.5, 8 * v + 3.5])[None]

    network.encoder = Positions(network.encoder.conv1)
    source = ScenePairs(n_views=2)
    pixels, shares = pixel_errors(network, source, [0], 10_000)
    pair = source.pair(0)
    expected = np.linalg.norm(pair.uv_a.clip(3.5, [123.5, 91.5]) - pair.uv_b, axis=1)
    np.testing.assert_allclose(pixels, expected, atol=1.0)
    np.testing.assert_allclose(shares, pixels / 160)
