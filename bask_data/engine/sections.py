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
    laid = of_stage(below, stage)
    for section in sorted(of_stage(above, stage), key=lambda name: _width(name, variants)):
        for field, value in above[section].items():
            _assign(laid, section, field, value, variants)
    return {section: values for section, values in laid.items() if values}


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
    narrowed: Config = {}
    for section in sorted(of_stage(config, stage), key=lambda name: _width(name, variants)):
        variant, item = _names(section, variants)
        if variant and scope_variants is not None and variant not in scope_variants:
            continue
        if item and scope_items is not None and item not in scope_items:
            continue
        for narrow in _sections(stage, [variant] if variant else scope_variants, [item] if item else scope_items):
            for field, value in config[section].items():
                # In order of width: a value for an item in all variants overrides one for a variant.
                _assign(narrowed, narrow, field, value, variants)
    return {section: values for section, values in narrowed.items() if values}


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


def _assign(laid: Config, section: str, field: str, value: Any, variants: Collection[str]) -> None:
    """Set a field for all artifacts of a section, and for no others."""
    variant, item = _names(section, variants)
    width = _width(section, variants)
    narrower = [
        other
        for other, values in laid.items()
        if field in values
        and _width(other, variants) > width
        and (not item or _names(other, variants)[1] == item)
        and (not variant or _names(other, variants)[0] in ("", variant))
    ]
    of_all_variants = [other for other in narrower if variant and not _names(other, variants)[0]]
    for other in narrower:
        if other not in of_all_variants:
            del laid[other][field]
    for other in of_all_variants:
        # A value for an item in all variants overrides one for this variant, unless it is for both.
        laid.setdefault(f"{section}@{_names(other, variants)[1]}", {})[field] = value
    laid.setdefault(section, {})[field] = value
