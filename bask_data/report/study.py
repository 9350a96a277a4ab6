"""The keypoint study: its figures as the paper draws them, in files to show elsewhere, and the report's section."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bask_data.artifact import read_json
from bask_data.dataset import Dataset
from bask_data.drawing.pictures import Mark, marks_picture, palette
from bask_data.drawing.plots import Curve, line_plot, numbers
from bask_data.errors import BadData
from bask_data.evaluation.keypoint_study import FILE, is_current
from bask_data.evaluation.lookup import find_recording
from bask_data.report.chosen import Chosen, Part

COLOURS = ("#a0673a", "#7fb2e5", "#2f6db5", "#e08a1e", "#2f9e5b", "#8a5fb5")
"""Of methods; the first, brown, is the base network's."""
PHASE_COLOURS = {"visible": "#dcefe2", "occluded": "#f6e2c2", "out of view": "#dcdce6", "not seen yet": "#f4f4f6"}
TRUTH = "#e02020"
LABELS = {
    "apart": "Distance between mean and mode, cm",
    "error": "Distance to the truth, cm",
}
STUDY_TILE = 256
"""Half the pixels of width of the picture of reference positions."""
PAPER_ALPHA = 4.0
"""The paper's temperature, p(z) = exp(-4 z), von Hartz et al. 2023, Sec. III-B: drawn solid, others dashed."""
DPI = 150
"""Pixels an inch of the PNG files: a figure 12 inches wide is sharp on a slide."""
GROUP_COLOURS = {"near": "#2f9e5b", "objects": "#e08a1e", "background": "#8b8b95"}
GROUP_NAMES = {"near": "around the keypoint", "objects": "elsewhere on objects", "background": "background"}


def write_pictures(dataset: Dataset, found: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw a study into PNG files: for each set of objects errors over time and examples, and the likelihood model.

    Args:
        found: of `evaluated_keypoints`.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    colours = method_colours(found)
    for name, group in found["groups"].items():
        made.append(_saved(_study_figure(dataset, group, colours), folder / f"{name}.png"))
        made.append(_saved(_likelihood_figure(found, group), folder / f"{name}-likelihood.png"))
    return made


def method_colours(found: Mapping[str, Any]) -> dict[str, str]:
    """A colour for each method; those of single frames of other networks come first."""
    names = [one["name"] for one in found["methods"]]
    n_others = sum(one["variant"] != found["methods"][-1]["variant"] for one in found["methods"])
    others = [COLOURS[0], *COLOURS[5:]]
    return {
        name: others[i % len(others)] if i < n_others else COLOURS[1 + (i - n_others) % (len(COLOURS) - 1)]
        for i, name in enumerate(names)
    }


def _saved(figure: Any, file: Path) -> Path:
    unfinished = file.with_name(f".{file.name}.unfinished")
    try:
        # Without the software's name in it, the same figure has the same bytes.
        figure.savefig(unfinished, format="png", dpi=DPI, metadata={"Software": None})
        unfinished.replace(file)
    finally:
        unfinished.unlink(missing_ok=True)
    return file


# Over time -----------------------------------------------------------------------------------------------------------


def _study_figure(dataset: Dataset, group: Mapping[str, Any], colours: Mapping[str, str]) -> Any:
    """Reference positions, multimodality and error over time, and below them a row of an example for each object."""
    from matplotlib.figure import Figure

    examples = group["examples"]
    n_tiles = max((len(one["frames"]) for one in examples), default=1)
    width = 12.0
    figure = Figure(figsize=(width, 4.1 + len(examples) * (width / n_tiles + 0.25)), layout="constrained")
    heights = [4.1, *[width / n_tiles + 0.25] * len(examples)]
    rows: Any = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    top = rows[0].subplots(1, 3, width_ratios=[1.0, 1.5, 1.5])
    _draw_reference(top[0], dataset, group)
    for axes, what in zip(top[1:], ("apart", "error"), strict=True):
        draw_over_time(axes, group, what, colours)
    handles, labels = top[2].get_legend_handles_labels()
    rows[0].legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    for row, example in zip(rows[1:], examples, strict=True):
        _draw_example(row, dataset, group, example, colours)
    return figure


def draw_over_time(axes: Any, group: Mapping[str, Any], what: str, colours: Mapping[str, str]) -> None:
    """Mean and standard deviation of each method from first to last frame, over what the cameras see of the points."""
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
    for name, told in group["methods"].items():
        mean, deviation = (100 * numbers(told["over_time"][f"{what}_{one}"]) for one in ("mean", "deviation"))
        axes.fill_between(
            moments, np.maximum(mean - deviation, 0), mean + deviation, color=colours[name], alpha=0.13, linewidth=0
        )
        axes.plot(moments, mean, color=colours[name], linewidth=2.0, label=name)
        highest = max(highest, float(np.nanmax(mean, initial=0.0)))
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.25 * highest or 1.0)
    axes.set_xlabel("from the first frame to the last", fontsize=8)
    axes.set_title(LABELS[what], fontsize=9)
    axes.tick_params(labelsize=8)


