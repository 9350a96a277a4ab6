"""The report's page: figures and pictures of every section that has something to show, in one HTML file."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import jinja2

from bask_data import __version__
from bask_data.dataset import Dataset
from bask_data.evaluation.figures import Measured
from bask_data.evaluation.judging import verdicts
from bask_data.evaluation.lookup import UNREADABLE, what_is_wrong
from bask_data.evaluation.verdicts import StageVerdict, next_step
from bask_data.report import evaluated, heat, keypoints, networks, study, surfaces, views
from bask_data.report.chosen import Chosen, choose
from bask_data.report.overview import overview
from bask_data.report.verdict_table import Verdicts
from bask_data.report.words import FILTERS

TEMPLATE = "page.html.j2"
SCRIPT = Path(__file__).with_name("surface.js")
"""The only script of the page; its digest is in the page's policy, so that no other can run."""
MOST_PAGE_BYTES = 8_000_000
"""Size of the page, at most, so that it can be sent by mail."""
FRAMES_TRIED = (8, 4, 2)
"""Frames of each camera, tried in this order until the page fits into `MOST_PAGE_BYTES`."""


def render(dataset: Dataset, measured: Measured) -> str:
    """The page as text, with as many frames of each camera as fit into `MOST_PAGE_BYTES`."""
    rows = verdicts(dataset, measured)
    for n_frames in FRAMES_TRIED:
        html = _rendered(choose(dataset, measured, n_frames, [row.worst for row in rows]), rows)
        if len(html) <= MOST_PAGE_BYTES:
            break
    return html


def _rendered(chosen: Chosen, rows: list[StageVerdict]) -> str:
    table = Verdicts(rows)
    built = [_built(name, title, make, chosen) for name, title, make in SECTIONS]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(FILTERS)
    sections = [section for section in built if section]
    names = {section["name"] for section in sections}
    # A page without a surface runs nothing.
    script = SCRIPT.read_text(encoding="utf-8") if any(_has_surface(section) for section in sections) else ""
    return environment.get_template(TEMPLATE).render(
        dataset=chosen.dataset.file,
        version=__version__,
        sections=[{**section, **table.of_section(section)} for section in sections],
        summary=overview(chosen),
        script=script,
        script_digest=b64encode(sha256(script.encode()).digest()).decode(),
        verdicts={"rows": table.linked(names), "next": next_step(rows)},
    )


SECTIONS: list[tuple[str, str, Callable[[Chosen], Any]]] = [
    ("frames", "Input frames", views.frames),
    ("reconstruction", "Reconstruction", surfaces.reconstruction),
    ("objects", "Objects", surfaces.objects),
    ("masks", "Visible masks", views.masks),
    ("matches", "Matches between two views", views.matches),
    ("training", "Training", networks.training),
    ("evaluation", "Evaluation of descriptor networks", evaluated.evaluation),
    ("reference", "Reference keypoints", keypoints.reference),
    ("heat", "Heat maps", heat.heat_maps),
    ("keypoints", "Tracked keypoints", keypoints.tracks),
    ("study", "Accuracy of tracked keypoints", study.study),
]


def _has_surface(section: dict[str, Any]) -> bool:
    return any(part.get("surface") for part in section["parts"])


def _built(name: str, title: str, make: Callable[[Chosen], Any], chosen: Chosen) -> Any:
    """A section with its parts, or None without any; an unreadable artifact becomes a part with the error."""
    try:
        parts = make(chosen)
    except UNREADABLE as error:
        parts = [{"title": "", "error": what_is_wrong(error)}]
    return {"name": name, "title": title, "parts": parts} if parts else None
