from __future__ import annotations

import json
import time
from itertools import product
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.dataset import Dataset, Variant
from bask_data.engine import PARAMS, REQUESTED, Requested, RunRequest, plan, read_requested, run_pipeline, status
from bask_data.engine.sections import Config, laid_over, sections_for, within
from bask_data.errors import BadData
from bask_data.kinds import Demonstration, Reconstruction
from tests.datasets import add_scan
from tests.toy_stages import fuse, label, learn, pick, weigh

STAGES = (fuse, pick)
VARIANTS, ITEMS = ("main", "big"), ("a", "b")


def made(dataset: Dataset, **asked: object) -> list[str]:
    request = RunRequest(**{"stages": ("fuse",), **asked})  # type: ignore[arg-type]
    return [outcome.status for outcome in run_pipeline(dataset, STAGES, request)]


def stale(dataset: Dataset) -> list[str]:
    """Labels of what is not up to date for somebody who opens the dataset and gives no parameters."""
    request = RunRequest(stages=("fuse",))
    return [
        standing.label
        for standing in status(Dataset(dataset.root), STAGES, request)
        if standing.state.status != "up to date"
    ]


def parameters(dataset: Dataset) -> Config:
    return read_requested(dataset.root).parameters


def voxel_sizes(dataset: Dataset) -> list[float]:
    return [Reconstruction(dataset.path(Reconstruction, name)).manifest.params["voxel_size"] for name in "ab"]


def test_artifacts_made_with_options_are_up_to_date_without_them(dataset: Dataset) -> None:
    assert made(dataset, options={"voxel_size": 0.2}) == ["made", "made"]
    assert parameters(dataset) == {"fuse": {"voxel_size": 0.2}}
    assert stale(dataset) == []
    assert made(dataset) == ["up to date", "up to date"]


def test_scene_added_later_is_made_with_the_same_parameters(dataset: Dataset) -> None:
    made(dataset, options={"voxel_size": 0.2})
    add_scan(dataset, "c")
    assert made(dataset) == ["up to date", "up to date", "made"]
    assert Reconstruction(dataset.path(Reconstruction, "c")).manifest.params["voxel_size"] == 0.2


def test_options_for_some_scenes_are_recorded_for_these(dataset: Dataset) -> None:
    made(dataset, options={"voxel_size": 0.2})
    assert made(dataset, only=("b",), options={"voxel_size": 0.3}) == ["made"]
    assert parameters(dataset) == {"fuse": {"voxel_size": 0.2}, "fuse@b": {"voxel_size": 0.3}}
    assert stale(dataset) == []
    made(dataset, options={"voxel_size": 0.4})
    assert parameters(dataset) == {"fuse": {"voxel_size": 0.4}}
    assert stale(dataset) == []


def test_config_replaces_the_record_and_set_adds_to_it(dataset: Dataset) -> None:
    made(dataset, options={"voxel_size": 0.2})
    made(dataset, given={"fuse": {"ignored": 1}})
    assert parameters(dataset) == {"fuse": {"voxel_size": 0.2, "ignored": 1}}
    made(dataset, given={"fuse@a": {"ignored": 2}, "pick": {}}, replaces=True)
    assert parameters(dataset) == {"fuse@a": {"ignored": 2}}
    assert stale(dataset) == []


def test_config_for_one_scene_keeps_the_record_of_the_others(dataset: Dataset) -> None:
    made(dataset, options={"voxel_size": 0.2})
    made(dataset, only=("a",), given={"fuse": {"ignored": 1}}, replaces=True)
    assert Reconstruction(dataset.path(Reconstruction, "a")).manifest.params["voxel_size"] == 0.1
    assert stale(dataset) == []


def test_defaults_drop_the_record(dataset: Dataset) -> None:
    made(dataset, options={"voxel_size": 0.2})
    assert made(dataset, replaces=True) == ["made", "made"]
    assert parameters(dataset) == {}
    assert stale(dataset) == []


def test_the_order_is_option_given_standing_recorded_default(dataset: Dataset) -> None:
    made(dataset, only=("a",), options={"voxel_size": 0.2})

    def size(**asked: object) -> float:
        [task, _] = plan(dataset, fuse, **asked)  # type: ignore[arg-type]
        return task.params.model_dump()["voxel_size"]

    assert size(requested=Requested()) == 0.1
    assert size() == 0.2
    assert size(config={"fuse": {"voxel_size": 0.3}}) == 0.3
    assert size(config={"fuse": {"voxel_size": 0.3}}, options={"voxel_size": 0.4}) == 0.4


