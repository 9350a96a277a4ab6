from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from bask_data.config import load_config, section_written, write_section
from bask_data.engine import resolve
from bask_data.errors import BadData, UsageError
from tests.toy_stages import fuse, pick

STAGES = (fuse, pick)


def written(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "params.yaml"
    file.write_text(text)
    return file


def test_order_is_option_then_set_then_item_then_stage_then_default(tmp_path: Path) -> None:
    file = written(tmp_path, "fuse: {voxel_size: 1, ignored: 1}\nfuse@a: {voxel_size: 2}\n")
    config = load_config(file, [], STAGES)
    assert resolve(fuse, config, "b", "main", {}).model_dump() == {
        "voxel_size": 1,
        "fail": "",
        "ignored": 1,
        "file": None,
    }
    assert resolve(fuse, config, "a", "main", {}).model_dump()["voxel_size"] == 2
    config = load_config(file, ["fuse@a.voxel_size=3"], STAGES)
    assert resolve(fuse, config, "a", "main", {}).model_dump()["voxel_size"] == 3
    assert resolve(fuse, config, "a", "main", {"voxel_size": 4}).model_dump()["voxel_size"] == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fusing: {}", "fusing: expected one of fuse, pick, got fusing"),
        ("fuse: {voxel: 1}", "fuse.voxel: expected one of voxel_size, .* got voxel.  fix: did you mean voxel_size?"),
    ],
)
def test_unknown_names_are_refused_with_the_choices(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        load_config(written(tmp_path, text), [], STAGES)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1", "expected a section per stage, got list"),
        ("fuse: 1", "fuse: expected parameters by name, got 1"),
        ("a: [", "expected YAML"),
        ("!!python/object/apply:os.system ['touch ran']", "expected YAML, got could not determine a constructor"),
    ],
)
def test_files_that_are_not_a_configuration_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(BadData, match=message):
        load_config(written(tmp_path, text), [], STAGES)
    assert not Path("ran").exists()


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        UsageError, match=r"--config: expected a YAML file, got no such file '.*none.yaml'.  fix: check the path"
    ):
        load_config(tmp_path / "none.yaml", [], STAGES)


@pytest.mark.parametrize("text", ["fuse.voxel_size", "voxel_size=1"])
def test_assignments_must_name_stage_and_field(text: str) -> None:
    with pytest.raises(UsageError, match="--set: expected stage.field=value"):
        load_config(None, [text], STAGES)


def test_assignment_must_be_yaml() -> None:
    with pytest.raises(UsageError, match="expected a YAML value"):
        load_config(None, ["fuse.voxel_size=["], STAGES)


def test_an_unknown_name_is_blamed_on_what_states_it(tmp_path: Path) -> None:
    file = written(tmp_path, "fuse: {voxel_size: 1}")
    with pytest.raises(UsageError, match=r"^--set: fuse.voxel: expected"):
        load_config(file, ["fuse.voxel=1"], STAGES)
    file = written(tmp_path, "fuse: {voxel: 1}")
    with pytest.raises(UsageError, match=rf"^{file}: fuse.voxel: expected"):
        load_config(file, ["fuse.voxel_size=1"], STAGES)


def test_a_section_is_written_without_touching_the_rest(tmp_path: Path) -> None:
    file = tmp_path / "params.yaml"
    write_section(file, "pick@main", {"picks": ["a:1:é", "b: 2"]})
    assert yaml.safe_load(file.read_text()) == {"pick@main": {"picks": ["a:1:é", "b: 2"]}}
    before, after = "# Ours.\nfuse:\n  # Metres.\n  voxel_size: 1\n\n", "\n# Theirs.\nother:\n  a: 1"
    text = f"{before}pick@main:\n  n: 3\n  picks:\n  - x\n{after}"
    file.write_text(text)
    write_section(file, "pick@main", {"picks": ["y"]})
    assert file.read_text() == text.replace("- x", "- y")
    write_section(file, "pick@v2", {"picks": []})
    assert file.read_text() == text.replace("- x", "- y") + "\npick@v2:\n  picks: []\n"


