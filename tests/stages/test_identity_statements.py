from __future__ import annotations

import pytest

from bask_data.errors import UsageError
from bask_data.stages.identity_statements import IdentifyParams, Statements

OBJECTS = {"a/1": "tin", "a/2": "", "b/1": "tin", "b/2": "can", "c/1": "can"}


def stated(**options: tuple[str, ...]) -> Statements:
    return Statements(OBJECTS, IdentifyParams(**options))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"names": ("a/9=tin",)}, r"names: expected SCENE/ID=NAME with .*a/1.*, got a/9=tin"),
        ({"names": ("a/1",)}, r"names: expected SCENE/ID=NAME.*got a/1"),
        ({"same": ("a/1=b",)}, r"same: expected SCENE/ID=SCENE/ID with .*, got a/1=b"),
        ({"same": ("a/1=a/1",)}, r"same: expected two objects, got a/1=a/1"),
        (
            {"same": ("a/1=b/1", "b/1=c/1"), "different": ("c/1=a/1",)},
            r"different: expected objects not stated to be the same, got c/1 and a/1 in --same as well",
        ),
    ],
)
def test_statements_that_cannot_be_followed_are_refused(options, words) -> None:
    with pytest.raises(UsageError, match=words):
        stated(**options)


def test_a_name_that_is_given_precedes_the_most_frequent_of_the_scans() -> None:
    assert stated().name_of(["a/2"]) == ""
    assert stated().name_of(["a/1", "a/2", "b/1", "c/1"]) == "tin"
    assert stated().name_of(["a/1", "c/1"]) == "can"  # As many of either: the first in the alphabet.
    assert stated(names=("a/2=soup tin",)).name_of(["a/1", "a/2", "b/1"]) == "soup tin"
    with pytest.raises(UsageError, match=r"names: expected one name for an object, got tin and pot"):
        stated(names=("a/1=tin", "b/1=pot")).name_of(["a/1", "b/1"])


def test_pairs_are_indices_of_the_objects_that_were_seen() -> None:
    both = stated(same=("a/1=b/1", "a/2=b/2"), different=("c/1=a/1",))
    assert both.pairs(["c/1", "a/1", "b/1", "b/2"]) == ([(1, 2)], [(0, 1)])
