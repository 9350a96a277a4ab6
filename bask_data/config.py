"""Parameters from a YAML file and from `--set`, checked for names before anything runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from bask_data.artifact import write_text_atomically
from bask_data.errors import BadData, UsageError
from bask_data.presets import PresetName, preset
from bask_data.stage import Config, Stage


def load_config(
    file: Path | None, assignments: Sequence[str], stages: Iterable[Stage], preset_name: PresetName | None = None
) -> Config:
    """Sections `stage` or `stage@name` with parameters; a preset goes over the file, `--set stage.field=value` over
    both.

    Raises:
        BadData: the file is no YAML mapping of mappings.
        UsageError: a section or a field that no stage has.
    """
    config = _from_file(file) if file else {}
    for section, values in preset(preset_name, stages).items() if preset_name else ():
        config.setdefault(section, {}).update(values)
        # What the file says of one variant would go over what it says of all, and so over the preset.
        for other in (config[name] for name in config if name.startswith(f"{section}@")):
            for field in values:
                other.pop(field, None)
    for assignment in assignments:
        target, equals, text = assignment.partition("=")
        section, dot, field = target.strip().rpartition(".")
        if not equals or not dot:
            raise UsageError("--set", "", expected="stage.field=value", got=assignment)
        config.setdefault(section, {})[field] = _value(text)
    by_name = {stage.name: stage for stage in stages}
    where = str(file) if file else "--set"
    for section, values in config.items():
        stage = by_name.get(section.split("@")[0])
        if stage is None:
            raise UsageError(where, section, expected=f"one of {', '.join(by_name)}", got=section)
        unknown = [field for field in values if field not in stage.params.model_fields]
        if unknown:
            known = ", ".join(stage.params.model_fields)
            raise UsageError(where, f"{section}.{unknown[0]}", expected=f"one of {known}", got=str(unknown[0]))
    return config


def _from_file(file: Path) -> Config:
    import yaml

    try:
        document = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
    except FileNotFoundError:
        raise UsageError(file, "", expected="a YAML file", got="nothing") from None
    except (yaml.YAMLError, OSError, ValueError, RecursionError) as error:
        raise BadData(file, "", expected="YAML", got=str(error).replace("\n", " ")) from error
    return _sections(document, file)


def _sections(document: Any, file: Path) -> Config:
    if not isinstance(document, dict):
        raise BadData(file, "", expected="sections named like stages", got=type(document).__name__)
    for section, values in document.items():
        if not isinstance(values, dict | None):
            raise BadData(file, str(section), expected="parameters by name", got=str(values)[:60])
    return {str(section): dict(values or {}) for section, values in document.items()}


def _value(text: str) -> Any:
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise UsageError("--set", "", expected="a YAML value", got=text) from error


def write_section(file: Path, section: str, values: dict[str, Any]) -> None:
    """Set parameters of one section of a YAML file, which need not exist; the rest stays as it is, comments included.

    Raises:
        BadData: the file is no YAML mapping of mappings.
    """
    import yaml

    config = _from_file(file) if file.exists() else {}
    wanted = {**config, section: {**config.get(section, {}), **values}}
    text = _with_section(file.read_text(encoding="utf-8") if file.exists() else "", section, wanted[section])
    try:
        is_right = _sections(yaml.safe_load(text), file) == wanted
    except (yaml.YAMLError, BadData):
        is_right = False
    if not is_right:
        # It is written in a way whose lines cannot be exchanged: all of it in one, for instance.
        text = yaml.safe_dump(wanted, sort_keys=False, allow_unicode=True)
    write_text_atomically(file, text)


def _with_section(text: str, section: str, values: dict[str, Any]) -> str:
    """The text with the lines of one top-level section replaced, or added at its end."""
    import yaml

    written = yaml.safe_dump({section: values}, sort_keys=False, allow_unicode=True, width=1000)
    lines = text.splitlines(keepends=True)
    begin = next((i for i, line in enumerate(lines) if line.startswith((f"{section}:", f'"{section}":'))), None)
    if begin is None:
        return text + ("" if text.endswith("\n") or not text else "\n") + written
    end = begin + 1
    while end < len(lines) and (lines[end].startswith((" ", "-")) or not lines[end].strip()):
        end += 1
    # The empty lines before the next section belong to what comes after.
    while not lines[end - 1].strip():
        end -= 1
    return "".join([*lines[:begin], written, *lines[end:]])
