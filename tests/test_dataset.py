from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from bask_data.dataset import Dataset, Source, Splits
from bask_data.errors import BadData, UsageError, WouldOverwrite

SOURCE = Source(format="frames", path="somewhere")


def test_created_dataset_opens_and_is_a_zarr_group(tmp_path: Path) -> None:
    import zarr

    Dataset.create(tmp_path / "d", licence="CC-BY-4.0")
    assert Dataset(tmp_path / "d").file.licence == "CC-BY-4.0"
    assert zarr.open_group(str(tmp_path / "d"), mode="r").attrs["bask"]["dataset"] == 1


def test_existing_dataset_is_not_made_again(tmp_path: Path) -> None:
    Dataset.create(tmp_path)
    with pytest.raises(WouldOverwrite, match=r"dataset.json: expected no dataset, got one"):
        Dataset.create(tmp_path)


def test_directory_without_dataset_is_refused_with_the_command_that_makes_one(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="fix: check the path, or create one: bask-data init"):
        Dataset(tmp_path)


def test_path_of_a_file_is_refused_without_the_command_that_would_fail_on_it(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(BadData, match=r"notes.txt: expected a dataset .*, got a file\.  fix: check the path\.$"):
        Dataset(tmp_path / "notes.txt")
    Dataset.create(tmp_path)
    with pytest.raises(BadData, match=rf"got a file\.  fix: give its directory: {tmp_path}$"):
        Dataset(tmp_path / "dataset.json")


@pytest.mark.parametrize(("version", "fix"), [(99, "made by a newer version: upgrade"), (0, "restore it")])
def test_dataset_of_another_version_is_refused(tmp_path: Path, version: int, fix: str) -> None:
    Dataset.create(tmp_path)
    document = json.loads((tmp_path / "dataset.json").read_text()) | {"bask_dataset": version}
    (tmp_path / "dataset.json").write_text(json.dumps(document))
    with pytest.raises(BadData, match=rf"bask_dataset: expected 1, got {version}\.  fix: .*{fix}"):
        Dataset(tmp_path)


@pytest.mark.parametrize("text", ["{", "", "[]", '{"name": 3}', "{}", '{"name": "d", "scenes": {"a": {}}}'])
def test_every_error_of_a_damaged_dataset_file_has_a_fix(tmp_path: Path, text: str) -> None:
    Dataset.create(tmp_path)
    (tmp_path / "dataset.json").write_text(text)
    with pytest.raises(BadData, match=r"expected .*, got .*\.  fix: correct the file, or restore it from a copy"):
        Dataset(tmp_path)


@pytest.mark.parametrize(("name", "allowed"), [("table ü", "table"), ("", "table"), ("../x", "x"), ("a b", "a_b")])
def test_a_refused_name_comes_with_one_that_is_allowed(tmp_path: Path, name: str, allowed: str) -> None:
    dataset = Dataset.create(tmp_path)
    with pytest.raises(UsageError, match=f"fix: for instance {allowed}$"):
        dataset.add("scene", name, SOURCE)
    dataset.add("scene", allowed, SOURCE)


def test_file_in_place_of_the_directory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "d").touch()
    with pytest.raises(UsageError, match="expected a directory, got a file"):
        Dataset.create(tmp_path / "d")


@pytest.mark.parametrize("name", ["../up", "a/b", "", ".hidden", "-x", "a" * 65, "a b", "a\n"])
def test_names_that_are_not_a_plain_directory_are_refused(tmp_path: Path, name: str) -> None:
    dataset = Dataset.create(tmp_path)
    with pytest.raises(UsageError, match="name: expected letters, digits"):
        dataset.add("scene", name, SOURCE)


@pytest.mark.parametrize("field", ["scenes", "demonstrations"])
def test_names_in_an_untrusted_dataset_file_are_checked(tmp_path: Path, field: str) -> None:
    Dataset.create(tmp_path)
    document = json.loads((tmp_path / "dataset.json").read_text())
    document[field] = {"../../etc": SOURCE.model_dump()}
    (tmp_path / "dataset.json").write_text(json.dumps(document))
    with pytest.raises(UsageError, match=r"got '\.\./\.\./etc'"):
        Dataset(tmp_path)


def test_variants_of_inputs_in_an_untrusted_dataset_file_are_checked(tmp_path: Path) -> None:
    Dataset.create(tmp_path)
    document = json.loads((tmp_path / "dataset.json").read_text())
    document["variants"] = {"reference": {"fine": {"inputs": {"descriptor": "../../etc"}}}}
    (tmp_path / "dataset.json").write_text(json.dumps(document))
    with pytest.raises(UsageError, match=r"got '\.\./\.\./etc'"):
        Dataset(tmp_path)


