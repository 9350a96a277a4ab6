"""The certainty of a study's tracks: nominal against measured shares, and a row of figures for each method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bask_data.drawing.plots import Curve, line_plot, numbers
from bask_data.evaluation.certainty import OF_CERTAINTY
from bask_data.report.chosen import Part


def certainty(group: Mapping[str, Any], colours: Mapping[str, str]) -> Part | None:
    """A calibration curve for each method, and its figures; None for a study made before there were any.

    Args:
        group: figures of a study for one set of objects.
        colours: by method.
    """
    methods = {name: figures["certainty"] for name, figures in group["methods"].items() if "certainty" in figures}
    if not methods:
        return None
    return {
        "phases": list(OF_CERTAINTY),
        "cameras": list(next(iter(methods.values()))["observed"]),
        "rows": [
            {
                "name": name,
                "colour": colours[name],
                **found["coverage"]["all"],
                "errors": [found["coverage"][phase]["calibration_error"] for phase in OF_CERTAINTY],
                "claims": [found["localised"], *found["observed"].values()],
            }
            for name, found in methods.items()
        ],
        "plot": _calibration_plot({name: found["coverage"]["all"] for name, found in methods.items()}, colours),
    }


def _calibration_plot(coverages: Mapping[str, Mapping[str, Any]], colours: Mapping[str, str]) -> Part:
    """Measured against nominal shares; the dashed diagonal is a calibrated belief."""
    diagonal = np.linspace(0.0, 1.0, 41)  # Curves of up to 20 points are drawn with markers.
    curves = [Curve(diagonal, diagonal, "", dashed=True)]
    legend = [{"name": "calibrated", "colour": "currentColor", "last": None}]
    for name, found in coverages.items():
        nominal, measured = numbers(found["nominal"]), numbers(found["measured"])
        curves.append(Curve(nominal, measured, colours[name], thick=True))
        legend.append({"name": name, "colour": colours[name], "last": None})
    svg = line_plot(
        curves,
        x_label="nominal share in the ellipsoid",
        y_label="measured share",
        x_range=(0, 1),
        y_range=(0, 1.02),
    )
    return {"title": "Certainty: measured against nominal shares", "svg": svg, "legend": legend}
