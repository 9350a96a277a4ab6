from __future__ import annotations

from pathlib import Path

import pytest

from bask_data.errors import UsageError
from bask_data.formats.choices import by_camera, chosen_episode

NAMES = [f"demo_{i}" for i in range(12)]


def test_an_episode_is_chosen_by_name_or_number_and_needs_no_choice_alone() -> None:
    assert chosen_episode(Path("d"), NAMES, "demo_10") == "demo_10"
    assert chosen_episode(Path("d"), NAMES, "1") == "demo_1"
    assert chosen_episode(Path("d"), ["7"], "") == "7"


@pytest.mark.parametrize("wanted", ["", "12", "demo", "demo_12"])
def test_an_episode_that_is_not_there_or_not_named_is_refused_with_some_names(wanted: str) -> None:
    with pytest.raises(UsageError, match="--episode: expected one of demo_0, demo_1, .* and 7 more") as error:
        chosen_episode(Path("d"), NAMES[::-1], wanted)
    assert error.value.fix == "pass --episode demo_0, or --episode all."


def test_a_number_that_two_names_end_with_is_refused() -> None:
    with pytest.raises(UsageError, match="--episode"):
        chosen_episode(Path("d"), ["a_1", "b_1"], "1")


def test_a_source_without_episodes_is_refused() -> None:
    with pytest.raises(UsageError, match="expected an episode in the source, got none"):
        chosen_episode(Path("d"), [], "")


def test_values_are_given_to_one_camera_to_named_ones_or_to_all() -> None:
    assert by_camera("--intrinsics", "", ["a", "b"]) == {}
    assert by_camera("--intrinsics", "1,2,3,4", ["a"]) == {"a": "1,2,3,4"}
    assert by_camera("--intrinsics", "a=1,2,3,4; b=5,6,7,8", ["a", "b"]) == {"a": "1,2,3,4", "b": "5,6,7,8"}
    assert by_camera("--intrinsics", "{camera}/K.txt", ["a", "b"]) == {"a": "a/K.txt", "b": "b/K.txt"}


def test_one_value_for_several_cameras_and_unknown_cameras_are_refused() -> None:
    with pytest.raises(UsageError, match="expected NAME=VALUE;NAME=VALUE for a, b, got 1,2,3,4") as error:
        by_camera("--intrinsics", "1,2,3,4", ["a", "b"])
    assert "--intrinsics 'a=1,2,3,4;b=...'" in error.value.fix
    with pytest.raises(UsageError, match="a name among a, b, got c=1,2,3,4"):
        by_camera("--intrinsics", "a=1,2,3,4;c=1,2,3,4", ["a", "b"])