def test_unknown_field_in_the_dataset_file_is_named(tmp_path: Path) -> None:
    Dataset.create(tmp_path)
    document = json.loads((tmp_path / "dataset.json").read_text()) | {"colour": 1}
    (tmp_path / "dataset.json").write_text(json.dumps(document))
    with pytest.raises(BadData, match=r"dataset.json: colour: expected no field of that name"):
        Dataset(tmp_path)


def test_a_name_is_a_scene_or_a_demonstration(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path)
    dataset.add("scene", "a", SOURCE)
    with pytest.raises(UsageError, match="a: expected a demonstration, got the name of a scene"):
        dataset.add("demonstration", "a", SOURCE)


def test_items_added_at_the_same_time_are_all_kept(tmp_path: Path) -> None:
    Dataset.create(tmp_path)
    names = [f"s{i}" for i in range(20)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda name: Dataset(tmp_path).add("scene", name, SOURCE), names))
    assert sorted(Dataset(tmp_path).items("scene")) == sorted(names)


def test_names_are_checked_against_the_file_as_another_process_left_it(tmp_path: Path) -> None:
    first, second = Dataset.create(tmp_path / "d"), Dataset(tmp_path / "d")
    first.add("scene", "a", SOURCE)
    with pytest.raises(UsageError, match="a: expected a demonstration, got the name of a scene"):
        second.add("demonstration", "a", SOURCE)
    assert Dataset(tmp_path / "d").items("recording") == ["a"]
    other = Dataset(tmp_path / "d")
    first.add("scene", "b", SOURCE)
    other.set_splits(Splits(train=("a", "b")))
    assert Dataset(tmp_path / "d").file.splits.train == ("a", "b")


def test_items_are_selected_by_name_each_once_and_all_by_default(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path)
    for scope, name in (("scene", "table"), ("scene", "shelf"), ("demonstration", "pour")):
        dataset.add(scope, name, SOURCE)
    assert dataset.select([]) == ["table", "shelf", "pour"]
    assert dataset.select(["pour", "table", "pour"]) == ["pour", "table"]
    assert dataset.select([], "scene") == ["table", "shelf"]


def test_a_misspelt_item_is_refused_with_the_nearest_name(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path)
    for name in ("table1", "shelf"):
        dataset.add("scene", name, SOURCE)
    with pytest.raises(
        UsageError, match=r"--only: expected one of table1, shelf, got tabel1\.  fix: did you mean table1\?"
    ):
        dataset.select(["shelf", "tabel1"])
    with pytest.raises(UsageError, match=r"splits: expected one of .*, got Shelf\.  fix: did you mean shelf\?"):
        dataset.set_splits(Splits(test=("Shelf",)))


def test_an_unknown_item_of_a_large_dataset_is_refused_in_one_line(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path)
    dataset.file.scenes.update({f"scene{i}": SOURCE for i in range(2000)})
    with pytest.raises(UsageError, match=r"scene19 and 1,980 more, got b") as caught:
        dataset.select(["b"])
    assert len(str(caught.value)) < 400


def test_selecting_from_a_dataset_without_items_names_the_command_that_adds_them(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path)
    with pytest.raises(UsageError, match="expected a scene, got none in the dataset.  fix: bask-data ingest --help"):
        dataset.select([], "scene")
    with pytest.raises(UsageError, match="--only: expected one of no items yet, got a"):
        dataset.select(["a"])


def test_splits_name_existing_scenes_once(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path)
    for name in "ab":
        dataset.add("scene", name, SOURCE)
    with pytest.raises(UsageError, match="splits: expected one of a, b, got c"):
        dataset.set_splits(Splits(train=("c",)))
    with pytest.raises(UsageError, match="expected each scene in one split, got a"):
        dataset.set_splits(Splits(train=("a",), test=("a",)))
    dataset.set_splits(Splits(train=("a",), test=("b",)))
    assert Dataset(tmp_path).file.splits.test == ("b",)


def test_splits_that_name_an_unknown_scene_are_refused(tmp_path: Path) -> None:
    Dataset.create(tmp_path)
    document = json.loads((tmp_path / "dataset.json").read_text())
    document["splits"]["train"] = ["nope"]
    (tmp_path / "dataset.json").write_text(json.dumps(document))
    with pytest.raises(BadData, match="splits: expected one of no scenes, got nope"):
        Dataset(tmp_path)
