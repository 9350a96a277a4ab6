"""The section on training: loss terms and validation metrics over the steps."""

from __future__ import annotations

from typing import Any

import numpy as np

from bask_data.drawing.colours import css, palette
from bask_data.drawing.plots import Curve, line_plot
from bask_data.evaluation.network_figures import descriptor_figures
from bask_data.kinds import DescriptorNet
from bask_data.report.chosen import N_ITEMS, Chosen, Part, per_item, untitled_if_alone


def training(chosen: Chosen) -> list[Part]:
    """Loss terms and validation metrics over the steps."""

    def part(variant: str) -> Part:
        descriptor = chosen.networks[variant]
        numbers = descriptor_figures(descriptor)
        marked = numbers["step"] if numbers["chosen_by"] is not None else None
        return {
            "title": variant,
            "numbers": numbers,
            "metrics": numbers["metrics"],
            "plots": _curve_plots(descriptor, marked),
        }

    return untitled_if_alone(per_item(list(chosen.networks), part))


def _curve_plots(descriptor: DescriptorNet, marked_step: int | None) -> list[Part]:
    """A plot per family of terms that share a scale, with a line at the step of the saved weights."""
    table = descriptor.curve()
    step, names, value = table["step"].to_numpy(), np.array(table["name"].to_pylist(), dtype=object), table["value"]
    values = value.to_numpy()
    families: dict[str, list[str]] = {}
    for name in dict.fromkeys(names.tolist()):
        families.setdefault(_family(name), []).append(name)
    plots = []
    for family, members in families.items():
        colours = [css(colour) for colour in palette(len(members))]
        curves, legend = [], []
        for name, colour in list(zip(members, colours, strict=True))[: N_ITEMS * 4]:
            chosen = names == name
            curves.append(_curve(step[chosen], values[chosen], colour))
            legend.append({"name": name, "colour": colour, "last": float(values[chosen][-1])})
        plots.append({"title": family, "svg": _training_plot(curves, family, marked_step), "legend": legend})
    return plots


def _family(name: str) -> str:
    lowered = name.lower()
    for word, family in (
        ("loss", "loss"),
        ("pck", "share of matches within 1, 2, 4, 8 % of the diagonal"),
        ("px", "error in pixels"),
        ("pixel", "error in pixels"),
        ("rate", "learning rate"),
        ("accuracy", "shares"),
        ("share", "shares"),
        ("fraction", "shares"),
    ):
        if word in lowered:
            return family
    return name if len(name) < 40 else "other"


def _curve(x: np.ndarray, y: np.ndarray, colour: str) -> Any:
    # Long curves are noisy, so means over short stretches are drawn.
    stride = max(len(x) // 400, 1)
    n = len(x) // stride * stride
    return Curve(
        x[:n].reshape(-1, stride).mean(axis=1), y[:n].reshape(-1, stride).mean(axis=1), colour, thick=len(x) < 50
    )


def _training_plot(curves: list[Any], family: str, marked_step: int | None) -> str:
    share = family.startswith("share")
    return line_plot(
        curves,
        x_label="optimiser steps",
        y_label="share" if share else "pixels" if "pixel" in family else "value",
        logarithmic=family == "loss",
        marked_x=marked_step,
        y_range=(0, 1.02) if share else None,
    )