def test_parameters_of_the_datasets_own_file_are_not_recorded(dataset: Dataset) -> None:
    (dataset.root / PARAMS).write_text("fuse: {voxel_size: 0.2}")
    made(dataset)
    assert Reconstruction(dataset.path(Reconstruction, "a")).manifest.params["voxel_size"] == 0.2
    assert not (dataset.root / REQUESTED).exists()


def test_a_later_option_takes_precedence_over_params_yaml_until_the_file_says_something_else(dataset: Dataset) -> None:
    file = dataset.root / PARAMS
    file.write_text("fuse: {voxel_size: 0.2, ignored: 1}")
    assert made(dataset) == ["made", "made"]
    assert made(dataset, only=("a",), options={"voxel_size": 0.3}) == ["made"]
    assert parameters(dataset) == {"fuse@a": {"voxel_size": 0.3}}
    assert stale(dataset) == []
    file.write_text("fuse: {voxel_size: 0.2, ignored: 2}")
    assert made(dataset) == ["made", "made"]
    assert voxel_sizes(dataset) == [0.3, 0.2]
    file.write_text("fuse: {voxel_size: 0.4}")
    assert made(dataset) == ["made", "made"]
    assert voxel_sizes(dataset) == [0.4, 0.4]
    # The latest statement again, although an option once overrode the same value.
    file.write_text("fuse: {voxel_size: 0.2}")
    assert made(dataset) == ["made", "made"]
    assert voxel_sizes(dataset) == [0.2, 0.2]
    assert stale(dataset) == []


def test_an_option_for_one_scene_does_not_bring_back_what_params_yaml_overrode_for_another(dataset: Dataset) -> None:
    file = dataset.root / PARAMS
    made(dataset, only=("a",), options={"voxel_size": 0.2})
    file.write_text("fuse@a: {voxel_size: 0.3}")
    assert made(dataset, only=("b",), options={"voxel_size": 0.4}) == ["made"]
    assert made(dataset) == ["made", "up to date"]
    assert voxel_sizes(dataset) == [0.3, 0.4]


@pytest.mark.parametrize("only", [(), ("a",)])
def test_a_configuration_used_instead_of_params_yaml_is_what_the_dataset_is_compared_with(
    dataset: Dataset, only: tuple[str, ...]
) -> None:
    (dataset.root / PARAMS).write_text("fuse: {voxel_size: 0.2, ignored: 1}")
    made(dataset)
    given = {"fuse": {"voxel_size": 0.3}}
    assert set(made(dataset, only=only, given=given, replaces=True, ignores_own_file=True)) == {"made"}
    assert voxel_sizes(dataset) == [0.3, 0.2 if only else 0.3]
    assert Reconstruction(dataset.path(Reconstruction, "a")).manifest.params["ignored"] == 0
    assert stale(dataset) == []


@pytest.mark.parametrize("only", [(), ("a",)])
def test_defaults_leave_what_params_yaml_says(dataset: Dataset, only: tuple[str, ...]) -> None:
    (dataset.root / PARAMS).write_text("fuse: {voxel_size: 0.2}")
    made(dataset, options={"voxel_size": 0.3, "ignored": 1})
    made(dataset, only=only, replaces=True)
    assert voxel_sizes(dataset) == [0.2, 0.3 if only else 0.2]
    assert stale(dataset) == []


def test_neither_a_dry_run_nor_a_failure_records_anything(dataset: Dataset) -> None:
    request = RunRequest(stages=("fuse",), options={"voxel_size": 0.2})
    assert [outcome.status for outcome in run_pipeline(dataset, STAGES, request, dry_run=True)] == ["would make"] * 2
    assert made(dataset, options={"fail": "this"}) == ["failed", "failed"]
    assert not (dataset.root / REQUESTED).exists()


def test_options_of_a_variant_are_its_own(dataset: Dataset) -> None:
    stages = (fuse, pick, learn, label)
    options = {"scans": ["a"], "described": False}
    request = RunRequest(stages=("label",), variant="few", options=options)
    assert [outcome.status for outcome in run_pipeline(dataset, stages, request)] == ["made"]
    assert read_requested(dataset.root).parameters == {"label@few": options}
    assert list(dataset.variants(label.makes)) == ["main", "few"]
    states = {
        standing.variant: standing.state.status for standing in status(dataset, stages, RunRequest(stages=("label",)))
    }
    assert states == {"main": "blocked", "few": "up to date"}


