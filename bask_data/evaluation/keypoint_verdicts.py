"""Networks, reference keypoints and tracks, judged by their figures; pure, so that any command can use it.

Fixes name `ROOT` for the dataset's directory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bask_data.evaluation import usual
from bask_data.evaluation.usual import Usual, length, percent
from bask_data.evaluation.verdicts import ItemVerdict
from bask_data.findings import Finding
from bask_data.kinds.reference import ambiguous

if TYPE_CHECKING:
    from bask_data.kinds import Pick


def network_judgement(variant: str, metrics: Mapping[str, float], validated_on: str, step: int) -> ItemVerdict:
    """A network by the share of the matches that it found when it was validated."""
    found = metrics.get("validation_pck_4", math.nan)
    findings = _of_found(variant, found, validated_on)
    if step == 0 and not findings:
        words = "the weights are those from before the training: it did not help"
        findings = [Finding("network-weak", variant, words, "bask-data train ROOT --force --steps 5000")]
    evidence = "not validated" if math.isnan(found) else f"{percent(found)} of the matches found on {validated_on}"
    return ItemVerdict(variant, evidence, usual.FOUND.text, found, tuple(findings))


def evaluation_judgement(variant: str, found: float | None, measured_on: str) -> ItemVerdict:
    """A network by the share of the matches that it finds in views that it did not learn from."""
    share = math.nan if found is None else found
    findings = tuple(_of_found(variant, share, measured_on))
    evidence = (
        "no match to measure on" if math.isnan(share) else f"{percent(share)} of the matches found on {measured_on}"
    )
    return ItemVerdict(variant, evidence, usual.FOUND.text, share, findings)


def _of_found(variant: str, found: float, where: str) -> list[Finding]:
    if not usual.FOUND.is_unusual(found):
        return []
    code = "network-poor" if usual.FOUND.is_bad(found) else "network-weak"
    words = f"only {percent(found)} of the matches are found within 4 % of the image's diagonal on {where}"
    fix = "scan the objects more often, and train for longer: bask-data train ROOT --force --steps 10000"
    return [Finding(code, variant, words, fix)]


def reference_judgement(variant: str, picks: Sequence[Pick]) -> ItemVerdict:
    """Reference keypoints by the error to expect of them."""
    errors = sorted(pick.recognition.error for pick in picks if pick.recognition is not None)
    if not errors:
        return ItemVerdict(variant, f"{len(picks)} keypoints, expected error not measured", usual.EXPECTED_ERROR.text)
    middle = errors[len(errors) // 2]
    findings = []
    fix = "pick points that are found again in other views: bask-data reference ROOT --pick"
    if usual.EXPECTED_ERROR.is_unusual(middle):
        code = "keypoints-poor" if usual.EXPECTED_ERROR.is_bad(middle) else "keypoints-weak"
        findings.append(Finding(code, variant, f"the median expected error is {length(middle)}", fix))
    if unsure := ambiguous(picks):
        words = f"{len(unsure)} of {len(picks)} look like other places: {', '.join(unsure[:5])}"
        findings.append(Finding("keypoints-ambiguous", variant, words, fix))
    evidence = f"{len(picks)} keypoints, expected error {length(middle)} (median)"
    return ItemVerdict(variant, evidence, usual.EXPECTED_ERROR.text, -middle, tuple(findings))


def track_judgement(item: str, figures: Mapping[str, Any], jumps: float) -> ItemVerdict:
    """A track by its error, or without ground truth by its spread.

    Args:
        figures: of `figures_of_track`.
        jumps: share of the steps longer than `JUMP_M`.
    """
    findings = []
    localised, error, spread = figures["localised_share"], figures["error_m"].median, figures["spread_m"].median
    if usual.LOCALISED.is_unusual(localised):
        code = "track-lost" if usual.LOCALISED.is_bad(localised) else "track-gaps"
        words = f"keypoints have a position in {percent(localised)} of the frames"
        findings.append(Finding(code, item, words, "check that demonstrations have depth and show the objects"))
    fix = "see the heat maps below; train for longer, or pick other points: bask-data reference ROOT --pick"
    if usual.TRACK_ERROR.is_unusual(error):
        code = "track-wrong" if usual.TRACK_ERROR.is_bad(error) else "track-off"
        findings.append(Finding(code, item, f"the median error is {length(error)}", fix))
    if usual.SPREAD.is_unusual(spread):
        findings.append(Finding("track-uncertain", item, f"the median spread is {length(spread)}", fix))
    if usual.JUMPS.is_unusual(jumps):
        words = f"{percent(jumps)} of the steps are longer than {100 * usual.JUMP_M:.0f} cm"
        findings.append(Finding("track-jumps", item, words, fix))
    by: tuple[str, float, Usual] = ("error", error, usual.TRACK_ERROR)
    if math.isnan(error):
        by = ("spread", spread, usual.SPREAD)
    evidence = f"{figures['n_keypoints']} keypoints, {by[0]} {length(by[1])} (median)"
    return ItemVerdict(item, evidence, by[2].text, -by[1], tuple(findings))
