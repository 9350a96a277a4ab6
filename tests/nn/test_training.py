from __future__ import annotations

from dataclasses import replace
from math import inf

import pytest
import torch

from bask_data.nn import training
from bask_data.nn.augment import AugmentSettings
from bask_data.nn.loss import Terms
from bask_data.nn.network import DescriptorNetwork, NetworkSettings
from bask_data.nn.sampling import Examples, SampleSettings, batch_of_step, plan_of_step
from bask_data.nn.state import BEST, STATE
from bask_data.nn.training import TrainingSettings, best_step, learning_rate, train_network, uses_bfloat16
from tests.nn.pairs import ScenePairs
from tests.threads import no_garbage_collector, threads_named

SAMPLE = SampleSettings((32, 40), n_pairs=1, n_matches=24, n_non_matches=30, foreground_share=0.5, clearance=1.0)
SETTINGS = TrainingSettings(steps=6, learning_rate=1e-3, precision="float32", log_every=2, save_share=inf)
AUGMENT = AugmentSettings(rotation=0.3)
CONTRASTIVE = {
    "loss",
    "loss_match",
    "loss_foreground",
    "loss_background",
    "share_inside_margin_foreground",
    "share_inside_margin_background",
}


class TinyEncoder(torch.nn.Module):
    """A small encoder like all others: convolutions with batch norm to cells at stride 8, and a head."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = torch.nn.Conv2d(3, 16, 9, stride=4, padding=4)
        self.norm1 = torch.nn.BatchNorm2d(16)
        self.conv2 = torch.nn.Conv2d(16, 32, 3, stride=2, padding=1)
        self.norm2 = torch.nn.BatchNorm2d(32)
        self.head = torch.nn.Conv2d(32, 8, 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        found = self.norm1(self.conv1(images)).relu()
        return self.head(self.norm2(self.conv2(found)).relu())


def new_network() -> DescriptorNetwork:
    network = DescriptorNetwork(NetworkSettings("resnet18", descriptor_dim=8, height=32))
    torch.manual_seed(0)
    network.encoder = TinyEncoder()
    return network


def weights(network: DescriptorNetwork) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in network.state_dict().items()}


def assert_equal_bits(network: DescriptorNetwork, expected: dict[str, torch.Tensor]) -> None:
    for name, value in weights(network).items():
        assert torch.equal(value, expected[name]), name


class Interrupted(Exception):
    pass


def stopping_before(step: int):
    def steps(numbers: range):
        for number in numbers:
            if number == step:
                raise Interrupted
            yield number

    return steps


class Verdicts:
    """A validation with known results: one metric per call; records the weights of each call."""

    def __init__(self, *values: float, name: str = "validation_pck_4") -> None:
        self.values, self.name = list(values), name
        self.seen: list[dict[str, torch.Tensor]] = []

    def __call__(self, network: DescriptorNetwork) -> dict[str, float]:
        self.seen.append(weights(network))
        network.eval()  # as describing images does
        network.train()
        return {self.name: self.values[len(self.seen) - 1]}


@pytest.mark.parametrize("loss", ["contrastive", "infonce"])
def test_training_twice_gives_the_same_bits(loss):
    settings = replace(SETTINGS, steps=2, loss=loss)
    first, second = new_network(), new_network()
    trained = train_network(first, Examples(ScenePairs(), SAMPLE, AUGMENT), settings)
    assert train_network(second, Examples(ScenePairs(), SAMPLE, AUGMENT), settings) == trained
    assert_equal_bits(second, weights(first))


def judged(network: DescriptorNetwork) -> dict[str, float]:
    """A validation metric that depends on the weights only."""
    return {"validation_pck_4": float(network.encoder.head.weight.detach().sum())}


@pytest.mark.parametrize("stop", [1, 3, 5])
def test_an_interrupted_training_ends_with_the_bits_of_an_uninterrupted_one(tmp_path, stop):
    settings = replace(SETTINGS, validate_every=1, accumulate=2)
    sample, arguments = replace(SAMPLE, n_pairs=2), {"validate": judged}
    whole = new_network()
    expected = train_network(whole, Examples(ScenePairs(), sample, AUGMENT), settings, **arguments)
    arguments["state_folder"] = tmp_path
    cut = new_network()
    with pytest.raises(Interrupted):
        train_network(cut, Examples(ScenePairs(), sample, AUGMENT), settings, **arguments, steps=stopping_before(stop))
    assert (tmp_path / STATE).exists()
    resumed = new_network()
    numbers: list[int] = []

    def steps(chosen: range):
        for number in chosen:
            numbers.append(number)
            yield number

    found = train_network(resumed, Examples(ScenePairs(), sample, AUGMENT), settings, **arguments, steps=steps)
    assert numbers[0] == stop
    assert found == expected
    assert_equal_bits(resumed, weights(whole))
    again = new_network()
    assert train_network(again, Examples(ScenePairs(), sample, AUGMENT), settings, **arguments, steps=steps) == expected
    assert numbers[-1] == 5, "a finished training is not repeated"
    assert_equal_bits(again, weights(whole))


@pytest.mark.parametrize(("loss", "share_left"), [("contrastive", 0.65), ("infonce", 0.75)])
def test_training_lowers_the_loss(loss, share_left):
    settings = replace(SETTINGS, steps=80, loss=loss, learning_rate=3e-3, log_every=4)
    gentle = AugmentSettings(zoom=(1.0, 1.0), rotation=0.0, flip=0.0, background=0.0)
    trained = train_network(new_network(), Examples(ScenePairs(n_views=2), SAMPLE, gentle), settings)
    values = [value for _, name, value in trained.curve if name == "loss"]
    assert values[-1] < share_left * values[0]


def test_the_curve_has_every_term_and_the_validation():
    verdicts = Verdicts(0.5)
    settings = replace(SETTINGS, steps=4, validate_every=4)
    curve = train_network(new_network(), Examples(ScenePairs(), SAMPLE, AUGMENT), settings, validate=verdicts).curve
    assert {name for _, name, _ in curve} == CONTRASTIVE | {"learning_rate", "validation_pck_4"}
    assert [step for step, name, _ in curve if name == "loss"] == [2, 4]
    assert [step for step, name, _ in curve if name == "validation_pck_4"] == [4]


def test_rows_of_the_curve_are_means_over_the_steps_between_them():
    every = train_network(new_network(), Examples(ScenePairs(), SAMPLE, AUGMENT), replace(SETTINGS, log_every=1)).curve
    third = train_network(new_network(), Examples(ScenePairs(), SAMPLE, AUGMENT), replace(SETTINGS, log_every=3)).curve
    losses = [value for _, name, value in every if name == "loss"]
    expected = [sum(losses[:3]) / 3, sum(losses[3:]) / 3]
    assert [value for _, name, value in third if name == "loss"] == pytest.approx(expected)


@pytest.mark.parametrize("loss", ["contrastive", "infonce"])
def test_a_batch_in_parts_gives_the_gradients_of_the_whole(loss):
    settings = replace(SETTINGS, steps=2, loss=loss, frozen_batch_norm=True, log_every=1)
    sample, whole, parted = replace(SAMPLE, n_pairs=3), new_network(), new_network()
    of_whole = train_network(whole, Examples(ScenePairs(), sample, AUGMENT), settings)
    # Three pairs in two parts, of one and of two pairs, weighted accordingly.
    of_parts = train_network(parted, Examples(ScenePairs(), sample, AUGMENT), replace(settings, accumulate=2))
    values = [[value for _, _, value in trained.curve] for trained in (of_whole, of_parts)]
    assert values[0] == pytest.approx(values[1], rel=1e-4)
    assert max(value for _, name, value in of_whole.curve if name == "loss") > 0.01


@pytest.mark.parametrize(
    ("name", "values", "chosen"),
    [
        ("validation_pck_4", (0.1, 0.7, 0.3), 2),
        ("validation_pck_4", (0.1, 0.7, 0.7), 3),
        ("validation_median_error_px", (9.0, 5.0, 8.0), 2),
    ],
)
def test_the_weights_that_validated_best_are_kept(tmp_path, name, values, chosen):
    verdicts, network = Verdicts(*values, name=name), new_network()
    settings = replace(SETTINGS, steps=3, validate_every=1, best_by=name)
    trained = train_network(
        network, Examples(ScenePairs(), SAMPLE, AUGMENT), settings, validate=verdicts, state_folder=tmp_path
    )
    assert (trained.step, trained.n_steps) == (chosen, 3)
    assert_equal_bits(network, verdicts.seen[chosen - 1])
    assert not torch.equal(verdicts.seen[0]["encoder.head.weight"], verdicts.seen[1]["encoder.head.weight"])
    assert [file.name for file in tmp_path.glob(BEST.format(step="*"))] == [BEST.format(step=chosen)]


def test_without_a_metric_the_last_weights_are_kept():
    verdicts, network = Verdicts(0.9, 0.1), new_network()
    settings = replace(SETTINGS, steps=2, validate_every=1, best_by=None)
    trained = train_network(network, Examples(ScenePairs(), SAMPLE, AUGMENT), settings, validate=verdicts)
    assert trained.step == 2
    assert_equal_bits(network, verdicts.seen[1])


def test_training_stops_early_when_validation_does_not_improve(tmp_path):
    verdicts, network = Verdicts(0.1, 0.5, 0.4, 0.3), new_network()
    settings = replace(SETTINGS, steps=40, validate_every=1, patience=2)
    arguments = {"validate": verdicts, "state_folder": tmp_path}
    trained = train_network(network, Examples(ScenePairs(), SAMPLE, AUGMENT), settings, **arguments)
    assert (trained.step, trained.n_steps) == (2, 4)
    assert_equal_bits(network, verdicts.seen[1])
    again = new_network()
    assert train_network(again, Examples(ScenePairs(), SAMPLE, AUGMENT), settings, **arguments) == trained
    assert len(verdicts.seen) == 4, "called again, it does not continue"
    assert_equal_bits(again, verdicts.seen[1])


def test_patience_restarts_with_each_improvement():
    verdicts = Verdicts(0.1, 0.0, 0.2, 0.1, 0.3, 0.2)
    settings = replace(SETTINGS, steps=6, validate_every=1, patience=2)
    trained = train_network(new_network(), Examples(ScenePairs(), SAMPLE, AUGMENT), settings, validate=verdicts)
    assert (trained.step, trained.n_steps) == (5, 6)


def test_the_best_step_is_the_last_of_several_equal_ones():
    curve = [(1, "a", 2.0), (2, "a", 3.0), (3, "a", 3.0), (4, "a", 1.0), (5, "b", 9.0)]
    assert best_step(curve, "a") == 3
    assert (
        best_step([(step, "validation_median_error_px", value) for step, _, value in curve[:4]], training.MEDIAN) == 4
    )
    assert best_step(curve, None) == best_step(curve, "c") == 0


def test_frozen_batch_norm_keeps_its_statistics_after_validation_too():
    network = new_network()
    before = weights(network)
    settings = replace(SETTINGS, steps=3, frozen_batch_norm=True, validate_every=1)
    train_network(network, Examples(ScenePairs(), SAMPLE, AUGMENT), settings, validate=Verdicts(0.0, 0.0, 0.0))
    after = weights(network)
    assert all(torch.equal(before[name], after[name]) for name in before if "running" in name)
    assert not torch.equal(before["encoder.conv1.weight"], after["encoder.conv1.weight"])


def test_a_plan_rendered_on_the_device_trains_as_a_batch():
    given = (ScenePairs(), 0, 1, replace(SAMPLE, n_pairs=2), AUGMENT)
    cpu, losses = torch.device("cpu"), []
    for made in (batch_of_step(*given), plan_of_step(*given)):
        terms = training._terms(new_network(), training._on_device(made, cpu), SETTINGS)
        losses.append({name: float(value / count) for name, (value, count) in terms.logged.items()})
    # Images are equal up to the rounding of grey levels.
    assert losses[0] == pytest.approx(losses[1], rel=0.02)
    assert losses[0]["loss"] > 0.1


def test_frozen_parameters_are_not_trained():
    network = new_network()
    network.encoder.requires_grad_(False)
    network.encoder.head.requires_grad_(True)
    before = weights(network)
    train_network(network, Examples(ScenePairs(), SAMPLE, AUGMENT), replace(SETTINGS, steps=2, frozen_batch_norm=True))
    changed = {name for name, value in weights(network).items() if not torch.equal(value, before[name])}
    assert changed == {"encoder.head.weight", "encoder.head.bias"}


def test_speed_and_waiting_are_reported_but_not_part_of_the_curve():
    reported: list[tuple[int, dict[str, float]]] = []
    settings = replace(SETTINGS, steps=4)
    trained = train_network(
        new_network(), Examples(ScenePairs(), SAMPLE, AUGMENT), settings, watch=lambda *row: reported.append(row)
    )
    assert [step for step, _ in reported] == [2, 4]
    for _, values in reported:
        assert values["images_per_second"] > 0
        assert 0 <= values["share_waited"] <= 1
        speed = {"images_per_second", "share_waited"} & values.keys()
        assert values.keys() - speed == CONTRASTIVE | {"learning_rate"}
    assert not {"images_per_second", "share_waited"} & {name for _, name, _ in trained.curve}


def test_bfloat16_is_used_and_gives_nearly_the_loss_of_float32():
    losses = {}
    for precision in ("float32", "bfloat16"):
        settings = replace(SETTINGS, steps=2, precision=precision, log_every=1)
        trained = train_network(new_network(), Examples(ScenePairs(), SAMPLE, AUGMENT), settings)
        losses[precision] = [value for _, name, value in trained.curve if name == "loss"]
    assert losses["bfloat16"] != losses["float32"]
    assert losses["bfloat16"] == pytest.approx(losses["float32"], rel=0.1)
    assert uses_bfloat16("bfloat16", torch.device("cpu"))
    assert not uses_bfloat16("float32", torch.device("cpu"))


def test_steps_are_those_of_adam(monkeypatch):
    monkeypatch.setattr(training, "_terms", lambda model, batch, settings: weights_as_terms(network))
    network = new_network()
    expected = [value.detach().clone().requires_grad_() for value in network.trainable_parameters()]
    settings = replace(SETTINGS, steps=3, weight_decay=0.1, schedule="step", decay=1.0)
    optimiser = torch.optim.Adam(expected, lr=settings.learning_rate, weight_decay=0.1, foreach=False)
    for _ in range(3):
        optimiser.zero_grad()
        sum(value.square().sum() for value in expected).backward()
        optimiser.step()
    train_network(network, Examples(ScenePairs(), SAMPLE, AUGMENT), settings)
    for found, value in zip(network.trainable_parameters(), expected, strict=True):
        torch.testing.assert_close(found, value)


def weights_as_terms(network: DescriptorNetwork) -> Terms:
    loss = sum(value.square().sum() for value in network.trainable_parameters())
    return Terms(loss, {"loss": torch.stack([loss.detach(), torch.tensor(1.0)])})


def test_learning_rates_follow_their_schedule():
    step = TrainingSettings(steps=100, learning_rate=1.0, decay=0.5, decay_every=10)
    assert [learning_rate(i, step) for i in (0, 9, 10, 25)] == [1.0, 1.0, 0.5, 0.25]
    cosine = TrainingSettings(steps=100, learning_rate=1.0, schedule="cosine", warmup=3)
    assert learning_rate(0, cosine) == pytest.approx(0.25)
    assert learning_rate(50, cosine) == pytest.approx(0.5)
    assert learning_rate(99, cosine) < 0.001


def test_a_loss_that_is_not_finite_stops_training():
    network = new_network()
    with torch.no_grad():
        network.encoder.head.weight.fill_(float("nan"))
    with no_garbage_collector():
        with pytest.raises(FloatingPointError, match="loss is nan at step 2; a smaller learning rate may help"):
            train_network(network, Examples(ScenePairs(), SAMPLE, AUGMENT), SETTINGS)
        assert not threads_named("batches")


@pytest.mark.parametrize(("share", "expected"), [(inf, [2, 4, 6]), (0.0, [2, 6])])
def test_states_are_written_as_often_as_their_cost_allows_and_at_the_end(tmp_path, monkeypatch, share, expected):
    saved: list[int] = []
    monkeypatch.setattr(training, "save_state", lambda *given: saved.append(given[-1].step))
    train_network(
        new_network(),
        Examples(ScenePairs(), SAMPLE, AUGMENT),
        replace(SETTINGS, save_share=share),
        state_folder=tmp_path,
    )
    assert saved == expected
