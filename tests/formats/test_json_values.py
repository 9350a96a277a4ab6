from __future__ import annotations

import math

import pytest

from bask_data.errors import BadData
from bask_data.formats.json_values import array, number, parse_json


@pytest.mark.parametrize("text", ["[" * 100_000, "[1, 2]", "{", '{"a": ' + "9" * 5000 + "}", "\xff", ""])
def test_damaged_and_hostile_json_is_refused(text: str) -> None:
    with pytest.raises(BadData, match=r"a\.json: content: expected"):
        parse_json("a.json", text.encode("latin-1"))


def test_numbers_are_finite_and_no_booleans() -> None:
    table = parse_json("a.json", b'{"a": 3, "b": true, "c": NaN, "d": "4", "e": ' + b"9" * 400 + b"}")
    assert number("a.json", table, "a") == 3.0
    assert number("a.json", table, "missing", 2.0) == 2.0
    for key in ("b", "c", "d", "e"):
        with pytest.raises(BadData, match=f"a.json: {key}: expected a number"):
            number("a.json", table, key)
    with pytest.raises(BadData, match="missing: expected a number, got nothing"):
        number("a.json", table, "missing")


@pytest.mark.parametrize("wrong", ["text", {"a": 1}, 3, None])
def test_what_is_no_list_is_no_array_of_any_length(wrong: object) -> None:
    with pytest.raises(BadData, match=r"a\.json: x: expected n numbers"):
        array("a.json", "x", wrong, ((-1,),))


def test_arrays_have_one_of_the_shapes() -> None:
    value = [[1, 2, 3], [4, 5, math.nan]]
    assert array("a.json", "x", value, ((2, 3),)).shape == (2, 3)
    assert array("a.json", "x", value, ((4, 4), (-1, 3))).shape == (2, 3)
    for wrong in ([[1, 2], [3]], "text", None, [[["1"]]], [10**400]):
        with pytest.raises(BadData, match="a.json: x: expected n x 3 or 2 numbers, got"):
            array("a.json", "x", wrong, ((-1, 3), (2,)))
