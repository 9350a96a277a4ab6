"""Parameters by section: `stage`, `stage@variant`, `stage@item`, `stage@variant@item`; the narrow one counts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

Config = dict[str, dict[str, Any]]
"""Parameters by section: the name of a stage, or `stage@name` for one item or variant."""


def sections_for(stage: str, item: str, variant: str) -> list[str]:
    """The sections that say something of one artifact, the widest first."""
    return [stage, f"{stage}@{variant}", f"{stage}@{item}", f"{stage}@{variant}@{item}"]


def of_stage(config: Mapping[str, Mapping[str, Any]], stage: str) -> Config:
    """The sections of one stage, copied."""
    return {name: dict(values) for name, values in config.items() if name.partition("@")[0] == stage}


def laid_over(
    below: Mapping[str, Mapping[str, Any]],
    above: Mapping[str, Mapping[str, Any]],
    stage: str,
    variants: Collection[str],
) -> Config:
    """The sections of a stage, such that `above` counts wherever it says something, however wide its section is.

    Merging section by section would not do: what `below` says of one item would go over what `above` says of all.

    Args:
        variants: names that stand for variants in `stage@name`; every other one is an item.
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
    """What sections of a stage say of some of its artifacts, in sections that hold these artifacts alone.

    Args:
        scope_variants: of these artifacts; None for all there are or will be.
        scope_items: of these artifacts; None for all.
        variants: as for `laid_over`.
    """
    found: Config = {}
    for section in sorted(of_stage(config, stage), key=lambda name: _width(name, variants)):
        variant, item = _names(section, variants)
        if variant and scope_variants is not None and variant not in scope_variants:
            continue
        if item and scope_items is not None and item not in scope_items:
            continue
        for narrow in _sections(stage, [variant] if variant else scope_variants, [item] if item else scope_items):
            for field, value in config[section].items():
                # In order of width: what is said of an item in all variants goes over what is said of one variant.
                _assign(found, narrow, field, value, variants)
    return {section: values for section, values in found.items() if values}


def _sections(stage: str, variants: Sequence[str] | None, items: Sequence[str] | None) -> list[str]:
    suffixes = [""] if variants is None else [f"@{variant}" for variant in variants]
    if items is not None:
        suffixes = [f"{suffix}@{item}" for suffix in suffixes for item in items]
    return [stage + suffix for suffix in suffixes]


def _names(section: str, variants: Collection[str]) -> tuple[str, str]:
    """Variant and item that a section is for; empty where it is for all."""
    _, *names = section.split("@")
    if len(names) == 1:
        return (names[0], "") if names[0] in variants else ("", names[0])
    return (names[0], names[1]) if names else ("", "")


def _width(section: str, variants: Collection[str]) -> int:
    """0 for the widest."""
    variant, item = _names(section, variants)
    return bool(variant) + 2 * bool(item)


def _assign(laid: Config, section: str, field: str, value: Any, variants: Collection[str]) -> None:
    """Set a field for all that a section is for, and for nothing else."""
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
        # What is said of an item in all variants goes over what is said of this one, but for what is said of both.
        laid.setdefault(f"{section}@{_names(other, variants)[1]}", {})[field] = value
    laid.setdefault(section, {})[field] = value
