"""What `evaluate` shows a person: scenes, variants and methods side by side."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

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
"""Figures of a row: their heads, and how they are written."""


def mask_lines(found: dict[str, Any]) -> Iterator[str]:
    """A line an object of each scene, then the figures of all.

    Args:
        found: of `evaluated_masks`.
    """
    for scene, score in found["scenes"].items():
        yield f"  {scene}: {score['n_found']} objects found, {len(score['objects'])} are there"
        for one in score["objects"]:
            yield f"    {'+'.join(one['names']):<32} instance {one['instance'] or 'none':<4}  IoU {one['iou']:.3f}"
    yield from _figure_lines(found["all"])


def match_lines(found: dict[str, Any]) -> Iterator[str]:
    """The figures of each scene, then of all.

    Args:
        found: of `evaluated_correspondences`.
    """
    for scene, figures in found["scenes"].items():
        yield f"  {scene}"
        yield from _figure_lines(figures)
    yield "  all scenes"
    yield from _figure_lines(found["all"])


def _figure_lines(figures: dict[str, float | None]) -> Iterator[str]:
    for name, value in figures.items():
        yield f"    {name:<14} {'unknown' if value is None else f'{value:.4g}'}"


def descriptor_tables(found: dict[str, Any]) -> Iterator[str]:
    """Lines: what was measured on, a table of all that is told apart, a row a variant, and how true the heat maps are.

    Args:
        found: of `evaluated_descriptor`.
    """
    yield f"measured on {found['measured_on']}; {found['n_pairs']} pairs of frames"
    for scene, source in found["matches_by"].items():
        yield f"  {scene}: matches by {source}"
    variants = found["variants"]
    yield from _table({"all": {name: told["all"] for name, told in variants.items()}})
    first = next(iter(variants.values()))
    for what in (name for name in first if name.startswith("by_")):
        yield what.replace("_", " ")
        yield from _table({row: {name: told[what][row] for name, told in variants.items()} for row in first[what]})
    yield from _keypoint_table(variants)
    for name, told in variants.items():
        error, least = (_written(told["calibration"][key], 100, ".1f") for key in ("ece", "truest_ece"))
        words = f"what they promise and what is so differ by {error} % (ECE) at alpha {found['alpha']:g}"
        yield f"heat maps of {name}: {words}; by {least} % at alpha {told['calibration']['truest_alpha']:g}"


def _keypoint_table(variants: dict[str, dict[str, Any]]) -> Iterator[str]:
    """A line for each variant, set of objects and column: mean and deviation of the errors, and what was seen."""
    rows = [
        (name, objects, row) for name, told in variants.items() for objects, row in told.get("keypoints", {}).items()
    ]
    if rows:
        yield "keypoints of one training view in others: error / image size, mean +- deviation (seen, hidden, outside)"
    for name, objects, row in rows:
        yield f"  {objects} {name}"
        for column, told in row.items():
            mean, std = (_written(told[key], 1, ".3f") for key in ("mean", "std"))
            yield f"    {column:<28} {mean} +- {std}  ({told['seen']}, {told['hidden']}, {told['outside']})"


def _table(rows: dict[str, dict[str, dict[str, float | None]]]) -> Iterator[str]:
    """A head, and for each row a line a variant."""
    yield " " * 34 + "".join(f"{head:>9}" for head, _, _ in COLUMNS.values())
    for row, variants in rows.items():
        for place, (name, figures) in enumerate(variants.items()):
            values = "".join(f"{_written(figures[key], factor, form):>9}" for key, (_, factor, form) in COLUMNS.items())
            yield f"  {row if place == 0 else '':<20} {name:<11}" + values


def keypoint_tables(found: dict[str, Any]) -> Iterator[str]:
    """Lines: for each set of objects a row a method, with its errors by what the cameras see.

    Args:
        found: of `evaluated_keypoints`.
    """
    for name, group in found["groups"].items():
        demonstrations = group["demonstrations"]
        n_frames = sum(one["n_frames"] for one in demonstrations.values())
        yield f"{name}: {len(group['keypoints'])} keypoints in {len(demonstrations)} demonstrations, {n_frames} frames"
        methods = group["methods"]
        phases = list(next(iter(methods.values()))["error"])
        heads = "".join(f"{phase:>13}" for phase in phases) + f"{'mode':>8}{'apart':>8}"
        yield f"{'  mean distance to the truth, mm':<38}{heads}"
        for method, told in methods.items():
            cells = "".join(f"{_written(told['error'][phase]['mean'], 1000, '.0f'):>13}" for phase in phases)
            others = [_written(told[what]["all"]["mean"], 1000, ".0f") for what in ("error_of_mode", "apart")]
            yield f"    {method:<34}" + cells + "".join(f"{one:>8}" for one in others)
        counted = next(iter(methods.values()))["error"]
        yield f"    {'frames x keypoints':<34}" + "".join(f"{counted[phase]['n']:>13}" for phase in phases)
    yield "mode: mean distance of the likeliest place to the truth; apart: to the mean, large where it is one of many"


def _written(value: float | None, factor: float, form: str) -> str:
    return "-" if value is None else format(value * factor, form)
