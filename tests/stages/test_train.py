from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from bask_data.dataset import Dataset, Splits
from bask_data.kinds import Correspondences, DescriptorNet, Scan, VisibleMasks
from bask_data.nn.network import load
from bask_data.nn.resnet import DenseResNet
from bask_data.stage import make, plan
from bask_data.stages.train import Pairs, ScanPairs, train
from tests.nn.pairs import SIZE, ScenePairs
from tests.stages.learning import SMALL, learning_dataset

GOLDEN = Path(__file__).parent / "golden"


def made(dataset: Dataset, **options):
    [task] = plan(dataset, train, options={**SMALL, **options})
    return make(task)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    return learning_dataset(tmp_path_factory.mktemp("train") / "d", ("a", "b"))


@pytest.fixture(scope="module")
def trained(dataset):
    outcome = made(dataset)
    assert outcome.status == "made", outcome.why
    return outcome


def test_a_network_is_made_that_describes_images(dataset, trained):
    descriptor = DescriptorNet(dataset.path(DescriptorNet))
    network = load(descriptor.path, "cpu")
    assert network.describe(np.zeros((*SIZE, 3), np.uint8)).shape == (8, 32, 40)
    assert sorted(file.name for file in descriptor.path.iterdir()) == [
        "artifact.json",
        "curve.parquet",
        "model.json",
        "weights.safetensors",
        "zarr.json",
    ]
    assert {
        "loss",
        "loss_heat_map",
        "validation_median_error_px",
        "validation_pck_4",
    } <= descriptor.metadata.metrics.keys()
    assert descriptor.curve()["step"].to_pylist()[-1] == 4


def test_training_again_gives_the_same_bytes(dataset, trained):
    [task] = plan(dataset, train, options=SMALL)
    assert make(task).status == "up to date"
    assert make(task, force=True).digest == trained.digest


def test_without_other_scenes_the_last_frames_are_held_out_and_it_says_so(dataset, trained):
    words = DescriptorNet(dataset.path(DescriptorNet)).metadata.validated_on
    # 15 % of 5 frames is one; a pair holds it in 8 of 20 cases, in each of two scenes.
    assert words == "held-out frames: the last 2 of 10 (16 pairs), of scenes that were trained on"


def test_with_scenes_for_validation_those_are_held_out(tmp_path):
    dataset = learning_dataset(tmp_path / "d", ("a", "b", "c"), n_views=2)
    dataset.file.splits = Splits(train=("a",), validation=("b",), test=("c",))
    assert made(dataset, steps=1).status == "made"
    assert DescriptorNet(dataset.path(DescriptorNet)).metadata.validated_on == "held-out scenes: b (2 pairs)"


def test_nothing_held_out_is_said_and_gives_no_metrics(tmp_path):
    dataset = learning_dataset(tmp_path / "d", n_views=2)
    assert made(dataset, steps=1, held_out=0.0).status == "made"
    metadata = DescriptorNet(dataset.path(DescriptorNet)).metadata
    assert metadata.validated_on == "nothing: no scene and no frame with matches was held out"
    assert not [name for name in metadata.metrics if name.startswith("validation")]


def test_pairs_are_those_of_the_correspondences(dataset):
    pairs = scan_pairs(dataset)
    source = ScenePairs(5, 0)
    assert pairs.n_pairs == source.n_pairs
    for i in (0, 7, 19):
        found, known = pairs.pair(i), source.pair(i)
        for name in ("rgb_a", "rgb_b", "instance_a", "instance_b", "instance", "uv_a", "uv_b"):
            np.testing.assert_allclose(getattr(found, name), getattr(known, name), atol=1e-5)


def test_matches_follow_when_frames_are_shrunk(dataset):
    pairs = scan_pairs(dataset)
    whole = pairs.pair(3)
    pairs.shrink_to((48, 64))
    shrunk = pairs.pair(3)
    assert shrunk.rgb_a.shape == (48, 64, 3)
    np.testing.assert_allclose(shrunk.uv_a, (whole.uv_a + 0.5) / 2 - 0.5)
    # Away from edges, where a pixel holds several objects, the shrunk mask shows what the match says.
    row, column = np.rint(shrunk.uv_a[:, 1]).astype(int), np.rint(shrunk.uv_a[:, 0]).astype(int)
    assert (shrunk.instance_a[row, column] == shrunk.instance).mean() > 0.9


def scan_pairs(dataset: Dataset) -> Pairs:
    scan = ScanPairs(*(kind(dataset.path(kind, "a")) for kind in (Scan, VisibleMasks, Correspondences)))
    return Pairs([(scan, i) for i in range(len(scan.frames))])


