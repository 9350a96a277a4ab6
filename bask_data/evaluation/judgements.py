"""What each stage made for one item, judged by its metadata and figures; pure, so that any command can use it.

Fixes name `ROOT` for the dataset's directory.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from statistics import median
from typing import TYPE_CHECKING, Any

from bask_data.evaluation import usual
from bask_data.evaluation.usual import Usual
from bask_data.evaluation.verdicts import Judgement
from bask_data.findings import Finding
from bask_data.formats.verdict import SURE
from bask_data.kinds.reference import ambiguous

if TYPE_CHECKING:
    from bask_data.kinds import Pick
    from bask_data.kinds.cameras import RecordingMetadata
    from bask_data.kinds.correspondences import CorrespondencesMetadata
    from bask_data.kinds.masks import MasksMetadata
    from bask_data.kinds.objects import ObjectsMetadata
    from bask_data.kinds.reconstruction import ReconstructionMetadata

_SHARE = re.compile(r"(\d+)% of the depth of a frame")
_BETTER = re.compile(r"; with (.+?) it would be (\d+)%")
_OPTIONS = re.compile(r"^(?:--[a-z-]+ [^\s()]+ ?)+")
_UNSEEN = re.compile(r"most pixels that are none: (?:hidden|outside)_in_b|: outside_b")
"""Objects with few matches as other things hide them: nothing is wrong with them."""
_HARMLESS = re.compile(r"objects that nearly touch|facing the cameras|depth between")
"""Warnings of stages that need no look: what they tell is in a section of its own."""


def recording_judgement(
    item: str, metadata: RecordingMetadata, again: Callable[[str], str], *, is_scan: bool
) -> Judgement:
    """A recording by what depth said about its reading when it was ingested.

    Args:
        again: the command that ingests it again with further options.
    """
    texts = {name: text for name, text in metadata.assumptions.items() if name.split(": ")[-1] == "agreement"}
    if not texts:
        return Judgement(item, "simulated: poses are exact" if metadata.format == "sim" else "poses not judged")
    findings: list[Finding] = []
    shares = []
    for name, text in texts.items():
        camera = name.removesuffix("agreement").removesuffix(": ")
        share = _SHARE.search(text)
        shares += [int(share[1]) / 100] if share else []
        finding = _of_agreement(f"{item}/{camera}" if camera else item, text, again, is_scan)
        findings += [finding] if finding else []
    worst = min(shares, default=math.nan)
    evidence = f"{_percent(worst)} of a frame's depth meets that of others" if shares else "the camera does not move"
    return Judgement(item, evidence, usual.AGREEMENT.text if shares else "", worst, tuple(findings))


def _of_agreement(place: str, text: str, again: Callable[[str], str], is_scan: bool) -> Finding | None:
    """What an agreement's text finds; None if it is sure of the reading."""
    if better := _BETTER.search(text):
        options = _OPTIONS.match(better[1])
        words = f"with {better[1]}, {better[2]} % of the depth would meet, more than as read"
        fix = again(options[0].strip()) if options else f"correct it in the source, then {again('')}"
        return Finding("other-reading", place, words, fix)
    if "no more than for" in text:
        words = "depth of a frame meets that of others no better than if the camera had not moved"
        fix = f"check poses, intrinsics and depth's unit, then {again('')}"
        return Finding("poses-unrelated", place, words, fix)
    if "the camera moved" in text:
        fix = f"give the poses of this recording: {again('')}"
        return Finding("camera-moved", place, "all poses are the same, but depth changes", fix)
    if SURE in text:
        return None
    if not is_scan or "does not move" in text or "single frame" in text:
        return Finding("hardly-moves", place, text)
    rivals = text.removeprefix("cannot tell from ").split(":")[0]
    fix = "look at the surface below: is it sharp, and as large as in reality?"
    return Finding("reading-unknown", place, f"depth cannot tell this reading from {rivals}", fix)


