"""One call of a stage's command, as its options describe it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bask_data.cli.options import given_options, names_of
from bask_data.cli.working import quoted, request_of
from bask_data.dataset import Dataset, Variant, check_name
from bask_data.engine import RunRequest, Stage, Task, is_follower, planned
from bask_data.errors import UsageError
from bask_data.pipeline import STAGES


@dataclass(frozen=True)
class StageCall:
    """A stage, the dataset it runs on, and the request."""

    dataset: Dataset
    stage: Stage
    request: RunRequest

    def tasks(self, more: dict[str, Any] | None = None) -> list[Task]:
        """The tasks of the request; `more` are parameters that override those given."""
        request = replace(self.request, options={**self.request.options, **(more or {})})
        return [task for part in planned(self.dataset, STAGES, request) for task in part.tasks]

    @property
    def following(self) -> str:
        """The command to run next: the first stage that reads this one's artifacts, with the same variants."""
        root, makes, request = quoted(self.dataset.root), self.stage.makes, self.request
        required = [stage for stage in STAGES if not stage.on_request]
        later = [other for other in required if makes in [input_.artifact for input_ in other.inputs]]
        if not later:
            return f"bask-data report {root}"
        own = {input_.artifact.kind for input_ in self.stage.inputs if input_.artifact.has_variants}
        shared = [input_.artifact.kind for input_ in later[0].inputs if input_.artifact.kind in own]
        variant = request.variant or "main"
        # Without the option, the variant keeps the inputs that it was made from.
        inputs = {**self.dataset.variants(makes).get(variant, Variant()).inputs, **request.variant_inputs}
        variants = {makes.kind: variant, **{kind: inputs.get(kind, variant) for kind in shared}}
        words = [f"--{kind} {name}" for kind, name in variants.items() if name != "main"]
        return " ".join([f"bask-data {later[0].name} {root}", *words])


def call_of(stage: Stage, root: Path, options: dict[str, Any]) -> StageCall:
    """The call with these options; `UsageError` if they ask for another version of the stage."""
    version = options["stage_version"]
    if version not in (0, stage.version):
        fix = f"bask-data dvc {root}"
        raise UsageError(stage.name, "--stage-version", expected=str(stage.version), got=version, fix=fix)
    dataset = Dataset(root)
    if not is_follower():
        dataset.recover()
    prefix = "variant_of_"
    for name in ("variant", *(name for name in options if name.startswith(prefix))):
        if options.get(name):
            check_name(options[name], stage.name, f"--{name.removeprefix(prefix)}")
    request = request_of(
        root,
        options["config"],
        options["set_"],
        preset=options.get("preset"),
        defaults=options["defaults"],
        stages=(stage.name,),
        only=tuple(names_of(options.get("only", ""))),
        variant=options.get("variant"),
        variant_inputs={
            name.removeprefix(prefix): value for name, value in options.items() if name.startswith(prefix) and value
        },
        options=given_options(stage.params, options),
    )
    return StageCall(dataset, stage, request)