def _draw_reference(axes: Any, dataset: Dataset, group: Mapping[str, Any]) -> None:
    """The image that most of the keypoints were picked in."""
    picks = group["keypoints"]
    frames = [(one["recording"], one["camera"], one["frame"]) for one in picks]
    recording, camera, i_frame = max(frames, key=frames.count)
    image = _frame(dataset, recording, camera, i_frame)
    colours = palette(len(picks))
    marks = [
        Mark(i, np.array([one["u"], one["v"]]), colours[i])
        for i, (one, frame) in enumerate(zip(picks, frames, strict=True))
        if frame == (recording, camera, i_frame)
    ]
    axes.imshow(marks_picture(image, marks, 2 * STUDY_TILE))
    axes.set_title(f"Reference positions ({recording})", fontsize=9)
    axes.set_axis_off()


def _draw_example(
    row: Any, dataset: Dataset, group: Mapping[str, Any], example: Mapping[str, Any], colours: Mapping[str, str]
) -> None:
    """A keypoint in some frames of a demonstration: the truth, and where each method has it."""
    tiles = np.atleast_1d(row.subplots(1, len(example["frames"])))
    keypoint = group["keypoints"][example["keypoint"]]["name"]
    row.suptitle(
        f"{keypoint} in {example['demonstration']}, {example['camera']} camera. Red: ground truth (hollow: hidden)",
        fontsize=8,
        x=0.01,
        ha="left",
    )
    for i, (axes, i_frame) in enumerate(zip(tiles, example["frames"], strict=True)):
        image = _frame(dataset, example["demonstration"], example["camera"], i_frame)
        height, width = image.shape[:2]
        axes.imshow(image)
        for name, pixels in example["pixel"].items():
            u, v = numbers(pixels[i])
            axes.plot(
                np.clip(u, 0, width - 1),
                np.clip(v, 0, height - 1),
                marker="o" if 0 <= u < width and 0 <= v < height else "X",
                color=colours[name],
                markersize=7,
                markeredgecolor="white",
                markeredgewidth=0.8,
            )
        u, v = numbers(example["truth"][i])
        axes.plot(
            np.clip(u, 0, width - 1),
            np.clip(v, 0, height - 1),
            marker="P",
            markersize=9,
            markerfacecolor=TRUTH if example["visible"][i] else "none",
            markeredgecolor="white" if example["visible"][i] else TRUTH,
        )
        axes.set_title(f"frame {i_frame}", fontsize=7)
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)
        axes.set_axis_off()


def _frame(dataset: Dataset, recording: str, camera: str, i_frame: int) -> np.ndarray:
    found = find_recording(dataset, recording)
    if found is None or camera not in found.camera_names or not 0 <= i_frame < found.camera(camera).n_frames:
        where = f"frame {i_frame} of {camera} in {recording}"
        raise BadData(dataset.root, where, expected="the frame the study was made with", got="none")
    return found.camera(camera).rgb(i_frame)


# The likelihood model ------------------------------------------------------------------------------------------------


def _likelihood_figure(found: Mapping[str, Any], group: Mapping[str, Any]) -> Any:
    """For each network a log-log histogram of descriptor distances with p(z) over it, and a distance map in bins."""
    from matplotlib.figure import Figure

    variants = list(group["distances"]["counts"])
    figure = Figure(figsize=(9.0, 3.2 * len(variants)), layout="constrained")
    rows = figure.subplots(len(variants), 2, width_ratios=[2.4, 1.0], squeeze=False)
    for (left, right), variant in zip(rows, variants, strict=True):
        draw_likelihood(left, found, group, variant)
        _draw_map(right, group, variant)
    return figure


def draw_likelihood(axes: Any, found: Mapping[str, Any], group: Mapping[str, Any], variant: str) -> None:
    """Pixels by descriptor distance, told apart by what they show, and the likelihood exp(-alpha z)."""
    from matplotlib.ticker import NullFormatter

    edges = np.array(group["distances"]["edges"])
    counts = {name: np.array(one) for name, one in group["distances"]["counts"][variant].items()}
    total = max(sum(int(one.sum()) for one in counts.values()), 1)
    for name, count in counts.items():
        share = np.where(count > 0, count / total, np.nan)
        axes.stairs(np.nan_to_num(share), edges, color=GROUP_COLOURS[name], label=GROUP_NAMES[name], linewidth=1.5)
    axes.set_xscale("log")
    axes.set_yscale("log")
    filled = edges[:-1][sum(counts.values()) > 0]
    if len(filled):
        axes.set_xlim(filled[0], 1.3 * filled[-1])
    axes.set_ylim(1e-7, 1.5)
    first, last = axes.get_xlim()
    for alpha in sorted({one["settings"]["alpha"] for one in found["methods"] if one["variant"] == variant}):
        z = np.geomspace(first, last, 200)
        axes.plot(z, np.exp(-alpha * z), color="black", linewidth=1.2, linestyle="-" if alpha == PAPER_ALPHA else "--")
        at = min(np.log(1e3) / alpha, 0.7 * last)
        axes.annotate(f"exp(-{alpha:.3g} z)", (at, np.exp(-alpha * at)), fontsize=7, rotation=-50, va="bottom")
    margins = found["margins"][variant] or {}
    for margin in dict.fromkeys(margins.values()):
        names = " = ".join(f"M {name}" for name, one in margins.items() if one == margin)
        axes.axvline(margin, color="black", linewidth=0.8, linestyle=":")
        axes.annotate(names, (margin, 0.6), fontsize=7, rotation=90, va="top", ha="right")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("descriptor distance z", fontsize=8)
    axes.set_ylabel("share of the pixels; p(z)", fontsize=8)
    axes.set_title(f"{variant}: distances, and the likelihood of a match", fontsize=9)
    axes.legend(fontsize=7, loc="lower right")
    axes.tick_params(labelsize=8)


