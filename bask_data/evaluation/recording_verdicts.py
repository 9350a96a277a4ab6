"""Recordings judged by what depth said of their reading at ingest; pure, so that any command can use it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import TYPE_CHECKING

from bask_data.evaluation import usual
from bask_data.evaluation.usual import percent
from bask_data.evaluation.verdicts import ItemVerdict
from bask_data.findings import Finding
from bask_data.formats.verdict import SURE

if TYPE_CHECKING:
    from bask_data.kinds.cameras import RecordingMetadata

_SHARE = re.compile(r"(\d+)% of the depth of a frame")
_BETTER = re.compile(r"; with (.+?) it would be (\d+)%")
_OPTIONS = re.compile(r"^(?:--[a-z-]+ [^\s()]+ ?)+")


def recording_judgement(
    item: str, metadata: RecordingMetadata, again: Callable[[str], str], *, is_scan: bool
) -> ItemVerdict:
    """A recording by what depth said about its reading when it was ingested.

    Args:
        again: the command that ingests it again with further options.
    """
    texts = {name: text for name, text in metadata.assumptions.items() if name.split(": ")[-1] == "agreement"}
    beside = [
        Finding("depth-shifted", item, text, f"register depth to colour, then {again('')}")
        for name, text in metadata.assumptions.items()
        if name.split(": ")[-1] == "registration" and "not to be registered" in text
    ]
    if not texts:
        return ItemVerdict(item, "simulated: poses are exact" if metadata.format == "sim" else "poses not judged")
    findings, shares = beside, []
    for name, text in texts.items():
        camera = name.removesuffix("agreement").removesuffix(": ")
        share = _SHARE.search(text)
        shares += [int(share[1]) / 100] if share else []
        finding = _of_agreement(f"{item}/{camera}" if camera else item, text, again, is_scan)
        findings += [finding] if finding else []
    worst = min(shares, default=math.nan)
    evidence = f"{percent(worst)} of a frame's depth meets that of others" if shares else "the camera does not move"
    return ItemVerdict(item, evidence, usual.AGREEMENT.text if shares else "", worst, tuple(findings))


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
