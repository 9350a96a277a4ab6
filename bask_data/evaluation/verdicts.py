"""Verdicts on the stages of a dataset: what is usable, what to look at, what is wrong, and what to do first.

A stage is judged by what it made for each scene or demonstration; its row shows the worst of them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from bask_data.findings import Finding, by_severity

Verdict = Literal["pass", "look", "fail", "not made"]

VERDICTS: tuple[Verdict, ...] = ("fail", "look", "not made", "pass")
"""The worst first: what was not made is no fault, but a thing to do."""


_OF_FIGURE = {
    *("surface-unexplained", "surface-doubtful", "masks-contradicted", "masks-unconfirmed", "network-weak"),
    *("network-poor", "keypoints-weak", "keypoints-poor", "track-lost", "track-off", "track-wrong", "track-uncertain"),
}
"""Codes whose evidence is the figure that a row shows."""


@dataclass(frozen=True)
class ItemVerdict:
    """What one stage made for one item.

    Args:
        item: scene, demonstration or variant.
        evidence: the figure that decides, in words.
        usual: its usual range, in words.
        figure: larger is better; orders items of the same verdict; NaN if unknown.
    """

    item: str
    evidence: str
    usual: str = ""
    figure: float = math.nan
    findings: tuple[Finding, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Errors fail, warnings deserve a look, and notes do neither."""
        worst = {finding.severity for finding in self.findings}
        return "fail" if "error" in worst else "look" if "warning" in worst else "pass"


@dataclass(frozen=True)
class StageVerdict:
    """A row of the table of verdicts.

    Args:
        stage: in words.
        worst: the item that evidence and fix are about; empty if there is only one.
        usual: the usual range of the evidence.
        why: what was found about the worst item, a sentence each.
        fix: what to do, a command where there is one.
        others: how many items are how good, and which is worst, in words; empty for a single one.
    """

    stage: str
    verdict: Verdict
    evidence: str
    usual: str = ""
    worst: str = ""
    why: tuple[str, ...] = ()
    fix: str = ""
    others: str = ""
    findings: tuple[Finding, ...] = field(default=(), repr=False)

    def as_json(self) -> dict[str, Any]:
        """All of it as plain values."""
        plain = {name: getattr(self, name) for name in ("stage", "verdict", "evidence", "usual", "worst", "fix")}
        return {**plain, "why": list(self.why), "findings": [finding.as_json() for finding in self.findings]}


def not_made(stage: str, evidence: str, fix: str) -> StageVerdict:
    """The row of a stage that made nothing."""
    return StageVerdict(stage, "not made", evidence, fix=fix)


def stage_verdict(stage: str, judgements: Sequence[ItemVerdict], missing: Sequence[str], fix: str) -> StageVerdict:
    """One row for all items of a stage.

    Args:
        missing: items for which it made nothing.
        fix: what makes them.
    """
    if not judgements:
        return not_made(stage, f"missing: {_listed(missing)}", fix)
    worst = min(judgements, key=_badness)
    findings = by_severity(finding for judgement in judgements for finding in judgement.findings)
    own = by_severity(worst.findings)
    n_items = len(judgements) + len(missing)
    verdict = worst.verdict
    is_incomplete = verdict == "pass" and bool(missing)
    return StageVerdict(
        stage=stage,
        verdict="not made" if is_incomplete else verdict,
        evidence=f"missing: {_listed(missing)}" if is_incomplete else worst.evidence,
        usual="" if is_incomplete else worst.usual,
        worst=worst.item if n_items > 1 and not is_incomplete else "",
        why=tuple(_why(finding) for finding in own if finding.severity != "note"),
        fix=next((each.fix for each in own if each.fix and each.severity != "note"), fix if is_incomplete else ""),
        others=_counts(judgements, missing, "" if is_incomplete else worst.item) if n_items > 1 else "",
        findings=tuple(findings),
    )


def _why(finding: Finding) -> str:
    """What the finding says beside the row's evidence, whose figure need not be repeated."""
    words = finding.meaning if finding.code in _OF_FIGURE else finding.evidence
    return re.sub(r"(\d)%", r"\1 %", words.rstrip("."))


def _badness(judgement: ItemVerdict) -> tuple[int, float]:
    return VERDICTS.index(judgement.verdict), -math.inf if math.isnan(judgement.figure) else judgement.figure


def _listed(names: Sequence[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _counts(judgements: Sequence[ItemVerdict], missing: Sequence[str], worst: str) -> str:
    """How many items are how good, in words, and the worst."""
    n, is_known = len(judgements) + len(missing), any(not math.isnan(each.figure) for each in judgements)
    of: dict[Verdict, int] = {verdict: sum(each.verdict == verdict for each in judgements) for verdict in VERDICTS}
    of["not made"] = len(missing)
    if of["pass"] == n:
        return f"lowest of {n}: {worst}" if is_known else f"all {n}"
    words = ", ".join(f"{of[verdict]} {verdict}" for verdict in reversed(VERDICTS) if of[verdict])
    return f"worst: {worst}; {words}" if worst else words


def after_failures(rows: Sequence[StageVerdict]) -> list[StageVerdict]:
    """The rows in the order of the stages; what comes after a failure is at most worth a look, and mended with it."""
    judged: list[StageVerdict] = []
    failed = ""
    for row in rows:
        if failed and row.verdict == "not made":
            row = replace(row, fix=f"mend first: {failed}")
        elif failed:
            verdict = "look" if row.verdict == "pass" else row.verdict
            why = row.why or (f"made from what failed: {failed}",)
            row = replace(row, verdict=verdict, why=why, fix=f"mend first: {failed}; then make it again")
        judged.append(row)
        failed = failed or (row.stage.lower() if row.verdict == "fail" else "")
    return judged


@dataclass(frozen=True)
class NextStep:
    """What to do first.

    Args:
        verdict: of the whole dataset.
        why: a sentence.
        fix: a command or what to look at; empty if nothing has to be done.
    """

    verdict: Verdict
    why: str
    fix: str = ""


def next_step(rows: Sequence[StageVerdict]) -> NextStep:
    """The first failure, as later stages suffer from it; else what is not made; else the first that deserves a look."""
    for verdict, words in (
        ("fail", "{}: wrong, and so is what is made from it"),
        ("look", "{}: look"),
        ("not made", "{}: not made yet"),
    ):
        found = [row for row in rows if row.verdict == verdict]
        if found:
            first = found[0]
            of = f" ({first.worst})" if first.worst else ""
            why = first.why[0] if first.why else first.evidence
            also = ", ".join(row.stage.lower() for row in found[1:]) if verdict == "look" else ""
            why = f"{words.format(first.stage + of)}. {_sentence(why)}." + (f" Then look at: {also}." if also else "")
            fix = first.fix if first.fix.startswith("bask-data") else _sentence(first.fix)
            return NextStep(first.verdict, why, fix)
    return NextStep("pass", "Everything is made, and all figures are in their usual ranges.")


def _sentence(words: str) -> str:
    """The words with a capital letter in front."""
    return words[:1].upper() + words[1:]


def as_json(rows: Sequence[StageVerdict]) -> dict[str, Any]:
    """The table and what to do first as plain values."""
    first = next_step(rows)
    return {
        "next": {"verdict": first.verdict, "why": first.why, "fix": first.fix},
        "stages": [row.as_json() for row in rows],
    }
