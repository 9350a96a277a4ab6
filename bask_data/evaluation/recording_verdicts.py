"""Recordings judged by what depth said of their reading at ingest; pure, so that any command can use it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from bask_data.core.readings_judgement import ADVICE
from bask_data.evaluation import usual
from bask_data.evaluation.usual import percent
from bask_data.evaluation.verdicts import ItemVerdict
from bask_data.findings import Finding
from bask_data.formats.verdict import SURE, TRUSTED, codes_in

if TYPE_CHECKING:
    from bask_data.kinds.cameras import RecordingMetadata

_SHARE = re.compile(r"(\d+)% of the depth of a frame, warped into another, meets")
_OPTIONS = re.compile(r"; pass ((?:--[a-z-]+ \S+ ?)+)(?:;|$)")
_FIX_IN_SOURCE = "correct it in the source"


def recording_judgement(
    item: str, metadata: RecordingMetadata, again: Callable[[str], str], *, is_scan: bool
) -> ItemVerdict:
    """A recording by what depth said about its reading when it was ingested.

    Args:
        again: the command that ingests it again with further options.
    """
    texts = _of_cameras(metadata.assumptions, "agreement")
    findings = [
        Finding(
            "depth-shifted",
            _place(item, camera),
            text.removesuffix(" [depth-shifted]"),
            f"register depth to colour, then {again('')}",
        )
        for camera, text in _of_cameras(metadata.assumptions, "registration").items()
        if "not to be registered" in text
    ]
    if not texts:
        evidence = "simulated: poses are exact" if metadata.format == "sim" else "poses not judged"
        return ItemVerdict(item, evidence, findings=tuple(findings))
    shares = []
    for camera, text in texts.items():
        share = _SHARE.match(text)
        shares += [int(share[1]) / 100] if share else []
        found = _of_agreement(_place(item, camera), text, again)
        # What cannot be told of a demonstration, whose things move and whose cameras often rest, is no reason to worry.
        findings += found if is_scan else [each for each in found if each.severity == "error"]
    worst = min(shares, default=math.nan)
    evidence = f"{percent(worst)} of a frame's depth meets that of others" if shares else "poses cannot be judged"
    return ItemVerdict(item, evidence, usual.AGREEMENT.text if shares else "", worst, tuple(findings))


def _of_cameras(assumptions: Mapping[str, str], what: str) -> dict[str, str]:
    """The texts on one subject by camera; that of a single camera has no name."""
    return {
        name.removesuffix(what).removesuffix(": "): text
        for name, text in assumptions.items()
        if name.split(": ")[-1] == what
    }


def _place(item: str, camera: str) -> str:
    return f"{item}/{camera}" if camera else item


def _of_agreement(place: str, text: str, again: Callable[[str], str]) -> list[Finding]:
    """The findings that the text of an agreement names by their codes."""
    options = _OPTIONS.search(text)
    parts = [part for part in text.split("; ") if codes_in(part) and part != TRUSTED]
    findings = []
    for part in parts:
        (code, *_), words = codes_in(part), re.sub(r"(?: \(\d+ pairs\))?(?: \[[a-z-]+\])?$", "", part)
        if code in ADVICE:
            fix = ADVICE[code] if not code.startswith(("poses", "camera")) else f"{ADVICE[code]}, then {again('')}"
        else:
            fix = again(options[1].strip()) if options else f"{_FIX_IN_SOURCE}, then {again('')}"
        findings.append(Finding(code, place, re.sub(r"^cannot tell: ", "", words), fix))
    if not parts and SURE not in text:  # Recorded by a version that named no codes.
        findings = [Finding("reading-unknown", place, text, f"read it again, to be judged: {again('')}")]
    return findings
