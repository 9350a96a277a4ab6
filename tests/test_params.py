from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import pytest
from pydantic import Field, JsonValue, ValidationError

from bask_data.formats import FORMATS
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.options.tum import TumOptions
from bask_data.params import PATTERNS, Params, first_fault
from bask_data.pipeline import STAGES
from bask_data.sim.options import SimOptions


class Inner(Params):
    steps: int = 1


class Example(Params):
    steps: int = Field(1, ge=1)
    rate: float = Field(1.0, gt=0)
    flag: bool = False
    name: str = ""
    loss: Literal["infonce", "contrastive"] = "infonce"
    zoom: tuple[float, float] = (1.0, 2.0)
    decay: float | None = None
    height: int = Field(8, multiple_of=8)
    picks: tuple[str, ...] = ()
    counts: dict[str, int] = {}
    inner: Inner = Inner()


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"steps": "many"}, ("steps", "a whole number", "'many'")),
        ({"steps": 1.5}, ("steps", "a whole number", "1.5")),
        ({"steps": 0}, ("steps", "greater than or equal to 1", "0")),
        ({"rate": "abc"}, ("rate", "a number", "'abc'")),
        ({"rate": [1]}, ("rate", "a number", "[1]")),
        ({"rate": float("nan")}, ("rate", "a finite number", "NaN")),
        ({"flag": "maybe"}, ("flag", "true or false", "'maybe'")),
        ({"name": 3}, ("name", "text", "3")),
        ({"loss": "infoncee"}, ("loss", "one of infonce, contrastive", "'infoncee'")),
        ({"zoom": [1]}, ("zoom", "2 values", "1: [1]")),
        ({"zoom": []}, ("zoom", "2 values", "0: []")),
        ({"zoom": ["1"]}, ("zoom", "2 values", "1: '1'")),
        ({"zoom": ["1", "2", "3"]}, ("zoom", "at most 2 values", "'1,2,3'")),
        ({"zoom": [1, 2, 3]}, ("zoom", "at most 2 values", "[1, 2, 3]")),
        ({"zoom": 3}, ("zoom", "a list", "3")),
        ({"decay": "x"}, ("decay", "a number", "'x'")),
        ({"height": 9}, ("height", "a multiple of 8", "9")),
        ({"picks": "a"}, ("picks", "a list", "'a'")),
        ({"counts": 3}, ("counts", "values by name", "3")),
        ({"inner": 3}, ("inner", "values by name", "3")),
        ({"stepz": 3}, ("stepz", "no field of that name", "3")),
    ],
)
def test_errors_are_reported_in_plain_words(values: dict[str, Any], fault: tuple[str, str, str]) -> None:
    with pytest.raises(ValidationError) as caught:
        Example.model_validate(values)
    assert first_fault(caught.value) == fault


def test_long_value_is_truncated() -> None:
    with pytest.raises(ValidationError) as caught:
        Example.model_validate({"rate": "x" * 1000})
    assert first_fault(caught.value)[2] == f"'{'x' * 80}'"


def test_the_path_to_a_deeply_nested_value_is_cut() -> None:
    class Nested(Params):
        value: dict[str, JsonValue]

    nested: object = object()
    for _ in range(60):
        nested = [nested]
    with pytest.raises(ValidationError) as caught:
        Nested.model_validate({"value": {"x": nested}})
    field, _, _ = first_fault(caught.value)
    assert field.startswith("value.x.list.0.") and field.endswith("...") and len(field) < 100


def _patterns(model: type[Params]) -> Iterator[str]:
    for field in model.model_fields.values():
        yield from (found.pattern for found in field.metadata if getattr(found, "pattern", None))


@pytest.mark.parametrize("model", [*(format.options for format in FORMATS), SimOptions, *(s.params for s in STAGES)])
def test_every_pattern_of_an_option_has_plain_words(model: type[Params]) -> None:
    assert set(_patterns(model)) <= set(PATTERNS)


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ({"intrinsics_size": "640"}, "WIDTHxHEIGHT in pixels, for instance 640x480"),
        ({"invalid_depth": "a"}, "whole numbers separated by commas, for instance 65535"),
        ({"camera": "left cam"}, "letters, digits, '_' and '-', beginning with a letter or digit"),
    ],
)
def test_text_of_the_wrong_form_is_reported_without_its_pattern(option: dict[str, str], expected: str) -> None:
    with pytest.raises(ValidationError) as caught:
        (TumOptions if "camera" in option else FramesOptions).model_validate(option)
    assert first_fault(caught.value)[1] == expected
