from __future__ import annotations

import pytest

from bask_data.spelling import choices, number_of, suggestion

NAMES = ["voxel_size", "workspace", "min_views", "near", "far"]


@pytest.mark.parametrize("name", ["voxelsize", "voxel-size", "VOXEL_SIZE", "voxel_sizes"])
def test_the_nearest_name_is_suggested(name: str) -> None:
    assert suggestion(name, NAMES) == "did you mean voxel_size?"


def test_nothing_is_suggested_where_nothing_is_near() -> None:
    assert suggestion("colour", NAMES) == ""
    assert suggestion("colour", []) == ""


def test_of_many_choices_the_first_are_listed_and_the_others_counted() -> None:
    assert choices("abc") == "a, b, c"
    assert choices(f"scene{i}" for i in range(2000)).endswith("scene18, scene19 and 1,980 more")
    assert choices([]) == ""


def test_a_noun_is_plural_unless_there_is_one() -> None:
    assert [number_of(n, "camera") for n in (0, 1, 2)] == ["0 cameras", "1 camera", "2 cameras"]