@pytest.mark.parametrize(
    "text",
    [
        "{fuse: {voxel_size: 1}, pick@main: {n: 3}}",
        "'pick@main': {n: 3}\nfuse: {voxel_size: 1}\n",
        "fuse: {voxel_size: 1}\npick@main: {\nn: 3\n}\n",
        "fuse:\n  voxel_size: 1\npick@main: &x\n# Here.\n  n: 3\n",
    ],
)
def test_a_file_in_another_style_keeps_its_values(tmp_path: Path, text: str) -> None:
    file = written(tmp_path, text)
    write_section(file, "pick@main", {"picks": ["y"]})
    assert yaml.safe_load(file.read_text()) == {"fuse": {"voxel_size": 1}, "pick@main": {"n": 3, "picks": ["y"]}}


@pytest.mark.parametrize(
    ("before", "section", "after"),
    [
        ("", "reference@main:\n  n: 3\n# Mine.\n  picks:\n  - x\n", "fuse: {a: 1}  # Its.\n"),
        ("# Ours.\n", "'reference@main':\n  n: 3\n  picks: [x]\n", "\n# Its.\nfuse: {a: 1}\n"),
        ("%YAML 1.1\n---\n# Ours.\nfuse: {a: 1}\n", "reference@main: {n: 3}\n", "...\n# End.\n"),
        ("---  # Ours.\nfuse: {a: 1}\n", "reference@main: {n: 3}", ""),
        ("fuse:\r\n  a: 1 # Its.\r\n", "reference@main:\r\n  n: 3\r\n", "\r\n# End.\r\n"),
    ],
)
def test_a_section_is_found_however_it_is_written(tmp_path: Path, before: str, section: str, after: str) -> None:
    file = tmp_path / "params.yaml"
    file.write_bytes(f"{before}{section}{after}".encode())
    assert write_section(file, "reference@main", {"picks": ["y"]}) == f"{before}{section}{after}"
    assert file.read_bytes().decode() == f"{before}reference@main:\n  n: 3\n  picks:\n  - y\n{after}"
    assert yaml.safe_load(file.read_text()) == {"fuse": {"a": 1}, "reference@main": {"n": 3, "picks": ["y"]}}


def test_a_new_section_goes_before_the_mark_of_the_documents_end(tmp_path: Path) -> None:
    file = written(tmp_path, "---\n# Ours.\nfuse: {a: 1}\n...\n# End.\n")
    write_section(file, "pick", {"n": 3})
    assert file.read_text() == "---\n# Ours.\nfuse: {a: 1}\npick:\n  n: 3\n...\n# End.\n"


@pytest.mark.parametrize(
    "text", ["fuse: {a: 2}\nfuse: {a: 1}\n", "fuse: {a: 2, a: 1}\n", "pick: {}\npick: {}\nfuse: {a: 1}\n"]
)
def test_no_key_stays_in_a_file_twice(tmp_path: Path, text: str) -> None:
    file = written(tmp_path, text)
    write_section(file, "pick", {"n": 3})
    assert (file.read_text().count("fuse"), file.read_text().count("pick"), file.read_text().count("a:")) == (1, 1, 1)
    assert yaml.safe_load(file.read_text()) == {"fuse": {"a": 1}, "pick": {"n": 3}}


@pytest.mark.parametrize("text", ["# Ours.\r\nfuse: {a: 1}\r\n", None])
def test_written_section_is_undone_if_the_body_fails(tmp_path: Path, text: str | None) -> None:
    file = tmp_path / "params.yaml"
    if text is not None:
        file.write_bytes(text.encode())
    during = {}
    with pytest.raises(KeyError, match="nothing"), section_written(file, "pick", {"n": 3}):
        during.update(yaml.safe_load(file.read_text())) or {}["nothing"]
    assert during["pick"] == {"n": 3}
    assert (file.read_bytes().decode() if file.exists() else None) == text


def test_unwritable_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / "no_folder").write_text("")
    with pytest.raises(BadData, match="expected a writable file, got .*no_folder"):
        write_section(tmp_path / "no_folder" / "params.yaml", "pick", {"n": 3})


def test_file_that_is_not_a_configuration_is_not_changed(tmp_path: Path) -> None:
    file = written(tmp_path, "- a\n")
    with pytest.raises(BadData, match="expected a section per stage, got list"):
        write_section(file, "pick", {})
    assert file.read_text() == "- a\n"
