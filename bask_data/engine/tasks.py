"""Tasks: the artifacts that a stage has to make in a dataset, with inputs and parameters."""

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
from bask_data.spelling import choices


@dataclass(frozen=True)
class Binding:
    """One artifact that a task reads."""

    artifact: type[Artifact]
    item: str
    variant: str

    @property
    def place(self) -> str:
        """Path relative to the dataset's directory, with forward slashes."""
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
    """SHA-256 by path of files that parameters name and that may be missing on this machine."""

    @property
    def place(self) -> str:
        """Path of the artifact relative to the dataset's directory, with forward slashes."""
        return artifact_place(self.stage.makes, self.item, self.variant)

    @property
    def target(self) -> Path:
        """Path of the artifact, whether it exists or not."""
        return self.root / self.place

    @property
    def label(self) -> str:
        """The task in words: stage, variant unless it is `main`, item."""
        parts = [self.stage.name, self.variant if self.variant != "main" else "", self.item]
        return " ".join(part for part in parts if part)

    @property
    def bindings(self) -> list[Binding]:
        """All inputs, in order."""
        return [binding for bindings in self.inputs.values() for binding in bindings]

    def input_path(self, binding: Binding) -> Path:
        """Path of an input."""
        return self.root / binding.place

    @property
    def input_paths(self) -> list[Path]:
        """Paths of all inputs, in order."""
        return [self.input_path(binding) for binding in self.bindings]

    def resumable_scratch(self, key: str) -> Path:
        """The scratch directory of a resumable stage, named by the skip key; it survives a kill."""
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
    """The tasks of a stage: one per item, or one for the dataset.

    Args:
        config: parameters by section, which override the recorded ones.
        options: parameters that override both.
        only: names of items; empty means all.
        variant_inputs: variant of each input kind that has variants; by default that of `dataset.json`, or `variant`.
        requested: the parameters recorded with the dataset; by default read from it.

    Raises:
        UsageError: an item, variant, section or parameter is unknown or invalid.
        BadData: the recorded parameters are invalid.
    """
    makes = stage.makes
    items = dataset.items(makes.scope) if makes.scope != "dataset" else [""]
    wanted = set(dataset.select(only, makes.scope) if only and makes.scope != "dataset" else items)
    recorded_inputs = dataset.variants(makes).get(variant, Variant()).inputs
    chosen = {**recorded_inputs, **(variant_inputs or {})}
    # They become names of folders, and an existing target is replaced.
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
            input_.name: tuple(
                Binding(
                    input_.artifact,
                    name,
                    chosen.get(input_.artifact.kind, variant) if input_.artifact.has_variants else "main",
                )
                for name in _items_of(dataset, input_, item, params)
            )
            for input_ in stage.inputs
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
    """The parameters of a stage's tasks: options, configuration, recorded ones, defaults, in order of precedence."""

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
        """The parameters of one item's task. Items without a section of their own share one object."""
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
            fix = f"drop the record: bask-data {self._stage.name} {self._root} --defaults"
            where = f"parameters.{faulty[-1]}.{error.field}"
            raise BadData(self._root / REQUESTED, where, expected=error.expected, got=error.got, fix=fix) from error


def resolve(stage: Stage, config: Config, item: str, variant: str, options: dict[str, Any]) -> Params:
    """The parameters of one task: options, then sections from narrow to wide, then defaults, in order of precedence.

    Raises:
        UsageError: a parameter is unknown or invalid.
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
    """`UsageError` for a section `stage@name` of an unknown name: most likely misspelt, it would have no effect."""
    items = dataset.items(stage.makes.scope) if stage.makes.scope != "dataset" else []
    known = dict.fromkeys([*items, *dataset.variants(stage.makes), variant])
    for section in config:
        name, *names = section.split("@")
        of = "@".join(names)
        if name == stage.name and (len(names) > 2 or any(part not in known for part in names)):
            raise UsageError(section, "", expected=f"{name}@ and one of {choices(known)}", got=of)


def _items_of(dataset: Dataset, input_: Input, item: str, params: Params) -> list[str]:
    read = params.reads(input_.artifact.kind)
    if input_.gather:
        items = dataset.items(input_.artifact.scope)
        if input_.artifact.scope == "recording":
            # No stage makes artifacts of recordings: they come from the source, or do not exist.
            sources, kind = {**dataset.file.scenes, **dataset.file.demonstrations}, input_.artifact
            items = [name for name in items if sources[name].truth or (dataset.path(kind, name) / MANIFEST).exists()]
        chosen = None if read is None else set(read)
        return [name for name in items if chosen is None or name in chosen]
    if read == ():
        return []
    return [""] if input_.artifact.scope == "dataset" else [item]


def named_files(stage: Stage, params: Params) -> dict[str, Path]:
    """Files that parameters name, by parameter: their content is part of the key. They need not exist.

    Such a field is declared with `json_schema_extra={"file": True}`.
    """
    files = {}
    for name, declared in stage.params.model_fields.items():
        value, extra = getattr(params, name), declared.json_schema_extra
        if isinstance(extra, dict) and extra.get("file") and value:
            files[name] = Path(value)
    return files


def parameter_files(task: Task) -> dict[str, Path]:
    """Files that a task reads besides its inputs, by parameter.

    Raises:
        UsageError: a file does not exist.
    """
    files = named_files(task.stage, task.params)
    for name, file in files.items():
        if not file.is_file():
            raise UsageError(task.stage.name, name, expected="a file", got=str(file), fix="check the path.")
    return files
