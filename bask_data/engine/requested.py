"""Parameters that a dataset's artifacts were requested with, stored in its `requested.json`.

Parameters given by `--config`, `--set` or an option are not part of the code. Without this file, everyone else who
opens the dataset would compare its artifacts with the defaults, and find them stale. docs/decisions/0006.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from filelock import FileLock
from pydantic import BaseModel, ConfigDict, JsonValue, StringConstraints, ValidationError
from pydantic_core import to_jsonable_python

from bask_data.artifact import SCRATCH, canonical_json, file_digest, read_json, write_json_atomically
from bask_data.dataset import Dataset
from bask_data.engine.declare import Stage
from bask_data.engine.sections import Config, laid_over, of_stage, within
from bask_data.errors import BadData
from bask_data.params import first_fault
from bask_data.progress import note

REQUESTED = "requested.json"
_RESTORE = "restore the file, or delete it and give the parameters again."

_SECTION = re.compile(r"[a-z_]+(@[A-Za-z0-9][A-Za-z0-9_-]{0,63}){0,2}")
_Digest = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]


class Requested(BaseModel):
    """The content of `requested.json`.

    Args:
        parameters: by section, as in `params.yaml`; also `stage@variant@item` for one item in one variant.
        overridden: by section, what `params.yaml` said of recorded parameters when they were recorded. What it says
            otherwise is newer, and takes precedence over the record.
        files: SHA-256 by path of every file that a parameter names, so that a machine without the file can determine
            what is up to date.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    bask_requested: Literal[1] = 1
    parameters: dict[str, dict[str, JsonValue]] = {}
    overridden: dict[str, dict[str, JsonValue]] = {}
    files: dict[str, _Digest] = {}


@dataclass(frozen=True)
class RunRequest:
    """A request to make artifacts, with its parameters.

    Precedence: `options`, `given`, the newer of the dataset's params.yaml and its record, the defaults.

    Args:
        stages: names of stages; empty for all.
        only: names of scenes or demonstrations; empty for all.
        variant: to make; None for all that the dataset lists.
        variant_inputs: variant of each input kind that has variants.
        options: parameters of the only stage.
        given: parameters by section, from `--config FILE`, `--preset` and `--set`; recorded, like options.
        replaces: ignore and replace the recorded parameters of the stages: `--config FILE` or `--defaults`.
        ignores_own_file: `given` has the parameters of `--config FILE`, which is used instead of params.yaml.
    """

    stages: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    variant: str | None = None
    variant_inputs: dict[str, str] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    given: Config = field(default_factory=dict)
    replaces: bool = False
    ignores_own_file: bool = False


def read_requested(root: Path) -> Requested:
    """The requested parameters of the dataset at `root`; empty if there is no such file.

    Sections of unknown stages are kept: another version may have written them.

    Raises:
        BadData: the file is too large, not JSON, or has invalid content.
    """
    file = root / REQUESTED
    if not file.exists():
        return Requested()
    document = read_json(file)
    try:
        canonical_json(document)  # Refuses NaN and infinity, which are not JSON but which Python reads.
        requested = Requested.model_validate(document)
    except ValidationError as error:
        name, expected, came = first_fault(error)
        raise BadData(file, name, expected=expected, got=came, fix=_RESTORE) from error
    except ValueError as error:
        raise BadData(file, "", expected="finite numbers", got=str(error), fix=_RESTORE) from error
    for section in [*requested.parameters, *requested.overridden]:
        if not _SECTION.fullmatch(section):
            expected = "stage, stage@name or stage@variant@item"
            raise BadData(file, "parameters", expected=expected, got=section[:80], fix=_RESTORE)
    return requested


def under_and_over_record(own: Config, requested: Requested) -> tuple[Config, Config]:
    """The parameters in `params.yaml` that are older than the record, and those that are newer.

    The newer statement takes precedence: options that override a value in `params.yaml`, or a later edit of that value.

    Args:
        own: parameters by section, from the dataset's own params.yaml.
    """
    older: Config = {}
    newer: Config = {}
    for section, values in own.items():
        was = requested.overridden.get(section, {})
        for name, value in values.items():
            side = older if name in was and was[name] == _as_json(value) else newer
            side.setdefault(section, {})[name] = value
    return older, newer


