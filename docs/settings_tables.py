"""Render the tables of docs/settings.md: what the sources say of each setting, and what our presets set.

    python docs/settings_tables.py            write them
    python docs/settings_tables.py --check    only say whether they are up to date

What the sources say is in settings_sources.yaml; values are those of the presets, as the package resolves them.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from bask_data.config import load_config
from bask_data.core.filters.table import FILTERS, settings_named
from bask_data.engine import resolve
from bask_data.pipeline import STAGES
from bask_data.presets import PRESETS
from bask_data.stages.train import train
from bask_data.stages.train_params import TrainParams

HERE = Path(__file__).resolve().parent
PAGE = HERE / "settings.md"
SOURCES = HERE / "settings_sources.yaml"
OF_TRAINING = ("the paper", "its code", "Dense Object Nets")
OF_FILTERS = ("the paper", "its code")
NOTHING = "-"
"""Of a source without such a setting."""


def main(arguments: Sequence[str]) -> int:
    """Write the page, or with `--check` only compare."""
    old = PAGE.read_text(encoding="utf-8")
    new = rendered(old)
    if new == old:
        print("docs/settings.md: up to date")
        return 0
    if "--check" in arguments:
        print("docs/settings.md: expected the tables of today's presets.  fix: python docs/settings_tables.py")
        return 1
    PAGE.write_text(new, encoding="utf-8")
    print("docs/settings.md: written")
    return 0


def rendered(page: str) -> str:
    """The page with its tables as they would be today."""
    sources = yaml.safe_load(SOURCES.read_text(encoding="utf-8"))
    tables = {"train": training_table(sources["train"])}
    tables |= {name: filter_table(name, sources[name]) for name in FILTERS}
    for name, table in tables.items():
        between = re.compile(rf"(<!-- table: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        page, n = between.subn(lambda found, table=table: f"{found[1]}\n{table}\n{found[2]}", page)
        if n != 1:
            raise ValueError(f"{PAGE.name}: expected one place for the table of {name}, got {n}")
    return page


def training_table(sources: Mapping[str, Sequence[str]]) -> str:
    """Every parameter of `train`, in order."""
    presets = {name: resolve(train, load_config(None, [], STAGES, name), "", "main", {}) for name in PRESETS}
    rows = {
        field: [shown(field, params) for params in presets.values()]  # type: ignore[arg-type]
        for field in TrainParams.model_fields
    }
    return table([*OF_TRAINING, *(f"`{name}`" for name in presets)], sources, len(OF_TRAINING), rows)


def filter_table(name: str, sources: Mapping[str, Sequence[str]]) -> str:
    """Every setting of a filter, in order."""
    presets = {preset: settings_named(name, preset) for preset in ("default", "paper", "code")}  # type: ignore[arg-type]
    rows = {
        field.name: [cell(getattr(settings, field.name)) for settings in presets.values()]
        for field in fields(presets["default"])
    }
    return table([*OF_FILTERS, *(f"`{preset}`" for preset in presets)], sources, len(OF_FILTERS), rows)


def table(
    heads: Sequence[str], sources: Mapping[str, Sequence[str]], n_sources: int, rows: Mapping[str, Sequence[str]]
) -> str:
    """A table in Markdown, with the sources before our values."""
    if unknown := sorted(set(sources) - set(rows)):
        raise ValueError(f"{SOURCES.name}: expected settings that there are, got {', '.join(unknown)}")
    lines = [_row(["setting", *heads]), _row(["---"] * (1 + len(heads)))]
    for field, values in rows.items():
        said = sources.get(field, [NOTHING] * n_sources)
        if len(said) != n_sources:
            raise ValueError(f"{SOURCES.name}: {field}: expected {n_sources} sources, got {len(said)}")
        lines.append(_row([f"`{field}`", *said, *values]))
    return "\n".join(lines) + "\n"


def shown(field: str, params: TrainParams) -> str:
    """A parameter's value, in parentheses if it has no effect beside the others."""
    value = cell(getattr(params, field))
    effective = all(_has_effect(condition, params) for condition in _conditions(field))
    return value if effective else f"({value})"


def _conditions(field: str) -> Iterator[str]:
    """What the description says that the parameter belongs to: `contrastive, normalised: ...`."""
    start, colon, _ = (TrainParams.model_fields[field].description or "").partition(":")
    known = {"contrastive", "infonce", "step", "normalised"}
    if field in ("loss", "crop", "hinge") or not colon:
        yield from {"hinge": ["contrastive"]}.get(field, [])
        return
    yield from (word for word in start.split(", ") if word in known)


def _has_effect(condition: str, params: TrainParams) -> bool:
    if condition == "normalised":
        return params.normalised
    return condition in (params.loss, params.schedule)


def cell(value: Any) -> str:
    """A value as the table shows it."""
    if value is None:
        return "unset"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "unlimited" if math.isinf(value) else f"{value:.3g}"
    if isinstance(value, tuple):
        return ", ".join(map(cell, value))
    return str(value)


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