def test_file_missing_on_this_machine_is_compared_by_its_recorded_digest(dataset: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "weights"
    file.write_text("one")
    made(dataset, options={"file": str(file)})
    file.rename(tmp_path / "elsewhere")
    [state, _] = [standing.state for standing in status(dataset, STAGES, RunRequest(stages=("fuse",)))]
    assert (state.status, state.why) == (
        "up to date",
        f"{file} is missing; compared with its recorded SHA-256",
    )
    assert made(dataset) == ["up to date", "up to date"]
    [outcome, _] = run_pipeline(dataset, STAGES, RunRequest(stages=("fuse",)), force=True)
    assert outcome.status == "failed"
    assert "fuse: file: expected a file, got" in outcome.why
    file.write_text("two")
    assert stale(dataset) == ["fuse a", "fuse b"]


def test_missing_file_without_a_record_leaves_the_state_unknown(dataset: Dataset, tmp_path: Path) -> None:
    made(dataset)
    request = RunRequest(stages=("fuse",), options={"file": str(tmp_path / "none")})
    [state, _] = [standing.state for standing in status(dataset, STAGES, request)]
    assert state.status == "blocked"
    assert "unknown whether it is up to date: fuse: file: expected a file, got" in state.why
    assert state.blocked is not None
    assert (state.blocked.kind, state.blocked.fix) == ("file missing", "check the path.")


def test_a_file_that_no_parameter_names_any_more_is_forgotten(dataset: Dataset, tmp_path: Path) -> None:
    files = [tmp_path / "first", tmp_path / "second"]
    for file in files:
        file.write_text(file.name)
    (dataset.root / PARAMS).write_text(f"fuse@b: {{file: {files[1]}}}")
    made(dataset, only=("a",), options={"file": str(files[0])})
    made(dataset)
    assert list(read_requested(dataset.root).files) == list(map(str, files))
    made(dataset, only=("a",), options={"file": None})
    assert list(read_requested(dataset.root).files) == [str(files[1])]


def test_a_run_of_all_stages_records_the_parameters_of_those_that_have_nothing_to_process_yet(
    dataset: Dataset,
) -> None:
    stages, empty = (fuse, label), Dataset.create(dataset.root.with_name("later"))
    add_scan(empty, "d", kind=Demonstration)
    given = {"fuse": {"voxel_size": 0.2}, "label": {"scans": ["a"]}}
    outcomes = run_pipeline(empty, stages, RunRequest(given=given))
    assert [(outcome.label, outcome.status) for outcome in outcomes] == [("label", "blocked")]
    assert read_requested(empty.root).parameters == given


def test_a_failure_leaves_a_note_that_the_parameters_are_not_recorded(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[str] = []
    monkeypatch.setattr("bask_data.progress._note_listener", notes.append)
    request = RunRequest(given={"fuse": {"fail": "this"}, "pick": {}})
    assert [outcome.status for outcome in run_pipeline(dataset, STAGES, request)] == ["failed"] * 2 + ["blocked"] * 2
    assert notes == ["fuse: its parameters are not recorded with the dataset, because nothing was made with them"]
    assert not (dataset.root / REQUESTED).exists()


def test_parameters_are_recorded_if_a_kill_follows_the_first_artifact(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("bask_data.engine.publishing.record", killed)
    with pytest.raises(KeyboardInterrupt):
        made(dataset, options={"voxel_size": 0.2})
    assert stale(dataset) == ["fuse b"]


def test_files_named_for_a_later_variant_are_recorded_too(dataset: Dataset, tmp_path: Path) -> None:
    files = [tmp_path / "first", tmp_path / "second"]
    for file in files:
        file.write_text(file.name)
    stages = (fuse, pick, learn, weigh)
    dataset.add_variant(weigh.makes, "big", Variant())
    given = {"weigh": {"file": str(files[0])}, "weigh@big": {"file": str(files[1])}}
    outcomes = list(run_pipeline(dataset, stages, RunRequest(given=given)))
    assert [outcome.status for outcome in outcomes[-2:]] == ["made", "made"]
    for file in files:
        file.unlink()
    standings = list(status(dataset, stages, RunRequest(stages=("weigh",))))
    assert [standing.state.status for standing in standings] == ["up to date", "up to date"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "expected a JSON document"),
        ("[]", "expected values by name, got"),
        ('{"bask_requested": 2}', "bask_requested: expected one of 1, got 2"),
        ('{"parameters": {"fuse": 1}}', "parameters.fuse: expected values by name, got 1"),
        ('{"parameters": {"fuse": {"voxel_size": NaN}}}', "expected finite numbers"),
        ('{"parameters": {"fuse": {"voxel_size": ' + "[" * 400 + "]" * 400 + "}}}", "requested.json"),
        ('{"parameters": {"fuse@../x": {}}}', "parameters: expected stage, stage@name .*, got fuse@../x"),
        ('{"overridden": {"fuse@../x": {}}}', "parameters: expected stage, stage@name .*, got fuse@../x"),
        ('{"files": {"a": "no digest"}}', "files.a: expected"),
        ('{"more": 1}', "more: expected no field of that name"),
    ],
)
def test_record_with_invalid_content_is_refused(dataset: Dataset, text: str, message: str) -> None:
    (dataset.root / REQUESTED).write_text(text)
    with pytest.raises(BadData, match=message) as caught:
        read_requested(dataset.root)
    assert str(dataset.root / REQUESTED) in str(caught.value)


def test_sections_of_unknown_stages_are_kept_and_ignored_with_a_note(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[str] = []
    monkeypatch.setattr("bask_data.progress._note_listener", notes.append)
    (dataset.root / REQUESTED).write_text(json.dumps({"parameters": {"polish": {"grit": 240}}}))
    assert made(dataset, options={"voxel_size": 0.2}) == ["made", "made"]
    assert notes == ["requested.json: no stage has these sections, which are ignored: polish"]
    assert parameters(dataset) == {"fuse": {"voxel_size": 0.2}, "polish": {"grit": 240}}
    assert made(dataset, replaces=True) == ["made", "made"]
    assert parameters(dataset) == {"polish": {"grit": 240}}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"voxel_size": -1},
            r"parameters.fuse.voxel_size: expected greater than 0, got -1.  fix: drop the record: .*--defaults",
        ),
        ({"voxel": 1}, "parameters.fuse.voxel: expected no field of that name, got 1"),
    ],
)
def test_invalid_recorded_parameter_is_refused_with_its_place(
    dataset: Dataset, values: dict[str, object], message: str
) -> None:
    (dataset.root / REQUESTED).write_text(json.dumps({"parameters": {"fuse": values}}))
    with pytest.raises(BadData, match=message):
        status(dataset, STAGES)
    assert made(dataset, replaces=True) == ["made", "made"]
    assert parameters(dataset) == {}


