"""The keypoint study: figures like the paper's as PNG files, and the report's section."""

from __future__ import annotations

import shlex
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
"""Colours of methods; the first, brown, is that of the base DON."""
PHASE_COLOURS = {"visible": "#dcefe2", "occluded": "#f6e2c2", "out of view": "#dcdce6", "not seen yet": "#f4f4f6"}
TRUTH = "#e02020"
LABELS = {
    "apart": "Distance between mean and mode, cm",
    "error": "Distance to ground truth, cm",
}
STUDY_TILE = 256
"""Half the width of the picture of reference positions, pixels."""
PAPER_ALPHA = 4.0
"""The paper's temperature, p(z) = exp(-4 z), von Hartz et al. 2023, Sec. III-B: drawn solid, others dashed."""
DPI = 150
"""Pixels per inch of the PNG files: a figure 12 inches wide is sharp on a slide."""
GROUP_COLOURS = {"near": "#2f9e5b", "objects": "#e08a1e", "background": "#8b8b95"}
GROUP_NAMES = {"near": "around the keypoint", "objects": "elsewhere on objects", "background": "background"}


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
        files.append(_saved(_likelihood_figure(result, group), folder / f"{name}-likelihood.png"))
    return files


def method_colours(result: Mapping[str, Any]) -> dict[str, str]:
    """A colour for each method; other networks than that of the last method come first."""
    names = [method["name"] for method in result["methods"]]
    n_others = sum(method["variant"] != result["methods"][-1]["variant"] for method in result["methods"])
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
    """Reference positions, multimodality and error over time, and below them a row of frames for each object."""
    from matplotlib.figure import Figure

    examples = group["examples"]
    n_tiles = max((len(example["frames"]) for example in examples), default=1)
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


def _draw_reference(axes: Any, dataset: Dataset, group: Mapping[str, Any]) -> None:
    """Draw the image that most of the keypoints were picked in."""
    picks = group["keypoints"]
    frames = [(pick["recording"], pick["camera"], pick["frame"]) for pick in picks]
    recording, camera, i_frame = max(frames, key=frames.count)
    image = _frame(dataset, recording, camera, i_frame)
    colours = palette(len(picks))
    marks = [
        Mark(i, np.array([pick["u"], pick["v"]]), colours[i])
        for i, (pick, frame) in enumerate(zip(picks, frames, strict=True))
        if frame == (recording, camera, i_frame)
    ]
    axes.imshow(marks_picture(image, marks, 2 * STUDY_TILE))
    axes.set_title(f"Reference positions ({recording})", fontsize=9)
    axes.set_axis_off()


