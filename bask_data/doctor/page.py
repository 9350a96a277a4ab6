"""The doctor's page: findings, evidence and pictures in one HTML file that loads nothing from elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jinja2

from bask_data import __version__
from bask_data.doctor.examination import Bar, Examination, ExaminedCamera, Picture, by_place
from bask_data.doctor.text import summary
from bask_data.drawing.images import jpeg_uri
from bask_data.errors import UsageError
from bask_data.findings import SEVERITIES

TEMPLATE = "page.html.j2"
MOST_PICTURES = 200
"""Pictures on a page, at most, 40 kB each, so that it can be sent by mail."""
MOST_READINGS = 8
"""Readings shown of a camera, the best first."""
VERDICTS = {"error": "Results will be wrong.", "warning": "Look at the warnings.", "note": "Nothing wrong was found."}


def write_page(examination: Examination, out: Path) -> Path:
    """Write an examination as one self-contained HTML file.

    Returns:
        The file, `out`.

    Raises:
        UsageError: `out` is a folder.
    """
    if out.is_dir():
        fix = f"--report {out / 'doctor.html'}"
        raise UsageError(out, "--report", expected="a file to write", got="a folder", fix=fix)
    html = render(examination)
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = out.with_name(f".{out.name}.unfinished")
    try:
        unfinished.write_text(html, encoding="utf-8")
        unfinished.replace(out)
    finally:
        unfinished.unlink(missing_ok=True)
    return out


def render(examination: Examination) -> str:
    """The page as text."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    n_pictures = sum(len(camera.edges) + len(camera.odd_frames) for camera in examination.cameras)
    step = -(-n_pictures // MOST_PICTURES) if n_pictures else 1
    worst = next((severity for severity in SEVERITIES if examination.count(severity)), "note")
    return environment.get_template(TEMPLATE).render(
        version=__version__,
        subject=examination.subject,
        read_as=examination.read_as,
        worst=worst,
        verdict=VERDICTS[worst],
        summary=summary(examination),
        counts=[(severity, examination.count(severity)) for severity in SEVERITIES],
        groups=by_place(examination.all_findings),
        right=examination.all_right,
        cameras=[_of_camera(camera, step) for camera in examination.cameras],
        assumptions=examination.assumptions,
    )


def _of_camera(camera: ExaminedCamera, step: int) -> dict[str, Any]:
    return {
        "place": camera.place,
        "facts": facts_in_words(camera.facts),
        "bars": [_bar(each) for each in camera.evidence[:MOST_READINGS]],
        "edges": [_tile(each) for each in camera.edges[::step]],
        "odd_frames": [_tile(each) for each in camera.odd_frames[::step]],
    }


def _bar(evidence: Bar) -> dict[str, Any]:
    return {
        "name": evidence.reading,
        "percent": round(100 * max(0.0, min(1.0, evidence.share)), 1),
        "is_told": evidence.is_told,
    }


def _tile(picture: Picture) -> dict[str, str]:
    return {"uri": jpeg_uri(picture.rgb), "text": picture.text}


def facts_in_words(facts: dict[str, Any]) -> list[str]:
    """Figures of a camera for readers."""
    if not facts:
        return []
    depth = "no depth" if facts["depth_m"] is None else f"median depth {facts['depth_m']:.2f} m"
    return [
        f"{facts['n_frames']:,} frames of {facts['width']} × {facts['height']}",
        f"{facts['seconds']:.1f} s",
        f"moved {facts['path_m']:.2f} m",
        f"depth at {facts['depth_share']:.0%} of the pixels",
        depth,
    ]
