"""The figure of the likelihood model: histograms of descriptor distances, and a distance map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bask_data.drawing.plots import numbers

PAPER_ALPHA = 4.0
"""The paper's temperature, p(z) = exp(-4 z), von Hartz et al. 2023, Sec. III-B: drawn solid, others dashed."""
GROUP_COLOURS = {"near": "#2f9e5b", "objects": "#e08a1e", "background": "#8b8b95"}
GROUP_NAMES = {"near": "around the keypoint", "objects": "elsewhere on objects", "background": "background"}


def likelihood_figure(result: Mapping[str, Any], group: Mapping[str, Any]) -> Any:
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
