"""What is wrong with the poses and the exposure of single frames of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from bask_data.doctor.frame_words import frames_in_words
from bask_data.findings import Finding

if TYPE_CHECKING:
    from bask_data.core.sensor_motion import NeighbourPairs, WrongPose

BRIGHTER = 1.3
"""Factor between neighbouring frames that counts as a jump; exposure control of real recordings makes up to 1.2."""

DRIFTED = (0.002, 0.002)
"""(a, b): a + b z metres of disagreement that grow with time. Ten recordings without drift, real and simulated, have up
to 0.0025."""

GROWN = 2.5
"""Disagreement of frames far apart in time, relative to neighbours': real recordings have up to 1.9."""

TIMELY = 0.25
"""Share of the disagreement that must grow with time rather than with the view for it to be drift."""


def pose_findings(place: str, pairs: NeighbourPairs) -> list[Finding]:
    """What is wrong with the poses of single frames, drift among them, and with exposure."""
    from bask_data.core import sensor_images, sensor_motion

    findings: list[Finding] = []
    if len(pairs) < 3:
        return findings
    if factors := sensor_images.brightness_jumps(sensor_motion.brightness_steps(pairs), BRIGHTER):
        worst = max(factors, key=lambda item: max(item[1], 1 / item[1]))
        findings.append(
            Finding(
                "exposure-jump",
                place,
                f"{frames_in_words(i for i, _ in factors)}: the same surfaces are up to {worst[1]:.2f} times as bright "
                "as in the frame before",
                "fix exposure and white balance while recording.",
            )
        )
    if not pairs.is_fit:
        # Poses as a whole do not fit depth, which the readings tell: no frame is better than the others.
        return findings
    repeated = sensor_motion.repeated_poses(pairs)
    if repeated:
        stretches = ", ".join(f"{run.first}-{run.last}" for run in repeated)
        findings.append(
            Finding(
                "poses-repeated",
                place,
                f"frames {stretches} have one pose each stretch, but the surfaces move by {_error(repeated)}",
                "leave these frames out: --frames; or record the poses again.",
            )
        )
    hanging = {k for run in repeated for k in range(run.first, run.last + 1)}
    off = [wrong for wrong in sensor_motion.off_frames(pairs) if wrong.first not in hanging]
    if off:
        findings.append(
            Finding(
                "frame-off",
                place,
                f"{frames_in_words(wrong.first for wrong in off)}: off by {_error(off)} against the frames before and "
                f"after, which differ by {1e3 * off[0].usual:.1f} mm otherwise",
                "leave them out: --frames, or reconstruct --exclude; or correct their poses.",
            )
        )
    steps = sensor_motion.path_breaks(pairs, {wrong.first for wrong in off})
    if steps := [step for step in steps if step.last not in hanging and step.first not in hanging]:
        listed = ", ".join(f"{step.first} and {step.last}" for step in steps[:5])
        more = f" and {len(steps) - 5} more" if len(steps) > 5 else ""
        findings.append(
            Finding(
                "pose-jump",
                place,
                f"between frames {listed}{more}: {_error(steps)} that the surfaces do not move; neighbours differ by "
                f"{1e3 * steps[0].usual:.1f} mm otherwise",
                "tracking was lost there: use the frames before or after, or bask-data refine.",
            )
        )
    return findings + ([] if off or steps or repeated else _drift_findings(place, pairs))


def _drift_findings(place: str, pairs: NeighbourPairs) -> list[Finding]:
    from bask_data.core import sensor_motion

    found = sensor_motion.drift(pairs)
    if found is None:
        return []
    depth = float(sorted(frame.typical_depth for frame in pairs.frames)[len(pairs) // 2])
    if found.far < GROWN * found.near:
        return []
    evidence = (
        f"frames far apart disagree by {1e3 * found.far:.1f} mm ({1e3 * found.shift:.0f} mm and "
        f"{_degrees(found.angle)} would mend it, {found.n_pairs} pairs), neighbours by {1e3 * found.near:.1f} mm"
    )
    if found.by_time > DRIFTED[0] + DRIFTED[1] * depth and found.by_time > TIMELY * found.far:
        return [Finding("drift", place, f"{evidence}; it grows with time", "bask-data refine.")]
    return []


def _error(wrong: Sequence[WrongPose]) -> str:
    """The largest error of some poses, in words."""
    shifts = [pose.shift for pose in wrong if pose.shift == pose.shift]
    angles = [pose.angle for pose in wrong if pose.angle == pose.angle]
    if not shifts:
        return "more than can be measured"
    return f"{'up to ' if len(wrong) > 1 else ''}{1e3 * max(shifts):.0f} mm and {_degrees(max(angles))}"


def _degrees(angle: float) -> str:
    from math import degrees

    return f"{degrees(angle):.1f} degrees"
