"""What is wrong with the depth of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from bask_data.doctor.frame_words import frames_in_words
from bask_data.findings import Finding

if TYPE_CHECKING:
    from bask_data.core.sensor_frames import FrameMeasures

LEAST_MEASURED = 0.5
"""Median share of the pixels with depth below which that is said. Real recordings have 0.26 to 0.95, the sparse ones
registered to colour without filling."""

COARSE_STEP = 0.01
"""Distance of neighbouring values of depth, relative to depth: a Kinect has it from 3.5 m on, 8 bits always."""

NOISY = 0.015
"""Noise relative to depth: depth cameras in their range have 0.001 to 0.01."""

BOWL = 0.004
"""Error at the image's edge, relative to depth. Of two real recordings with planes, one, said to be a bowl, has 0.006,
the other 0.002."""


def depth_findings(place: str, frames: Sequence[FrameMeasures], width: int) -> list[Finding]:
    """What is wrong with the depth of some frames.

    Args:
        width: of the images, pixels.
    """
    import numpy as np

    from bask_data.core import sensor_depth, sensor_images

    findings = []
    seen = [frame for frame in frames if frame.measured > 0]
    if len(seen) < len(frames):
        blind = frames_in_words(frame.index for frame in frames if frame.measured == 0)
        findings.append(Finding("depth-none", place, blind, "leave them out: --frames; or check the depth files."))
    if not seen:
        return findings
    share = float(np.median([frame.measured for frame in seen]))
    if share < LEAST_MEASURED:
        findings.append(
            Finding(
                "depth-sparse",
                place,
                f"{share:.0%} of the pixels have depth in the median frame; usual are 50 to 95 %",
                "masks and points are limited to these pixels; nearer, or with less shiny surfaces, there is more.",
            )
        )
    if patchy := sensor_images.patchy(seen):
        findings.append(
            Finding(
                "depth-sparse",
                place,
                f"{frames_in_words(i for i, _ in patchy)}: down to {min(s for _, s in patchy):.0%} of the pixels have "
                "depth, less than half as many as in the frames around",
                "leave them out: --frames.",
            )
        )
    for end in sensor_depth.range_ends(seen):
        what = "which is no distance but a mark" if end.is_mark else "the end of a range"
        findings.append(
            Finding(
                "depth-saturated",
                place,
                f"{end.share:.2%} of the measured pixels are exactly {end.value:.6g} m, {what}, in {end.n_frames} of "
                f"{len(seen)} frames",
                "set these values to 0, which means no measurement, before ingest.",
            )
        )
    return findings + _accuracy_findings(place, seen, width)


def _accuracy_findings(place: str, seen: Sequence[FrameMeasures], width: int) -> list[Finding]:
    import numpy as np

    from bask_data.core import sensor_depth

    findings = []
    steps = [frame.step for frame in seen if np.isfinite(frame.step)]
    depth = float(np.median([frame.typical_depth for frame in seen]))
    if steps and (step := float(np.median(steps))) > COARSE_STEP:
        findings.append(
            Finding(
                "depth-quantised",
                place,
                f"neighbouring values are {1e3 * step * depth:.1f} mm apart at {depth:.2f} m, {step:.1%} of the depth; "
                "usual are 0.02 to 0.7 %",
                "store depth in 16 bits, in millimetres or finer.",
            )
        )
    noises = [frame.noise for frame in seen if np.isfinite(frame.noise)]
    if noises and (noise := float(np.median(noises))) > NOISY:
        findings.append(
            Finding(
                "depth-noise",
                place,
                f"{1e3 * noise * depth:.1f} mm at {depth:.2f} m, {noise:.1%} of the depth; usual are 0.1 to 1 %",
                "nearer there is less; use a filter over time, or more light for stereo cameras.",
            )
        )
    found = sensor_depth.bowl([frame.blocks for frame in seen], width, np.random.default_rng(0))
    if found is not None and found.is_sure and abs(found.edge) > BOWL:
        way = "too far" if found.edge > 0 else "too near"
        findings.append(
            Finding(
                "depth-bowl",
                place,
                f"planes are {1e3 * abs(found.edge) * found.depth:.1f} mm {way} at the image's edge at "
                f"{found.depth:.2f} m, {abs(found.edge):.1%} of the depth, in {found.n_frames} frames; usual is less "
                f"than {BOWL:.1%}",
                "calibrate the depth camera; look from the same distances in all scans.",
            )
        )
    return findings