def record_requested(
    dataset: Dataset,
    stage: Stage,
    request: RunRequest,
    own: Config,
    *,
    items: Sequence[str] = (),
    files: Iterable[Path] = (),
) -> None:
    """Record the requested parameters of a stage; those of other stages, items and variants are kept.

    Args:
        own: parameters by section, from the dataset's own params.yaml.
        items: items of the request; empty for all, including later ones.
        files: files that parameters name.
    """
    own_of_stage = of_stage(own, stage.name)
    digests = {str(file): file_digest(file) for file in set(files) if file.is_file()}

    def changed(current: Requested) -> Requested:
        recorded = _recorded(current, own_of_stage, dataset, stage, request, items or None)
        parameters = _replaced(current.parameters, stage, recorded)
        named = {*digests, *_texts(parameters), *_texts(own)}
        return Requested(
            parameters=parameters,
            overridden=_replaced(current.overridden, stage, _restricted(own_of_stage, _fields(recorded))),
            files={file: digest for file, digest in {**current.files, **digests}.items() if file in named},
        )

    current = read_requested(dataset.root)
    if changed(current) == current:
        return
    try:
        (dataset.root / SCRATCH).mkdir(exist_ok=True)
        with FileLock(dataset.root / SCRATCH / "requested.lock"):
            # Another process may have changed the file in the meantime.
            document = changed(read_requested(dataset.root)).model_dump(mode="json")
            write_json_atomically(dataset.root / REQUESTED, document)
    except OSError as error:
        # The artifact is valid all the same, and a user without write access knows the parameters.
        note(f"{stage.name}: {REQUESTED} cannot be written, so the dataset does not keep these parameters: {error}")


def _replaced(config: Config, stage: Stage, sections: Config) -> Config:
    """The configuration with other sections of one stage, in JSON."""
    others = {section: values for section, values in config.items() if section.partition("@")[0] != stage.name}
    return dict(sorted({**others, **_as_json(sections)}.items()))


def _as_json(value: Any) -> Any:
    return to_jsonable_python(value, fallback=str, inf_nan_mode="strings")


def _texts(config: Config) -> set[str]:
    """All parameters that are text, as paths; some name files."""
    values = [value for section in config.values() for value in section.values()]
    return {str(Path(value)) for value in values if isinstance(value, str)}


def _fields(config: Config) -> set[str]:
    return {field for values in config.values() for field in values}


def _restricted(config: Config, fields: Collection[str]) -> Config:
    """The sections with some fields only."""
    kept = {section: {f: value for f, value in values.items() if f in fields} for section, values in config.items()}
    return {section: values for section, values in kept.items() if values}


def _recorded(
    current: Requested, own: Config, dataset: Dataset, stage: Stage, request: RunRequest, items: Sequence[str] | None
) -> Config:
    """The recorded sections of a stage after a request."""
    makes, variant = stage.makes, request.variant
    names = variant_names(dataset, stage, variant)
    scope = None if variant is None or not makes.has_variants else [variant]

    def over(below: Config, above: Config) -> Config:
        return laid_over(below, within(above, stage.name, scope, items, names), stage.name, names)

    recorded = of_stage(current.parameters, stage.name)
    # A newer value in params.yaml becomes part of the record, which changes no parameter. It would otherwise count as
    # older from here on, and the value that it overrode would return.
    _, newer = under_and_over_record(own, current)
    recorded = laid_over(recorded, _restricted(newer, _fields(recorded)), stage.name, names)
    if request.replaces:
        is_whole = scope is None and items is None
        # A record for other variants and items is kept, so those of the request need values to override it, and
        # likewise to override a params.yaml that was not used.
        overruled = set() if is_whole else _fields(recorded)
        overruled |= _fields(own) if request.ignores_own_file else set()
        defaults = laid_over({stage.name: _defaults(stage, overruled)}, {}, stage.name, names)
        used = {} if request.ignores_own_file else _restricted(own, overruled)
        recorded = over({} if is_whole else recorded, laid_over(defaults, used, stage.name, names))
    recorded = over(recorded, request.given)
    return over(recorded, {stage.name: request.options})


def _defaults(stage: Stage, names: Collection[str]) -> dict[str, Any]:
    fields = stage.params.model_fields
    return {
        name: fields[name].get_default(call_default_factory=True)
        for name in sorted(names)
        if name in fields and not fields[name].is_required()
    }


def variant_names(dataset: Dataset, stage: Stage, variant: str | None = None) -> list[str]:
    """Names that denote variants in sections of a stage: the listed ones, and `variant`, which may be new."""
    if not stage.makes.has_variants:
        return []
    return list(dict.fromkeys([*dataset.variants(stage.makes), *([variant] if variant else [])]))
