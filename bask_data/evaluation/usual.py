"""Usual ranges of the figures that verdicts are about: each with the values it is based on.

A figure outside its usual range is worth a look; beyond `bad`, results will be wrong. The values named were measured on
simulated tables, on the shelf that ships, on a scan of transparent containers, and on a recording whose poses were read
the wrong way; the ranges were set before, and not moved to make one of them pass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Usual:
    """Where a figure usually lies.

    Args:
        look: end of the usual range.
        bad: value beyond which results will be wrong; equal to `look` if nothing lies between.
        text: the range in words.
        higher_is_better: whether the range begins, not ends, at `look`.
    """

    look: float
    bad: float
    text: str
    higher_is_better: bool = True

    def is_unusual(self, value: float) -> bool:
        """Whether the figure is outside its range; NaN is not."""
        return value < self.look if self.higher_is_better else value > self.look

    def is_bad(self, value: float) -> bool:
        """Whether results will be wrong with this figure; NaN says nothing."""
        return value < self.bad if self.higher_is_better else value > self.bad


AGREEMENT = Usual(0.4, 0.25, "40 % or more")
"""Share of a frame's depth that meets another's: exact synthetic depth has 86 %, hand-held recordings 50 to 70 %. Below
25 %, no recording in the tests is read rightly."""

EXPLAINED = Usual(0.75, 0.6, "75 % or more")
"""Share of the depth on the mesh: 99 % simulated, 86 % on the shelf, 91 % around the containers; 18 % with poses that
point the other way. `reconstruct` warns below 60 %. Sensitivity not measured."""

SUSPECT = Usual(0.05, 1.0, "5 % or fewer", higher_is_better=False)
"""Share of the frames that disagree with the mesh. Sensitivity not measured."""

CONFIRMED = Usual(0.7, 0.0, "70 % or more")
"""Share of the masks' pixels with measured depth: 99 % simulated, 80 % around the containers. Where it is less, masks
are inferred from the mesh. Sensitivity not measured."""

CONTRADICTED = Usual(0.15, 1.0, "15 % or less", higher_is_better=False)
"""Share of the objects' pixels whose depth lies behind the surface, or in front of it without being an occluder: on
simulated tables 2 to 3 %; 43 % where poses pointed the other way."""

IOU = Usual(0.7, 0.4, "0.7 or more")
"""Mean IoU with labels: simulated tables have 0.98, hand-labelled shelves 0.74 and 0.78 (docs/results.md)."""

ACCEPTED = Usual(0.1, 0.0, "10 % or more")
"""Share of the pixels tried that became matches: 33 to 37 % simulated, 10 % on the shelf, 5 % with poses that point the
other way. Sensitivity not measured."""

FOUND = Usual(0.7, 0.4, "70 % or more")
"""Share of the matches that a network finds within 4 % of the diagonal, in views that it did not learn from: on two
held-out simulated tasks 85 %, the paper's baseline 68 % (docs/results.md)."""

EXPECTED_ERROR = Usual(0.02, 0.1, "2 cm or less", higher_is_better=False)
"""Expected error of keypoints, metres: within 2 cm, `reference` counts a keypoint as found. Sensitivity not
measured."""

LOCALISED = Usual(0.9, 0.5, "90 % or more")
"""Share of the frames in which keypoints have a position. Sensitivity not measured."""

TRACK_ERROR = Usual(0.05, 0.15, "5 cm or less", higher_is_better=False)
"""Median error of tracked keypoints, metres: 0.2 to 4.8 cm where they are seen (docs/results.md)."""

SPREAD = Usual(0.05, 1.0, "5 cm or less", higher_is_better=False)
"""Median spread of tracked keypoints, metres. Sensitivity not measured."""

JUMP_M, JUMPS = 0.1, Usual(0.02, 1.0, "2 % or fewer", higher_is_better=False)
"""Motion from one frame to the next that counts as a jump, metres: 3 m/s at 30 Hz. And the share of jumps. Chosen,
sensitivity not measured."""


def percent(share: float) -> str:
    """A share in words; a dash if unknown."""
    return "–" if math.isnan(share) else f"{100 * share:.0f} %"


def length(metres: float) -> str:
    """A length in words."""
    return "unknown" if math.isnan(metres) else f"{1000 * metres:.0f} mm"
