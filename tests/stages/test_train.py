from __future__ import annotations

import json
import os
import re
import shutil
import struct
import typing
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock

from bask_data.artifact import digest_of
from bask_data.dataset import Dataset, Splits
from bask_data.engine import key_parts, make, plan
from bask_data.errors import BadData, UsageError
from bask_data.kinds import DescriptorNet
from bask_data.nn.augment import AugmentSettings
from bask_data.nn.backbones import BACKBONES
from bask_data.nn.loss import ContrastiveSettings
from bask_data.nn.network import load
from bask_data.nn.processes import Group
from bask_data.nn.resnet import DenseResNet
from bask_data.nn.sampling import SampleSettings
from bask_data.nn.state import saved_step
from bask_data.nn.training import TrainingSettings
from bask_data.progress import listen
from bask_data.stages import train as train_module
from bask_data.stages.train import train
from bask_data.stages.train_params import TrainParams
from tests.datasets import copied
from tests.nn.pairs import SIZE
from tests.stages.learning import SMALL, learning_dataset

GOLDEN = Path(__file__).parent / "golden"


def made(dataset: Dataset, **options):
    [task] = plan(dataset, train, options={**SMALL, **options})
    return make(task)


@pytest.fixture(scope="module")
def learned_from(learnable, tmp_path_factory) -> Dataset:
    """Two scans, and the networks that these tests train on them."""
    return copied(learnable, tmp_path_factory.mktemp("train") / "d")


@pytest.fixture(scope="module")
def trained(learned_from):
    outcome = made(learned_from)
    assert outcome.status == "made", outcome.why
    return outcome


def test_a_network_is_made_that_describes_images(learned_from, trained):
    descriptor = DescriptorNet(learned_from.path(DescriptorNet))
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


def test_training_again_gives_the_same_bytes(learned_from, trained):
    [task] = plan(learned_from, train, options=SMALL)
    assert make(task).status == "up to date"
    assert make(task, force=True).digest == trained.digest


def test_weights_may_be_read_by_whom_all_else_may(learned_from, trained):
    modes = {file.name: file.stat().st_mode for file in learned_from.path(DescriptorNet).iterdir()}
    assert modes["weights.safetensors"] == modes["model.json"]


def test_weights_with_a_spoilt_number_are_not_used(learned_from, trained, tmp_path):
    path = shutil.copytree(learned_from.path(DescriptorNet), tmp_path / "main")
    content = bytearray((path / "weights.safetensors").read_bytes())
    content[-100] ^= 1
    (path / "weights.safetensors").write_bytes(content)
    load(path, "cpu")
    with pytest.raises(BadData, match=r"main/weights.safetensors: expected SHA-256 \w+..., got .*fix: make it again"):
        DescriptorNet(path).network()


def test_a_state_that_a_disk_has_spoilt_costs_no_more_than_time(learned_from, trained):
    [task] = plan(learned_from, train, options=SMALL)
    scratch = task.resumable_scratch(digest_of(key_parts(task)))
    scratch.mkdir(parents=True)
    (scratch / "state.safetensors").write_bytes(b"spoilt")
    told: list[str] = []
    listen(None, told.append)
    try:
        assert make(task, force=True).digest == trained.digest
    finally:
        listen(None)
    assert told[:1] == ["the state that an interrupted training saved is damaged: trained from the beginning"]
    assert not scratch.exists()


def test_another_training_of_the_same_network_is_waited_for_and_it_is_told(learned_from, trained):
    [task] = plan(learned_from, train, options={**SMALL, "seed": 11})
    other = FileLock(learned_from.root / ".scratch" / "resume~descriptor~main~~.lock", thread_local=False)
    told: list[str] = []

    def hear(line: str) -> None:
        told.append(line)
        other.release()

    other.acquire()
    listen(None, hear)
    try:
        assert make(task).status == "made"
    finally:
        listen(None)
        other.release()
    assert told[0] == "train: waiting for another process that is making it"
    assert made(learned_from).status == "made"


