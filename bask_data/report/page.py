"""The report's page: figures and pictures of every section that has something to show, in one HTML file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jinja2
import markupsafe

from bask_data import __version__
from bask_data.dataset import Dataset
from bask_data.evaluation.figures import Measured
from bask_data.evaluation.lookup import UNREADABLE, what_is_wrong
from bask_data.report import evaluated, heat, sections, study

TEMPLATE = "page.html.j2"
MOST_BYTES = 8_000_000
"""A larger page cannot be sent around."""
N_FRAMES = (8, 4, 2)
"""Frames of each camera: what is tried, in this order, to stay below `MOST_BYTES`."""
NBSP = "\u00a0"
"""A number and its unit stay on one line."""


def render(dataset: Dataset, measured: Measured) -> str:
    """The page as text, with as many frames of each camera as fit into `MOST_BYTES`."""
    for n_frames in N_FRAMES:
        html = _rendered(dataset, measured, n_frames)
        if len(html) <= MOST_BYTES:
            break
    return html


def _rendered(dataset: Dataset, measured: Measured, n_frames: int) -> str:
    chosen = sections.choose(dataset, measured, n_frames)
    built = [_built(name, title, make, chosen) for name, title, make in SECTIONS]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(FILTERS)
    return environment.get_template(TEMPLATE).render(
        dataset=dataset.file,
        version=__version__,
        sections=[section for section in built if section],
        summary=sections.overview(chosen),
    )


SECTIONS: list[tuple[str, str, Callable[[sections.Chosen], Any]]] = [
    ("frames", "Input frames", sections.frames),
    ("reconstruction", "Reconstruction", sections.reconstruction),
    ("objects", "Objects", sections.objects),
    ("masks", "Masks over frames", sections.masks),
    ("matches", "Matches between two views", sections.matches),
    ("training", "Training", sections.training),
    ("evaluation", "How well networks find true matches", evaluated.evaluation),
    ("reference", "Reference keypoints", sections.reference),
    ("heat", "Correspondence heat maps", heat.heat_maps),
    ("keypoints", "Keypoints tracked", sections.tracks),
    ("study", "How right tracked keypoints are", study.study),
]


def _built(name: str, title: str, make: Callable[[sections.Chosen], Any], chosen: sections.Chosen) -> Any:
    """A section's parts, or None without any; an artifact that cannot be read says so in place of its pictures."""
    try:
        parts = make(chosen)
    except UNREADABLE as error:
        parts = [{"title": "", "error": what_is_wrong(error)}]
    return {"name": name, "title": title, "parts": parts} if parts else None


def number(value: object, digits: int = 3) -> str:
    """A number as people write it; a dash where it is not known."""
    if value is None or (isinstance(value, float) and value != value):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        if value.is_integer() and abs(value) < 1e6:
            return f"{int(value):,}"
        return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:,.0f}"
    if isinstance(value, (list, tuple)):
        return ", ".join(number(one, digits) for one in value)
    return str(value)


def percent(value: float | None) -> str:
    """A share in percent."""
    if value is None or value != value:
        return "–"
    return f"{100 * value:.1f}{NBSP}%" if 0 < value < 0.0995 else f"{100 * value:.0f}{NBSP}%"


def millimetres(value: float | None) -> str:
    """Metres, written in millimetres below one metre, so that a column of them compares at a glance."""
    if value is None or value != value:
        return "–"
    if value >= 1:
        return f"{value:.2f}{NBSP}m"
    return f"{1000 * value:.1f}{NBSP}mm" if value < 0.0995 else f"{1000 * value:.0f}{NBSP}mm"


def size(value: float | None) -> str:
    """Bytes."""
    if value is None:
        return "–"
    return (
        f"{value / 1e9:.1f}{NBSP}GB"
        if value >= 1e9
        else f"{value / 1e6:.1f}{NBSP}MB"
        if value >= 1e5
        else f"{value / 1e3:.0f}{NBSP}kB"
    )


def duration(value: float | None) -> str:
    """Seconds."""
    if value is None:
        return "–"
    return f"{value:.1f}{NBSP}s" if value < 100 else f"{int(value) // 60}{NBSP}min {int(value) % 60:02d}{NBSP}s"


def svg(text: str) -> markupsafe.Markup:
    """A plot of ours, which is markup; nothing else on the page is."""
    return markupsafe.Markup(text)  # Drawn by `plots`, which puts no text of others in it.


FILTERS = {
    "number": number,
    "percent": percent,
    "mm": millimetres,
    "size": size,
    "duration": duration,
    "svg": svg,
}
