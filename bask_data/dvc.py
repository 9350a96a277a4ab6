"""DVC: `dvc.yaml` and `params.yaml`, rendered from the declared stages and the dataset's items.

DVC has no wildcards, so every item has its own DVC stage. It does not see Python code, so a stage's version is part of
its command. Splits are tracked as a parameter, and `dataset.json` is not a dependency: adding a scene must not make
the other scenes stale.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bask_data.artifact import MANIFEST, write_text_atomically
from bask_data.dataset import DATASET, Dataset, Source
from bask_data.engine import (
    Config,
    Stage,
    Task,
    laid_over,
    of_stage,
    own_parameters,
    parameter_files,
    plan,
    read_requested,
    resolve,
    sections_for,
    under_and_over_record,
)
from bask_data.errors import UsageError
from bask_data.kinds import KINDS, Demonstration, Scan

_HEADER = "# Written by `bask-data dvc`; change params.yaml or dataset.json, then run it again.\n"
_PARAMS_HEADER = "# Parameters of every stage. A section `stage@name` holds what differs for one item or variant.\n"


@dataclass(frozen=True)
class DvcFiles:
    """The files for DVC, as rendered.

    Args:
        root: the dataset's directory.
        texts: content by file name.
        changed: names of the files that are missing on disk or differ.
    """

    root: Path
    texts: dict[str, str]
    changed: tuple[str, ...]

    def refuse_changed(self) -> None:
        """`UsageError` if a file on disk is missing or differs."""
        if self.changed:
            fix = f"bask-data dvc {self.root}"
            names = ", ".join(self.changed)
            raise UsageError(self.root, names, expected="what the code renders", got="something else", fix=fix)


def compared_files(dataset: Dataset, stages: Sequence[Stage], config: Config) -> DvcFiles:
    """The rendered files, compared with those on disk. Nothing is written."""
    texts = render(dataset, stages, config)
    changed = tuple(name for name, text in texts.items() if not _holds(dataset.root / name, text))
    return DvcFiles(dataset.root, texts, changed)


def written_files(dataset: Dataset, stages: Sequence[Stage], config: Config) -> DvcFiles:
    """The rendered files, after writing those that differ and creating the groups above artifacts, for Git."""
    stages = _listed(dataset, stages, config)
    files = compared_files(dataset, stages, config)
    for name in files.changed:
        write_text_atomically(dataset.root / name, files.texts[name])
    for stage in stages:
        for variant in dataset.variants(stage.makes):
            dataset.prepare(stage.makes, variant)
    return files


def _holds(file: Path, text: str) -> bool:
    return file.exists() and file.read_text(encoding="utf-8") == text


def render(dataset: Dataset, stages: Iterable[Stage], config: Config) -> dict[str, str]:
    """Content by file name of dvc.yaml, params.yaml and .gitignore in the dataset's directory."""
    import yaml

    stages = _listed(dataset, list(stages), config)
    config = _with_kept(dataset, stages, config)
    described: dict[str, Any] = {}
    for scope, kind in (("scene", Scan), ("demonstration", Demonstration)):
        sources = dataset.file.scenes if scope == "scene" else dataset.file.demonstrations
        for item, source in sources.items():
            described[f"ingest-{item}"] = _ingest(kind.kind, item, source)
    for stage in stages:
        for variant in dataset.variants(stage.makes):
            for task in plan(dataset, stage, config=config, variant=variant):
                described["-".join(task.label.split())] = _stage(dataset, task, config)
    text = yaml.safe_dump({"stages": described}, sort_keys=False, width=120, allow_unicode=True)
    return {
        "dvc.yaml": _HEADER + text,
        "params.yaml": params_text(stages, config),
        ".gitignore": _gitignore(dataset.root / ".gitignore"),
    }


def _listed(dataset: Dataset, stages: Sequence[Stage], config: Config) -> list[Stage]:
    """The stages without those made on request only, unless an artifact or a section of parameters shows a request."""
    kept = _with_kept(dataset, stages, config) if any(stage.on_request for stage in stages) else {}
    return [
        stage
        for stage in stages
        if not stage.on_request
        or of_stage(kept, stage.name)
        or any((dataset.root / stage.makes.kind).glob(f"**/{MANIFEST}"))
    ]