def test_interrupted_it_goes_on_and_ends_the_same(dataset, trained, tmp_path, monkeypatch):
    from bask_data.nn import training

    other = learning_dataset(tmp_path / "d", ("a", "b"))
    save = training.save_state

    def save_and_stop(file, network, optimiser, step, curve):
        save(file, network, optimiser, step, curve)
        # What a kill in the middle of a write leaves: ours, and safetensors' own temporary file.
        (file.parent / "state.part").write_bytes(b"half")
        (file.parent / ".tmpqWgRll").write_bytes(b"half")
        (file.parent / "weights.safetensors").write_bytes(b"half")
        raise KeyboardInterrupt

    settings = training.TrainingSettings
    monkeypatch.setattr(training, "TrainingSettings", lambda **given: settings(**given, save_every=2, log_every=2))
    monkeypatch.setattr(training, "save_state", save_and_stop)
    with pytest.raises(KeyboardInterrupt):
        made(other)
    first = []
    load_state = training.load_state
    monkeypatch.setattr(training, "save_state", save)
    monkeypatch.setattr(training, "load_state", lambda *given: first.append(load_state(*given)) or first[-1])
    assert made(other).status == "made"
    assert first[0][0] == 2
    for name in ("weights.safetensors", "model.json"):
        expected = (dataset.path(DescriptorNet) / name).read_bytes()
        assert (other.path(DescriptorNet) / name).read_bytes() == expected
    left = {file.name for file in other.path(DescriptorNet).iterdir()}
    assert left == {file.name for file in dataset.path(DescriptorNet).iterdir()}


def test_pretrained_weights_are_taken_over(tmp_path):
    dataset = learning_dataset(tmp_path / "d", n_views=2)
    torch.manual_seed(5)
    state = {name: value for name, value in DenseResNet(18, 8).state_dict().items() if not name.startswith("head.")}
    torch.save(state, tmp_path / "resnet18.pth")
    options = {"weights": str(tmp_path / "resnet18.pth"), "learning_rate": 1e-9, "weight_decay": 0.0, "steps": 1}
    outcome = made(dataset, **options, held_out=0.0)
    assert outcome.status == "made", outcome.why
    found = load(dataset.path(DescriptorNet), "cpu").encoder.state_dict()
    torch.testing.assert_close(found["layer4.1.conv2.weight"], state["layer4.1.conv2.weight"], atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weights": "nowhere.pth"}, r"train: weights: expected a file, got nowhere.pth"),
        ({"zoom": (2.0, 1.0)}, r"train: zoom: expected 0 < smallest <= largest, got 2.0,1.0"),
        ({"learning_rate": 1e30, "schedule": "step"}, r"train: learning_rate: got loss is .* try a smaller one"),
    ],
)
def test_what_cannot_work_is_refused(dataset, options, message):
    outcome = made(dataset, **options)
    assert outcome.status == "failed"
    assert re.search(message, outcome.why)


def test_broken_or_foreign_weights_are_refused(dataset, tmp_path):
    (tmp_path / "broken.pth").write_bytes(b"nothing")
    outcome = made(dataset, weights=str(tmp_path / "broken.pth"))
    assert "broken.pth: expected weights of a resnet18, got" in outcome.why
    state = DenseResNet(18, 8).state_dict()
    torch.save({name: value for name, value in state.items() if not name.startswith("layer4")}, tmp_path / "part.pth")
    outcome = made(dataset, weights=str(tmp_path / "part.pth"))
    assert "layer4.0.conv1.weight: expected all weights of a resnet18, got 25 missing" in outcome.why


def test_a_dataset_without_scenes_to_train_on_is_refused(tmp_path):
    dataset = learning_dataset(tmp_path / "d", n_views=2)
    dataset.file.splits = Splits(test=("a",))
    assert "train: splits: expected a scene to train on, got none" in made(dataset).why


def test_a_dataset_with_all_pairs_held_out_is_refused(tmp_path):
    dataset = learning_dataset(tmp_path / "d", n_views=2)
    assert "expected pairs with matches to train on, got none in a" in made(dataset, held_out=0.5).why


@pytest.mark.parametrize("loss", ["infonce", "contrastive"])
def test_golden(dataset, loss):
    """If this differs, mend the code, or raise the stage's version and write the file anew."""
    outcome = made(dataset, loss=loss, steps=2, non_matches=20, held_out=0.0)
    assert outcome.status == "made", outcome.why
    curve = DescriptorNet(dataset.path(DescriptorNet)).curve()
    values = dict(zip(curve["name"].to_pylist(), curve["value"].to_numpy(), strict=True))
    file = GOLDEN / f"train_{loss}_v{train.version}.npz"
    if os.environ.get("BASK_WRITE_GOLDEN"):
        np.savez_compressed(file, **values)
    golden = np.load(file)
    assert set(golden.files) == set(values)
    for name in golden.files:
        # Convolutions add up in another order on other hardware.
        np.testing.assert_allclose(values[name], golden[name], rtol=1e-3, err_msg=name)


def test_the_model_is_described(dataset, trained):
    model = json.loads((dataset.path(DescriptorNet) / "model.json").read_text())
    assert model["backbone"] == "resnet18"
    assert model["descriptor_dim"] == 8
    assert model["height"] == 32
