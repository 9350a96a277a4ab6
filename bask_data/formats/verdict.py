"""What depth says about the way a recording was read, in a form that is kept and shown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bask_data.errors import BadData

STILL = "a camera that does not move"
"""The rival that every reading must beat."""

SURE = "no other reading does as well"
"""Words of a text that says the reading is sure."""

GOOD_SHARE, CLEAR_GAIN = 0.6, 1.5
"""Another reading that neither explains so much of the depth, nor so many times more than the given one, may be wrong
itself, as under wrong intrinsics. Hand-held recordings have 0.5 to 0.7. Sensitivity not measured."""


@dataclass(frozen=True)
class Agreement:
    """What the depth of a recording says about the way it was read.

    Args:
        share: mean evidence of the given reading, in [0, 1].
        verdict: `fits`: sure; `other`: sure of another reading; `nothing fits`; `moved` and `may have moved`: the poses
            are all the same, but depth is not; `cannot tell`.
        better: the reading that fits better, in words or as options; for `other`.
        options: options that give the better reading, empty if there are none.
        fix: what to do instead where no option gives it, but the files can be mended.
        rivals: what cannot be told from the given reading; for `cannot tell`.
    """

    share: float
    n_pairs: int
    verdict: str
    better: str = ""
    better_share: float = 0.0
    options: str = ""
    rivals: tuple[str, ...] = ()
    fix: str = ""

    @property
    def text(self) -> str:
        """A sentence for the recording's assumptions; it is stored: rewording it changes the digests of artifacts."""
        if self.rivals == (STILL,) and self.share == 0:
            return "cannot tell: the camera does not move, so nothing shows how its pose is meant"
        if self.n_pairs == 0:
            return "cannot tell: a single frame has nothing to hold its pose against, and shows objects from one side"
        share = f"{self.share:.0%} of the depth of a frame, warped into another, meets what was measured there"
        if self.verdict == "fits":
            return f"{share} ({self.n_pairs} pairs); {SURE}"
        if self.verdict == "other":
            return f"{share}; with {self.better} it would be {self.better_share:.0%} ({self.n_pairs} pairs)"
        if self.verdict == "nothing fits":
            return f"{share}, no more than for {STILL} ({self.n_pairs} pairs): these poses do not belong to this depth"
        if self.verdict in ("moved", "may have moved"):
            return f"{share} ({self.n_pairs} pairs), though all poses are the same: the camera {self.verdict}"
        return f"cannot tell from {', '.join(self.rivals)}: {share} ({self.n_pairs} pairs)"

    def refuse(self, source: Path, camera: str) -> None:
        """Raise `BadData` if depth is sure that the recording is read wrongly and there is something to do about it."""
        if self.verdict == "other" and self.options:
            fix = f"pass {self.options}; --trust reads it as told."
            if self.better_share < min(GOOD_SHARE, CLEAR_GAIN * self.share):
                fix = f"check the intrinsics first, as neither fits well. If they are right, {fix}"
        elif self.verdict == "other" and self.fix:
            fix = f"{self.fix}; --trust reads it as told."
        elif self.verdict == "nothing fits":
            fix = "check that poses, depth and intrinsics belong together, and depth's unit; --trust reads it as told."
        elif self.verdict == "moved":
            fix = "pass the poses of this recording, one for each frame; --trust reads it as told."
        else:
            return
        raise BadData(source, f"poses of {camera}", expected="a reading that depth supports", got=self.text, fix=fix)


def is_doubtful(text: str) -> bool:
    """Whether the text of an agreement says that a reading is not sure, or wrong."""
    return SURE not in text
