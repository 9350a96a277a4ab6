"""Parameters by section: `stage`, `stage@variant`, `stage@item`, `stage@variant@item`; the narrowest counts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

Config = dict[str, dict[str, Any]]
"""Parameters by section: the name of a stage, or `stage@name` for one item or variant."""


def sections_for(stage: str, item: str, variant: str) -> list[str]:
    """The sections that apply to one artifact, the widest first."""
    return [stage, f"{stage}@{variant}", f"{stage}@{item}", f"{stage}@{variant}@{item}"]


def of_stage(config: Mapping[str, Mapping[str, Any]], stage: str) -> Config:
    """A copy of the sections of one stage."""
    return {name: dict(values) for name, values in config.items() if name.partition("@")[0] == stage}


def laid_over(
    below: Mapping[str, Mapping[str, Any]],
    above: Mapping[str, Mapping[str, Any]],
    stage: str,
    variants: Collection[str],
) -> Config:
    """The sections of a stage with `above` over `below`: `above` takes precedence however wide its section is.

    Merging section by section would be wrong: a value of `below` for one item would override that of `above` for all.

    Args:
        variants: names that denote variants in `stage@name`; every other name is an item.
    """
    laid = _Layers(of_stage(below, stage), variants)
    for section in sorted(of_stage(above, stage), key=lambda name: _width(name, variants)):
        for field, value in above[section].items():
            laid.assign(section, field, value)
    return laid.filled()


def within(
    config: Mapping[str, Mapping[str, Any]],
    stage: str,
    scope_variants: Sequence[str] | None,
    scope_items: Sequence[str] | None,
    variants: Collection[str],
) -> Config:
    """The parameters of some artifacts of a stage, in sections that apply to these artifacts only.

    Args:
        scope_variants: variants of these artifacts; None for all, including later ones.
        scope_items: items of these artifacts; None for all.
        variants: as for `laid_over`.
    """
    narrowed = _Layers({}, variants)
    chosen = None if scope_items is None else set(scope_items)
    for section in sorted(of_stage(config, stage), key=lambda name: _width(name, variants)):
        variant, item = _names(section, variants)
        if variant and scope_variants is not None and variant not in scope_variants:
            continue
        if item and chosen is not None and item not in chosen:
            continue
        for narrow in _sections(stage, [variant] if variant else scope_variants, [item] if item else scope_items):
            for field, value in config[section].items():
                # In order of width: a value for an item in all variants overrides one for a variant.
                narrowed.assign(narrow, field, value)
    return narrowed.filled()


def _sections(stage: str, variants: Sequence[str] | None, items: Sequence[str] | None) -> list[str]:
    suffixes = [""] if variants is None else [f"@{variant}" for variant in variants]
    if items is not None:
        suffixes = [f"{suffix}@{item}" for suffix in suffixes for item in items]
    return [stage + suffix for suffix in suffixes]


def _names(section: str, variants: Collection[str]) -> tuple[str, str]:
    """Variant and item of a section; empty if it applies to all."""
    _, *names = section.split("@")
    if len(names) == 1:
        return (names[0], "") if names[0] in variants else ("", names[0])
    return (names[0], names[1]) if names else ("", "")


def _width(section: str, variants: Collection[str]) -> int:
    """Rank of a section, from 0 for the widest to 3 for the narrowest."""
    variant, item = _names(section, variants)
    return bool(variant) + 2 * bool(item)


class _Layers:
    """Sections of a stage, to which further parameters are assigned.

    Indexed by item: there may be a section for each of thousands of items, and most assignments concern one of them.
    """

    def __init__(self, sections: Config, variants: Collection[str]) -> None:
        self._sections, self._variants = sections, variants
        self._of_item: dict[str, set[str]] = {}
        for section in sections:
            self._index(section)

    def filled(self) -> Config:
        """The sections that set a parameter."""
        return {section: values for section, values in self._sections.items() if values}

    def assign(self, section: str, field: str, value: Any) -> None:
        """Set a field for all artifacts of a section, and for no others."""
        variant, item = _names(section, self._variants)
        of_all_variants = []
        for other in self._narrower(section, variant, item):
            of_variant, of_item = _names(other, self._variants)
            if field not in self._sections[other]:
                continue
            if variant and not of_variant:
                of_all_variants.append(of_item)
            else:
                del self._sections[other][field]
        for of_item in of_all_variants:
            # A value for an item in all variants overrides one for this variant, unless it is for both.
            self._set(f"{section}@{of_item}", field, value)
        self._set(section, field, value)

    def _narrower(self, section: str, variant: str, item: str) -> list[str]:
        width = _width(section, self._variants)
        return [
            other
            for other in (self._of_item.get(item, ()) if item else self._sections)
            if _width(other, self._variants) > width
            and (not variant or _names(other, self._variants)[0] in ("", variant))
        ]

    def _set(self, section: str, field: str, value: Any) -> None:
        if section not in self._sections:
            self._sections[section] = {}
            self._index(section)
        self._sections[section][field] = value

    def _index(self, section: str) -> None:
        _, item = _names(section, self._variants)
        if item:
            self._of_item.setdefault(item, set()).add(section)