def test_without_other_scenes_the_last_frames_are_held_out_and_it_says_so(learned_from, trained):
    words = DescriptorNet(learned_from.path(DescriptorNet)).metadata.validated_on
    # 15 % of 5 frames is one; a pair holds it in 8 of 20 cases, in each of two scenes.
    assert words == "held-out frames: the last 2 of 10 (16 pairs), of scenes that were trained on"
    assert DescriptorNet(learned_from.path(DescriptorNet)).metadata.held_out == TrainParams().held_out


def test_with_scenes_for_validation_those_are_held_out(tmp_path):
    dataset = learning_dataset(tmp_path / "d", ("a", "b", "c"), n_views=2)
    dataset.file.splits = Splits(train=("a",), validation=("b",), test=("c",))
    assert made(dataset, steps=1).status == "made"
    metadata = DescriptorNet(dataset.path(DescriptorNet)).metadata
    assert (metadata.validated_on, metadata.held_out) == ("held-out scenes: b (2 pairs)", 0.0)


def test_nothing_held_out_is_said_and_gives_no_metrics(tmp_path):
    dataset = learning_dataset(tmp_path / "d", n_views=2)
    assert made(dataset, steps=1, held_out=0.0).status == "made"
    metadata = DescriptorNet(dataset.path(DescriptorNet)).metadata
    assert metadata.validated_on == "nothing: no scene and no frame with matches was held out"
    assert not [name for name in metadata.metrics if name.startswith("validation")]


def scalars(folder: Path) -> dict[tuple[str, int], float]:
    """What TensorBoard shows of a run: a file's start takes back what earlier files say of its step and later ones."""
    from tensorboardX.proto.event_pb2 import Event

    found: dict[tuple[str, int], float] = {}
    for file in sorted(folder.glob("events.out.tfevents.*"), key=lambda file: file.stat().st_mtime_ns):
        content, at = file.read_bytes(), 0
        while at < len(content):
            (length,) = struct.unpack_from("<Q", content, at)
            event = Event.FromString(content[at + 12 : at + 12 + length])
            at += 12 + length + 4
            if event.HasField("session_log"):
                found = {key: value for key, value in found.items() if key[1] < event.step}
            found |= {(value.tag, event.step): value.simple_value for value in event.summary.value}
    return found


def test_tensorboard_files_tell_the_curve_and_the_speed_outside_the_artifact(learned_from, trained):
    found = scalars(learned_from.root / "runs/descriptor/main")
    rows = DescriptorNet(learned_from.path(DescriptorNet)).curve().to_pylist()
    for row in rows:
        name = row["name"]
        tag = name.replace("validation_", "validation/") if "validation" in name else f"train/{name}"
        assert found.pop((tag, row["step"])) == row["value"]
    assert {tag for tag, _ in found} == {"speed/images_per_second", "speed/share_waited"}
    cost = json.loads((learned_from.root / "runs/descriptor/main/run.json").read_text())
    assert cost.keys() == {"device", "processes", "images_per_second", "share_waited"}
    assert cost["processes"] == 1


def test_interrupted_it_goes_on_and_ends_the_same(learned_from, trained, tmp_path, monkeypatch):
    from bask_data.nn import training

    other = learning_dataset(tmp_path / "d", ("a", "b"))
    monkeypatch.setattr(training, "save_state", save_and_stop)
    with pytest.raises(KeyboardInterrupt):
        made(other)
    monkeypatch.undo()
    [state] = (other.root / ".scratch").glob("resume*/state.safetensors")
    assert saved_step(state.parent) == 2
    train_step, trained = training._Run.train_step, []
    monkeypatch.setattr(
        training._Run, "train_step", lambda run, step, some: trained.append(step) or train_step(run, step, some)
    )
    assert made(other).status == "made"
    assert trained == [2, 3]
    assert digest(other) == digest(learned_from)
    names = {file.name for file in learned_from.path(DescriptorNet).iterdir()}
    assert {file.name for file in other.path(DescriptorNet).iterdir()} == names
    whole, found = (
        {key: value for key, value in scalars(some.root / "runs/descriptor/main").items() if "speed" not in key[0]}
        for some in (learned_from, other)
    )
    assert found == whole


