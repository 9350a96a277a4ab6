from __future__ import annotations

import copy
from typing import Any

import pytest

from tests.scripts import REPOSITORY, script

keypoint_sets = script("benchmarks/keypoint_sets.py")


@pytest.fixture
def given() -> dict[str, Any]:
    return copy.deepcopy(keypoint_sets.load())


def found(given: dict[str, Any]) -> list[str]:
    return [*keypoint_sets.findings(given, REPOSITORY)]


def test_no_table_reports_what_it_was_tuned_on_without_saying_so(given: dict[str, Any]) -> None:
    assert found(given) == []


def test_a_table_of_a_task_that_settings_were_chosen_on_is_refused(given: dict[str, Any]) -> None:
    given["sets"]["held-out tasks"]["tasks"].append("lid")
    [first, *_] = [line for line in found(given) if line.startswith("table keypoints:")]
    assert (
        "expected sets that share nothing, got simulated lid and rubbish to choose on, held-out tasks to report"
        in first
    )
    assert "fix: report other data, or say in `tuned` why not." in first


def test_another_seed_of_a_task_is_not_held_out(given: dict[str, Any]) -> None:
    assert keypoint_sets.overlap({"tasks": ["lid"], "seed": 0}, {"tasks": ["mug", "lid"], "seed": 7})
    assert not keypoint_sets.overlap({"tasks": ["lid"], "seed": 0}, {"tasks": ["mug"], "seed": 0})


@pytest.mark.parametrize(
    ("points", "frames", "shares"),
    [
        ("odd", "odd", False),
        ("even", "odd", True),
        ("odd", "even", True),
        ("all", "odd", True),
        ("odd", "all", True),
    ],
)
def test_halves_of_a_recording_are_held_out_in_points_and_frames_alike(points: str, frames: str, shares: bool) -> None:
    fitted = {"recording": "kitchen", "points": "even", "frames": "even"}
    assert keypoint_sets.overlap(fitted, fitted | {"points": points, "frames": frames}) is shares
    assert not keypoint_sets.overlap(fitted, {"recording": "office", "points": points, "frames": frames})
    assert not keypoint_sets.overlap(fitted, {"tasks": ["lid"], "seed": 0})


def test_a_table_that_is_no_longer_tuned_must_not_say_so(given: dict[str, Any]) -> None:
    given["tables"]["keypoints"]["tuned"] = "for some reason"
    assert "table keypoints: expected no `tuned`, as it reports nothing that settings were chosen on, got it" in found(
        given
    )


def test_the_section_of_a_tuned_table_says_so(given: dict[str, Any]) -> None:
    given["tables"]["descriptors"]["section"] = "docs/results.md#masks-and-matches"
    assert [line for line in found(given) if "'tuned on what it reports' in docs/results.md#masks-and-matches" in line]


@pytest.mark.parametrize("place", ["docs/results.md#nowhere", "docs/nowhere.md#descriptors"])
def test_a_table_is_in_a_section_that_exists(given: dict[str, Any], place: str) -> None:
    given["tables"]["descriptors"]["section"] = place
    assert f"table descriptors: expected a section of a page, got {place}" in found(given)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda given: given["sets"].update(x={"tasks": ["lid"]}), "set x: expected tasks, seed or recording"),
        (
            lambda given: given["sets"]["kitchen, to fit"].update(points="some"),
            "set kitchen, to fit: points: expected one of even, odd, all, got some",
        ),
        (lambda given: given["tables"].update(x={"script": "filters.py"}), "table x: expected script, section, chosen"),
        (lambda given: given["tables"]["filters"].update(reports=["x"]), "table filters: expected a set of simulated"),
    ],
)
def test_what_the_check_cannot_read_is_reported(given: dict[str, Any], change: Any, message: str) -> None:
    change(given)
    assert [line for line in found(given) if line.startswith(message)]


def test_a_benchmark_of_a_table_that_nothing_names_is_refused(given: dict[str, Any]) -> None:
    del given["tables"]["filters"]
    assert [line for line in found(given) if line.startswith("filters.py: expected one of the tables keypoints, ")]


def test_a_table_is_read_by_its_script(given: dict[str, Any]) -> None:
    given["tables"]["filters"]["script"] = "keypoints.py"
    assert "table filters: expected keypoints.py to read its sets, got none of its name there" in found(given)
    given["tables"]["filters"]["script"] = "nothing.py"
    assert "table filters: expected a script, got nothing.py" in found(given)


def test_benchmarks_read_the_sets_of_their_table_alone() -> None:
    assert keypoint_sets.simulated("keypoints").tasks == ("drawer", "mug")
    assert keypoint_sets.static("amazon_box").table == "static scenes, further"
    assert keypoint_sets.static("sevenscenes_redkitchen").table == "static scene, kitchen"
    assert keypoint_sets.static("a holiday") is None
    with pytest.raises(LookupError, match=r"expected one of keypoints, .*, got x\.  fix: add the table"):
        keypoint_sets.simulated("x")


def test_the_tables_that_a_script_reads_are_those_it_names() -> None:
    assert keypoint_sets.tables_read('simulated("a"); static(name); f(static)') == {"a", None}


def test_the_command_prints_what_it_finds(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert keypoint_sets.main() == 0
    assert "nothing found" in capsys.readouterr().out
    monkeypatch.setattr(keypoint_sets, "findings", lambda *_: ["table x: wrong"])
    assert keypoint_sets.main() == 1
    assert capsys.readouterr().out == "table x: wrong\n"
