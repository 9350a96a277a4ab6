from __future__ import annotations

from pathlib import Path

import pytest

from bask_data.config import load_config
from bask_data.engine import resolve
from bask_data.pipeline import STAGES
from bask_data.presets import PRESETS, PresetName, preset
from bask_data.stages.encode import encode
from bask_data.stages.train import train
from bask_data.stages.train_params import TrainParams


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_made_of_parameters_that_there_are(name: PresetName) -> None:
    config = load_config(None, [], STAGES, name)
    params = resolve(train, config, "", "main", {})
    for field, value in PRESETS[name].get("train", {}).items():
        assert getattr(params, field) == value


def test_all_presets_set_the_same_fields_so_that_none_leaves_a_trace_of_another(tmp_path: Path) -> None:
    for section in ("train", "encode"):
        fields = [set(preset(name, STAGES)[section]) for name in PRESETS]
        assert all(one == fields[0] for one in fields)
    file = tmp_path / "params.yaml"
    file.write_text("train: {backbone: resnet50, steps: 7, seed: 5}\n")
    params = resolve(train, load_config(file, [], STAGES, "tabletop"), "", "main", {})
    assert params == TrainParams(seed=5)


def test_order_is_option_then_set_then_preset_then_file(tmp_path: Path) -> None:
    file = tmp_path / "params.yaml"
    file.write_text("train: {backbone: resnet50, descriptor_dim: 3, steps: 7}\n")
    config = load_config(file, ["train.steps=9"], STAGES, "bask")
    params = resolve(train, config, "", "main", {"matches": 11})
    assert (params.backbone, params.descriptor_dim, params.steps, params.matches) == ("resnet101", 64, 9, 11)


def test_a_preset_goes_over_what_the_file_says_of_one_variant(tmp_path: Path) -> None:
    file = tmp_path / "params.yaml"
    file.write_text("train@v2: {descriptor_dim: 9, seed: 4}\n")
    params = resolve(train, load_config(file, [], STAGES, "florence"), "", "v2", {})
    assert (params.descriptor_dim, params.seed) == (16, 4)


def test_presets_tell_the_filters_of_the_paper_and_of_its_code() -> None:
    told = [resolve(encode, load_config(None, [], STAGES, name), "", "main", {}) for name in PRESETS]
    assert [(params.filter, params.settings) for params in told] == [
        ("particle", "default"),
        ("particle", "paper"),
        ("particle", "code"),
        ("expectation", "default"),
    ]


def test_presets_tell_the_networks_of_the_papers() -> None:
    bask, base = (resolve(train, load_config(None, [], STAGES, name), "", "main", {}) for name in ("bask", "florence"))
    assert (bask.backbone, bask.descriptor_dim, bask.normalised) == ("resnet101", 64, True)
    assert (bask.margin_foreground, bask.margin_background, bask.foreground_share) == (0.25, 0.75, None)
    assert (base.backbone, base.descriptor_dim, base.rotation_deg, base.zoom) == ("resnet34", 16, 0.0, (1.0, 1.0))