def save_and_stop(folder: Path, *given: object) -> None:
    from bask_data.nn.state import save_state

    save_state(folder, *given)
    # What a kill in the middle of a write leaves: ours, and safetensors' own temporary file.
    for left in ("state.part", ".tmpqWgRll", "weights.safetensors"):
        (folder / left).write_bytes(b"half")
    raise KeyboardInterrupt


def digest(dataset: Dataset) -> str:
    return DescriptorNet(dataset.path(DescriptorNet)).manifest.digest


def test_trained_anew_it_forgets_what_an_earlier_run_logged(tmp_path):
    dataset = learning_dataset(tmp_path / "d", n_views=2)
    for seed in (0, 1):
        assert made(dataset, steps=1, seed=seed).status == "made"
    assert len(list((dataset.root / "runs/descriptor/main").glob("events*"))) == 1


def test_the_weights_that_validated_best_are_published_and_it_is_said(learned_from, monkeypatch):
    from bask_data.nn import validation

    verdicts = iter([0.1, 0.9, 0.2, 0.3])
    seen = []

    def judged(network, source):
        seen.append({name: value.clone() for name, value in network.encoder.state_dict().items()})
        return {"validation_pck_8": next(verdicts)}

    monkeypatch.setattr(validation, "validation_metrics", judged)
    outcome = made(learned_from, best_by="pck_8", validations=4)
    assert outcome.status == "made", outcome.why
    descriptor = DescriptorNet(learned_from.path(DescriptorNet))
    assert (descriptor.metadata.step, descriptor.metadata.chosen_by) == (2, "validation_pck_8")
    assert descriptor.metadata.metrics["validation_pck_8"] == 0.9
    for name, value in load(descriptor.path, "cpu").encoder.state_dict().items():
        assert torch.equal(value, seen[1][name]), name
    lines = descriptor.summary()
    assert lines[:2] == [
        "validated on held-out frames: the last 2 of 10 (16 pairs), of scenes that were trained on",
        "weights of step 2 of 4: best validation_pck_8",
    ]
    assert "validation_pck_8 0.9" in lines
    drawn = "\n".join(lines[lines.index("validation_pck_8 0.9") + 1 :])
    # Dots of braille: a curve, not an empty frame.
    assert sum("\u2801" <= character <= "\u28ff" for character in drawn) > 20


def test_the_last_weights_are_published_where_none_are_chosen(learned_from):
    assert made(learned_from, best_by="none", steps=2).status == "made"
    descriptor = DescriptorNet(learned_from.path(DescriptorNet))
    assert (descriptor.metadata.step, descriptor.metadata.chosen_by) == (2, None)
    assert descriptor.summary()[1] == "weights of step 2 of 2: the last"


def test_patience_ends_training_early(tmp_path, monkeypatch):
    from bask_data.nn import validation

    monkeypatch.setattr(validation, "validation_metrics", lambda network, source: {"validation_pck_4": 0.5 / next(n)})
    n = iter(range(1, 100))
    dataset = learning_dataset(tmp_path / "d")
    assert made(dataset, steps=20, validations=20, patience=2).status == "made"
    descriptor = DescriptorNet(dataset.path(DescriptorNet))
    assert descriptor.metadata.step == 1
    assert descriptor.curve()["step"].to_pylist()[-1] == 3


def test_every_backbone_can_be_chosen():
    assert set(typing.get_args(TrainParams.model_fields["backbone"].annotation)) == set(BACKBONES)


