"""`evaluate`: masks, correspondences, networks and keypoints, compared with ground truth."""

from __future__ import annotations

from collections.abc import Sequence

from bask_data.cli.commands import CommandList
from bask_data.cli.console import print_result, say, shown_progress
from bask_data.cli.evaluate_options import (
    Against,
    Alpha,
    Cameras,
    Demonstrations,
    FilterSettings,
    Networks,
    Objects,
    Pairs,
    PickIn,
    Pictures,
    Reference,
    Scenes,
    Seed,
    SoughtKeypoints,
    Sweep,
    TrackedKeypoints,
    Trackers,
)
from bask_data.cli.options import Json, Only, Root, names_of
from bask_data.cli.working import quoted
from bask_data.dataset import Dataset
from bask_data.errors import UsageError

app = CommandList(
    name="evaluate",
    no_args_is_help=True,
    help="Compare what was made with the ground truth of recordings that have it.",
    epilog="""
    bask-data evaluate masks data/demo
    bask-data evaluate descriptor data/demo --json > descriptor.json
    """,
)


@app.callback()
def _group() -> None:
    """Keep the commands below a name of their own."""


@app.command(
    epilog="""
    bask-data evaluate masks data/demo
    bask-data evaluate masks data/demo --only table --json
    """
)
def masks(root: Root, only: Only = "", json_: Json = False) -> None:
    """Count the objects found, and give the IoU of their visible masks with the labels.

    Bodies that touch count as one object: geometry cannot tell them apart.
    """
    from bask_data.evaluation import evaluated_masks
    from bask_data.evaluation.tables import mask_lines

    with shown_progress():
        found = evaluated_masks(Dataset(root), names_of(only))
    print_result("evaluate masks", mask_lines(found), found, json_)


@app.command(
    epilog="""
    bask-data evaluate correspondences data/demo
    """
)
def correspondences(root: Root, only: Only = "", json_: Json = False) -> None:
    """Measure how far matches are from where exact depth and cameras put them, in pixels."""
    from bask_data.evaluation import evaluated_correspondences
    from bask_data.evaluation.tables import match_lines

    with shown_progress():
        found = evaluated_correspondences(Dataset(root), names_of(only))
    print_result("evaluate correspondences", match_lines(found), found, json_)


@app.command(
    epilog="""
    bask-data evaluate descriptor data/demo
    bask-data evaluate descriptor data/demo --variant main,florence --scenes table3
    bask-data evaluate descriptor data/demo --against cups=data/other_cups
    """
)
def descriptor(
    root: Root,
    variant: Networks = "main",
    scenes: Scenes = "",
    against: Against = [],  # noqa: B006  # Typer copies it.
    keypoints: SoughtKeypoints = 16,
    sweep: Sweep = True,
    pairs: Pairs = 100,
    alpha: Alpha = 4.0,
    seed: Seed = 0,
    json_: Json = False,
) -> None:
    """Measure how well networks find in held-out views what they saw in others.

    By exact depth and cameras where the truth knows them, else by the dataset's own matches; broken down by change of
    scale, rotation, occlusion and object.
    """
    from bask_data.evaluation import DescriptorSettings, evaluated_descriptor
    from bask_data.evaluation.tables import descriptor_tables

    with shown_progress():
        found = evaluated_descriptor(
            Dataset(root),
            names_of(variant),
            DescriptorSettings(
                scenes=names_of(scenes), pairs=pairs, sweep=sweep, keypoints=keypoints, alpha=alpha, seed=seed
            ),
            against=_named_datasets(against),
        )
    print_result("evaluate descriptor", descriptor_tables(found), found, json_)


@app.command(
    epilog="""
    bask-data evaluate keypoints data/demo
    bask-data evaluate keypoints data/demo --cameras wrist --settings paper --pictures figures
    """
)
def keypoints(
    root: Root,
    variant: Trackers = "main",
    demonstrations: Demonstrations = "",
    objects: Objects = "",
    cameras: Cameras = "",
    reference: Reference = "",
    pick_in: PickIn = "",
    keypoints: TrackedKeypoints = 16,
    settings: FilterSettings = "default",
    seed: Seed = 0,
    pictures: Pictures = None,
    json_: Json = False,
) -> None:
    """Measure how far tracked keypoints are from the truth, over time and by what the cameras see of them.

    Single frames, discrete and particle filter, on demonstrations whose truth knows where the objects are. The dataset
    keeps the result in evaluation/keypoints.json, for its report.
    """
    from bask_data.evaluation import StudySettings, evaluated_keypoints
    from bask_data.evaluation.keypoint_study import save_study
    from bask_data.evaluation.tables import keypoint_tables
    from bask_data.report.study import write_pictures

    dataset = Dataset(root)
    with shown_progress():
        found = evaluated_keypoints(
            dataset,
            names_of(variant),
            StudySettings(
                demonstrations=names_of(demonstrations),
                objects=names_of(objects),
                cameras=names_of(cameras),
                reference=reference,
                pick_in=names_of(pick_in),
                n_keypoints=keypoints,
                filters=settings,
                seed=seed,
            ),
        )
    files = [save_study(dataset, found), *(write_pictures(dataset, found, pictures) if pictures else [])]
    print_result("evaluate keypoints", keypoint_tables(found), {"files": list(map(str, files)), **found}, json_)
    for file in files:
        say(f"made {file}")
    say(f"next: bask-data report {quoted(root)}")


def _named_datasets(given: Sequence[str]) -> dict[str, Dataset]:
    """Of NAME=ROOT."""
    found = {}
    for text in given:
        name, is_pair, root = text.partition("=")
        if not (name and is_pair and root):
            raise UsageError("evaluate descriptor", "--against", expected="NAME=ROOT", got=text)
        if name in found:
            raise UsageError("evaluate descriptor", "--against", expected="names that differ", got=f"{name} twice")
        found[name] = Dataset(root)
    return found
