"""Reference keypoints: their descriptors, and where each was picked."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.artifact import REMAKE, Artifact, Metadata
from bask_data.errors import BadData
from bask_data.kinds.arrays import read_all, start, write_array
from bask_data.specs import ArraySpec
from bask_data.spelling import number_of

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.calibration import Calibration

LARGEST_MEASURED = 1e6
"""Largest alpha and tau ratio that are read: with it, single precision overflows nowhere. `reference` measures at most
64."""

LARGEST_DESCRIPTOR = 1e15
"""Largest number of a descriptor that is read: sums of the squares of thousands are finite in single precision. Chosen,
far beyond any network's; sensitivity not measured."""


class Recognition(Metadata):
    """How well a network recognises a keypoint, frame by frame, measured before any demonstration is encoded.

    Args:
        error: expected error, metres: mean distance of a frame's best match from the keypoint's place.
        share_found: share of the frames whose best match is within 2 cm of it.
        n_frames: frames that show the place.
        scans: scans of these frames: other scans than that of the pick if the object is recognised in any.
        is_ambiguous: at least half of the frames have places 4 cm or more apart that match equally well, as on a
            symmetric object.
    """

    error: float
    share_found: float
    n_frames: int
    scans: tuple[str, ...]
    is_ambiguous: bool


class Pick(Metadata):
    """Where a keypoint was picked.

    Args:
        recording: scene or demonstration.
        u, v: pixel of the recording's image; integers are pixel centres.
        instance: instance in the scene's masks; 0 if unknown.
        point_world: metres, world frame of that recording; None without depth.
        recognition: how well it is recognised; None: not measured.
    """

    name: str
    recording: str
    camera: str
    frame: int
    u: float
    v: float
    instance: int = 0
    point_world: tuple[float, float, float] | None = None
    recognition: Recognition | None = None


class ReferenceMetadata(Metadata):
    """The picks, in the order of the keypoints."""

    picks: list[Pick]


class ReferenceKeypoints(Artifact):
    """Reference descriptors of k keypoints."""

    kind = "reference"
    scope = "dataset"
    has_variants = True
    metadata_model = ReferenceMetadata
    arrays = {
        "descriptors": ArraySpec(("k", "d"), "float32", "Descriptor of each keypoint where it was picked."),
        "alpha": ArraySpec(
            ("k",),
            "float64",
            "Temperature of the filters, measured: a pixel at distance z has likelihood exp(-alpha z).",
            optional=True,
        ),
        "tau_ratio": ArraySpec(
            ("k",),
            "float64",
            "Likelihood of an image that does not show the keypoint, over that at its average pixel, measured.",
            optional=True,
        ),
        "sharp_alpha": ArraySpec(
            ("k",), "float64", "Temperature of a single frame's heat map, measured.", optional=True
        ),
    }

    @cached_property
    def descriptors(self) -> np.ndarray:
        """Descriptors (k, d) float32; `BadData` if they are not finite, or above `LARGEST_DESCRIPTOR`."""
        import numpy as np

        descriptors = read_all(self.group, "descriptors", self.path)
        if not np.isfinite(descriptors).all():
            raise BadData(self.path, "descriptors", expected="finite numbers", got="NaN or infinity", fix=REMAKE)
        largest = float(np.abs(descriptors).max(initial=0))
        if largest > LARGEST_DESCRIPTOR:
            expected = f"numbers of at most {LARGEST_DESCRIPTOR:g}"
            raise BadData(self.path, "descriptors", expected=expected, got=f"{largest:g}", fix=REMAKE)
        return descriptors

    @cached_property
    def calibration(self) -> Calibration | None:
        """Temperature and tau as measured; None where nothing could be measured, and in artifacts from before.

        Raises:
            BadData: there is not one positive number, of at most `LARGEST_MEASURED`, for each keypoint.
        """
        from bask_data.core.calibration import Calibration

        if "tau_ratio" not in self.group:
            return None
        values = {name: read_all(self.group, name, self.path) for name in ("alpha", "tau_ratio", "sharp_alpha")}
        k = len(self.picks)
        for name, value in values.items():
            is_shaped = value.shape == (k,) and value.dtype.kind == "f"
            if not is_shaped or not ((value > 0) & (value <= LARGEST_MEASURED)).all():
                expected = f"{k} numbers above 0, at most {LARGEST_MEASURED:g}"
                got = str(value.tolist()) if is_shaped else f"{value.shape} {value.dtype}"
                raise BadData(self.path, name, expected=expected, got=got, fix=REMAKE)
        return Calibration(**values)

    @property
    def picks(self) -> list[Pick]:
        """Where each keypoint was picked."""
        return self.metadata.picks

    @property
    def names(self) -> list[str]:
        """Names of the keypoints."""
        return [pick.name for pick in self.picks]

    def summary(self) -> list[str]:
        """Expected errors, and the ambiguous keypoints, as lines of text."""
        return recognition_lines(self.picks)

    @staticmethod
    def write(out: Path, *, descriptors: np.ndarray, picks: list[Pick], calibration: Calibration | None = None) -> None:
        """Write descriptors (k, d), their k picks and what was measured for the filters, if anything."""
        group = start(out, ReferenceKeypoints, {"picks": [pick.model_dump() for pick in picks]})
        write_array(group, ReferenceKeypoints, "descriptors", descriptors)
        if calibration is not None:
            for name in ("alpha", "tau_ratio", "sharp_alpha"):
                write_array(group, ReferenceKeypoints, name, getattr(calibration, name))


def ambiguous(picks: Sequence[Pick]) -> list[str]:
    """Names of the keypoints that are ambiguous."""
    return [pick.name for pick in picks if pick.recognition is not None and pick.recognition.is_ambiguous]


def recognition_lines(picks: Sequence[Pick]) -> list[str]:
    """How well keypoints are recognised, for people: the expected error of each, then those that are ambiguous."""
    lines = [f"{pick.name}: {_in_words(pick)}" for pick in picks]
    if unsure := ambiguous(picks):
        lines.append(
            f"ambiguous, as several places look the same: {', '.join(unsure)}.  fix: pick others with --pick, or "
            "expect a track that jumps between these places."
        )
    return lines


def _in_words(pick: Pick) -> str:
    known = pick.recognition
    if known is None:
        return "expected error not measured, as no other frame of a scan shows it; objects move in demonstrations"
    own = ", its own scan: expect more in others" if known.scans == (pick.recording,) else ""
    frames, ambiguity = number_of(known.n_frames, "frame"), "; ambiguous" if known.is_ambiguous else ""
    return (
        f"expected error {1000 * known.error:.0f} mm, found within 20 mm in {known.share_found:.0%} of "
        f"{frames} of {', '.join(known.scans)}{own}{ambiguity}"
    )
