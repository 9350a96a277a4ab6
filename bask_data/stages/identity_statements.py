"""What the user states of the objects of several scans: names, and which are the same or not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pydantic import Field

from bask_data.engine import Params
from bask_data.errors import UsageError
from bask_data.spelling import choices

Pair = tuple[str, str]
"""Two objects, each SCENE/ID."""


class IdentifyParams(Params):
    """What is known of the objects, and how sure a match must be."""

    names: tuple[str, ...] = Field(
        (),
        description="Names of objects, each SCENE/ID=NAME with any scan that shows it. Default: those of `objects`.",
    )
    same: tuple[str, ...] = Field((), description="Objects known to be the same, each SCENE/ID=SCENE/ID.")
    different: tuple[str, ...] = Field((), description="Objects known to differ, each SCENE/ID=SCENE/ID.")
    confidence: float = Field(
        0.9,
        gt=0.5,
        lt=1,
        description="Least probability of a match, and of one candidate against another; others are unknown.",
    )


class Statements:
    """The statements in the parameters, checked against the objects there are.

    Args:
        names: of all objects by place, SCENE/ID, as `objects` was told; may be empty.

    Raises:
        UsageError: a statement names no object, or contradicts another.
    """

    def __init__(self, names: Mapping[str, str], params: IdentifyParams) -> None:
        self._of_objects = dict(names)
        self.same = [self._pair("same", text) for text in params.same]
        self.different = [self._pair("different", text) for text in params.different]
        self._given = dict(self._named(text) for text in params.names)
        for a, b in self.different:
            if b in self._connected(a):
                got, expected = f"{a} and {b} in --same as well", "objects not stated to be the same"
                raise UsageError("identify", "different", expected=expected, got=got)

    def pairs(self, places: Sequence[str]) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Those that are the same and those that are not, as indices; without objects that are not in the list."""
        index = {place: i for i, place in enumerate(places)}
        same, different = (
            [(index[a], index[b]) for a, b in stated if a in index and b in index]
            for stated in (self.same, self.different)
        )
        return same, different

    def name_of(self, members: Sequence[str]) -> str:
        """The name of an object by its members: as given, else the most frequent of `objects`; may be empty.

        Raises:
            UsageError: members were given different names.
        """
        given = list(dict.fromkeys(self._given[place] for place in members if place in self._given))
        if len(given) > 1:
            got, fix = " and ".join(given), "give one of them, or separate them with --different."
            raise UsageError("identify", "names", expected="one name for an object", got=got, fix=fix)
        names = [self._of_objects[place] for place in members if self._of_objects[place]]
        return given[0] if given else max(sorted(set(names)), key=names.count, default="")

    def _named(self, text: str) -> Pair:
        place, _, name = text.partition("=")
        return self._known("names", place if name.strip() else "", text, "SCENE/ID=NAME"), name.strip()

    def _pair(self, field: str, text: str) -> Pair:
        a, _, b = text.partition("=")
        first, second = (self._known(field, place, text, "SCENE/ID=SCENE/ID") for place in (a, b))
        if first == second:
            raise UsageError("identify", field, expected="two objects", got=text)
        return first, second

    def _known(self, field: str, place: str, text: str, form: str) -> str:
        place = place.strip()
        if place not in self._of_objects:
            expected = f"{form} with {choices(self._of_objects) or 'an object, but there is none'}"
            raise UsageError("identify", field, expected=expected, got=text)
        return place

    def _connected(self, place: str) -> set[str]:
        """What is stated to be the same as an object, directly or through others."""
        reached = {place}
        while grown := {other for pair in self.same if reached & set(pair) for other in pair} - reached:
            reached |= grown
        return reached
