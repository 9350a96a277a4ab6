from __future__ import annotations

import numpy as np

from bask_data.drawing.plots import Curve, line_plot


def test_plots_take_the_page_s_text_colour_and_load_nothing():
    x = np.arange(50.0)
    svg = line_plot([Curve(x, 1 / (x + 1), "#d08020"), Curve(x, x, "")], x_label="frame", y_label="m", logarithmic=True)
    assert svg.startswith("<svg")
    assert svg.endswith("</svg>")
    assert "currentColor" in svg
    assert "http" not in svg
    assert "mathdefault" not in svg


def test_an_empty_curve_still_gives_a_plot():
    assert "<svg" in line_plot([Curve(np.arange(3), np.full(3, np.nan), "")], x_label="", y_label="", logarithmic=True)
    assert "<svg" in line_plot([], x_label="", y_label="")