def _draw_map(axes: Any, group: Mapping[str, Any], variant: str) -> None:
    """The example's distance map in bins of equal factors."""
    from matplotlib.colors import BoundaryNorm

    axes.set_axis_off()
    if not group["examples"]:
        return
    example = group["examples"][0]
    z = np.array([numbers(row) for row in example["first_map"][variant]])
    least = max(float(np.nanmin(z)), 1e-3)
    # A network that sees nothing has one distance everywhere.
    bins = np.geomspace(least, max(1.001 * float(np.nanmax(z)), 2 * least), 9)
    drawn = axes.imshow(z, cmap="viridis_r", norm=BoundaryNorm(bins, 256), interpolation="nearest")
    axes.figure.colorbar(drawn, ax=axes, shrink=0.85, format="%.2f").ax.tick_params(labelsize=6)
    name = group["keypoints"][example["keypoint"]]["name"]
    axes.set_title(f"z of {name}, {example['demonstration']}, first frame", fontsize=8)


# The report's section ------------------------------------------------------------------------------------------------


def study(chosen: Chosen) -> list[Part]:
    """What the dataset's last study found, for each set of objects: figures by what the cameras see, and over time."""
    file = chosen.dataset.root / FILE
    if not file.exists():
        return []
    try:
        found: Any = read_json(file)
        colours, is_stale = method_colours(found), not is_current(chosen.dataset, found)
        return [_study_part(found, name, colours, is_stale) for name in found["groups"]]
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        expected = "what `bask-data evaluate keypoints` found"
        fix = f"bask-data evaluate keypoints {chosen.dataset.root}"
        raise BadData(file, "", expected=expected, got=f"{type(error).__name__}: {error}", fix=fix) from error


def _study_part(found: Mapping[str, Any], name: str, colours: Mapping[str, str], is_stale: bool) -> Part:
    group = found["groups"][name]
    methods = group["methods"]
    first = next(iter(methods.values()))
    return {
        "title": name,
        "is_stale": is_stale,
        "settings": found["settings"],
        "n_keypoints": len(group["keypoints"]),
        "demonstrations": list(group["demonstrations"]),
        "phases": [{"name": phase, "n": told["n"] + told["n_unknown"]} for phase, told in first["error"].items()],
        "rows": [
            {
                "name": method,
                "colour": colours[method],
                "cells": list(told["error"].values()),
                "close": told["error"]["all"]["close"],
                "apart": told["apart"]["all"]["mean"],
            }
            for method, told in methods.items()
        ],
        "plots": [
            *(_study_plot(group, what, colours) for what in ("error", "apart")),
            _share_plot(group),
        ],
    }


def _study_plot(group: Mapping[str, Any], what: str, colours: Mapping[str, str]) -> Part:
    moments, curves, legend = np.array(group["moments"]), [], []
    for name, told in group["methods"].items():
        mean, deviation = (100 * numbers(told["over_time"][f"{what}_{one}"]) for one in ("mean", "deviation"))
        curves.append(Curve(moments, mean, colours[name], thick=True, deviation=deviation))
        legend.append({"name": name, "colour": colours[name], "last": None})
    highest = max((float(np.nanmax(curve.y, initial=0.0)) for curve in curves), default=0.0)
    svg = line_plot(
        curves,
        x_label="from the first frame to the last",
        y_label="cm",
        x_range=(0, 1),
        y_range=(0, 1.25 * highest or 1),
    )
    return {"title": LABELS[what], "svg": svg, "legend": legend}


def _share_plot(group: Mapping[str, Any]) -> Part:
    moments, curves, legend = np.array(group["moments"]), [], []
    for colour, (phase, share) in zip(("", *COLOURS), group["share_of"].items(), strict=False):
        if phase != "still":
            curves.append(Curve(moments, numbers(share), colour, thick=True))
            legend.append({"name": phase, "colour": colour or "currentColor", "last": None})
    svg = line_plot(
        curves, x_label="from the first frame to the last", y_label="share", x_range=(0, 1), y_range=(0, 1.02)
    )
    return {"title": "What the cameras see of the keypoints", "svg": svg, "legend": legend}
