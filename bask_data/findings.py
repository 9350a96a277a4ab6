"""What the doctor finds: each finding has a code with a fixed severity and meaning, a place, evidence and a fix.

`CODES` is the only list of codes; docs/doctor.md shows it, and scripts may rely on the names.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]
"""error: results will be wrong; warning: look at it; note: good to know, or what cannot be told from the data."""

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""The worst first."""


@dataclass(frozen=True)
class Code:
    """What a kind of finding means.

    Args:
        meaning: one sentence for people who see it for the first time.
    """

    severity: Severity
    meaning: str


CODES = {
    # Poses, depth and intrinsics of one camera, judged by warping depth from frame to frame.
    "other-reading": Code("error", "Depth is sure that the poses are meant another way: direction, axes or order."),
    "other-unit": Code("error", "Depth is sure that depth or poses are in another unit."),
    "other-depth": Code("error", "Depth is sure that its values are the length of the ray, not z, or the reverse."),
    "other-clock": Code(
        "error", "Depth is sure that the poses are those of other frames, some frames earlier or later."
    ),
    "other-intrinsics": Code("error", "Depth is sure that the intrinsics are for images of another size."),
    "poses-unrelated": Code(
        "error", "No reading makes depth of one frame meet that of another: these poses do not belong to these images."
    ),
    "camera-moved": Code("error", "All poses are the same, but depth changes: the camera moved."),
    "clock-unknown": Code(
        "warning", "Depth fits better with the poses of earlier or later frames, but it is open by how many."
    ),
    "intrinsics-unknown": Code(
        "warning", "Depth fits better with other intrinsics, but not with those of a usual size."
    ),
    "poses-repeated": Code("warning", "Poses stay the same for some frames while the images change."),
    "reading-unknown": Code("warning", "How poses are meant cannot be told from this recording."),
    "axes-unknown": Code(
        "warning", "The axes of the camera, for instance OpenCV or OpenGL, cannot be told, as it hardly turns."
    ),
    "unit-unknown": Code("warning", "The unit of depth and poses cannot be told, as the camera hardly translates."),
    "hardly-moves": Code("note", "The camera hardly moves, so poses cannot be judged."),
    "few-views": Code("note", "Too few frames overlap to judge poses."),
    "depth-shifted": Code("warning", "Depth does not lie on colour; masks will lie beside the objects."),
    "registration-unknown": Code("note", "Whether depth lies on colour cannot be told from the images."),
    "trusted": Code("note", "What depth objects to was overridden with --trust."),
    "depth-rotated": Code("error", "The bits of depth are rotated, as APC's: far values start again near 0."),
    # Sensor: images, depth, single frames and stamps.
    "depth-none": Code("warning", "Frames have no depth at all."),
    "depth-sparse": Code("warning", "Much of the images has no depth."),
    "depth-stuck": Code("warning", "The same depth image comes again although colour changes."),
    "depth-saturated": Code("warning", "Depth stands at the end of a range: these values are no distances."),
    "depth-quantised": Code("warning", "Values of depth are so far apart that surfaces become steps."),
    "depth-noise": Code("warning", "Depth is noisier than usual for a depth camera."),
    "depth-bowl": Code(
        "warning", "Planes are measured as bowls: depth errs with the distance from the image's middle."
    ),
    "frames-black": Code("warning", "Frames show one colour: black, covered, or lost."),
    "frames-duplicate": Code("warning", "The same colour image comes again although the pose or depth changes."),
    "frames-resting": Code(
        "note", "Frames are the same in colour, depth and pose: the robot waits, or the camera hung."
    ),
    "frames-blurred": Code("note", "Frames are far less sharp than those around them."),
    "exposure-jump": Code("warning", "The same surfaces are suddenly brighter or darker."),
    "frame-off": Code(
        "warning", "A frame's pose is wrong: it lies far from both neighbours, which lie near each other."
    ),
    "pose-jump": Code("warning", "The poses make a step that the surfaces do not make."),
    "drift": Code("warning", "Frames far apart in time disagree about the same surfaces, although neighbours agree."),
    "time-gap": Code("warning", "Stamps are missing."),
    "time-backwards": Code("warning", "Stamps do not increase."),
    "time-jitter": Code("note", "Stamps are irregular."),
    "time-apart": Code("warning", "Frames of two cameras of the same number were not taken at the same time."),
    # Reading of a source.
    "unreadable": Code("error", "A file is missing, damaged, or contradicts the options: `ingest` refuses it."),
    "not-examined": Code("note", "Only a part of the source was examined."),
    # Dataset: recordings and artifacts looked at together.
    "split-leak": Code("error", "The same scene is in two splits: results on one of them say nothing."),
    "scene-twice": Code("warning", "Two recordings show the same images: they count double."),
    "instance-empty": Code("warning", "A scan has no object, or no frame shows an object."),
    "instance-tiny": Code("warning", "An object is so small that it is more likely a splinter of a surface."),
    "masks-vanish": Code("warning", "The mask of an object is empty in most frames that should show it."),
    "objects-differ": Code("warning", "A scan has far more or fewer objects than the others of the dataset."),
    "demonstration-still": Code("warning", "The robot does not move in a demonstration."),
    "gripper-still": Code("note", "The gripper never opens or closes in a demonstration."),
    "keypoints-collapsed": Code("warning", "The keypoints of a demonstration lie at nearly one place."),
    "keypoints-exploded": Code(
        "warning", "The positions of keypoints are uncertain by more than a quarter of a metre."
    ),
    "keypoints-outside": Code("warning", "Keypoints lie outside of everything that the cameras measured."),
    "version-old": Code("note", "An artifact was made by an older version, and opens as it is."),
    "version-unreadable": Code("warning", "An artifact was made by an older version, and has to be made again."),
    "stale": Code("note", "An artifact was made from other inputs than are there."),
    "unlisted-file": Code("warning", "A file or folder in the dataset belongs to no artifact."),
    "damaged": Code("error", "Files of an artifact are missing or have changed."),
    # Refine.
    "refined": Code("note", "Depth of frames meets better with corrected poses, which were written."),
    "refine-no-better": Code("note", "No correction of the poses makes depth of frames meet clearly better."),
    "refine-cannot-tell": Code("note", "Whether the poses could be corrected cannot be told from this recording."),
    # Objects found on the support.
    "no-object": Code("warning", "No object was found."),
    "support-uncertain": Code("warning", "Which plane the objects stand on, or how far it reaches, is not certain."),
    "objects-touch": Code("warning", "An object is hollow, or is several objects that touch."),
    "object-one-side": Code("note", "Objects were seen from one side only; nothing is learned of their other sides."),
    "object-cut": Code(
        "warning", "Something is cut by the border of what was seen: it may belong to the robot or the room."
    ),
    "object-floating": Code("warning", "Something does not stand on the support: it may hang, or belong to the robot."),
    "object-with-camera": Code("warning", "Something moves with the camera, as a gripper does, or moved by itself."),
    "object-flat": Code("note", "Something is flat on the support: a thin object, or the support's own unevenness."),
    # What the stages made, judged by its figures; evaluation/usual.py has the ranges.
    "surface-unexplained": Code("error", "Most of the measured depth is not on the surface: the recording is wrong."),
    "surface-doubtful": Code("warning", "Less of the measured depth is on the surface than usual."),
    "frames-disagree": Code("warning", "Many frames do not fit the surface that the others make."),
    "frame-disagrees": Code("note", "Some frames do not fit the surface that the others make."),
    "unmeasured": Code(
        "warning", "Cameras saw something without measuring its depth; masks are missing or wrong there."
    ),
    "stage-warning": Code("warning", "The stage noted something when it ran."),
    "objects-none": Code("error", "No object was found, so there are no masks and no matches."),
    "objects-doubtful": Code("warning", "Objects may be merged, missing, or parts of the background."),
    "objects-merged": Code("warning", "Objects with labels of their own were found as one."),
    "masks-empty": Code("error", "No mask shows anything."),
    "masks-unconfirmed": Code("warning", "Less of the masks is confirmed by depth than usual."),
    "masks-contradicted": Code("warning", "Depth contradicts the surface at many pixels of the objects."),
    "masks-off": Code("warning", "Masks overlap less with the labels than usual."),
    "masks-wrong": Code("error", "Masks hardly overlap with the labels."),
    "no-matches": Code("error", "There is nothing to train on."),
    "few-matches": Code("warning", "Objects, pairs or pixels have fewer matches than usual."),
    "network-weak": Code("warning", "The network recognises fewer points than usual."),
    "network-poor": Code("error", "The network does not recognise points in other views."),
    "keypoints-weak": Code("warning", "The keypoints are found less exactly than usual."),
    "keypoints-poor": Code("error", "The network does not recognise the keypoints in other views."),
    "keypoints-ambiguous": Code("warning", "Several places look like a keypoint, so that its track may jump."),
    "track-gaps": Code("warning", "Keypoints have no position in more frames than usual."),
    "track-lost": Code("error", "Keypoints have no position in most frames."),
    "track-off": Code("warning", "Tracked keypoints are farther from ground truth than usual."),
    "track-wrong": Code("error", "Tracked keypoints are far from ground truth."),
    "track-uncertain": Code("warning", "The filter is less certain of the keypoints than usual."),
    "track-jumps": Code("warning", "Keypoints jump from frame to frame."),
    # Identity of objects across scans.
    "identity-unknown": Code("note", "An object has no likely partner in another scan, or several that tie."),
    "identity-twins": Code("note", "Objects of one scan look the same: which one is which cannot be told."),
}
"""All codes, by subject."""


@dataclass(frozen=True)
class Finding:
    """One thing found.

    Args:
        code: one of `CODES`.
        place: what it is about: `table/wrist`, `table/wrist 12`, `masks of table`, a file.
        evidence: what was measured, with the number and what is usual.
        fix: what to do, a command or options where there are any.
    """

    code: str
    place: str
    evidence: str
    fix: str = ""

    @property
    def severity(self) -> Severity:
        """How bad it is."""
        return CODES[self.code].severity

    @property
    def meaning(self) -> str:
        """What the code means."""
        return CODES[self.code].meaning

    def as_json(self) -> dict[str, str]:
        """All of it as plain values."""
        return {
            "code": self.code,
            "severity": self.severity,
            "place": self.place,
            "meaning": self.meaning,
            "evidence": self.evidence,
            "fix": self.fix,
        }


def by_severity(findings: Iterable[Finding]) -> list[Finding]:
    """The worst first, otherwise in the given order."""
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))
