"""What depth and colour say about the way a recording was read, in a form that is kept and shown."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bask_data.core.readings_judgement import ADVICE, Judgement, Offers
from bask_data.errors import BadData
from bask_data.findings import CODES, Finding

SURE = "no other reading does as well"
"""Words of a text that says the reading is sure."""

NOTED = ("other-clock",)
"""What depth objects to, but no option and no file of poses alone mends: it is said, and the recording is read."""

TRUSTED = "read as told, with --trust [trusted]"
"""Words of a text that says that what depth objects to was overridden."""

SHIFTED_FIX = (
    "register depth to colour with the camera's own library, or state --depth-intrinsics and --color-from-depth; if "
    "depth is registered, correct the pose of the camera on its mount"
)
"""What to do about depth that lies beside colour."""

_QUESTIONS = {
    "reading-unknown": "how poses are meant",
    "axes-unknown": "OpenCV axes from OpenGL axes",
    "unit-unknown": "the unit of depth and poses",
    "clock-unknown": "by how many frames the clock is off",
    "intrinsics-unknown": "the size of images that intrinsics are for",
}


@dataclass(frozen=True)
class Agreement:
    """What the depth of a recording says about the way it was read.

    Args:
        judgement: what was found.
        offers: options of the format.
        is_trusted: whether it is read as told in any case.
    """

    judgement: Judgement
    offers: Offers = field(default_factory=Offers)
    is_trusted: bool = False

    @property
    def text(self) -> str:
        """A sentence for the recording's assumptions, with the codes of findings in brackets; it is stored: rewording
        it changes the digests of artifacts."""
        judgement = self.judgement
        known = f"{judgement.told:.0%} of the depth of a frame, warped into another, meets what was measured there"
        known += f" ({judgement.n_pairs} pairs)"
        if not judgement.codes:
            return f"{known}; {SURE}"
        parts: list[str] = []
        for code, reason in judgement.reasons.items():
            if code in _QUESTIONS:
                parts += [*([] if parts else [known]), f"cannot tell {_QUESTIONS[code]}: {reason} [{code}]"]
            elif CODES[code].severity == "note":
                parts.append(f"cannot tell: {reason} [{code}]")
            else:
                parts.append(f"{reason} [{code}]")
        if judgement.objections and not set(ADVICE) & set(judgement.codes):
            parts.append(self.judgement.fix(self.offers))
        return "; ".join([*parts, *([TRUSTED] if self.is_trusted and judgement.objections else [])])

    def findings(self, place: str) -> list[Finding]:
        """What is wrong, or cannot be told; with `trusted` if it is read as told in spite of it."""
        found = self.judgement.findings(place, self.offers)
        if self.is_trusted and self.judgement.objections:
            found.append(Finding("trusted", place, ", ".join(self.judgement.objections)))
        return found

    def refuse(self, source: Path, camera: str) -> None:
        """Raise `BadData` if depth is sure that the recording is read wrongly and there is something to do about it."""
        refused = [code for code in self.judgement.objections if code not in NOTED]
        if self.is_trusted or not refused:
            return
        raise BadData(
            source,
            f"poses of {camera}",
            expected="a reading that depth supports",
            got="; ".join(f"{self.judgement.reasons[code]} [{code}]" for code in refused),
            fix=f"{self.judgement.fix(self.offers)}; --trust reads it as told.",
        )


@dataclass(frozen=True)
class Registration:
    """What colours and edges say: `fits`, `shifted` or `cannot tell`.

    Args:
        shift: how many pixels (u, v) colour lies away from depth.
        by: what says so: `colours` of the same surface, `edges`, or both; of `cannot tell`, what is at least alike.
    """

    verdict: str
    shift: tuple[int, int] = (0, 0)
    by: str = ""

    @property
    def text(self) -> str:
        """A sentence for the recording's assumptions, with the code of what is wrong in brackets."""
        if self.verdict == "fits":
            return f"depth lies on colour, by {self.by}"
        if self.verdict == "shifted":
            (u, v), distance = self.shift, float(np.hypot(*self.shift))
            return (
                f"by {self.by}, colour lies {distance:.0f} pixels (u {u:+d}, v {v:+d}) away from depth: depth seems "
                "not to be registered to colour, or the poses to be those of another camera; masks will lie beside "
                "the objects [depth-shifted]"
            )
        but = f"; {self.by} are alike, but before a plane they always are" if self.by else ""
        return f"cannot tell whether depth lies on colour{but}; --picture FILE shows the edges of both"

    def findings(self, place: str) -> list[Finding]:
        """The doctor's findings."""
        if self.verdict == "fits":
            return []
        if self.verdict == "shifted":
            return [Finding("depth-shifted", place, self.text.removesuffix(" [depth-shifted]"), SHIFTED_FIX)]
        fix = "look at the edges of depth over colour: `ingest --picture FILE`, `doctor --report FILE`"
        return [Finding("registration-unknown", place, self.text.rpartition(";")[0], fix)]


def codes_in(text: str) -> tuple[str, ...]:
    """The codes of findings in the text of an assumption."""
    return tuple(code for code in re.findall(r"\[([a-z-]+)\]", text) if code in CODES)


def advice(text: str) -> str:
    """What to do about the findings in the text of an assumption that state no remedy themselves."""
    known = {**ADVICE, "depth-shifted": SHIFTED_FIX}
    said = dict.fromkeys(known[code] for code in codes_in(text) if code in known)
    return f".  fix: {'; '.join(said)}" if said and TRUSTED not in text else ""


def is_doubtful(text: str) -> bool:
    """Whether the text of an agreement says that a reading is not sure, or wrong."""
    return SURE not in text
