"""`evaluate`: masks, correspondences, networks and keypoints beside the truth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from bask_data.cli.console import say, shown_progress
from bask_data.cli.failures import reporting
from bask_data.cli.options import Json, Only, Root, names_of
from bask_data.cli.working import quoted
from bask_data.dataset import Dataset
from bask_data.errors import UsageError

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Hold what was made against the truth of recordings that have one.",
)


@app.command("masks")
@reporting
def evaluate_masks(root: Root, only: Only = "", json_: Json = False) -> None:
    """Objects found, and IoU of their visible masks with the labels.

    Bodies that touch count as one object: geometry cannot tell them apart.
    """
    from bask_data.evaluation import evaluated_masks

    with shown_progress():
        found = evaluated_masks(Dataset(root), names_of(only))
    for scene, score in found["scenes"].items():
        say(f"  {scene}: {score['n_found']} objects found, {len(score['objects'])} are there")
        for one in score["objects"]:
            say(f"    {'+'.join(one['names']):<32} instance {one['instance'] or 'none':<4}  IoU {one['iou']:.3f}")
    _show_figures(found["all"])
    if json_:
        print(json.dumps({"command": "evaluate masks", **found}, indent=2))


@app.command("correspondences")
@reporting
def evaluate_correspondences(root: Root, only: Only = "", json_: Json = False) -> None:
    """Pixels between the matches and where the exact depth and cameras say they belong."""
    from bask_data.evaluation import evaluated_correspondences

    with shown_progress():
        found = evaluated_correspondences(Dataset(root), names_of(only))
    for scene, figures in found["scenes"].items():
        say(f"  {scene}")
        _show_figures(figures)
    say("  all scenes")
    _show_figures(found["all"])
    if json_:
        print(json.dumps({"command": "evaluate correspondences", **found}, indent=2))


@app.command("descriptor")
@reporting
def evaluate_descriptor(
    root: Root,
    variant: Annotated[
        str, typer.Option(help="Networks to measure beside each other, separated by commas.", metavar="NAMES")
    ] = "main",
    scenes: Annotated[
        str, typer.Option(help="Scenes to measure on. [default: what was held out of training]", metavar="NAMES")
    ] = "",
    pairs: Annotated[int, typer.Option(min=1, help="Most pairs of frames, of each scene.")] = 100,
    sweep: Annotated[
        bool, typer.Option("--sweep/--no-sweep", help="Zoom and turn some of the views by given amounts, too.")
    ] = True,
    keypoints: Annotated[
        int, typer.Option(min=0, help="Keypoints picked in a view trained on, to look for in others; 0 is none.")
    ] = 16,
    against: Annotated[
        list[str],
        typer.Option(
            help="A further dataset whose truth names the same objects, to look for the keypoints in: other instances, "
            "other surroundings. May be repeated.",
            metavar="NAME=ROOT",
        ),
    ] = [],  # noqa: B006  # Typer copies it.
    alpha: Annotated[
        float, typer.Option(min=0, help="Temperature of the heat maps whose truthfulness is measured.")
    ] = 4.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the pairs and their matches.")] = 0,
    json_: Json = False,
) -> None:
    """How well networks find in held-out views what they saw in others.

    By exact depth and cameras where truth knows them, else by the dataset's own matches; told apart by change of scale,
    rotation, occlusion and object.
    """
    from bask_data.evaluation import evaluated_descriptor
    from bask_data.evaluation.tables import descriptor_tables

    with shown_progress():
        found = evaluated_descriptor(
            Dataset(root),
            names_of(variant),
            scenes=names_of(scenes),
            pairs=pairs,
            sweep=sweep,
            keypoints=keypoints,
            against=_named_datasets(against),
            alpha=alpha,
            seed=seed,
        )
    for line in descriptor_tables(found):
        say(line)
    if json_:
        print(json.dumps({"command": "evaluate descriptor", **found}, indent=2))


@app.command("keypoints")
@reporting
def evaluate_keypoints(
    root: Root,
    variant: Annotated[
        str,
        typer.Option(
            help="Networks to track with, by commas: all filters with the first, single frames with the others.",
            metavar="NAMES",
        ),
    ] = "main",
    demonstrations: Annotated[
        str, typer.Option(help="Demonstrations to track in. [default: all with truth]", metavar="NAMES")
    ] = "",
    objects: Annotated[
        str, typer.Option(help="Objects to put keypoints on. [default: all of a demonstration]", metavar="NAMES")
    ] = "",
    cameras: Annotated[
        str, typer.Option(help="Cameras to track with, `wrist` in the paper. [default: all]", metavar="NAMES")
    ] = "",
    reference: Annotated[
        str,
        typer.Option(help="Reference keypoints to track. [default: points spread over the objects]", metavar="VARIANT"),
    ] = "",
    pick_in: Annotated[
        str,
        typer.Option(
            help="Recordings to choose these points in, the first with the objects; a demonstration in the paper. "
            "[default: scans that networks learn from]",
            metavar="NAMES",
        ),
    ] = "",
    keypoints: Annotated[int, typer.Option(min=1, help="Number of points, shared among the objects.")] = 16,
    settings: Annotated[
        Literal["default", "paper", "code"],
        typer.Option(help="Settings of the filters: our own, the paper's, or its authors' code's."),
    ] = "default",
    pictures: Annotated[
        Path | None, typer.Option(help="Draw the figures into this folder, as PNG.", metavar="DIR")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the points and of the particle filter.")] = 0,
    json_: Json = False,
) -> None:
    """How right tracked keypoints are, over time and by what the cameras see of them.

    Single frames, discrete and particle filter, on demonstrations whose truth knows where the objects are. The dataset
    keeps the result in evaluation/keypoints.json, for its report.
    """
    from bask_data.evaluation import evaluated_keypoints
    from bask_data.evaluation.keypoint_study import save_study
    from bask_data.evaluation.tables import keypoint_tables
    from bask_data.report.study import write_pictures

    dataset = Dataset(root)
    with shown_progress():
        found = evaluated_keypoints(
            dataset,
            names_of(variant),
            demonstrations=names_of(demonstrations),
            objects=names_of(objects),
            cameras=names_of(cameras),
            reference=reference,
            pick_in=names_of(pick_in),
            n_keypoints=keypoints,
            settings=settings,
            seed=seed,
        )
    made = [save_study(dataset, found), *(write_pictures(dataset, found, pictures) if pictures else [])]
    for line in keypoint_tables(found):
        say(line)
    for file in made:
        say(f"made {file}")
    if json_:
        print(json.dumps({"command": "evaluate keypoints", "files": [str(file) for file in made], **found}, indent=2))
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


def _show_figures(figures: dict[str, float | None]) -> None:
    for name, value in figures.items():
        say(f"    {name:<14} {'unknown' if value is None else f'{value:.4g}'}")