def test_options_reach_the_batches_and_the_loop():
    params = TrainParams(
        crop_share=1.0,
        zoom=(0.5, 1.5),
        crop="padded",
        rotation_deg=90,
        flip=0.1,
        background=0.2,
        composition=0.4,
        colour=0.6,
        hue_deg=180,
        noise=7.0,
        blur=1.5,
        pairs_per_step=6,
        matches=11,
        non_matches=12,
        foreground_share=0.3,
        clearance=4.0,
        self_pairs=0.7,
        loss="contrastive",
        margin_foreground=0.3,
        margin_background=0.8,
        hinge="plain",
        non_match_term="hard",
        normalised=False,
        match_root=True,
        background_normalised=False,
        accumulate=3,
        validations=4,
        steps=100,
        best_by="median_error_px",
        patience=5,
        schedule="step",
        decay=0.8,
        decay_every=10,
        warmup=5,
        frozen_batch_norm=True,
        precision="bfloat16",
        learning_rate=0.01,
        weight_decay=0.02,
        alpha=5.0,
        match_weight=0.2,
        seed=3,
    )
    assert train_module._augment(params, 2.0) == AugmentSettings(
        zoom=(1.0, 3.0),
        crop="padded",
        rotation=np.pi / 2,
        flip=0.1,
        background=0.2,
        composition=0.4,
        brightness=0.6,
        contrast=0.6,
        saturation=0.6,
        hue=np.pi,
        noise=7.0,
        blur=1.5,
    )
    assert train_module._sample(params, (8, 16)) == SampleSettings((8, 16), 6, 11, 12, 0.3, 4.0, 0.7)
    assert train_module._settings(params, "cpu") == TrainingSettings(
        steps=100,
        seed=3,
        loss="contrastive",
        contrastive=ContrastiveSettings(0.3, 0.8, "plain", "hard", False, True, False),
        alpha=5.0,
        match_weight=0.2,
        accumulate=3,
        learning_rate=0.01,
        weight_decay=0.02,
        schedule="step",
        decay=0.8,
        decay_every=10,
        warmup=5,
        frozen_batch_norm=True,
        precision="bfloat16",
        validate_every=25,
        best_by="validation_median_error_px",
        patience=5,
    )


def test_what_pretrained_weights_are_best_served_with_is_the_default():
    tuned, scratch = TrainParams(), TrainParams(backbone="resnet18")
    of = train_module._settings
    assert of(tuned, "cpu").frozen_batch_norm and not of(scratch, "cpu").frozen_batch_norm
    assert of(TrainParams(backbone="resnet18", weights="some.pth"), "cpu").frozen_batch_norm
    assert not of(TrainParams(frozen_batch_norm=False), "cpu").frozen_batch_norm
    assert (of(tuned, "cpu").precision, of(tuned, "cuda").precision) == ("float32", "auto")
    assert of(scratch, "cpu").precision == "auto"


def test_a_step_looks_at_a_share_of_the_image_as_large_as_all_of_it_would_show(learned_from, monkeypatch):
    seen = {}

    def look(network, examples, *rest, **options):
        seen.update(size=examples.sample.size, zoom=examples.augment.zoom)
        raise FloatingPointError("seen enough")

    monkeypatch.setattr("bask_data.nn.training.train_network", look)
    for share, size, enlarged in ((1.0, (32, 40), 1), (0.5, (16, 24), 2)):
        made(learned_from, seed=9, crop_share=share)
        assert seen == {"size": size, "zoom": (0.7 * enlarged, 2.0 * enlarged)}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"crop": "padded", "crop_share": 0.5}, r"crop: expected resized, or --crop-share 1 .*, got 'padded'"),
        ({"zoom": (2.0, 1.0)}, r"zoom: expected 0.1 <= smallest <= largest <= 10, got \[2.0, 1.0\]"),
        ({"zoom": (1.0, 1e30)}, r"zoom: expected 0.1 <= smallest <= largest <= 10, got \[1.0, 1e\+30\]"),
        ({"pairs_per_step": 2, "accumulate": 3}, r"accumulate: expected at most 2, the pairs of a step, got 3"),
        ({"seed": 1 << 63}, f"seed: expected less than {1 << 63}, got {1 << 63}"),
        ({"patience": 2, "best_by": "none"}, r"patience: expected a --best-by other than none, .*, got 2"),
    ],
)
def test_what_clashes_is_refused_before_anything_is_done(learned_from, options, message):
    with pytest.raises(UsageError, match=message):
        plan(learned_from, train, options={**SMALL, **options})


