"""Picking reference keypoints in a browser; the `reference` stage makes the artifact from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from bask_data.artifact import SCRATCH
from bask_data.config import section_written
from bask_data.dataset import Dataset, Variant
from bask_data.engine import Outcome, Task, make
from bask_data.errors import BadData, BaskError, UsageError
from bask_data.kinds import Demonstration, DescriptorNet, Pick, Recording, ReferenceKeypoints, Scan, VisibleMasks
from bask_data.kinds.reference import ambiguous
from bask_data.picker.desk import Desk
from bask_data.picker.draft import Draft, KeypointMark
from bask_data.picker.gallery import Gallery
from bask_data.picker.server import serve
from bask_data.stages.automatic_keypoints import Wanted, chosen
from bask_data.stages.reference import ReferenceParams, as_text, parsed

__all__ = ["Picking", "pick_keypoints"]


@dataclass
class Picking:
    """The variant of the reference keypoints that is picked, and where its parameters are written.

    Args:
        planned: returns the stage's task with the given parameters replaced.
        parameters: YAML file that records the picks for `status` and `run`.
        inputs: variants of the inputs, as recorded in `dataset.json`.
        following: the command to run next.
        outcomes: result of the last save; empty if nothing was saved.
    """

    dataset: Dataset
    planned: Callable[[dict[str, Any]], Task]
    parameters: Path
    following: str
    inputs: dict[str, str] = field(default_factory=dict)
    outcomes: list[Outcome] = field(default_factory=list)


def pick_keypoints(
    picking: Picking, *, say: Callable[[str], None], opened: Callable[[str], None], port: int = 0
) -> list[Outcome]:
    """Serve the page until it is closed, or interrupted after a save.

    Args:
        say: receives notes for the user.
        opened: receives the page's URL.

    Returns:
        outcome of the last save; empty if nothing was saved.

    Raises:
        KeyboardInterrupt: interrupted before anything was saved.
        UsageError: another page is open for this variant, or the dataset has no recordings.
        BadData: the descriptor network is missing, or the draft is damaged.
    """
    task = picking.planned({})
    file = picking.dataset.root / SCRATCH / f"picks~{task.variant}.json"
    file.parent.mkdir(exist_ok=True)
    try:
        with FileLock(file.with_suffix(".lock"), timeout=0):
            desk = _desk(picking, task, file, say)
            try:
                _serve(desk, port, say, opened)
            except KeyboardInterrupt:
                if not picking.outcomes:
                    raise
    except Timeout:
        fix = "use the page that is open, or stop its command."
        raise UsageError(
            "--pick", task.variant, expected="no other page for this variant", got="one that is open", fix=fix
        ) from None
    return picking.outcomes


def _desk(picking: Picking, task: Task, file: Path, say: Callable[[str], None]) -> Desk:
    dataset = picking.dataset
    recordings = _recordings(dataset)
    network = _network_of(task)
    assert isinstance(task.params, ReferenceParams)
    params = task.params

    def propose(scene: str, n: int) -> list[KeypointMark]:
        wanted = Wanted(n, () if scene != params.scene else params.instances, params.seed)
        masks = dataset.path(VisibleMasks, scene)
        if scene not in dataset.items("scene") or not masks.exists():
            expected, fix = "a scan with masks of its objects", "choose another, or run `bask-data run` first."
            raise UsageError("propose", "scene", expected=expected, got=scene, fix=fix)
        picks, _ = chosen(wanted, scene, Scan(dataset.path(Scan, scene)), VisibleMasks(masks), network)
        return [KeypointMark(**pick.model_dump(include=set(KeypointMark.model_fields))) for pick in picks]

    def save(marks: Sequence[KeypointMark]) -> tuple[str, str]:
        picking.outcomes[:] = [_saved(picking, [as_text(Pick(**mark.model_dump())) for mark in marks])]
        unsure = ambiguous(ReferenceKeypoints(task.target).picks)
        note = f" (ambiguous: {', '.join(unsure)})" if unsure else ""
        return f"{len(marks)} keypoints saved as {task.target.relative_to(dataset.root)}{note}", picking.following

    gallery = Gallery(recordings, network)
    draft = Draft(file, _given(params, recordings))
    if not draft.is_new:
        say(f"restored {len(draft.marks)} unsaved keypoints")
    elif params.auto:
        draft.add(propose(params.scene or _first_scene(dataset), params.n))
    title = " · ".join(part for part in (dataset.file.name, "" if task.variant == "main" else task.variant) if part)
    return Desk(gallery, draft, propose=propose, save=save, title=title)


def _serve(desk: Desk, port: int, say: Callable[[str], None], opened: Callable[[str], None]) -> None:
    """Serve the page, then wait for a save that the server left in a thread: only its end tells what was saved."""
    try:
        serve(desk, port, opened=opened)
    finally:
        desk.jobs.cancel()
        while job := desk.jobs.state():
            try:
                say(f"waiting for the end of {job['name']}")
                desk.jobs.wait()
            except KeyboardInterrupt:
                continue  # The thread cannot be stopped, and writes on.


def _recordings(dataset: Dataset) -> dict[str, Recording]:
    """Existing scans and demonstrations, by name; `UsageError` if there are none."""
    recordings: dict[str, Recording] = {}
    for kind, scope in ((Scan, "scene"), (Demonstration, "demonstration")):
        for name in dataset.items(scope):
            if dataset.path(kind, name).exists():
                recordings[name] = kind(dataset.path(kind, name))
                recordings[name].check_complete()
    if not recordings:
        fix = "bask-data ingest --help"
        raise UsageError(dataset.root, "", expected="a recording", got="none in the dataset", fix=fix)
    return recordings


def _network_of(task: Task) -> Any:
    [binding] = task.inputs["descriptor"]
    path = task.input_path(binding)
    if not path.exists():
        where = path.relative_to(task.root).as_posix()
        raise BadData(task.root, where, expected="a network", got="none", fix=f"bask-data train {task.root}")
    return DescriptorNet(path).network()


def _first_scene(dataset: Dataset) -> str:
    """Name of the first scan with instances; `UsageError` if there is none."""
    for name in dataset.items("scene"):
        path = dataset.path(VisibleMasks, name)
        if path.exists() and VisibleMasks(path).n_instances:
            return name
    raise UsageError("--auto", "", expected="a scan with masks of its objects", got="none", fix="bask-data run first.")


def _given(params: ReferenceParams, recordings: dict[str, Recording]) -> list[KeypointMark]:
    """The picks in the parameters, with which a new draft starts; none for automatic keypoints."""
    if params.auto:
        return []
    picks = [parsed(text, f"point_{i}", recordings)[0] for i, text in enumerate(params.picks)]
    return [KeypointMark(**pick.model_dump(include=set(KeypointMark.model_fields))) for pick in picks]


def _saved(picking: Picking, picks: list[str]) -> Outcome:
    """Record the picks as parameters and make the artifact from them."""
    values = {"picks": picks, "auto": False}
    task = picking.planned(values)
    # Parameters come first: an artifact whose parameters could not be written would be stale at once.
    with section_written(picking.parameters, f"{task.stage.name}@{task.variant}", values):
        outcome = make(task)
        if outcome.status not in ("made", "up to date"):
            raise outcome.error or BaskError("reference", "", expected="to be made", got=outcome.why)
    if task.variant != "main":
        picking.dataset.add_variant(task.stage.makes, task.variant, Variant(inputs=picking.inputs))
    return outcome
