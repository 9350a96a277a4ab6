"""The table of verdicts at the top of the page, and what it says of each section."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import Any

from bask_data.evaluation.verdicts import VERDICTS, StageVerdict
from bask_data.report.chosen import Part

SECTION_OF = {
    "Scans": "frames",
    "Demonstrations": "frames",
    "Surface": "reconstruction",
    "Objects": "objects",
    "Visible masks": "masks",
    "Matches": "matches",
    "Training": "training",
    "Evaluation": "evaluation",
    "Reference keypoints": "reference",
    "Tracked keypoints": "keypoints",
}
"""Section of the page that shows what each stage made."""


@dataclass(frozen=True)
class Verdicts:
    """The rows, with the sections that they lead to."""

    rows: list[StageVerdict]

    def linked(self, sections: Set[str]) -> list[Part]:
        """The rows, each with its section, empty if that is not on the page."""
        return [
            {**vars(row), "section": name if (name := SECTION_OF[row.stage]) in sections else ""} for row in self.rows
        ]

    def of_section(self, section: dict[str, Any]) -> Part:
        """The worst verdict on what a section shows, and the titles of the parts to open."""
        rows = [row for row in self.rows if SECTION_OF[row.stage] == section["name"] and row.verdict != "not made"]
        worst = [row.worst for row in rows if row.worst and row.verdict != "pass"]
        titles = [str(part.get("title", "")) for part in section["parts"]]
        return {
            "verdict": min((row.verdict for row in rows), key=VERDICTS.index, default=""),
            "open": [title for title in titles if title.split(" (")[0] in worst],
        }
