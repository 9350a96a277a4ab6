"""An examination as lines for a terminal, and as a document for scripts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

from bask_data.doctor.examination import Examination, by_place
from bask_data.findings import CODES, SEVERITIES, Code, Finding
from bask_data.spelling import number_of

FailOn = Literal["error", "warning", "warn", "note", "never"]
"""The least severity that fails a command; `warn` is `warning`."""


def lines(examination: Examination) -> Iterator[str]:
    """Findings by place, the worst first, then what was found right, and the counts."""
    for place, findings in by_place(examination.all_findings).items():
        yield place
        for finding in findings:
            yield from _of_finding(place, finding)
    if examination.all_right:
        yield "right"
        yield from (f"  {sentence}" for sentence in examination.all_right)
    yield summary(examination)


def _of_finding(place: str, finding: Finding) -> Iterator[str]:
    where = finding.place[len(place) :].strip()
    yield f"  {finding.severity:<8} {finding.code}{f', frame {where}' if where else ''}: {finding.meaning}"
    if finding.evidence:
        yield f"           {finding.evidence}"
    if finding.fix:
        yield f"           fix: {finding.fix}"


def summary(examination: Examination) -> str:
    """What was found in one line."""
    counts = ", ".join(number_of(examination.count(severity), severity) for severity in SEVERITIES)
    found = number_of(len(examination.all_right), "check") + " found right"
    return f"{examination.subject}: {counts}; {found}."


def document(examination: Examination, fail_on: FailOn) -> dict[str, Any]:
    """All of it but the pictures, as plain values."""
    return {
        "subject": examination.subject,
        "read_as": examination.read_as,
        "counts": {severity: examination.count(severity) for severity in SEVERITIES},
        "failed": fails(examination, fail_on),
        "findings": [finding.as_json() for finding in examination.all_findings],
        "right": examination.all_right,
        "cameras": [
            {
                "place": camera.place,
                **camera.facts,
                "evidence": [vars(each) for each in camera.evidence],
            }
            for camera in examination.cameras
        ],
        "assumptions": examination.assumptions,
    }


def fails(examination: Examination, fail_on: FailOn) -> bool:
    """Whether the findings fail the command."""
    if fail_on == "never":
        return False
    return examination.reaches("warning" if fail_on == "warn" else fail_on)


def codes_table() -> str:
    """All codes as a table in Markdown, for the documentation."""

    def row(name: str, code: Code) -> str:
        return f"| `{name}` | {code.severity} | {code.meaning} |"

    head = ["| code | severity | meaning |", "|---|---|---|"]
    return "\n".join([*head, *(row(name, code) for name, code in CODES.items())])
