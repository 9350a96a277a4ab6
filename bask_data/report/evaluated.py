"""The section on descriptor networks: matches found in held-out views, compared with ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bask_data.drawing.plots import Curve, line_plot, numbers
from bask_data.report.chosen import N_ROWS, Chosen, Part

COLOURS = ("#4a90d0", "#d08020", "#3f9f74", "#a07cc0", "#c8504a")
"""Colours of networks, legible on light and dark pages."""
CURVES = {
    "error_share": ("Error of the best match", "share of the image's diagonal"),
    "error_3d": ("Error of the best match in 3D", "metres"),
    "closer_share": ("False positives: pixels closer than the true match", "share of the image"),
    "false_positive_share": ("Distance of false positives from the true match", "mean, share of the image's diagonal"),
}
GROUPS = {
    "by_scale": "change of scale",
    "by_zoom": "zoom alone",
    "by_rotation": "rotation in the image, degrees",
    "by_turn": "rotation alone, degrees",
    "by_occlusion": "visible share of the object",
    "by_object": "object",
    "by_scene": "scene",
}
SPLITS = ("scale", "rotation", "occlusion")
SHADES = ("#3f9f74", "#4a90d0", "#d08020", "#c8504a")
"""Colours of bins."""
END_OF_SPLIT_CURVES = 0.3
"""End of the curves by bin, share of the image's diagonal; the same for all plots."""
NEARLY_ALL = 0.995
"""Share of the matches at which a cumulative curve is cut off."""


def evaluation(chosen: Chosen) -> list[Part]:
    """Figures, cumulative curves and reliability of all networks, on the same matches."""
    result = chosen.measured.descriptors()
    parts: list[Part] = [{"title": name, "error": why} for name, why in result.get("errors", {}).items()]
    if "variants" not in result:
        return parts
    variants: dict[str, Any] = result["variants"]
    colours = {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(variants)}
    part: Part = {
        "title": "",
        "measured_on": result["measured_on"],
        "n_pairs": result["n_pairs"],
        "sources": sorted(set(result["matches_by"].values())),
        "radius": result["radius_share"],
        "alpha": result["alpha"],
        "colours": colours,
        "rows": [
            {"name": name, **figures["all"], "ece": figures["calibration"]["ece"]} for name, figures in variants.items()
        ],
        "groups": [
            {"title": title, "rows": rows[:N_ROWS], "n_left_out": max(len(rows) - N_ROWS, 0)}
            for name, title in GROUPS.items()
            if (rows := _rows(variants, name))
        ],
        "plots": [
            *(_curve_plot(variants, name, colours) for name in CURVES),
            _reliability_plot(variants, colours, result["radius_share"]),
        ],
        "split_plots": _split_plots(variants),
    }
    return [*parts, part]


def _rows(variants: Mapping[str, Any], group: str) -> list[Part]:
    """Each bin's figures of every network; bins without matches are left out."""
    bins = [figures.get(group, {}) for figures in variants.values()]
    rows = [
        {"name": name, "n": of_first["n"], "cells": [of_network[name] for of_network in bins]}
        for name, of_first in bins[0].items()
    ]
    # A single scene or object would only repeat the figures of all matches.
    return [row for row in rows if row["n"]] if len(rows) > 1 else []


def _curve_plot(variants: Mapping[str, Any], metric: str, colours: Mapping[str, str]) -> Part:
    title, x_label = CURVES[metric]
    curves, legend, end = [], [], 0.0
    for name, figures in variants.items():
        x, y = (numbers(figures["curves"][metric][key]) for key in ("threshold", "share"))
        curves.append(Curve(x, y, colours[name], thick=True))
        legend.append({"name": name, "colour": colours[name], "last": figures["all"][f"area_{metric}"]})
        reached = x[y >= NEARLY_ALL]
        end = max(end, float(reached[0]) if len(reached) else float(x[-1]))
    svg = line_plot(curves, x_label=x_label, y_label="share of the matches", x_range=(0.0, end), y_range=(0, 1.02))
    return {"title": title, "svg": svg, "legend": legend}


def _split_plots(variants: Mapping[str, Any]) -> list[Part]:
    """Cumulative curves of the error by bin: a plot for each network and each way of binning."""
    plots = []
    for split in SPLITS:
        for name, figures in variants.items():
            x = numbers(figures["curves"]["error_share"]["threshold"])
            bins = {
                bin_: curves["error_share"]
                for bin_, curves in figures["curves_by"][split].items()
                if curves["error_share"][0] is not None
            }
            if len(bins) < 2:
                continue
            curves = [Curve(x, numbers(y), SHADES[i % len(SHADES)], thick=True) for i, y in enumerate(bins.values())]
            areas = [figures[f"by_{split}"][bin_]["area_error_share"] for bin_ in bins]
            svg = line_plot(
                curves,
                x_label="share of the diagonal",
                y_label="share of the matches",
                x_range=(0, END_OF_SPLIT_CURVES),
                y_range=(0, 1.02),
            )
            legend = [
                {"name": bin_, "colour": curve.colour, "last": area}
                for bin_, curve, area in zip(bins, curves, areas, strict=True)
            ]
            plots.append({"title": f"{name}: {GROUPS[f'by_{split}']}", "svg": svg, "legend": legend})
    return plots


def _reliability_plot(variants: Mapping[str, Any], colours: Mapping[str, str], radius: float) -> Part:
    curves, legend = [Curve(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "", dashed=True)], []
    for name, figures in variants.items():
        calibration = figures["calibration"]
        known = numbers(calibration["n"]) > 0
        confidence, accuracy = (numbers(calibration[key])[known] for key in ("confidence", "accuracy"))
        curves.append(Curve(confidence, accuracy, colours[name], thick=True))
        legend.append({"name": f"{name}, calibration error", "colour": colours[name], "last": calibration["ece"]})
    svg = line_plot(
        curves,
        x_label="probability near the best match",
        y_label="share of true matches near it",
        x_range=(0.0, 1.0),
        y_range=(0, 1.02),
    )
    caption = (
        f"Near means within {radius:.0%} of the image's diagonal. Above the dashed line a network is underconfident, "
        "below it overconfident."
    )
    return {"title": "Calibration of the heat map", "svg": svg, "legend": legend, "caption": caption}
