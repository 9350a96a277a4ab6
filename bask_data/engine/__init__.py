"""The engine: declares stages, plans what they have to make, and makes it. A stage's signature defines everything.

A parameter annotated with a kind is an input: the artifact of the same item if the kind has the stage's scope, the
dataset's only one if the kind belongs to the dataset, and those of all items if it is `list[Kind]`. Depending on the
parameters a stage may not need some of them (`Params.reads`); a single input that can be absent is annotated
`Kind | None`. `params` holds what changes the result, `out` is the empty directory to fill, `Splits` gives the
dataset's splits; `log`, if present, is a directory outside the artifact for what differs between runs. Exactly one
stage makes a kind, so the graph needs no names.
"""

from bask_data.dataset import Splits
from bask_data.engine.declare import Stage, in_order, stage
from bask_data.engine.group import follow, is_follower, processes
from bask_data.engine.making import Outcome, Position, make, predicted, run
from bask_data.engine.params_file import PARAMS, checked_sections, own_parameters, sections_in, sections_of
from bask_data.engine.pipeline import PlannedStage, Standing, planned, run_pipeline, status
from bask_data.engine.publishing import Origin, published, scratches
from bask_data.engine.requested import (
    REQUESTED,
    Requested,
    RunRequest,
    read_requested,
    record_requested,
    under_and_over_record,
)
from bask_data.engine.sections import Config, laid_over, of_stage, sections_for
from bask_data.engine.snapshot import Snapshot
from bask_data.engine.state import Blocked, State, key_parts, state_of, state_or_blocked
from bask_data.engine.tasks import Task, parameter_files, plan, resolve
from bask_data.params import Params
from bask_data.progress import progress

__all__ = [
    "PARAMS",
    "REQUESTED",
    "Blocked",
    "Config",
    "Origin",
    "Outcome",
    "Params",
    "PlannedStage",
    "Position",
    "Requested",
    "RunRequest",
    "Snapshot",
    "Splits",
    "Stage",
    "Standing",
    "State",
    "Task",
    "checked_sections",
    "follow",
    "in_order",
    "is_follower",
    "key_parts",
    "laid_over",
    "make",
    "of_stage",
    "own_parameters",
    "parameter_files",
    "plan",
    "planned",
    "predicted",
    "processes",
    "progress",
    "published",
    "read_requested",
    "record_requested",
    "resolve",
    "run",
    "run_pipeline",
    "scratches",
    "sections_for",
    "sections_in",
    "sections_of",
    "stage",
    "state_of",
    "state_or_blocked",
    "status",
    "under_and_over_record",
]
