"""Tasks: what a stage has to make in a dataset, with which inputs and which parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from bask_data.artifact import MANIFEST, SCRATCH, Artifact
from bask_data.dataset import Dataset, Splits, Variant, artifact_place, check_name
from bask_data.engine.declare import Input, Stage
from bask_data.errors import UsageError
from bask_data.params import Params, first_fault

Config = dict[str, dict[str, Any]]
"""Parameters by section: the name of a stage, or `stage@name` for one item or variant."""


@dataclass(frozen=True)
class Binding:
    """One artifact that a task reads."""

    artifact: type[Artifact]
    item: str
    variant: str

    @property
    def place(self) -> str:
        """Where it lies below the dataset's directory, with forward slashes."""
        return artifact_place(self.artifact, self.item, self.variant)


@dataclass(frozen=True)
class Task:
    """One artifact to make: a stage, an item, a variant and resolved parameters. Picklable and idempotent."""

    root: Path
    stage: Stage
    item: str
    variant: str
    params: Params
    inputs: dict[str, tuple[Binding, ...]]
    splits: Splits

    @property
    def place(self) -> str:
        """Where the artifact lies below the dataset's directory, with forward slashes."""
        return artifact_place(self.stage.makes, self.item, self.variant)

    @property
    def target(self) -> Path:
        """Where the artifact lies or will lie."""
        return self.root / self.place

    @property
    def label(self) -> str:
        """The task in words: stage, variant unless it is `main`, item."""
        parts = [self.stage.name, self.variant if self.variant != "main" else "", self.item]
        return " ".join(part for part in parts if part)

    @property
    def bindings(self) -> list[Binding]:
        """All that it reads, in order."""
        return [binding for bindings in self.inputs.values() for binding in bindings]

    def input_path(self, binding: Binding) -> Path:
        """Where an input lies."""
        return self.root / binding.place

    @property
    def input_paths(self) -> list[Path]:
        """Where all of them lie, in order."""
        return [self.input_path(binding) for binding in self.bindings]

    def resumable_scratch(self, key: str) -> Path:
        """The scratch directory of a resumable stage, named by the skip key: what a kill leaves in place."""
        return self.root / SCRATCH / f"resume~{self.stage.makes.kind}~{self.variant}~{self.item}~{key[:32]}"


def plan(
    dataset: Dataset,
    stage: Stage,
    *,
    config: Config | None = None,
    options: dict[str, Any] | None = None,
    only: Sequence[str] = (),
    variant: str = "main",
    variant_inputs: dict[str, str] | None = None,
) -> list[Task]:
    """The tasks of a stage: one an item, or one for the dataset.

    Args:
        only: names of items; empty means all.
        variant_inputs: variant of each input kind that has them; else as `dataset.json` says, else `variant`.
    """
    makes = stage.makes
    items = dataset.items(makes.scope) if makes.scope != "dataset" else [""]
    there = set(items)
    unknown = [name for name in only if name not in there]
    if unknown and makes.scope != "dataset":
        raise UsageError(
            dataset.root, "--only", expected=f"one of {', '.join(items) or 'no items yet'}", got=", ".join(unknown)
        )
    recorded = dataset.variants(makes).get(variant, Variant()).inputs
    chosen = {**recorded, **(variant_inputs or {})}
    # They become names of folders, and what stands in a target's place is replaced.
    for name in (variant, *chosen.values()):
        check_name(name, dataset.root)
    _refuse_unknown_sections(dataset, stage, config or {}, variant)
    wanted = set(only) if only and makes.scope != "dataset" else there
    tasks = []
    for item in items:
        if item not in wanted:
            continue
        params = resolve(stage, config or {}, item, variant, options or {})
        inputs = {
            given.name: tuple(
                Binding(
                    given.artifact,
                    name,
                    chosen.get(given.artifact.kind, variant) if given.artifact.has_variants else "main",
                )
                for name in _items_of(dataset, given, item, params)
            )
            for given in stage.inputs
        }
        tasks.append(
            Task(
                root=dataset.root,
                stage=stage,
                item=item,
                variant=variant,
                params=params,
                inputs=inputs,
                splits=dataset.file.splits if stage.wants_splits else Splits(),
            )
        )
    return tasks


def resolve(stage: Stage, config: Config, item: str, variant: str, options: dict[str, Any]) -> Params:
    """The parameters of one task: options over `stage@item` over `stage@variant` over `stage` over defaults."""
    values: dict[str, Any] = {}
    sections = [stage.name, f"{stage.name}@{variant}", f"{stage.name}@{item}"]
    for section in sections:
        values.update(config.get(section) or {})
    values.update(options)
    try:
        return stage.params.model_validate(values)
    except ValidationError as error:
        field, expected, came = first_fault(error)
        known = ", ".join(stage.params.model_fields)
        fix = (
            f"see `bask-data {stage.name} --help`."
            if field.split(".")[0] in stage.params.model_fields
            else f"one of {known}."
        )
        raise UsageError(stage.name, field, expected=expected, got=came, fix=fix) from error


def _refuse_unknown_sections(dataset: Dataset, stage: Stage, config: Config, variant: str) -> None:
    """A section `stage@name` for a name that does not exist is most likely misspelt, and would not count."""
    items = dataset.items(stage.makes.scope) if stage.makes.scope != "dataset" else []
    known = dict.fromkeys([*items, *dataset.variants(stage.makes), variant])
    for section in config:
        name, _, of = section.partition("@")
        if name == stage.name and of and of not in known:
            raise UsageError(section, "", expected=f"{name}@ and one of {', '.join(known)}", got=of)


def _items_of(dataset: Dataset, given: Input, item: str, params: Params) -> list[str]:
    read = params.reads(given.artifact.kind)
    if given.gather:
        items = dataset.items(given.artifact.scope)
        if given.artifact.scope == "recording":
            # No stage makes what belongs to recordings: their source brings it, or there is none.
            sources, kind = {**dataset.file.scenes, **dataset.file.demonstrations}, given.artifact
            items = [name for name in items if sources[name].truth or (dataset.path(kind, name) / MANIFEST).exists()]
        chosen = None if read is None else set(read)
        return [name for name in items if chosen is None or name in chosen]
    if read == ():
        return []
    return [""] if given.artifact.scope == "dataset" else [item]


def parameter_files(task: Task) -> dict[str, Path]:
    """Files that parameters name, by parameter: what they hold is part of the key.

    Such a field is declared with `json_schema_extra={"file": True}`.

    Raises:
        UsageError: a file does not exist.
    """
    found = {}
    for name, field in task.stage.params.model_fields.items():
        value = getattr(task.params, name)
        if isinstance(field.json_schema_extra, dict) and field.json_schema_extra.get("file") and value:
            found[name] = Path(value)
            if not found[name].is_file():
                raise UsageError(task.stage.name, name, expected="a file", got=str(value), fix="check the path.")
    return found
