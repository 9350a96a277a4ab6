"""The report's section on how well networks find in held-out views what they saw in others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bask_data.drawing.plots import Curve, line_plot, numbers
from bask_data.report.chosen import N_ROWS, Chosen, Part

COLOURS = ("#4a90d0", "#d08020", "#3f9f74", "#a07cc0", "#c8504a")
"""Of networks; they read on a light and on a dark page."""
CURVES = {
    "error_share": ("How far the best match is from the true one", "share of the image's diagonal"),
    "error_3d": ("The same in space", "metres"),
    "closer_share": ("Pixels taken for closer than the true match", "share of the image"),
    "false_positive_share": ("How far these are from the true match", "mean, share of the image's diagonal"),
}
GROUPS = {
    "by_scale": "change of scale",
    "by_zoom": "zoomed, nothing else changed",
    "by_rotation": "rotation in the image, degrees",
    "by_turn": "turned by degrees, nothing else changed",
    "by_occlusion": "how much of the object is visible",
    "by_object": "object",
    "by_scene": "scene",
}
SPLITS = ("scale", "rotation", "occlusion")
SHADES = ("#3f9f74", "#4a90d0", "#d08020", "#c8504a")
"""Of bins."""
END_OF_SPLIT_CURVES = 0.3
"""Where curves that are told apart end, share of the image's diagonal: the same for all of them."""
NEARLY_ALL = 0.995
"""Share of the matches at which a cumulative curve has no more to tell."""


def evaluation(chosen: Chosen) -> list[Part]:
    """Figures, cumulative curves and reliability of all networks, on the same matches."""
    found = chosen.measured.descriptors()
    parts: list[Part] = [{"title": name, "error": why} for name, why in found.get("errors", {}).items()]
    if "variants" not in found:
        return parts
    variants: dict[str, Any] = found["variants"]
    colours = {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(variants)}
    part: Part = {
        "title": "",
        "measured_on": found["measured_on"],
        "n_pairs": found["n_pairs"],
        "sources": sorted(set(found["matches_by"].values())),
        "radius": found["radius_share"],
        "alpha": found["alpha"],
        "colours": colours,
        "rows": [{"name": name, **told["all"], "ece": told["calibration"]["ece"]} for name, told in variants.items()],
        "groups": [
            {"title": title, "rows": rows[:N_ROWS], "n_left_out": max(len(rows) - N_ROWS, 0)}
            for name, title in GROUPS.items()
            if (rows := _rows(variants, name))
        ],
        "plots": [
            *(_curve_plot(variants, name, colours) for name in CURVES),
            _reliability_plot(variants, colours, found["radius_share"]),
        ],
        "split_plots": _split_plots(variants),
    }
    return [*parts, part]


def _rows(variants: Mapping[str, Any], group: str) -> list[Part]:
    """Of each bin, what every network found; bins without matches are left out."""
    told = [one.get(group, {}) for one in variants.values()]
    rows = [
        {"name": name, "n": of_first["n"], "cells": [one[name] for one in told]} for name, of_first in told[0].items()
    ]
    # A single scene or object is the whole.
    return [row for row in rows if row["n"]] if len(rows) > 1 else []


def _curve_plot(variants: Mapping[str, Any], metric: str, colours: Mapping[str, str]) -> Part:
    title, x_label = CURVES[metric]
    curves, legend, end = [], [], 0.0
    for name, told in variants.items():
        x, y = (numbers(told["curves"][metric][key]) for key in ("threshold", "share"))
        curves.append(Curve(x, y, colours[name], thick=True))
        legend.append({"name": name, "colour": colours[name], "last": told["all"][f"area_{metric}"]})
        reached = x[y >= NEARLY_ALL]
        end = max(end, float(reached[0]) if len(reached) else float(x[-1]))
    svg = line_plot(curves, x_label=x_label, y_label="share of the matches", x_range=(0.0, end), y_range=(0, 1.02))
    return {"title": title, "svg": svg, "legend": legend}


def _split_plots(variants: Mapping[str, Any]) -> list[Part]:
    """Cumulative curves of the error, told apart: a plot for each network and what its matches are told apart by."""
    plots = []
    for split in SPLITS:
        for name, told in variants.items():
            x = numbers(told["curves"]["error_share"]["threshold"])
            bins = {
                bin_: one["error_share"]
                for bin_, one in told["curves_by"][split].items()
                if one["error_share"][0] is not None
            }
            if len(bins) < 2:
                continue
            curves = [Curve(x, numbers(y), SHADES[i % len(SHADES)], thick=True) for i, y in enumerate(bins.values())]
            areas = [told[f"by_{split}"][bin_]["area_error_share"] for bin_ in bins]
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
    for name, told in variants.items():
        found = told["calibration"]
        known = numbers(found["n"]) > 0
        promised, kept = (numbers(found[key])[known] for key in ("confidence", "accuracy"))
        curves.append(Curve(promised, kept, colours[name], thick=True))
        legend.append({"name": f"{name}, calibration error", "colour": colours[name], "last": found["ece"]})
    svg = line_plot(
        curves,
        x_label="share of the heat map near the best match",
        y_label="share of true matches there",
        x_range=(0.0, 1.0),
        y_range=(0, 1.02),
    )
    caption = (
        f"Near is within {radius:.0%} of the image's diagonal. Above the dashed line a network knows more than "
        "it says, below it promises too much."
    )
    return {"title": "Is the heat map's probability true?", "svg": svg, "legend": legend, "caption": caption}