def test_patience_without_anything_to_validate_on_is_refused(tmp_path):
    dataset = learning_dataset(tmp_path / "d", n_views=2)
    why = made(dataset, held_out=0.0, patience=2).why
    assert "train: patience: expected matches to validate on, got nothing: no scene and no frame" in why


def test_more_processes_than_pairs_are_refused(learned_from, monkeypatch):
    from bask_data.nn import processes

    monkeypatch.setattr(train_module, "processes", lambda: 2)
    monkeypatch.setattr(processes, "joined", lambda: nullcontext(Group(0, 2)))
    expected = "train: torchrun: expected at most one for each of the batch's 1 pairs, got 2."
    assert made(learned_from, seed=7).why == f"{expected}  fix: give torchrun a smaller --nproc-per-node."


def test_a_group_of_processes_does_not_wait_for_another(learned_from, monkeypatch):
    from bask_data.engine import resumable

    monkeypatch.setattr(resumable, "processes", lambda: 2)
    with FileLock(learned_from.root / ".scratch" / "resume~descriptor~main~~.lock"):
        outcome = made(learned_from, seed=8)
    message = "train: expected no other process making it, got one that is running.  fix: wait until it has finished."
    assert outcome.why == message


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
        ({"backbone": "vit"}, r"train: weights: expected pretrained weights, got no file, .* give --weights FILE"),
        ({"learning_rate": 1e30, "schedule": "step"}, r"train: learning_rate: got loss is .* try a smaller one"),
    ],
)
def test_what_cannot_work_is_refused(learned_from, options, message):
    outcome = made(learned_from, **options)
    assert outcome.status == "failed"
    assert re.search(message, outcome.why)


def test_broken_or_foreign_weights_are_refused(learned_from, tmp_path):
    (tmp_path / "broken.pth").write_bytes(b"nothing")
    outcome = made(learned_from, weights=str(tmp_path / "broken.pth"))
    assert "broken.pth: expected weights of a resnet18, got" in outcome.why
    state = DenseResNet(18, 8).state_dict()
    torch.save({name: value for name, value in state.items() if not name.startswith("layer4")}, tmp_path / "part.pth")
    outcome = made(learned_from, weights=str(tmp_path / "part.pth"))
    assert "expected weights of a resnet18, got weights without layer4.0.conv1.weight (25 tensors" in outcome.why


def test_a_dataset_without_scenes_to_train_on_is_refused(tmp_path):
    dataset = learning_dataset(tmp_path / "d", n_views=2)
    dataset.file.splits = Splits(test=("a",))
    assert "train: splits: expected a scene to train on, got none" in made(dataset).why


def test_a_dataset_with_all_pairs_held_out_is_refused(tmp_path):
    dataset = learning_dataset(tmp_path / "d", n_views=2)
    assert "expected pairs with matches to train on, got none in a" in made(dataset, held_out=0.5).why


@pytest.mark.parametrize("loss", ["infonce", "contrastive"])
def test_golden(learned_from, loss):
    """If this differs, mend the code, or raise the stage's version and write the file anew."""
    outcome = made(learned_from, loss=loss, steps=2, non_matches=20, held_out=0.0)
    assert outcome.status == "made", outcome.why
    curve = DescriptorNet(learned_from.path(DescriptorNet)).curve()
    values = dict(zip(curve["name"].to_pylist(), curve["value"].to_numpy(), strict=True))
    file = GOLDEN / f"train_{loss}_v{train.version}.npz"
    if os.environ.get("BASK_WRITE_GOLDEN"):
        np.savez_compressed(file, **values)
    golden = np.load(file)
    assert set(golden.files) == set(values)
    for name in golden.files:
        # Convolutions add up in another order on other hardware.
        np.testing.assert_allclose(values[name], golden[name], rtol=1e-3, err_msg=name)


def test_the_model_is_described(learned_from, trained):
    model = json.loads((learned_from.path(DescriptorNet) / "model.json").read_text())
    assert model["backbone"] == "resnet18"
    assert model["descriptor_dim"] == 8
    assert model["height"] == 32
