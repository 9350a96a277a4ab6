"""Matches of a pair of frames that descriptors are measured on, and how the views of the pair differ."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from bask_data.evaluation.frames import Frame

if TYPE_CHECKING:
    import numpy as np

LEAST_MATCHES = 6
"""Pairs with fewer matches are left out."""
SCALES = (1.25, 1.75)
"""Edges of the bins of changes of scale, as factors: neighbouring views of a path, up to most of an octave, more."""
ROTATIONS_DEG = (30.0, 60.0, 90.0)
"""Edges of the bins of rotations in the image, degrees; training rotates views by any angle."""
VISIBLE = (0.6, 0.9)
"""Edges of the bins of visible shares of the object. None of these edges changes a figure over all matches."""
BINS = {
    "scale": ("<1.25", "1.25-1.75", ">=1.75"),
    "rotation": ("0-30", "30-60", "60-90", ">=90"),
    "occlusion": ("visible <60%", "visible 60-90%", "visible >=90%"),
}


@dataclass(frozen=True)
class PairMatches:
    """Matches from one frame to another.

    Attributes:
        is_random: the pair was drawn at random, rather than to fill bins.
        uv_a, uv_b: pixels of the images (m, 2).
        label: object of each (m,).
        points_b: matched surface points (m, 3), metres, frame of the second camera; NaN without depth.
        scale: factor by which the images differ in scale (m,), at least 1; NaN without depth.
        rotation: rotation between the images (m,), radians in [0, pi]; NaN without depth.
        visible: share of the object that is not occluded in the second image (m,).
    """

    scene: str
    a: Frame
    b: Frame
    is_random: bool
    uv_a: np.ndarray
    uv_b: np.ndarray
    label: np.ndarray
    points_b: np.ndarray
    scale: np.ndarray
    rotation: np.ndarray
    visible: np.ndarray

    def some(self, which: np.ndarray) -> PairMatches:
        """The same pair with some of its matches."""
        names = ("uv_a", "uv_b", "label", "points_b", "scale", "rotation", "visible")
        return replace(self, **{name: getattr(self, name)[which] for name in names})

    def bins(self) -> dict[str, np.ndarray]:
        """Bin number of each match (m,), by kind of bin; -1 where it is unknown."""
        import numpy as np

        values = {"scale": self.scale, "rotation": np.degrees(self.rotation), "occlusion": self.visible}
        edges = {"scale": SCALES, "rotation": ROTATIONS_DEG, "occlusion": VISIBLE}
        return {
            name: np.where(np.isnan(value), -1, np.searchsorted(edges[name], value, side="right"))
            for name, value in values.items()
        }


def bin_counts(pair: PairMatches) -> np.ndarray:
    """Number of matches in each bin of each kind, one after the other."""
    import numpy as np

    bins = pair.bins()
    return np.concatenate([np.bincount(bins[name] + 1, minlength=len(BINS[name]) + 1)[1:] for name in BINS])
