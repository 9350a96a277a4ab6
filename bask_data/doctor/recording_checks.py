"""What is wrong with the images, the depth, single frames and the stamps of a camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

from bask_data.doctor.depth_checks import depth_findings
from bask_data.doctor.frame_words import frames_in_words
from bask_data.doctor.pose_checks import pose_findings
from bask_data.findings import Finding

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.sensor_frames import FrameMeasures

Read = Callable[[int], "tuple[np.ndarray, np.ndarray]"]
"""Gives the colour (h, w, 3) uint8 and the depth (h, w) float32, metres, 0 = none, of a frame."""

MOST_DECODED = 80
"""Frames decoded of a recording by default; longer ones are sampled. Chosen to bound time."""

LEAST_RESTING = 0.1
"""Share of the frames that repeat the one before below which a robot's waiting is not worth a note."""


def sensor_findings(
    place: str,
    n_frames: int,
    read: Read,
    Ks: np.ndarray,
    world_from_cameras: np.ndarray,
    time: np.ndarray,
    most_frames: int = MOST_DECODED,
) -> list[Finding]:
    """What is wrong with the images, the depth, single frames and the stamps of a camera.

    Frames are read once, in order, and none is kept.

    Args:
        place: the camera, for the findings: `table/wrist`.
        Ks: (t, 3, 3), pixels.
        world_from_cameras: (t, 4, 4), metres.
        time: (t,), seconds.
        most_frames: frames that are decoded; of more, pairs of neighbours spread over the recording are.
    """
    from bask_data.core.sensor_frames import measures_of
    from bask_data.core.sensor_motion import NeighbourPairs
    from bask_data.core.sensor_sample import looked_at

    frames: list[FrameMeasures] = []
    width = 0
    for i_frame in looked_at(world_from_cameras[:n_frames], most_frames):
        rgb, depth = read(i_frame)
        width = depth.shape[1]
        frames.append(measures_of(i_frame, rgb, depth, Ks[i_frame]))
    # Depth of another moment would have poses blamed for it.
    own = [b for a, b in pairwise([None, *frames]) if b and b.measured > 0 and not (a and a.depth_hash == b.depth_hash)]
    pairs = NeighbourPairs(own, world_from_cameras)
    findings = [
        *_image_findings(place, frames, world_from_cameras),
        *depth_findings(place, frames, width),
        *pose_findings(place, pairs),
        *_stamp_findings(place, time),
    ]
    if len(frames) < n_frames:
        looked = f" ({len(frames)} of {n_frames} frames looked at)"
        findings = [Finding(f.code, f.place, f.evidence + looked, f.fix) if _is_sampled(f) else f for f in findings]
    return findings


def _is_sampled(finding: Finding) -> bool:
    return not finding.code.startswith("time-")


# Images ---------------------------------------------------------------------------------------------------------------


def _image_findings(place: str, frames: Sequence[FrameMeasures], world_from_cameras: np.ndarray) -> list[Finding]:
    from bask_data.core import sensor_images

    findings = []
    if plain := sensor_images.one_coloured(frames):
        greys = f"grey level {min(f.grey for f in plain):.0f} to {max(f.grey for f in plain):.0f} of 255"
        findings.append(
            Finding(
                "frames-black",
                place,
                f"{frames_in_words(f.index for f in plain)}: {greys}",
                "leave them out: --frames.",
            )
        )
    repeats = sensor_images.repeats(frames, world_from_cameras)
    if repeats.colour:
        findings.append(
            Finding(
                "frames-duplicate",
                place,
                f"{frames_in_words(repeats.colour)} repeat the colour image of the frame before",
                "record colour at the rate of the poses, or leave them out: --frames.",
            )
        )
    if repeats.depth:
        findings.append(
            Finding(
                "depth-stuck",
                place,
                f"{frames_in_words(repeats.depth)} repeat the depth image of the frame before",
                "record depth at the rate of colour, or leave these frames out: --frames.",
            )
        )
    # A camera on a stand before a static scene rests from beginning to end, as it should.
    if LEAST_RESTING * len(frames) <= len(repeats.all) < len(frames) - 1:
        findings.append(
            Finding(
                "frames-resting", place, f"{frames_in_words(repeats.all)} change nothing", "cut them off: --frames."
            )
        )
    if blurred := sensor_images.blurred(frames):
        worst = min(share for _, share in blurred)
        findings.append(
            Finding(
                "frames-blurred",
                place,
                f"{frames_in_words(i for i, _ in blurred)}: down to {worst:.0%} of the sharpness of the frames around",
                "move the camera slower, or expose for a shorter time.",
            )
        )
    return findings


# Stamps ---------------------------------------------------------------------------------------------------------------


def _stamp_findings(place: str, time: np.ndarray) -> list[Finding]:
    from bask_data.core import sensor_images

    found = sensor_images.stamps(time)
    if found is None:
        return []
    findings = []
    if found.backwards:
        findings.append(
            Finding(
                "time-backwards",
                place,
                f"after {frames_in_words(found.backwards)} time stands still or goes back",
                "sort the frames by time, or correct the stamps.",
            )
        )
    # Where many steps are long, frames were chosen, not lost.
    if found.gaps and len(found.gaps) <= 0.1 * len(time):
        listed = ", ".join(f"{seconds:.2f} s after frame {k}" for k, seconds in found.gaps[:5])
        more = f" and {len(found.gaps) - 5} more" if len(found.gaps) > 5 else ""
        findings.append(
            Finding(
                "time-gap",
                place,
                f"{listed}{more}; frames are {found.period:.3f} s apart in the median",
                "frames were lost while recording: check the disc and the driver. Split demonstrations there.",
            )
        )
    elif found.jitter > 0.25 or found.gaps:
        findings.append(
            Finding("time-jitter", place, f"steps differ from {found.period:.3f} s by {found.jitter:.0%} in the median")
        )
    return findings


def stamp_findings(place: str, times: Mapping[str, np.ndarray]) -> list[Finding]:
    """Whether frames of the same number of several cameras were taken at the same time.

    Args:
        place: the recording.
        times: stamps of each camera, seconds.
    """
    import numpy as np

    findings = []
    for (a, time_a), (b, time_b) in combinations(times.items(), 2):
        if len(time_a) != len(time_b) or len(time_a) < 2:
            continue
        period = float(np.median(np.diff(time_a)))
        apart = float(np.median(np.abs(time_b - time_a)))
        if period > 0 and apart > 0.5 * period:
            findings.append(
                Finding(
                    "time-apart",
                    place,
                    f"{a} and {b}: {apart:.3f} s apart in the median, frames follow each other in {period:.3f} s",
                    "pair the frames by time, not by number.",
                )
            )
    return findings
