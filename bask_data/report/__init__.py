"""Reports on the contents and quality of a dataset, as one page and as figures for scripts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.dataset import Dataset
from bask_data.errors import UsageError

if TYPE_CHECKING:
    from bask_data.evaluation.figures import Measured

__all__ = ["measure", "summarise", "write_report"]


def measure(dataset: Dataset) -> Measured:
    """Figures that need many frames; pass them to `write_report` and `summarise` to measure only once."""
    from bask_data.evaluation.figures import Measured

    return Measured(dataset)


def write_report(dataset: Dataset, out: Path, measured: Measured | None = None) -> Path:
    """Write a report on a dataset as one self-contained HTML file.

    Returns:
        The file, `out`.

    Raises:
        UsageError: `out` is a folder.
    """
    # Imported here: the page needs OpenCV, Open3D and Matplotlib, and the command line must start without them.
    from bask_data.report.page import render

    if out.is_dir():
        raise UsageError(out, "--out", expected="a file to write", got="a folder", fix=f"--out {out / 'report.html'}")
    html = render(dataset, measured or measure(dataset))
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = out.with_name(f".{out.name}.unfinished")
    try:
        unfinished.write_text(html, encoding="utf-8")
        unfinished.replace(out)
    finally:
        unfinished.unlink(missing_ok=True)
    return out


def summarise(dataset: Dataset, measured: Measured | None = None) -> dict[str, Any]:
    """The report's figures of all items as plain JSON values; None where a figure is unknown."""
    from bask_data.evaluation.figures import summary
    from bask_data.evaluation.judging import verdicts
    from bask_data.evaluation.verdicts import as_json

    measured = measured or measure(dataset)
    rows = verdicts(dataset, measured)
    return {**summary(dataset, measured), **({"verdicts": as_json(rows)} if rows else {})}
