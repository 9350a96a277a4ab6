"""Choosing reference keypoints by hand, on a page in a browser; the `reference` stage makes the artifact of them."""

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
from bask_data.kinds import Demonstration, DescriptorNet, Pick, Recording, Scan, VisibleMasks
from bask_data.picker.desk import Desk
from bask_data.picker.draft import Draft, KeypointMark
from bask_data.picker.gallery import Gallery
from bask_data.picker.server import serve
from bask_data.stages.reference import ReferenceParams, as_text, chosen, parsed

__all__ = ["Picking", "pick_keypoints"]


@dataclass
class Picking:
    """What is picked for: a variant of the reference keypoints, and where its parameters are written.

    Args:
        planned: the stage's task with these parameters in place of its own.
        parameters: YAML file; it keeps the picks, so that `status` and `run` know them.
        inputs: variants of inputs, as `dataset.json` will keep them.
        following: the command that comes after.
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
    """Serve the page until it is closed; Ctrl-C closes it too once something was saved.

    Args:
        say: told what a person should know.
        opened: told the link.

    Returns:
        what became of the last saving; empty if nothing was saved.

    Raises:
        KeyboardInterrupt: Ctrl-C, and nothing was saved.
    """
    task = picking.planned({})
    file = picking.dataset.root / SCRATCH / f"picks~{task.variant}.json"
    file.parent.mkdir(exist_ok=True)
    try:
        with FileLock(file.with_suffix(".lock"), timeout=0):
            desk = _desk(picking, task, file, say)
            try:
                serve(desk, port, opened=opened)
            except KeyboardInterrupt:
                if not picking.outcomes:
                    raise
    except Timeout:
        fix = "use the page that is open, or end its command."
        raise UsageError("--pick", task.variant, expected="one page at a time", got="another", fix=fix) from None
    return picking.outcomes


def _desk(picking: Picking, task: Task, file: Path, say: Callable[[str], None]) -> Desk:
    dataset = picking.dataset
    recordings = _recordings(dataset)
    network = _network_of(task)
    assert isinstance(task.params, ReferenceParams)
    params = task.params

    def propose(scene: str, n: int) -> list[KeypointMark]:
        wanted = params.model_copy(update={"n": n, "instances": () if scene != params.scene else params.instances})
        masks = dataset.path(VisibleMasks, scene)
        if scene not in dataset.items("scene") or not masks.exists():
            expected, fix = "a scan whose objects are known", "choose another, or `bask-data run` first."
            raise UsageError("propose", "scene", expected=expected, got=scene, fix=fix)
        picks, _ = chosen(wanted, scene, Scan(dataset.path(Scan, scene)), VisibleMasks(masks), network)
        return [KeypointMark(**pick.model_dump(include=set(KeypointMark.model_fields))) for pick in picks]

    def save(marks: Sequence[KeypointMark]) -> tuple[str, str]:
        picking.outcomes[:] = [_saved(picking, [as_text(Pick(**mark.model_dump())) for mark in marks])]
        draft.drop()
        return f"{len(marks)} keypoints saved as {task.target.relative_to(dataset.root)}", picking.following

    gallery = Gallery(recordings, network)
    draft = Draft(file, _given(params, recordings))
    if not draft.is_new:
        say(f"going on with {len(draft.marks)} unsaved keypoints of last time")
    elif params.auto:
        draft.add(propose(params.scene or _first_scene(dataset), params.n))
    title = " · ".join(part for part in (dataset.file.name, "" if task.variant == "main" else task.variant) if part)
    return Desk(gallery, draft, propose=propose, save=save, title=title)


def _recordings(dataset: Dataset) -> dict[str, Recording]:
    """Scans and demonstrations that are there, by name."""
    found: dict[str, Recording] = {}
    for kind, scope in ((Scan, "scene"), (Demonstration, "demonstration")):
        for name in dataset.items(scope):
            if dataset.path(kind, name).exists():
                found[name] = kind(dataset.path(kind, name))
                found[name].check_complete()
    if not found:
        fix = "bask-data ingest --help"
        raise UsageError(dataset.root, "", expected="a recording", got="none in the dataset", fix=fix)
    return found


def _network_of(task: Task) -> Any:
    [binding] = task.inputs["descriptor"]
    path = task.input_path(binding)
    if not path.exists():
        where = path.relative_to(task.root).as_posix()
        raise BadData(task.root, where, expected="a network", got="none", fix=f"bask-data train {task.root}")
    return DescriptorNet(path).network()


def _first_scene(dataset: Dataset) -> str:
    """The first scan in which objects were found."""
    for name in dataset.items("scene"):
        path = dataset.path(VisibleMasks, name)
        if path.exists() and VisibleMasks(path).n_instances:
            return name
    raise UsageError("--auto", "", expected="a scan whose objects are known", got="none", fix="bask-data run first.")


def _given(params: ReferenceParams, recordings: dict[str, Recording]) -> list[KeypointMark]:
    """The picks of the parameters: where one goes on from."""
    if params.auto:
        return []
    picks = [parsed(text, f"point_{i}", recordings)[0] for i, text in enumerate(params.picks)]
    return [KeypointMark(**pick.model_dump(include=set(KeypointMark.model_fields))) for pick in picks]


def _saved(picking: Picking, picks: list[str]) -> Outcome:
    """The artifact of these picks, made by its stage, and the parameters that make it again."""
    values = {"picks": picks, "auto": False}
    task = picking.planned(values)
    # The parameters first: were they refused when the artifact is there, it could not be made again.
    with section_written(picking.parameters, f"{task.stage.name}@{task.variant}", values):
        outcome = make(task)
        if outcome.status not in ("made", "up to date"):
            raise outcome.error or BaskError("reference", "", expected="to be made", got=outcome.why)
    if task.variant != "main":
        picking.dataset.add_variant(task.stage.makes, task.variant, Variant(inputs=picking.inputs))
    return outcome
