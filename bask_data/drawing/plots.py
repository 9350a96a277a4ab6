"""Plots as inline SVG in the page's text colour, legible on light and dark pages."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

_INK = "#010203"
"""A placeholder for the page's text colour."""
_BAR = "#5f93cc"
"""Colour of histogram bars; legible on light and dark pages."""


@dataclass(frozen=True)
class Curve:
    """One line of a plot; an empty colour is that of the text."""

    x: np.ndarray
    y: np.ndarray
    colour: str
    thick: bool = False
    dashed: bool = False
    dots: bool = False
    """Points only, not joined."""
    deviation: np.ndarray | None = None
    """Half-width of a shaded band around the curve, cut off at zero."""


def numbers(values: Sequence[float | None]) -> np.ndarray:
    """Values from JSON as an array (n,); None becomes NaN."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def line_plot(
    curves: Sequence[Curve],
    *,
    x_label: str,
    y_label: str,
    logarithmic: bool = False,
    x_range: tuple[float, float] | None = None,
    y_range: tuple[float, float] | None = None,
    marked_x: float | None = None,
) -> str:
    """Curves over common axes, as an SVG element.

    Axis labels must be constants: names from files belong in HTML, where they are escaped.

    Args:
        marked_x: position of a vertical line.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    with _canvas(x_label, y_label) as (axes, drawn):
        for curve in curves:
            if curve.deviation is not None:
                low, high = np.maximum(curve.y - curve.deviation, 0.0), curve.y + curve.deviation
                axes.fill_between(curve.x, low, high, color=curve.colour or _INK, alpha=0.13, linewidth=0)
            axes.plot(
                curve.x,
                curve.y,
                color=curve.colour or _INK,
                linewidth=2.2 if curve.thick else 0.9,
                alpha=1.0 if curve.thick else 0.75,
                linestyle="" if curve.dots else "--" if curve.dashed else "-",
                marker="o" if curve.dots or np.isfinite(curve.y).sum() <= 20 else "",
                markersize=6 if curve.dots else 3.5 if curve.thick else 2,
            )
        if x_range:
            axes.set_xlim(*x_range)
        if marked_x is not None:
            axes.axvline(marked_x, color=_INK, linewidth=1.2, linestyle=":")
        if logarithmic and any((curve.y[np.isfinite(curve.y)] > 0).any() for curve in curves):
            axes.set_yscale("log")
            # The default labels whole powers of ten only, as TeX, and the range may contain none.
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        elif y_range:
            axes.set_ylim(*y_range)
        else:
            axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    return drawn[0]


def histogram(values: np.ndarray, *, x_label: str, y_label: str, n_bins: int = 24, logarithmic: bool = False) -> str:
    """A histogram as an SVG element; on a logarithmic axis, each bin spans the same factor."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    if logarithmic:
        low, high = max(low, 1e-6), max(high, 1e-6)
        edges = np.geomspace(min(low, 0.9 * high), high * (1 + 1e-9), n_bins + 1)
    else:
        edges = np.linspace(low, max(high, low + 1e-6), n_bins + 1)
    counts, _ = np.histogram(values, edges)
    with _canvas(x_label, y_label, (3.4, 1.9)) as (axes, drawn):
        axes.stairs(counts, edges, fill=True, color=_BAR)
        if logarithmic:
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        axes.yaxis.get_major_locator().set_params(integer=True)
    return drawn[0]


@contextmanager
def _canvas(x_label: str, y_label: str, size: tuple[float, float] = (5.2, 2.5)) -> Iterator[tuple[Any, list[str]]]:
    """Axes to draw on, and a list that holds the SVG element afterwards."""
    import matplotlib
    from matplotlib.figure import Figure

    style: Any = {
        "svg.fonttype": "none",
        "svg.hashsalt": "bask-data",
        "font.family": "sans-serif",
        "font.size": 9,
        "text.parse_math": False,
        "text.color": _INK,
        "axes.edgecolor": _INK,
        "axes.labelcolor": _INK,
        "xtick.color": _INK,
        "ytick.color": _INK,
        "grid.color": "#888888",
        "grid.alpha": 0.3,
        "path.simplify_threshold": 0.5,
    }
    drawn: list[str] = []
    with matplotlib.rc_context(style):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.add_subplot()
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        axes.grid(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        yield axes, drawn
        text = io.StringIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    drawn.append(_inline(text.getvalue()))


def _inline(document: str) -> str:
    """The `<svg>` element alone, without what a stand-alone file needs, in the page's text colour."""
    svg = document[document.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", svg)
    # A fixed width and height would keep it from shrinking on a phone; the view box is enough.
    svg = re.sub(r'(<svg[^>]*?)\swidth="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?)\sheight="[^"]*"', r"\1", svg, count=1)
    # Matplotlib repeats its ids from plot to plot; on one page they must differ.
    prefix = "p" + hashlib.sha256(svg.encode()).hexdigest()[:8]
    svg = re.sub(r'\sid="', f' id="{prefix}-', svg)
    svg = re.sub(r'(url\(|href=")#', rf"\1#{prefix}-", svg)
    return svg.replace(_INK, "currentColor").strip()
