"""Reports: what a dataset holds and how good it is, as one page to look at and as figures for a script."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bask_data.dataset import Dataset

__all__ = ["summarise", "write_report"]


def write_report(dataset: Dataset, out: Path) -> Path:
    """Write one self-contained HTML file about a dataset: it loads nothing from anywhere.

    Returns:
        The file, `out`.
    """
    # Imported here: the page needs OpenCV, Open3D and Matplotlib, and the command line must start without them.
    from bask_data.report.page import render

    html = render(dataset)
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = out.with_name(f".{out.name}.unfinished")
    unfinished.write_text(html, encoding="utf-8")
    unfinished.replace(out)
    return out


def summarise(dataset: Dataset) -> dict[str, Any]:
    """The report's figures of all items as plain JSON values; None where a figure is not known."""
    from bask_data.report.figures import summary

    return summary(dataset)
