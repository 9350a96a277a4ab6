"""Pieces of what a notebook shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

THUMBNAIL = 240
"""Pixels of the longer side of a picture in a notebook."""


def picture_html(rgb: np.ndarray) -> str:
    """A small picture (h, w, 3) uint8 as an `<img>` that needs no file."""
    import cv2

    from bask_data.drawing.images import jpeg_uri

    height, width = rgb.shape[:2]
    share = min(THUMBNAIL / max(height, width), 1.0)
    size = (max(round(width * share), 1), max(round(height * share), 1))
    picture = jpeg_uri(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
    return f'<img alt="" style="display: inline; margin: 0 3px 0 0" src="{picture}">'


def table_html(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table of plain text."""
    head = "".join(f'<th style="text-align: left">{escape(name)}</th>' for name in columns)
    body = "".join(
        "<tr>" + "".join(f'<td style="text-align: left">{escape(str(cell))}</td>' for cell in row) + "</tr>"
        for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"
