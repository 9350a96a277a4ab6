"""Tasks: what a stage has to make in a dataset, with which inputs and which parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from bask_data.artifact import MANIFEST, SCRATCH, Artifact
from bask_data.dataset import Dataset, Splits, Variant, artifact_place, check_name
from bask_data.engine.declare import Input, Stage
from bask_data.engine.requested import REQUESTED, Requested, read_requested, variant_names
from bask_data.engine.sections import Config, laid_over, of_stage, sections_for
from bask_data.errors import BadData, UsageError
from bask_data.params import Params, first_fault


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
    recorded_files: dict[str, str] = field(default_factory=dict)
    """SHA-256 by path, of files that parameters name and this machine may lack."""

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
    requested: Requested | None = None,
) -> list[Task]:
    """The tasks of a stage: one an item, or one for the dataset.

    Args:
        config: parameters by section; they go over what is recorded.
        options: parameters that go over both.
        only: names of items; empty means all.
        variant_inputs: variant of each input kind that has them; else as `dataset.json` says, else `variant`.
        requested: what is recorded of the dataset; read from it by default.

    Raises:
        UsageError: an item, a variant, a section or a parameter is not what it may be.
        BadData: what is recorded is not.
    """
    makes = stage.makes
    items = dataset.items(makes.scope) if makes.scope != "dataset" else [""]
    wanted = set(dataset.select(only, makes.scope) if only and makes.scope != "dataset" else items)
    recorded_inputs = dataset.variants(makes).get(variant, Variant()).inputs
    chosen = {**recorded_inputs, **(variant_inputs or {})}
    # They become names of folders, and what stands in a target's place is replaced.
    for name in (variant, *chosen.values()):
        check_name(name, dataset.root)
    _refuse_unknown_sections(dataset, stage, config or {}, variant)
    requested = read_requested(dataset.root) if requested is None else requested
    parameters = _Parameters(dataset, stage, variant, config or {}, options or {}, requested)
    tasks = []
    for item in items:
        if item not in wanted:
            continue
        params = parameters.of(item)
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
        files = named_files(stage, params).values()
        tasks.append(
            Task(
                root=dataset.root,
                stage=stage,
                item=item,
                variant=variant,
                params=params,
                inputs=inputs,
                splits=dataset.file.splits if stage.wants_splits else Splits(),
                recorded_files={
                    str(file): requested.files[str(file)] for file in files if str(file) in requested.files
                },
            )
        )
    return tasks


class _Parameters:
    """The parameters of a stage's tasks: options over configuration over what is recorded over defaults."""

    def __init__(
        self,
        dataset: Dataset,
        stage: Stage,
        variant: str,
        config: Config,
        options: dict[str, Any],
        requested: Requested,
    ) -> None:
        self._root, self._stage, self._variant = dataset.root, stage, variant
        self._config, self._options = config, options
        self._recorded = of_stage(requested.parameters, stage.name)
        self._laid = laid_over(self._recorded, config, stage.name, variant_names(dataset, stage, variant))
        self._shared: Params | None = None

    def of(self, item: str) -> Params:
        """The parameters of one item's task. Those for which no section is of an item of theirs are one object."""
        own = sections_for(self._stage.name, item, self._variant)[2:]
        if any(section in self._laid for section in own):
            return self._resolved(item)
        if self._shared is None:
            self._shared = self._resolved(item)
        return self._shared

    def _resolved(self, item: str) -> Params:
        try:
            return resolve(self._stage, self._laid, item, self._variant, self._options)
        except UsageError as error:
            name = error.field.split(".")[0]
            sections = sections_for(self._stage.name, item, self._variant)
            asked = {**self._options, **{key: 0 for section in sections for key in self._config.get(section, {})}}
            faulty = [section for section in sections if name in self._recorded.get(section, {})]
            if name in asked or not faulty:
                raise
            fix = f"forget it: bask-data {self._stage.name} {self._root} --defaults"
            where = f"parameters.{faulty[-1]}.{error.field}"
            raise BadData(self._root / REQUESTED, where, expected=error.expected, got=error.got, fix=fix) from error


def resolve(stage: Stage, config: Config, item: str, variant: str, options: dict[str, Any]) -> Params:
    """The parameters of one task: options over sections, a narrow one over a wide one, over defaults.

    Raises:
        UsageError: a parameter is not what it may be.
    """
    values: dict[str, Any] = {}
    for section in sections_for(stage.name, item, variant):
        values.update(config.get(section) or {})
    values.update(options)
    try:
        return stage.params.model_validate(values)
    except ValidationError as error:
        name, expected, came = first_fault(error)
        known = ", ".join(stage.params.model_fields)
        fix = (
            f"see `bask-data {stage.name} --help`."
            if name.split(".")[0] in stage.params.model_fields
            else f"one of {known}."
        )
        raise UsageError(stage.name, name, expected=expected, got=came, fix=fix) from error


def _refuse_unknown_sections(dataset: Dataset, stage: Stage, config: Config, variant: str) -> None:
    """A section `stage@name` for a name that does not exist is most likely misspelt, and would not count."""
    items = dataset.items(stage.makes.scope) if stage.makes.scope != "dataset" else []
    known = dict.fromkeys([*items, *dataset.variants(stage.makes), variant])
    for section in config:
        name, *names = section.split("@")
        of = "@".join(names)
        if name == stage.name and (len(names) > 2 or any(part not in known for part in names)):
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


def named_files(stage: Stage, params: Params) -> dict[str, Path]:
    """Files that parameters name, by parameter: what they hold is part of the key. They need not exist.

    Such a field is declared with `json_schema_extra={"file": True}`.
    """
    found = {}
    for name, declared in stage.params.model_fields.items():
        value, extra = getattr(params, name), declared.json_schema_extra
        if isinstance(extra, dict) and extra.get("file") and value:
            found[name] = Path(value)
    return found


def parameter_files(task: Task) -> dict[str, Path]:
    """Files that a task reads besides its inputs, by parameter.

    Raises:
        UsageError: a file does not exist.
    """
    found = named_files(task.stage, task.params)
    for name, file in found.items():
        if not file.is_file():
            raise UsageError(task.stage.name, name, expected="a file", got=str(file), fix="check the path.")
    return found