def _draw_example(
    row: Any, dataset: Dataset, group: Mapping[str, Any], example: Mapping[str, Any], colours: Mapping[str, str]
) -> None:
    """Draw a keypoint in some frames of a demonstration: ground truth, and the position by each method."""
    tiles = np.atleast_1d(row.subplots(1, len(example["frames"])))
    keypoint = group["keypoints"][example["keypoint"]]["name"]
    row.suptitle(
        f"{keypoint} in {example['demonstration']}, {example['camera']} camera. Red: ground truth (hollow: occluded)",
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


def remeasured(dataset: Dataset) -> str:
    """The command that measures a study again."""
    return f"bask-data evaluate keypoints {shlex.quote(str(dataset.root))}"


def _frame(dataset: Dataset, recording: str, camera: str, i_frame: int) -> np.ndarray:
    source = find_recording(dataset, recording)
    if source is None or camera not in source.camera_names or not 0 <= i_frame < source.camera(camera).n_frames:
        where = f"frame {i_frame} of {camera} in {recording}"
        raise BadData(
            dataset.root, where, expected="the frame that the study used", got="none", fix=remeasured(dataset)
        )
    return source.camera(camera).rgb(i_frame)


# The likelihood model ------------------------------------------------------------------------------------------------


def _likelihood_figure(result: Mapping[str, Any], group: Mapping[str, Any]) -> Any:
    """For each network a log-log histogram of descriptor distances with p(z), and a distance map in bins."""
    from matplotlib.figure import Figure

    variants = list(group["distances"]["counts"])
    figure = Figure(figsize=(9.0, 3.2 * len(variants)), layout="constrained")
    rows = figure.subplots(len(variants), 2, width_ratios=[2.4, 1.0], squeeze=False)
    for (left, right), variant in zip(rows, variants, strict=True):
        draw_likelihood(left, result, group, variant)
        _draw_map(right, group, variant)
    return figure


def draw_likelihood(axes: Any, result: Mapping[str, Any], group: Mapping[str, Any], variant: str) -> None:
    """Draw histograms of descriptor distances by what the pixels show, and the likelihood exp(-alpha z)."""
    from matplotlib.ticker import NullFormatter

    edges = np.array(group["distances"]["edges"])
    counts = {name: np.array(count) for name, count in group["distances"]["counts"][variant].items()}
    total = max(sum(int(count.sum()) for count in counts.values()), 1)
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
    for alpha in sorted({method["settings"]["alpha"] for method in result["methods"] if method["variant"] == variant}):
        z = np.geomspace(first, last, 200)
        axes.plot(z, np.exp(-alpha * z), color="black", linewidth=1.2, linestyle="-" if alpha == PAPER_ALPHA else "--")
        at = min(np.log(1e3) / alpha, 0.7 * last)
        axes.annotate(f"exp(-{alpha:.3g} z)", (at, np.exp(-alpha * at)), fontsize=7, rotation=-50, va="bottom")
    margins = result["margins"][variant] or {}
    for margin in dict.fromkeys(margins.values()):
        names = " = ".join(f"M {name}" for name, value in margins.items() if value == margin)
        axes.axvline(margin, color="black", linewidth=0.8, linestyle=":")
        axes.annotate(names, (margin, 0.6), fontsize=7, rotation=90, va="top", ha="right")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("descriptor distance z", fontsize=8)
    axes.set_ylabel("share of the pixels; p(z)", fontsize=8)
    axes.set_title(f"{variant}: distances, and the likelihood of a match", fontsize=9)
    axes.legend(fontsize=7, loc="lower right")
    axes.tick_params(labelsize=8)


def _draw_map(axes: Any, group: Mapping[str, Any], variant: str) -> None:
    """Draw the example's distance map in logarithmic bins."""
    from matplotlib.colors import BoundaryNorm

    axes.set_axis_off()
    if not group["examples"]:
        return
    example = group["examples"][0]
    z = np.array([numbers(row) for row in example["first_map"][variant]])
    least = max(float(np.nanmin(z)), 1e-3)
    # A network that distinguishes nothing has one distance everywhere.
    bins = np.geomspace(least, max(1.001 * float(np.nanmax(z)), 2 * least), 9)
    drawn = axes.imshow(z, cmap="viridis_r", norm=BoundaryNorm(bins, 256), interpolation="nearest")
    axes.figure.colorbar(drawn, ax=axes, shrink=0.85, format="%.2f").ax.tick_params(labelsize=6)
    name = group["keypoints"][example["keypoint"]]["name"]
    axes.set_title(f"z of {name}, {example['demonstration']}, first frame", fontsize=8)


# The report's section ------------------------------------------------------------------------------------------------


def study(chosen: Chosen) -> list[Part]:
    """The dataset's last study, for each set of objects: figures by visibility, and over time."""
    file = chosen.dataset.root / FILE
    if not file.exists():
        return []
    try:
        result: Any = read_json(file)
        colours, is_stale = method_colours(result), not is_current(chosen.dataset, result)
        return [_study_part(result, name, colours, is_stale) for name in result["groups"]]
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        expected = "the result of `bask-data evaluate keypoints`"
        raise BadData(
            file, "", expected=expected, got=f"{type(error).__name__}: {error}", fix=remeasured(chosen.dataset)
        ) from error


def _study_part(result: Mapping[str, Any], name: str, colours: Mapping[str, str], is_stale: bool) -> Part:
    group = result["groups"][name]
    methods = group["methods"]
    first = next(iter(methods.values()))
    return {
        "title": name,
        "is_stale": is_stale,
        "settings": result["settings"],
        "n_keypoints": len(group["keypoints"]),
        "demonstrations": list(group["demonstrations"]),
        "phases": [
            {"name": phase, "n": figures["n"] + figures["n_unknown"]} for phase, figures in first["error"].items()
        ],
        "rows": [
            {
                "name": method,
                "colour": colours[method],
                "cells": list(figures["error"].values()),
                "close": figures["error"]["all"]["close"],
                "apart": figures["apart"]["all"]["mean"],
            }
            for method, figures in methods.items()
        ],
        "plots": [
            *(_study_plot(group, what, colours) for what in ("error", "apart")),
            _share_plot(group),
        ],
    }


def _study_plot(group: Mapping[str, Any], what: str, colours: Mapping[str, str]) -> Part:
    moments, curves, legend = np.array(group["moments"]), [], []
    for name, figures in group["methods"].items():
        over_time = figures["over_time"]
        mean, deviation = (100 * numbers(over_time[f"{what}_{moment}"]) for moment in ("mean", "deviation"))
        curves.append(Curve(moments, mean, colours[name], thick=True, deviation=deviation))
        legend.append({"name": name, "colour": colours[name], "last": None})
    highest = max((float(np.nanmax(curve.y, initial=0.0)) for curve in curves), default=0.0)
    svg = line_plot(
        curves,
        x_label="time, from the first frame to the last",
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
        curves, x_label="time, from the first frame to the last", y_label="share", x_range=(0, 1), y_range=(0, 1.02)
    )
    return {"title": "Visibility of the keypoints", "svg": svg, "legend": legend}
