"""What depth says about poses, units, intrinsics and clock of a camera, as findings and as bars."""

from __future__ import annotations

from dataclasses import replace

from bask_data.core.readings import judge
from bask_data.doctor.examination import Bar
from bask_data.findings import Finding, by_severity
from bask_data.formats.recording import CameraRecording
from bask_data.formats.verdict import TRUSTED, Agreement

OF_RIGHT_POSES = ("frame-off", "pose-jump", "drift")
"""Findings about single frames that mean something only if the poses as a whole are read rightly."""

CLEARLY_WORSE = 0.05
"""Evidence by which another reading must be better for the one as read to be called worse. Sensitivity not measured."""


def agreement_of_stored(camera: CameraRecording, assumptions: dict[str, str]) -> Agreement:
    """What depth says about a stored camera.

    Args:
        assumptions: of its recording: they say whether it was read as told in spite of what depth objected to.
    """
    judgement = judge(
        camera.n_frames,
        lambda i: camera.read_depth(i).astype("float32") * camera.depth_scale,
        camera.Ks,
        camera.world_from_cameras,
    )
    is_trusted = any(TRUSTED in text for name, text in assumptions.items() if name.endswith("agreement"))
    return Agreement(judgement, is_trusted=is_trusted)


def reading_findings(place: str, said: Agreement, again: str = "") -> list[Finding]:
    """What is wrong, or cannot be told; empty if depth is sure that the camera was read rightly.

    Args:
        again: what reads a stored recording again, for the fixes.
    """
    findings = by_severity(said.findings(place))
    if not again:
        return findings
    return [
        replace(each, fix=f"{each.fix}, when you read it again: {again}") if each.severity == "error" else each
        for each in findings
    ]


def is_sure(said: Agreement) -> bool:
    """Whether no other reading does as well."""
    return not said.judgement.codes and not said.judgement.best.departures


def is_worse(said: Agreement) -> bool:
    """Whether depth fits the recording as it was read clearly worse than another reading, whichever that is."""
    return bool(said.judgement.objections) or said.judgement.told < said.judgement.share - CLEARLY_WORSE


def bars(said: Agreement) -> tuple[Bar, ...]:
    """Evidence of the reading as told, and of the best one if that is another."""
    judgement = said.judgement
    if judgement.n_pairs == 0:
        return ()
    told = Bar("as read", judgement.told, is_told=True)
    if not judgement.best.departures:
        return (told,)
    return (Bar(judgement.option[0] or judgement.best.words, judgement.share), told)
