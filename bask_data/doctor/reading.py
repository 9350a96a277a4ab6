"""What depth says about poses, unit and clock, as findings."""

from __future__ import annotations

from bask_data.doctor.examination import Bar
from bask_data.findings import Finding
from bask_data.formats.verdict import STILL, Agreement


def reading_findings(place: str, agreement: Agreement) -> list[Finding]:
    """What is wrong, or cannot be told, about the way a camera was read; empty if depth is sure that it is right."""
    if agreement.verdict == "fits":
        return []
    fix = agreement.fix
    if agreement.options:
        fix = f"read it with {agreement.options}"
    if agreement.verdict == "other":
        return [Finding(_code_of(agreement), place, agreement.text, fix)]
    if agreement.verdict == "nothing fits":
        fix = "check that poses, depth and intrinsics belong together, and depth's unit"
        return [Finding("poses-unrelated", place, agreement.text, fix)]
    if agreement.verdict == "moved":
        return [Finding("camera-moved", place, agreement.text, "give the poses of this recording, one for each frame")]
    if agreement.n_pairs == 0:
        return [Finding("few-views", place, agreement.text)]
    if agreement.rivals == (STILL,):
        return [Finding("hardly-moves", place, agreement.text)]
    return [Finding("reading-unknown", place, agreement.text, "check the conventions yourself: docs/conventions.md")]


def _code_of(agreement: Agreement) -> str:
    said = agreement.options or agreement.better
    if said.startswith("--depth-is"):
        return "other-depth"
    if said.startswith("the pose of"):
        return "other-clock"
    if said.startswith(("--depth-scale", "--pose-unit", "depth ", "distances ")):
        return "other-unit"
    return "other-reading"


def evidence_of(agreement: Agreement) -> tuple[Bar, ...]:
    """The readings that were compared, as far as they are known, the best first."""
    if agreement.n_pairs == 0:
        return ()
    told = Bar("as told", agreement.share, is_told=True)
    better = [Bar(agreement.better, agreement.better_share)] if agreement.better else []
    return (*better, told)