SECTIONS = [
    "s",
    *(f"s@{v}" for v in VARIANTS),
    *(f"s@{i}" for i in ITEMS),
    *(f"s@{v}@{i}" for v in VARIANTS for i in ITEMS),
]
configs = st.dictionaries(
    st.sampled_from(SECTIONS), st.dictionaries(st.sampled_from("xy"), st.integers(0, 9), min_size=1, max_size=2)
)


def resolved(config: Config, variant: str, item: str) -> dict[str, int]:
    values: dict[str, int] = {}
    for section in sections_for("s", item, variant):
        values.update(config.get(section, {}))
    return values


@given(configs, configs)
def test_upper_layer_overrides_the_lower_one_for_every_artifact(below: Config, above: Config) -> None:
    laid = laid_over(below, above, "s", VARIANTS)
    for variant, item in product(VARIANTS, ITEMS):
        assert resolved(laid, variant, item) == resolved(below, variant, item) | resolved(above, variant, item)


@given(
    configs,
    st.none() | st.lists(st.sampled_from(VARIANTS), unique=True, min_size=1),
    st.none() | st.lists(st.sampled_from(ITEMS), unique=True, min_size=1),
)
def test_sections_within_a_scope_are_equal_inside_and_empty_outside(
    config: Config, variants: list[str] | None, items: list[str] | None
) -> None:
    narrowed = within(config, "s", variants, items, VARIANTS)
    for variant, item in product(VARIANTS, ITEMS):
        inside = (variants is None or variant in variants) and (items is None or item in items)
        assert resolved(narrowed, variant, item) == (resolved(config, variant, item) if inside else {})


def test_sections_for_each_of_thousands_of_items_are_merged_in_no_time() -> None:
    items = [f"a{i}" for i in range(4000)]
    sections = {f"s@{item}": {"x": i} for i, item in enumerate(items)}
    begun = time.process_time()
    assert laid_over(sections, sections, "s", VARIANTS) == sections
    assert within(sections, "s", None, items, VARIANTS) == sections
    assert laid_over(sections, {"s": {"x": 0}}, "s", VARIANTS) == {"s": {"x": 0}}
    assert time.process_time() - begun < 2
