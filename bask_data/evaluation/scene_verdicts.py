"""What stages made of a scene, judged by its metadata and figures; pure, so that any command can use it.

Fixes name `ROOT` for the dataset's directory.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from bask_data.evaluation import usual
from bask_data.evaluation.label_matches import merged_labels
from bask_data.evaluation.match_reasons import plain_reason
from bask_data.evaluation.usual import percent
from bask_data.evaluation.verdicts import ItemVerdict
from bask_data.findings import Finding

if TYPE_CHECKING:
    from bask_data.kinds.correspondences import CorrespondencesMetadata
    from bask_data.kinds.masks import MasksMetadata
    from bask_data.kinds.objects import ObjectsMetadata
    from bask_data.kinds.reconstruction import ReconstructionMetadata

_IF_WRONG = {
    "support-uncertain": ("if the grey plane is not what the objects stand on", "--up 0,0,1"),
    "objects-touch": ("if one colour covers several things", "--eps 0.01"),
}
"""What the picture has to show for what is doubtful to be wrong, and the option to try then."""
_HARMLESS = re.compile(r"have no depth between")
"""Warnings of stages that need no look: what they tell is in a section of its own."""
_UNSEEN = re.compile(r"most pixels that are none: (?:hidden|outside)_in_b|: outside_b")
"""Objects with few matches as other things hide them: nothing is wrong with them."""


def reconstruction_judgement(item: str, metadata: ReconstructionMetadata) -> ItemVerdict:
    """A surface by how much of the measured depth lies on it."""
    quality, findings = metadata.quality, []
    explained = math.nan if quality.explained is None else quality.explained
    off = "" if quality.residual_abs is None else f", {1000 * quality.residual_abs:.1f} mm off in the median"
    evidence = f"{percent(explained)} of the depth lies on the surface{off}"
    if usual.EXPLAINED.is_unusual(explained):
        code = "surface-unexplained" if usual.EXPLAINED.is_bad(explained) else "surface-doubtful"
        words = f"only {percent(explained)} of the depth lies on the surface: it is doubled or blurred"
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
    return ItemVerdict(item, evidence, usual.EXPLAINED.text, explained, tuple(findings))


def objects_judgement(
    item: str, metadata: ObjectsMetadata, told: Sequence[Finding] = (), *, is_confirmed: bool = False
) -> ItemVerdict:
    """Objects by their number and by what is doubtful about them.

    Args:
        told: what the artifact itself finds.
        is_confirmed: whether labels confirm that each object is one, so that hollow ones need no look.
    """
    command = f"bask-data objects ROOT --only {item}"
    findings = [
        replace(each, fix=f"{_IF_WRONG[each.code][0]}: {command} {_IF_WRONG[each.code][1]}")
        if each.code in _IF_WRONG
        else each
        for each in told
        if each.code != "no-object" and not (is_confirmed and each.code == "objects-touch")
    ]
    findings += [
        Finding("objects-doubtful", item, text, f"if something is missing: {command} --max-extent 1")
        for text in metadata.warnings
        if "became background" in text
    ]
    n, n_flagged = len(metadata.instances), sum(bool(row.flags) for row in metadata.instances)
    if not n:
        fix = f"look at the surface; if the support is not found: {command} --up 0,0,1"
        findings = [Finding("objects-none", item, "nothing was found on the support", fix)]
    flagged = f", {n_flagged} of them flagged and not trained on" if n_flagged else ""
    evidence = f"{n} object{'' if n == 1 else 's'}{flagged}"
    return ItemVerdict(item, evidence, "as many as you see", float(n), tuple(findings))


def masks_judgement(item: str, metadata: MasksMetadata, labels: Sequence[Mapping[str, Any]] = ()) -> ItemVerdict:
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
        evidence = f"{percent(share)} of the objects' pixels contradict the surface"
        return ItemVerdict(item, evidence, usual.CONTRADICTED.text, -share, tuple(findings))
    if not apart:
        confirmed = _confirmed(metadata)
        evidence = f"{percent(confirmed)} of the masks' pixels have measured depth"
        return ItemVerdict(item, evidence, usual.CONFIRMED.text, confirmed, tuple(findings))
    mean = sum(apart) / len(apart)
    if usual.IOU.is_unusual(mean):
        code = "masks-wrong" if usual.IOU.is_bad(mean) else "masks-off"
        words = f"the mean IoU with the labels is {mean:.2f}; the worst object has {min(apart):.2f}"
        findings.append(Finding(code, item, words, "see which objects are merged or missing below"))
    evidence = f"mean IoU {mean:.2f} with {len(apart)} labelled object{'' if len(apart) == 1 else 's'}"
    return ItemVerdict(item, evidence, usual.IOU.text, mean, tuple(findings))


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
        words = f"at {percent(share)} of the objects' pixels, depth contradicts the surface"
        fix = "something moved during the scan, or poses are off: see the surface first"
        findings.append(Finding("masks-contradicted", item, words, fix))
    if usual.CONFIRMED.is_unusual(confirmed):
        words = f"only {percent(confirmed)} of the masks' pixels have measured depth; the others are inferred"
        findings.append(Finding("masks-unconfirmed", item, words, "see whether what is hatched below is right"))
    return findings


def without_depth(judgement: ItemVerdict, n_regions: int) -> ItemVerdict:
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


def correspondences_judgement(item: str, metadata: CorrespondencesMetadata) -> ItemVerdict:
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
        words = f"only {percent(accepted)} of the pixels tried became matches"
        findings.append(Finding("few-matches", item, words, "see why the others were rejected below"))
    evidence = f"{n:,} matches, {percent(accepted)} of the pixels tried"
    return ItemVerdict(item, evidence, usual.ACCEPTED.text, accepted, tuple(findings))
