"""One-line summaries of artifacts by kind, with amount and quality, printed at the end of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

from bask_data.artifact import Artifact
from bask_data.kinds.correspondences import Correspondences
from bask_data.kinds.descriptor import DescriptorNet
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


def _reconstructions(made: Sequence[Any]) -> str:
    explained = [each.quality.explained for each in made if each.quality.explained is not None]
    residuals = [each.quality.residual_abs for each in made if each.quality.residual_abs is not None]
    if not (explained and residuals):
        return ""
    return (
        f"{100 * median(explained):.1f} % of the measured depth lies on the mesh, "
        f"with an error of {1000 * median(residuals):.1f} mm (medians)"
    )


def _objects(made: Sequence[Any]) -> str:
    counts = [len(each.instances) for each in made]
    spread = f", {min(counts)} to {max(counts)} a scene" if min(counts) < max(counts) else ""
    return f"{_counted(sum(counts), 'object')}{spread}"


def _masks(made: Sequence[Any]) -> str:
    pixels: dict[str, int] = {}
    for each in made:
        for reason, n in each.pixels.items():
            pixels[reason] = pixels.get(reason, 0) + n
    agreeing, kept = pixels.get("measured_and_agreeing", 0), pixels.get("not_measured_and_kept", 0)
    hidden = sum(pixels.get(reason, 0) for reason in ("measured_in_front", "not_measured_and_hidden"))
    if not agreeing + kept:
        return ""
    return (
        f"{_percent(agreeing + kept, agreeing + kept + hidden)} of the objects' pixels are visible, "
        f"{_percent(agreeing, agreeing + kept)} of these confirmed by measured depth"
    )


def _correspondences(made: Sequence[Any]) -> str:
    matches, tried = sum(each.n_matches for each in made), sum(each.n_attempts for each in made)
    share = f"; {_percent(matches, tried)} of the pixels tried" if tried else ""
    return f"{matches:,} matches in {_counted(sum(each.n_pairs for each in made), 'pair')} of frames{share}"


def _descriptors(made: Sequence[Any]) -> str:
    return "; ".join(
        ", ".join([*_validation(each.metrics), f"on {each.validated_on}"]) for each in made if _validation(each.metrics)
    )


def _validation(metrics: dict[str, float]) -> list[str]:
    """The most important validation metrics: median error of the best match, and share of close ones."""
    found = []
    if "validation_median_error_px" in metrics:
        found.append(f"median error {metrics['validation_median_error_px']:.1f} px")
    if "validation_pck_4" in metrics:
        found.append(f"{100 * metrics['validation_pck_4']:.1f} % of the matches within 4 % of the diagonal")
    return found


def _references(made: Sequence[Any]) -> str:
    return ", ".join(_counted(len(each.picks), "keypoint") for each in made)


def _tracks(made: Sequence[Any]) -> str:
    least, most = (extreme(len(each.names) for each in made) for extreme in (min, max))
    numbers = f"{least} to {most} keypoints" if least < most else _counted(most, "keypoint")
    return (
        f"{numbers} in {_counted(len(made), 'demonstration')}, by {', '.join(sorted({each.filter for each in made}))}"
    )


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %"


def _counted(n: int, what: str) -> str:
    return f"{n:,} {what}{'' if n == 1 else 's'}"


HEADLINES: dict[type[Artifact], Callable[[Sequence[Any]], str]] = {
    Reconstruction: _reconstructions,
    ObjectInstances: _objects,
    VisibleMasks: _masks,
    Correspondences: _correspondences,
    DescriptorNet: _descriptors,
    ReferenceKeypoints: _references,
    KeypointTrack: _tracks,
}
"""Functions by kind that summarise the metadata of one or more artifacts."""