def _with_kept(dataset: Dataset, stages: Sequence[Stage], config: Config) -> Config:
    """The configuration over what the dataset keeps: the newer of its params.yaml and its recorded parameters."""
    requested = read_requested(dataset.root)
    older, newer = under_and_over_record(own_parameters(dataset.root, stages), requested)
    merged: Config = {}
    for stage in stages:
        variants = list(dataset.variants(stage.makes)) if stage.makes.has_variants else []
        sections = of_stage(older, stage.name)
        for above in (requested.parameters, newer, config):
            sections = laid_over(sections, above, stage.name, variants)
        merged |= sections
    return merged


def _gitignore(file: Path) -> str:
    """The existing lines, and the artifacts, which DVC tracks. Git tracks the groups above them, so a clone opens."""
    lines = file.read_text().splitlines() if file.exists() else []
    wanted = ["/.scratch/", "/provenance/", "/runs/", "/report.html"]
    for kind in KINDS:
        below = "/*" if kind.has_variants and kind.scope != "dataset" else ""
        wanted.append(f"/{kind.kind}{below}/*/")
    return "\n".join([*lines, *(line for line in wanted if line not in lines)]) + "\n"


def params_text(stages: Iterable[Stage], config: Config) -> str:
    """YAML with every parameter of every stage, its value and, as a comment, its description."""
    lines = [_PARAMS_HEADER]
    for stage in stages:
        values = resolve(stage, {stage.name: config.get(stage.name, {})}, "", "main", {}).model_dump(mode="json")
        lines.append(f"{stage.name}:")
        for name, value in values.items():
            description = (stage.params.model_fields[name].description or "").replace("\n", " ")
            lines += [f"  # {description}"] if description else []
            lines.append(f"  {name}: {_yaml_value(value)}")
        lines += [] if values else ["  {}"]
        for section in sorted(section for section in config if section.startswith(f"{stage.name}@")):
            lines.append(f"{section}:")
            lines += [f"  {name}: {_yaml_value(value)}" for name, value in config[section].items()]
        lines.append("")
    return "\n".join(lines)


def _yaml_value(value: Any) -> str:
    """A value on one line: JSON, except for floats such as 1e-05, which YAML 1.1 reads as text without a point."""
    text = json.dumps(value, ensure_ascii=False)
    if isinstance(value, float) and "e" in text and "." not in text:
        mantissa, exponent = text.split("e")
        return f"{mantissa}.0e{exponent}"
    return text


def _ingest(kind: str, item: str, source: Source) -> dict[str, Any]:
    options = [_option(name, value) for name, value in source.options.items()]
    outs = [f"{kind}/{item}", *([f"truth/{item}"] if source.truth else [])]
    if source.path:
        words = f"bask-data ingest {source.format} {_shell(source.path)} . --scene {item} --as {kind} --force"
    else:
        words = f"bask-data ingest {source.format} . --only {item} --force"
    return {
        "desc": f"Read {source.path}" if source.path else f"Make {item}",
        "cmd": " ".join([words, *options]),
        **({"deps": [source.path]} if source.path else {}),
        "outs": [{out: {"persist": True}} for out in outs],
    }


def _option(name: str, value: Any) -> str:
    """An option with its value, for the command line."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{flag}" if value else f"--no-{flag}"
    return f"--{flag} {_shell(','.join(map(str, value)) if isinstance(value, list) else value)}"


def _stage(dataset: Dataset, task: Task, config: Config) -> dict[str, Any]:
    stage = task.stage
    words = [f"bask-data {stage.name} .", "--config params.yaml", f"--stage-version {stage.version}"]
    if task.item:
        words.insert(1, f"--only {task.item}")
    if task.variant != "main":
        words.append(f"--variant {task.variant}")
        chosen = dataset.variants(stage.makes)[task.variant].inputs
        words += [f"--{kind} {variant}" for kind, variant in chosen.items()]
    sections = [stage.name] if stage.params.model_fields else []
    sections += [name for name in sections_for(stage.name, task.item, task.variant)[1:] if config.get(name)]
    params: list[Any] = list(sections)
    if stage.wants_splits:
        params.append({DATASET: ["splits"]})
    described: dict[str, Any] = {
        "desc": stage.help.splitlines()[0],
        "cmd": " ".join(words),
        "deps": [path.relative_to(dataset.root).as_posix() for path in task.input_paths]
        + [os.path.relpath(path, dataset.root) for path in parameter_files(task).values()],
    }
    if params:
        described["params"] = params
    described["outs"] = [{task.target.relative_to(dataset.root).as_posix(): {"persist": True}}]
    return described


def _shell(value: Any) -> str:
    import shlex

    return shlex.quote(str(value))
