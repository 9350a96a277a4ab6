"""Parameters from a YAML file and `--set`, with names checked before anything runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bask_data.artifact import write_text_atomically
from bask_data.engine import Config, Stage, checked_sections, sections_in, sections_of
from bask_data.errors import BadData, UsageError
from bask_data.presets import PresetName, preset


def load_config(
    file: Path | None, assignments: Sequence[str], stages: Iterable[Stage], preset_name: PresetName | None = None
) -> Config:
    """Parameters by section, `stage` or `stage@name`; a preset overrides the file, `--set stage.field=value` both.

    Raises:
        BadData: the file is not a YAML mapping of mappings.
        UsageError: no stage has a section or a field.
    """
    if file is not None and not file.exists():
        raise UsageError("--config", "", expected="a YAML file", got=f"no such file '{file}'", fix="check the path.")
    # The file's names are checked before `--set` adds others, so that each is blamed for its own.
    config = checked_sections(sections_of(file), stages, str(file)) if file else {}
    for section, values in preset(preset_name, stages).items() if preset_name else ():
        config.setdefault(section, {}).update(values)
        # Values of the file for single variants or items would otherwise override the preset.
        for other in (config[name] for name in config if name.startswith(f"{section}@")):
            for field in values:
                other.pop(field, None)
    for assignment in assignments:
        target, equals, text = assignment.partition("=")
        section, dot, field = target.strip().rpartition(".")
        if not equals or not dot:
            fix = "for instance --set reconstruct.voxel_size=0.003"
            raise UsageError("--set", "", expected="stage.field=value", got=assignment, fix=fix)
        config.setdefault(section, {})[field] = _value(text)
    return checked_sections(config, stages, "--set")


def _value(text: str) -> Any:
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        fix = "close its brackets and quotes, for instance --set objects.names=[mug,box]"
        raise UsageError("--set", "", expected="a YAML value", got=f"'{text}'", fix=fix) from error


@contextmanager
def section_written(file: Path, section: str, values: dict[str, Any]) -> Iterator[None]:
    """`write_section`, undone to the byte if the body fails."""
    before = write_section(file, section, values)
    try:
        yield
    except BaseException:
        if before is None:
            file.unlink(missing_ok=True)
        else:
            write_text_atomically(file, before)
        raise


def write_section(file: Path, section: str, values: dict[str, Any]) -> str | None:
    """Set parameters in one section of a YAML file, which need not exist; the rest is kept, including comments.

    Returns:
        the former text of the file; None if there was none.

    Raises:
        BadData: the file is not a YAML mapping of mappings, or cannot be written.
    """
    import yaml

    config = sections_of(file) if file.exists() else {}
    wanted = {**config, section: {**config.get(section, {}), **values}}
    before = file.read_bytes().decode() if file.exists() else None
    text = _with_section(before or "", section, wanted[section])
    if not _says(text, wanted, file):
        # Its layout does not allow replacing lines: flow style on a single line, for instance.
        text = yaml.safe_dump(wanted, sort_keys=False, allow_unicode=True)
    try:
        write_text_atomically(file, text)
    except OSError as error:
        raise BadData(file, "", expected="a writable file", got=str(error)) from error
    return before


def _with_section(text: str, section: str, values: dict[str, Any]) -> str:
    """The text with the lines of one top-level section replaced, or added at the document's end."""
    import yaml

    written = yaml.safe_dump({section: values}, sort_keys=False, allow_unicode=True, width=1000)
    lines = text.splitlines(keepends=True)
    root = yaml.compose(text, yaml.SafeLoader)
    if not isinstance(root, yaml.MappingNode):
        begin = end = len(lines)
    else:
        # First line of each section; the last section ends with the document, where an end mark may follow.
        begins = [key.start_mark.line for key, _ in root.value]
        begins.append(root.end_mark.line + (root.end_mark.column > 0))
        i = next((i for i, (key, _) in enumerate(root.value) if key.value == section), len(root.value))
        begin, end = begins[i], begins[min(i + 1, len(root.value))]
    # Empty lines and comments before the next section belong to that section.
    while end > begin + 1 and (lines[end - 1].startswith("#") or not lines[end - 1].strip()):
        end -= 1
    if begin and not lines[begin - 1].endswith("\n"):
        lines[begin - 1] += "\n"
    return "".join([*lines[:begin], written, *lines[end:]])


def _says(text: str, wanted: Config, file: Path) -> bool:
    """Whether a text is YAML with exactly these sections and no duplicate key."""
    import yaml

    try:
        root = yaml.compose(text, yaml.SafeLoader)
        return not _has_key_twice(root) and sections_in(yaml.safe_load(text), file) == wanted
    except (yaml.YAMLError, BadData):
        return False


def _has_key_twice(root: Any) -> bool:
    """Whether any mapping has a duplicate key; loading silently takes the last one."""
    import yaml

    pending, seen = [root], set()
    while pending:
        node = pending.pop()
        if id(node) in seen:  # Reached through an alias.
            continue
        seen.add(id(node))
        if isinstance(node, yaml.MappingNode):
            keys = [(key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
            if len(set(keys)) < len(keys):
                return True
            pending += [value for _, value in node.value]
        elif isinstance(node, yaml.SequenceNode):
            pending += node.value
    return False
