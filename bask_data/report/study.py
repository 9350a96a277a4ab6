"""The report's section on the keypoint study."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bask_data.artifact import read_json
from bask_data.drawing.plots import Curve, line_plot, numbers
from bask_data.errors import BadData
from bask_data.evaluation.keypoint_study import FILE, is_current
from bask_data.report.certainty import certainty
from bask_data.report.chosen import Chosen, Part
from bask_data.report.study_style import COLOURS, LABELS, method_colours, remeasured


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
        # Studies from before they were compared have none.
        "verdicts": [pair["verdict"] for pair in group.get("comparisons", [])],
        "plots": [
            *(_study_plot(group, what, colours) for what in ("error", "apart")),
            _share_plot(group),
        ],
        "certainty": certainty(group, colours),
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
