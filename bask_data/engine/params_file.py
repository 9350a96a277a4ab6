"""Files of parameters by section: the dataset's own `params.yaml`, or another one."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bask_data.engine.declare import Stage
from bask_data.engine.sections import Config
from bask_data.errors import BadData, UsageError
from bask_data.spelling import suggestion

PARAMS = "params.yaml"


def own_parameters(root: Path, stages: Iterable[Stage]) -> Config:
    """The parameters in the dataset's own `params.yaml`, which need not exist.

    Raises:
        BadData: the file is not a YAML mapping of mappings.
        UsageError: no stage has a section or a field.
    """
    file = root / PARAMS
    return checked_sections(sections_of(file), stages, str(file)) if file.exists() else {}


def sections_of(file: Path) -> Config:
    """The sections of a YAML file, not checked against the stages.

    Raises:
        UsageError: the file does not exist.
        BadData: it is not a YAML mapping of mappings.
    """
    import yaml

    try:
        document = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
    except FileNotFoundError:
        raise UsageError(file, "", expected="a YAML file", got="nothing") from None
    except (yaml.YAMLError, OSError, ValueError, RecursionError) as error:
        raise BadData(file, "", expected="YAML", got=str(error).replace("\n", " ")) from error
    return sections_in(document, file)


def sections_in(document: Any, file: Path) -> Config:
    """The sections of a parsed document; `BadData` if it is not a mapping of mappings."""
    if not isinstance(document, dict):
        raise BadData(file, "", expected="a section per stage", got=type(document).__name__)
    for section, values in document.items():
        if not isinstance(values, dict | None):
            raise BadData(file, str(section), expected="parameters by name", got=str(values)[:60])
    return {str(section): dict(values or {}) for section, values in document.items()}


def checked_sections(config: Config, stages: Iterable[Stage], where: str) -> Config:
    """The same sections; `UsageError` if no stage has one of them, or one of their fields.

    Args:
        where: what states them, for the error.
    """
    by_name = {stage.name: stage for stage in stages}
    for section, values in config.items():
        stage = by_name.get(section.split("@")[0])
        if stage is None:
            fix = suggestion(section.split("@")[0], by_name)
            raise UsageError(where, section, expected=f"one of {', '.join(by_name)}", got=section, fix=fix)
        unknown = [field for field in values if field not in stage.params.model_fields]
        if unknown:
            known, got = stage.params.model_fields, str(unknown[0])
            fix = suggestion(got, known) or f"`bask-data {stage.name} --help` lists them."
            raise UsageError(where, f"{section}.{got}", expected=f"one of {', '.join(known)}", got=got, fix=fix)
    return config
