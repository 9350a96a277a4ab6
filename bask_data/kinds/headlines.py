"""One-line summaries of artifacts by kind, with amount and quality, printed at the end of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

from bask_data.artifact import Artifact
from bask_data.kinds.correspondences import Correspondences
from bask_data.kinds.descriptor import DescriptorNet
from bask_data.kinds.identities import Identities
from bask_data.kinds.keypoints import KeypointTrack
from bask_data.kinds.masks import VisibleMasks
from bask_data.kinds.objects import ObjectInstances
from bask_data.kinds.reconstruction import Reconstruction
from bask_data.kinds.reference import ReferenceKeypoints


def headline(artifacts: Sequence[Artifact]) -> str:
    """Summary of artifacts of one kind from their metadata; empty for kinds without one.

    Raises:
        BadData: an artifact's metadata is corrupted.
    """
    line = HEADLINES.get(type(artifacts[0])) if artifacts else None
    return line([artifact.metadata for artifact in artifacts]) if line else ""


def _reconstructions(documents: Sequence[Any]) -> str:
    explained = [metadata.quality.explained for metadata in documents if metadata.quality.explained is not None]
    residuals = [metadata.quality.residual_abs for metadata in documents if metadata.quality.residual_abs is not None]
    if not (explained and residuals):
        return ""
    return (
        f"{100 * median(explained):.1f} % of the measured depth lies on the mesh, "
        f"with an error of {1000 * median(residuals):.1f} mm (medians)"
    )


def _objects(documents: Sequence[Any]) -> str:
    counts = [len(metadata.instances) for metadata in documents]
    spread = f", {min(counts)} to {max(counts)} a scene" if min(counts) < max(counts) else ""
    n_flagged = sum(bool(row.flags) for metadata in documents for row in metadata.instances)
    flagged = f", {n_flagged} of them flagged" if n_flagged else ""
    return f"{_counted(sum(counts), 'object')}{spread}{flagged}"


def _masks(documents: Sequence[Any]) -> str:
    pixels: dict[str, int] = {}
    for metadata in documents:
        for reason, n in metadata.pixels.items():
            pixels[reason] = pixels.get(reason, 0) + n
    agreeing, kept = pixels.get("measured_and_agreeing", 0), pixels.get("not_measured_and_kept", 0)
    hidden = sum(pixels.get(reason, 0) for reason in ("measured_in_front", "not_measured_and_hidden"))
    if not agreeing + kept:
        return ""
    return (
        f"{_percent(agreeing + kept, agreeing + kept + hidden)} of the objects' pixels are visible, "
        f"{_percent(agreeing, agreeing + kept)} of these confirmed by measured depth"
    )


def _correspondences(documents: Sequence[Any]) -> str:
    matches = sum(metadata.n_matches for metadata in documents)
    tried = sum(metadata.n_attempts for metadata in documents)
    share = f"; {_percent(matches, tried)} of the pixels tried" if tried else ""
    return (
        f"{matches:,} matches in {_counted(sum(metadata.n_pairs for metadata in documents), 'pair')} of frames{share}"
    )


def _identities(documents: Sequence[Any]) -> str:
    counts = [(len(metadata.identities), len(metadata.unknown)) for metadata in documents]
    return "; ".join(f"{_counted(n, 'object')} in several scans, {n_unknown} unknown" for n, n_unknown in counts)


def _descriptors(documents: Sequence[Any]) -> str:
    return "; ".join(
        ", ".join([*_validation(metadata.metrics), f"on {metadata.validated_on}"])
        for metadata in documents
        if _validation(metadata.metrics)
    )


def _validation(metrics: dict[str, float]) -> list[str]:
    """The most important validation metrics: median error of the best match, and share of close ones."""
    words = []
    if "validation_median_error_px" in metrics:
        words.append(f"median error {metrics['validation_median_error_px']:.1f} px")
    if "validation_pck_4" in metrics:
        words.append(f"{100 * metrics['validation_pck_4']:.1f} % of the matches within 4 % of the diagonal")
    return words


def _references(documents: Sequence[Any]) -> str:
    return ", ".join(_reference(metadata.picks) for metadata in documents)


def _reference(picks: Sequence[Any]) -> str:
    """The number of keypoints, the median of the errors to expect of them, and how many are ambiguous."""
    known = [pick.recognition for pick in picks if pick.recognition is not None]
    words = [_counted(len(picks), "keypoint")]
    if known:
        words.append(f"expected error {1000 * median(each.error for each in known):.0f} mm (median)")
    if n_ambiguous := sum(each.is_ambiguous for each in known):
        words.append(f"{n_ambiguous} ambiguous")
    return "; ".join(words)


def _tracks(documents: Sequence[Any]) -> str:
    least, most = (extreme(len(metadata.names) for metadata in documents) for extreme in (min, max))
    numbers = f"{least} to {most} keypoints" if least < most else _counted(most, "keypoint")
    filters = ", ".join(sorted({metadata.filter for metadata in documents}))
    return f"{numbers} in {_counted(len(documents), 'demonstration')}, by {filters}"


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %"


def _counted(n: int, what: str) -> str:
    return f"{n:,} {what}{'' if n == 1 else 's'}"


HEADLINES: dict[type[Artifact], Callable[[Sequence[Any]], str]] = {
    Reconstruction: _reconstructions,
    ObjectInstances: _objects,
    VisibleMasks: _masks,
    Correspondences: _correspondences,
    Identities: _identities,
    DescriptorNet: _descriptors,
    ReferenceKeypoints: _references,
    KeypointTrack: _tracks,
}
"""Functions by kind that summarise the metadata of one or more artifacts."""
