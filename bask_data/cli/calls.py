"""What one call of a stage's command asks for, read off its options."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bask_data.cli.options import given_options, names_of
from bask_data.cli.working import parameters_of, quoted
from bask_data.dataset import Dataset
from bask_data.engine import Config, Stage, Task, is_follower, plan
from bask_data.errors import UsageError
from bask_data.pipeline import STAGES


@dataclass(frozen=True)
class StageCall:
    """What one call of a stage's command asks for.

    Args:
        options: parameters given as options.
        inputs: variants of inputs, by kind.
    """

    dataset: Dataset
    stage: Stage
    config: Config
    options: dict[str, Any]
    only: list[str]
    variant: str
    inputs: dict[str, str]

    def tasks(self, more: dict[str, Any] | None = None) -> list[Task]:
        """What is to be made, with further parameters over those given."""
        return plan(
            self.dataset,
            self.stage,
            config=self.config,
            options={**self.options, **(more or {})},
            only=self.only,
            variant=self.variant,
            variant_inputs=self.inputs,
        )

    @property
    def following(self) -> str:
        """The command that goes on with what the stage makes, in the same variants."""
        root, makes = quoted(self.dataset.root), self.stage.makes
        later = [other for other in STAGES if makes in [given.artifact for given in other.inputs]]
        if not later:
            return f"bask-data report {root}"
        own = {given.artifact.kind for given in self.stage.inputs if given.artifact.has_variants}
        shared = [given.artifact.kind for given in later[0].inputs if given.artifact.kind in own]
        variants = {makes.kind: self.variant, **{kind: self.inputs.get(kind, self.variant) for kind in shared}}
        words = [f"--{kind} {name}" for kind, name in variants.items() if name != "main"]
        return " ".join([f"bask-data {later[0].name} {root}", *words])


def call_of(stage: Stage, root: Path, options: dict[str, Any]) -> StageCall:
    """The call that these options make; `UsageError` if another version of the stage is asked for."""
    version = options["stage_version"]
    if version not in (0, stage.version):
        fix = f"bask-data dvc {root}"
        raise UsageError(stage.name, "--stage-version", expected=str(stage.version), got=version, fix=fix)
    dataset = Dataset(root)
    if not is_follower():
        dataset.recover()
    prefix = "variant_of_"
    return StageCall(
        dataset=dataset,
        stage=stage,
        config=parameters_of(root, options["config"], options["set_"], options.get("preset")),
        options=given_options(stage.params, options),
        only=names_of(options.get("only", "")),
        variant=options.get("variant", "main"),
        inputs={
            name.removeprefix(prefix): value for name, value in options.items() if name.startswith(prefix) and value
        },
    )
