"""The keypoint study as PNG files like the paper's figures: errors over time, with examples."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bask_data.dataset import Dataset
from bask_data.drawing.plots import numbers
from bask_data.report.likelihood_figure import likelihood_figure
from bask_data.report.study_examples import draw_example, draw_reference
from bask_data.report.study_style import LABELS, method_colours

PHASE_COLOURS = {"visible": "#dcefe2", "occluded": "#f6e2c2", "out of view": "#dcdce6", "not seen yet": "#f4f4f6"}
DPI = 150
"""Pixels per inch of the PNG files: a figure 12 inches wide is sharp on a slide."""


def write_pictures(dataset: Dataset, result: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw a study as PNG files: for each set of objects, errors over time with examples, and the likelihood model.

    Args:
        result: of `evaluated_keypoints`.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    colours = method_colours(result)
    for name, group in result["groups"].items():
        files.append(_saved(_study_figure(dataset, group, colours), folder / f"{name}.png"))
        files.append(_saved(likelihood_figure(result, group), folder / f"{name}-likelihood.png"))
    return files


def _saved(figure: Any, file: Path) -> Path:
    unfinished = file.with_name(f".{file.name}.unfinished")
    try:
        # Without the software's name in it, the same figure has the same bytes.
        figure.savefig(unfinished, format="png", dpi=DPI, metadata={"Software": None})
        unfinished.replace(file)
    finally:
        unfinished.unlink(missing_ok=True)
    return file


def _study_figure(dataset: Dataset, group: Mapping[str, Any], colours: Mapping[str, str]) -> Any:
    """Reference positions, multimodality and error over time, and below them a row of frames for each object."""
    from matplotlib.figure import Figure

    examples = group["examples"]
    n_tiles = max((len(example["frames"]) for example in examples), default=1)
    width = 12.0
    figure = Figure(figsize=(width, 4.1 + len(examples) * (width / n_tiles + 0.25)), layout="constrained")
    heights = [4.1, *[width / n_tiles + 0.25] * len(examples)]
    rows: Any = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    top = rows[0].subplots(1, 3, width_ratios=[1.0, 1.5, 1.5])
    draw_reference(top[0], dataset, group)
    for axes, what in zip(top[1:], ("apart", "error"), strict=True):
        draw_over_time(axes, group, what, colours)
    handles, labels = top[2].get_legend_handles_labels()
    rows[0].legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    for row, example in zip(rows[1:], examples, strict=True):
        draw_example(row, dataset, group, example, colours)
    return figure


def draw_over_time(axes: Any, group: Mapping[str, Any], what: str, colours: Mapping[str, str]) -> None:
    """Draw each method's mean and standard deviation over time, on the shares of visible and occluded keypoints."""
    moments = np.array(group["moments"])
    share = np.zeros(len(moments))
    for phase, colour in PHASE_COLOURS.items():
        above = share + numbers(group["share_of"][phase])
        axes.fill_between(
            moments,
            share,
            above,
            color=colour,
            linewidth=0,
            transform=axes.get_xaxis_transform(),
            zorder=0,
            label=phase,
        )
        share = above
    highest = 0.0
    for name, figures in group["methods"].items():
        over_time = figures["over_time"]
        mean, deviation = (100 * numbers(over_time[f"{what}_{moment}"]) for moment in ("mean", "deviation"))
        axes.fill_between(
            moments, np.maximum(mean - deviation, 0), mean + deviation, color=colours[name], alpha=0.13, linewidth=0
        )
        axes.plot(moments, mean, color=colours[name], linewidth=2.0, label=name)
        highest = max(highest, float(np.nanmax(mean, initial=0.0)))
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.25 * highest or 1.0)
    axes.set_xlabel("time, from the first frame to the last", fontsize=8)
    axes.set_title(LABELS[what], fontsize=9)
    axes.tick_params(labelsize=8)
