"""`evaluate`: masks, correspondences, networks and keypoints compared with ground truth."""

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
    Stride,
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
    help="Compare artifacts with ground truth, on recordings that have it.",
    epilog="""
    bask-data evaluate masks data/demo
    bask-data evaluate descriptor data/demo --json > descriptor.json
    """,
)


@app.callback()
def _group() -> None:
    """A callback makes this a group: `evaluate NAME`."""


@app.command(
    epilog="""
    bask-data evaluate masks data/demo
    bask-data evaluate masks data/demo --only table --json
    """
)
def masks(root: Root, only: Only = "", json_: Json = False) -> None:
    """Count detected objects, and measure the IoU of their visible masks with the labels.

    Objects that touch count as one: geometry alone cannot separate them.
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
    """Measure the error of matches in pixels, by exact depth and camera poses."""
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
    """Measure how accurately networks match pixels between held-out views.

    By exact depth and camera poses where ground truth has them, otherwise by the dataset's own matches; by change of
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
    stride: Stride = 1,
    pictures: Pictures = None,
    json_: Json = False,
) -> None:
    """Measure the error of tracked keypoints, over time and by their visibility.

    Compares expectation, discrete filter and particle filter on demonstrations whose ground truth has the poses of
    objects. The result is stored in ROOT/evaluation/keypoints.json, for the report.
    """
    from bask_data.evaluation import StudySettings, evaluated_keypoints
    from bask_data.evaluation.keypoint_study import save_study
    from bask_data.evaluation.tables import keypoint_tables
    from bask_data.report.study_figure import write_pictures

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
                stride=stride,
            ),
        )
    files = [save_study(dataset, found), *(write_pictures(dataset, found, pictures) if pictures else [])]
    print_result("evaluate keypoints", keypoint_tables(found), {"files": list(map(str, files)), **found}, json_)
    for file in files:
        say(f"made {file}")
    say(f"next: bask-data report {quoted(root)}")


def _named_datasets(given: Sequence[str]) -> dict[str, Dataset]:
    """Datasets by name, from `NAME=ROOT`."""
    datasets: dict[str, Dataset] = {}
    for text in given:
        name, is_pair, root = text.partition("=")
        if not (name and is_pair and root):
            raise UsageError("evaluate descriptor", "--against", expected="NAME=ROOT", got=text)
        if name in datasets:
            raise UsageError("evaluate descriptor", "--against", expected="each name once", got=f"{name} twice")
        datasets[name] = Dataset(root)
    return datasets