def reconstruction_judgement(item: str, metadata: ReconstructionMetadata) -> Judgement:
    """A surface by how much of the measured depth lies on it."""
    quality, findings = metadata.quality, []
    explained = math.nan if quality.explained is None else quality.explained
    off = "" if quality.residual_abs is None else f", {1000 * quality.residual_abs:.1f} mm off in the median"
    evidence = f"{_percent(explained)} of the depth lies on the surface{off}"
    if usual.EXPLAINED.is_unusual(explained):
        code = "surface-unexplained" if usual.EXPLAINED.is_bad(explained) else "surface-doubtful"
        words = f"only {_percent(explained)} of the depth lies on the surface: it is doubled or blurred"
        fix = "check poses, unit and intrinsics of the recording: bask-data doctor ROOT"
        findings.append(Finding(code, item, words, fix))
    share = quality.frames_suspect / quality.frames if quality.frames else 0.0
    if share > 0:
        code = "frames-disagree" if usual.SUSPECT.is_unusual(share) else "frame-disagrees"
        words = f"{quality.frames_suspect} of {quality.frames} frames disagree with the surface"
        findings.append(Finding(code, item, words, "look at the frames listed below: poses off, or something moved"))
    if metadata.unmeasured:
        sizes = " and ".join(
            " × ".join(f"{100 * edge:.0f}" for edge in region.size) + " cm" for region in metadata.unmeasured[:3]
        )
        words = f"cameras could not measure what fills {sizes}: transparent, shiny or black"
        fix = "do not use masks of these things; or make them matt, and scan again"
        findings.append(Finding("unmeasured", item, words, fix))
    if metadata.warnings and not findings:
        findings += [Finding("stage-warning", item, text) for text in metadata.warnings if not _HARMLESS.search(text)]
    return Judgement(item, evidence, usual.EXPLAINED.text, explained, tuple(findings))


def objects_judgement(item: str, metadata: ObjectsMetadata, *, is_confirmed: bool = False) -> Judgement:
    """Objects by their number and by what the stage noted about them.

    Args:
        is_confirmed: whether labels confirm that each object is one, so that warnings of merged ones need no look.
    """
    n = len(metadata.instances)
    findings = [
        Finding("objects-doubtful", item, text, _mending_of(text, item))
        for text in metadata.warnings
        if not _HARMLESS.search(text) and not (is_confirmed and text.startswith("hollow"))
    ]
    if not n:
        findings = [Finding("no-objects", item, "nothing was found on the support", _mending_of("support", item))]
    return Judgement(item, f"{n} object{'' if n == 1 else 's'}", "as many as you see", float(n), tuple(findings))


def _mending_of(warning: str, item: str) -> str:
    """The command for a warning of `objects`, and the condition for it."""
    command = f"bask-data objects ROOT --only {item}"
    for word, condition, option in (
        ("touch", "if one colour covers several things", "--eps 0.01"),
        ("longer than", "if objects are missing", "--max-extent 1"),
        ("support", "if the grey plane is not what the objects stand on", "--up 0,0,1"),
        ("plane", "if the grey plane is not what the objects stand on", "--up 0,0,1"),
    ):
        if word in warning:
            return f"{condition}: {command} {option}"
    return f"look: bask-data view ROOT --only {item}"


def masks_judgement(item: str, metadata: MasksMetadata, labels: Sequence[Mapping[str, Any]] = ()) -> Judgement:
    """Masks by their overlap with labels, or else by what depth says of their pixels.

    Args:
        labels: what `masks_figures` says of each label.
    """
    findings = _of_pixels(item, metadata)
    merged, apart = merged_labels(labels), [float(row["iou"]) for row in labels if not row["shared"]]
    if merged:
        words = f"{' and '.join(merged)} are one object in the masks"
        fix = f"move them apart and scan again, or bask-data objects ROOT --only {item} --eps 0.01"
        findings.append(Finding("objects-merged", item, words, fix))
    against = [finding for finding in findings if finding.code == "masks-contradicted"]
    if against:
        share = _contradicted(metadata)
        evidence = f"{_percent(share)} of the objects' pixels contradict the surface"
        return Judgement(item, evidence, usual.CONTRADICTED.text, -share, tuple(findings))
    if not apart:
        confirmed = _confirmed(metadata)
        evidence = f"{_percent(confirmed)} of the masks' pixels have measured depth"
        return Judgement(item, evidence, usual.CONFIRMED.text, confirmed, tuple(findings))
    mean = sum(apart) / len(apart)
    if usual.IOU.is_unusual(mean):
        code = "masks-wrong" if usual.IOU.is_bad(mean) else "masks-off"
        words = f"the mean IoU with the labels is {mean:.2f}; the worst object has {min(apart):.2f}"
        findings.append(Finding(code, item, words, "see which objects are merged or missing below"))
    evidence = f"mean IoU {mean:.2f} with {len(apart)} labelled object{'' if len(apart) == 1 else 's'}"
    return Judgement(item, evidence, usual.IOU.text, mean, tuple(findings))


def _confirmed(metadata: MasksMetadata) -> float:
    """Share of the masks' pixels with measured depth; NaN for empty masks."""
    agreeing, kept = (metadata.pixels.get(name, 0) for name in ("measured_and_agreeing", "not_measured_and_kept"))
    return agreeing / (agreeing + kept) if agreeing + kept else math.nan


