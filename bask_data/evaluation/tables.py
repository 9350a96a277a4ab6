"""Text tables of evaluations: scenes, variants and methods side by side."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bask_data.evaluation.certainty import OF_COLUMNS, certainty_lines
from bask_data.evaluation.study_comparisons import comparison_lines
from bask_data.spelling import number_of

COLUMNS: dict[str, tuple[str, float, str]] = {
    "n": ("n", 1, "d"),
    "median_px": ("px", 1, ".1f"),
    "pck_1": ("PCK@1", 100, ".1f"),
    "pck_2": ("@2", 100, ".1f"),
    "pck_4": ("@4", 100, ".1f"),
    "pck_8": ("@8 %", 100, ".1f"),
    "median_3d_m": ("mm", 1000, ".1f"),
    "closer_mean": ("closer %", 100, ".2f"),
    "false_positive_px": ("false px", 1, ".1f"),
}
"""Figures of a row: head, factor and format of each."""


def mask_lines(result: dict[str, Any]) -> Iterator[str]:
    """A line for each object of each scene, then the figures of all.

    Args:
        result: of `evaluated_masks`.
    """
    for scene, score in result["scenes"].items():
        yield f"  {scene}: {score['n_found']} instances, {len(score['objects'])} true objects"
        for body in score["objects"]:
            identity = f"  {body['identity'] or 'no identity'}" if "identity" in body else ""
            instance = f"instance {body['instance'] or 'none':<4}"
            yield f"    {'+'.join(body['names']):<32} {instance}  IoU {body['iou']:.3f}{identity}"
    yield from _name_lines(result)
    yield from _figure_lines(result["all"])


def _name_lines(result: dict[str, Any]) -> Iterator[str]:
    """A line for each identity, if there are any, with the objects that it shows by ground truth."""
    if result.get("by_name"):
        yield "  by name"
    for name, figures in result.get("by_name", {}).items():
        shows = ", ".join(f"{true} {n}" for true, n in figures["shows"].items())
        scans = number_of(figures["n_scans"], "scan")
        yield f"    {name:<32} {scans:<13}  IoU {figures['iou']:.3f}, worst {figures['worst']:.3f}; shows {shows}"
    if result.get("outdated"):
        scans = ", ".join(result["outdated"])
        yield f"  no names for {scans}: the masks have changed since `bask-data identify`; run it again"


def match_lines(result: dict[str, Any]) -> Iterator[str]:
    """The figures of each scene, then of all.

    Args:
        result: of `evaluated_correspondences`.
    """
    for scene, figures in result["scenes"].items():
        yield f"  {scene}"
        yield from _figure_lines(figures)
    yield "  all scenes"
    yield from _figure_lines(result["all"])


def _figure_lines(figures: dict[str, float | None]) -> Iterator[str]:
    for name, value in figures.items():
        yield f"    {name:<14} {'unknown' if value is None else f'{value:.4g}'}"


def descriptor_tables(result: dict[str, Any]) -> Iterator[str]:
    """Lines: what was measured on, a table for each breakdown, with a row per variant, and the calibration.

    Args:
        result: of `evaluated_descriptor`.
    """
    yield f"measured on {result['measured_on']}; {result['n_pairs']} pairs of frames"
    for scene, source in result["matches_by"].items():
        yield f"  {scene}: matches from {source}"
    variants = result["variants"]
    yield from _table({"all": {name: figures["all"] for name, figures in variants.items()}})
    first = next(iter(variants.values()))
    for what in (name for name in first if name.startswith("by_")):
        yield what.replace("_", " ")
        yield from _table(
            {row: {name: figures[what][row] for name, figures in variants.items()} for row in first[what]}
        )
    yield from _keypoint_table(variants)
    for name, figures in variants.items():
        calibration = figures["calibration"]
        error, least = (_written(calibration[key], 100, ".1f") for key in ("ece", "truest_ece"))
        at_alpha = f"{error} % at alpha {result['alpha']:g}"
        yield f"calibration error (ECE) of {name}: {at_alpha}; best {least} % at alpha {calibration['truest_alpha']:g}"


def _keypoint_table(variants: dict[str, dict[str, Any]]) -> Iterator[str]:
    """A line for each variant, set of objects and column: mean and deviation of the errors, and numbers of views."""
    rows = [
        (name, objects, row)
        for name, figures in variants.items()
        for objects, row in figures.get("keypoints", {}).items()
    ]
    if rows:
        yield "keypoints of one training view in others: error / image size, mean +- deviation"
        yield "  (visible, occluded, out of view)"
    for name, objects, row in rows:
        yield f"  {objects} {name}"
        for column, figures in row.items():
            mean, std = (_written(figures[key], 1, ".3f") for key in ("mean", "std"))
            yield f"    {column:<28} {mean} +- {std}  ({figures['seen']}, {figures['hidden']}, {figures['outside']})"


def _table(rows: dict[str, dict[str, dict[str, float | None]]]) -> Iterator[str]:
    """A head, and for each row a line per variant."""
    yield " " * 34 + "".join(f"{head:>9}" for head, _, _ in COLUMNS.values())
    for row, variants in rows.items():
        for place, (name, figures) in enumerate(variants.items()):
            values = "".join(f"{_written(figures[key], factor, form):>9}" for key, (_, factor, form) in COLUMNS.items())
            yield f"  {row if place == 0 else '':<20} {name:<11}" + values


def keypoint_tables(result: dict[str, Any]) -> Iterator[str]:
    """Lines: for each set of objects a row per method, with its errors by visibility.

    Args:
        result: of `evaluated_keypoints`.
    """
    for name, group in result["groups"].items():
        demonstrations = group["demonstrations"]
        n_frames = sum(demonstration["n_frames"] for demonstration in demonstrations.values())
        n_keypoints, n_demonstrations = len(group["keypoints"]), len(demonstrations)
        where = f"{number_of(n_demonstrations, 'demonstration')}, {number_of(n_frames, 'frame')}"
        yield f"{name}: {number_of(n_keypoints, 'keypoint')} in {where}"
        methods = group["methods"]
        phases = list(next(iter(methods.values()))["error"])
        heads = "".join(f"{phase:>13}" for phase in phases) + f"{'mode':>8}{'apart':>8}"
        yield f"{'  mean distance to ground truth, mm':<38}{heads}"
        for method, figures in methods.items():
            cells = "".join(f"{_written(figures['error'][phase]['mean'], 1000, '.0f'):>13}" for phase in phases)
            others = [_written(figures[what]["all"]["mean"], 1000, ".0f") for what in ("error_of_mode", "apart")]
            yield f"    {method:<34}" + cells + "".join(f"{cell:>8}" for cell in others)
        counted = next(iter(methods.values()))["error"]
        yield f"    {'frames x keypoints':<34}" + "".join(f"{counted[phase]['n']:>13}" for phase in phases)
        yield from comparison_lines(group["comparisons"])
        yield from certainty_lines(methods)
    if len(result["groups"]) > 1:
        yield "all objects"
        yield from comparison_lines(result["comparisons"])
    yield "mode: mean distance of the belief's mode to ground truth; apart: to its mean, large for ambiguous keypoints"
    yield from OF_COLUMNS
    yield "[,]: 95 % interval of the difference, from resampled demonstrations; one that holds zero shows no difference"


def _written(value: float | None, factor: float, form: str) -> str:
    return "-" if value is None else format(value * factor, form)