def _contradicted(metadata: MasksMetadata) -> float:
    """Share of the pixels at which the surface shows an object and depth lies elsewhere, without an occluder."""
    of = metadata.pixels
    against = of.get("measured_behind", 0) + of.get("measured_through", 0)
    total = against + of.get("measured_and_agreeing", 0) + of.get("not_measured_and_kept", 0)
    return against / total if total else math.nan


def merged_labels(labels: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of the labelled objects that share an instance with another: they touch, or `objects` merged them."""
    return [str(row["name"]) for row in labels if row["shared"]]


def median_apart(labels: Sequence[Mapping[str, Any]]) -> float | None:
    """Median IoU of the labelled objects with an instance of their own; None without any."""
    apart = [float(row["iou"]) for row in labels if not row["shared"]]
    return median(apart) if apart else None


def labels_confirm(labels: Sequence[Mapping[str, Any]]) -> bool:
    """Whether every labelled object has an instance of its own that overlaps it well."""
    return bool(labels) and all(not row["shared"] and not usual.IOU.is_unusual(row["iou"]) for row in labels)


def _of_pixels(item: str, metadata: MasksMetadata) -> list[Finding]:
    """What depth says of the pixels at which the surface shows an object."""
    findings, pixels, confirmed = [], metadata.pixels, _confirmed(metadata)
    if math.isnan(confirmed):
        is_empty = metadata.n_instances and pixels
        return (
            [Finding("masks-empty", item, "no mask shows anything", "see surface and poses first")] if is_empty else []
        )
    share = _contradicted(metadata)
    if usual.CONTRADICTED.is_unusual(share):
        words = f"at {_percent(share)} of the objects' pixels, depth contradicts the surface"
        fix = "something moved during the scan, or poses are off: see the surface first"
        findings.append(Finding("masks-contradicted", item, words, fix))
    if usual.CONFIRMED.is_unusual(confirmed):
        words = f"only {_percent(confirmed)} of the masks' pixels have measured depth; the others are inferred"
        findings.append(Finding("masks-unconfirmed", item, words, "see whether what is hatched below is right"))
    return findings


def without_depth(judgement: Judgement, n_regions: int) -> Judgement:
    """The judgement of what was made from a surface in which regions could not be measured.

    Args:
        n_regions: their number.
    """
    if not n_regions:
        return judgement
    place, things = judgement.item, "thing" if n_regions == 1 else "things"
    words = f"{n_regions} {things} without depth, see the surface, may be missing here, or wrong"
    fix = "do not use them; or make them matt, and scan again"
    return replace(judgement, findings=(*judgement.findings, Finding("unmeasured", place, words, fix)))


def correspondences_judgement(item: str, metadata: CorrespondencesMetadata) -> Judgement:
    """Matches by the share of the pixels tried that became one."""
    n, accepted = metadata.n_matches, metadata.n_matches / max(metadata.n_attempts, 1)
    findings = [
        Finding("few-matches", item, plain_reason(text), "see the outcomes of the pixels below")
        for text in metadata.warnings
        if not _UNSEEN.search(text)
    ]
    if not n:
        fix = f"look at surface and masks first; then bask-data correspondences ROOT --only {item} --min-overlap 0.1"
        findings = [Finding("no-matches", item, "no pixel has a match", fix)]
    elif usual.ACCEPTED.is_unusual(accepted):
        words = f"only {_percent(accepted)} of the pixels tried became matches"
        findings.append(Finding("few-matches", item, words, "see why the others were rejected below"))
    evidence = f"{n:,} matches, {_percent(accepted)} of the pixels tried"
    return Judgement(item, evidence, usual.ACCEPTED.text, accepted, tuple(findings))


def network_judgement(variant: str, metrics: Mapping[str, float], validated_on: str, step: int) -> Judgement:
    """A network by the share of the matches that it found when it was validated."""
    found = metrics.get("validation_pck_4", math.nan)
    findings = _of_found(variant, found, validated_on)
    if step == 0 and not findings:
        words = "the weights are those from before the training: it did not help"
        findings = [Finding("network-weak", variant, words, "bask-data train ROOT --force --steps 5000")]
    evidence = "not validated" if math.isnan(found) else f"{_percent(found)} of the matches found on {validated_on}"
    return Judgement(variant, evidence, usual.FOUND.text, found, tuple(findings))


def evaluation_judgement(variant: str, found: float | None, measured_on: str) -> Judgement:
    """A network by the share of the matches that it finds in views that it did not learn from."""
    share = math.nan if found is None else found
    findings = tuple(_of_found(variant, share, measured_on))
    evidence = (
        "no match to measure on" if math.isnan(share) else f"{_percent(share)} of the matches found on {measured_on}"
    )
    return Judgement(variant, evidence, usual.FOUND.text, share, findings)


def _of_found(variant: str, found: float, where: str) -> list[Finding]:
    if not usual.FOUND.is_unusual(found):
        return []
    code = "network-poor" if usual.FOUND.is_bad(found) else "network-weak"
    words = f"only {_percent(found)} of the matches are found within 4 % of the image's diagonal on {where}"
    fix = "scan the objects more often, and train for longer: bask-data train ROOT --force --steps 10000"
    return [Finding(code, variant, words, fix)]


def reference_judgement(variant: str, picks: Sequence[Pick]) -> Judgement:
    """Reference keypoints by the error to expect of them."""
    errors = sorted(pick.recognition.error for pick in picks if pick.recognition is not None)
    if not errors:
        return Judgement(variant, f"{len(picks)} keypoints, expected error not measured", usual.EXPECTED_ERROR.text)
    middle = errors[len(errors) // 2]
    findings = []
    fix = "pick points that are found again in other views: bask-data reference ROOT --pick"
    if usual.EXPECTED_ERROR.is_unusual(middle):
        code = "keypoints-poor" if usual.EXPECTED_ERROR.is_bad(middle) else "keypoints-weak"
        findings.append(Finding(code, variant, f"the median expected error is {_length(middle)}", fix))
    if unsure := ambiguous(picks):
        words = f"{len(unsure)} of {len(picks)} look like other places: {', '.join(unsure[:5])}"
        findings.append(Finding("keypoints-ambiguous", variant, words, fix))
    evidence = f"{len(picks)} keypoints, expected error {_length(middle)} (median)"
    return Judgement(variant, evidence, usual.EXPECTED_ERROR.text, -middle, tuple(findings))


def track_judgement(item: str, figures: Mapping[str, Any], jumps: float) -> Judgement:
    """A track by its error, or without ground truth by its spread.

    Args:
        figures: of `figures_of_track`.
        jumps: share of the steps longer than `JUMP_M`.
    """
    findings = []
    localised, error, spread = figures["localised_share"], figures["error_m"].median, figures["spread_m"].median
    if usual.LOCALISED.is_unusual(localised):
        code = "track-lost" if usual.LOCALISED.is_bad(localised) else "track-gaps"
        words = f"keypoints have a position in {_percent(localised)} of the frames"
        findings.append(Finding(code, item, words, "check that demonstrations have depth and show the objects"))
    fix = "see the heat maps below; train for longer, or pick other points: bask-data reference ROOT --pick"
    if usual.TRACK_ERROR.is_unusual(error):
        code = "track-wrong" if usual.TRACK_ERROR.is_bad(error) else "track-off"
        findings.append(Finding(code, item, f"the median error is {_length(error)}", fix))
    if usual.SPREAD.is_unusual(spread):
        findings.append(Finding("track-uncertain", item, f"the median spread is {_length(spread)}", fix))
    if usual.JUMPS.is_unusual(jumps):
        words = f"{_percent(jumps)} of the steps are longer than {100 * usual.JUMP_M:.0f} cm"
        findings.append(Finding("track-jumps", item, words, fix))
    by: tuple[str, float, Usual] = ("error", error, usual.TRACK_ERROR)
    if math.isnan(error):
        by = ("spread", spread, usual.SPREAD)
    evidence = f"{figures['n_keypoints']} keypoints, {by[0]} {_length(by[1])} (median)"
    return Judgement(item, evidence, by[2].text, -by[1], tuple(findings))


REASONS = {
    "outside_b": "outside the second image",
    "no_depth_in_b": "no depth in the second frame",
    "hidden_in_b": "occluded in the second frame",
    "other_surface_in_b": "another surface, farther away, is visible",
    "other_instance_in_b": "another object, or none, is visible",
    "doubtful_in_b": "at an edge, or seen at a grazing angle",
    "cycle": "the way back leads to another pixel",
    "edge_in_b": "too close to an occluder's edge",
}
"""Why a pixel is no match, for readers; the artifact has the names."""


def plain_reason(text: str) -> str:
    """The text with reasons of rejections in words."""
    return re.sub(r"\b[a-z_]+\b", lambda word: REASONS.get(word[0], word[0]) if "_" in word[0] else word[0], text)


def _percent(share: float) -> str:
    return "–" if math.isnan(share) else f"{100 * share:.0f} %"


def _length(metres: float) -> str:
    return "unknown" if math.isnan(metres) else f"{1000 * metres:.0f} mm"
