"""Demonstrations in which nothing moves, and keypoint tracks that collapsed, exploded or left the workspace."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from functools import partial

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import transform, unproject
from bask_data.dataset import Dataset
from bask_data.doctor.artifact_checks import unless_damaged
from bask_data.doctor.recording import sampled
from bask_data.evaluation.lookup import find
from bask_data.findings import Finding
from bask_data.kinds import Demonstration, KeypointTrack

STILL_M, STILL_DEG = 0.01, 2.0
"""A gripper that stays within so many metres and degrees of where it began does not move: below any manipulation, above
the noise of joint encoders. Sensitivity not measured."""

STILL_WIDTH = 0.001
"""Change of the gripper's opening, metres, below which it never opens or closes. Sensitivity not measured."""

COLLAPSED_M = 0.008
"""Median distance of keypoints from their common centre, metres, below which they lie at one place: the smallest
objects that are worth several keypoints have 2 cm. Sensitivity not measured."""

EXPLODED_M = 0.25
"""Standard deviation of a keypoint's position, metres, from which on it says nothing: a quarter of a table. A new
particle filter spreads over what it sees, and has less after some frames. Sensitivity not measured."""

EXPLODED_SHARE = 0.5
"""Share of frames in which that must be so. Sensitivity not measured."""

OUTSIDE_SHARE = 0.2
"""Share of a keypoint's frames that it may be outside of what the cameras measured. Sensitivity not measured."""

ROOM_M, ROOM_SHARE = 0.1, 0.1
"""What the box around the measured points is grown by on each side: metres, and share of its side."""

LEAST_KEYPOINTS = 3
"""Keypoints below which their spread says nothing: two may be neighbours on purpose."""

N_DEPTH_FRAMES, STRIDE = 6, 16
"""Frames of each camera, and step in rows and columns, from which the box of measured points is found."""


def demonstration_findings(dataset: Dataset, names: list[str]) -> list[Finding]:
    """What is wrong with the motion and the keypoints of these demonstrations."""
    findings: list[Finding] = []
    for name in names:
        demonstration = find(dataset, Demonstration, name)
        if demonstration is None:
            continue
        findings += unless_damaged(dataset, name, [demonstration], partial(_still, name, demonstration))
        for variant in dataset.variants(KeypointTrack):
            track = find(dataset, KeypointTrack, name, variant)
            if track is not None:
                place = f"keypoints of {name}" + ("" if variant == "main" else f" ({variant})")
                again = f"bask-data encode {shlex.quote(str(dataset.root))} --only {name}"
                findings += unless_damaged(
                    dataset, place, [demonstration, track], partial(_of_track, place, again, track, demonstration)
                )
    return findings


def _still(name: str, demonstration: Demonstration) -> Iterator[Finding]:
    """A robot that does not move, or never opens or closes its gripper."""
    robot = demonstration.robot
    if robot is None:
        return
    poses, width = robot.world_from_gripper, robot.gripper_width
    opening = float(np.ptp(width)) if width is not None and len(width) else None
    moves_gripper = opening is not None and opening >= STILL_WIDTH
    if poses is not None and len(poses):
        distance = float(np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max())
        cosine = (np.einsum("tij,ij->t", poses[:, :3, :3], poses[0, :3, :3]) - 1) / 2
        angle = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).max())
        if distance < STILL_M and angle < STILL_DEG and not moves_gripper:
            evidence = f"the gripper stays within {distance * 1e3:.1f} mm and {angle:.1f} degrees of where it began"
            fix = "leave the recording out, or check which poses were read as the gripper's"
            yield Finding("demonstration-still", name, evidence, fix)
            return
    if opening is not None and not moves_gripper:
        evidence = f"its opening changes by {opening * 1e3:.2f} mm"
        yield Finding("gripper-still", name, evidence, "check which column was read as the gripper's opening")


def _of_track(place: str, again: str, track: KeypointTrack, demonstration: Demonstration) -> Iterator[Finding]:
    """Keypoints at one place, nowhere in particular, or outside of what was measured."""
    mean, names = np.asarray(track.mean, dtype=np.float64), track.names
    if mean.shape[0] == 0:
        return
    spread = collapsed_spread(mean)
    if spread is not None and spread < COLLAPSED_M:
        evidence = (
            f"{len(names)} keypoints lie within {spread * 1e3:.1f} mm of their centre, half of them and of the time"
        )
        fix = f"look at heat maps in the report: the network may not tell places apart; then {again}"
        yield Finding("keypoints-collapsed", place, evidence, fix)
    # Traces of covariances are sums over the three axes; a deviation is that of one.
    deviation = np.sqrt(np.maximum(np.trace(track.covariance, axis1=2, axis2=3), 0) / 3)
    share = np.nanmean(np.where(np.isfinite(deviation), deviation > EXPLODED_M, np.nan), axis=0)
    wide = [i for i in range(len(names)) if share[i] >= EXPLODED_SHARE]
    if wide:
        worst = max(wide, key=lambda i: share[i])
        evidence = (
            f"{_listed([names[i] for i in wide])}: standard deviation above {EXPLODED_M * 100:.0f} cm in "
            f"{share[worst]:.0%} of the frames"
        )
        yield Finding(
            "keypoints-exploded", place, evidence, f"leave them out, choose others, or change the filter; {again}"
        )
    yield from _outside(place, names, mean, demonstration)


def collapsed_spread(mean: Float[ndarray, "t k 3"]) -> float | None:
    """Median over frames of the median distance of keypoints from their centre, metres; None for few keypoints."""
    rows = [frame[np.isfinite(frame).all(axis=1)] for frame in mean]
    spreads = [
        float(np.median(np.linalg.norm(row - np.median(row, axis=0), axis=1)))
        for row in rows
        if len(row) >= LEAST_KEYPOINTS
    ]
    return float(np.median(spreads)) if spreads else None


def _outside(
    place: str, names: list[str], mean: Float[ndarray, "t k 3"], demonstration: Demonstration
) -> Iterator[Finding]:
    """Keypoints outside of what the cameras of the demonstration measured."""
    box = measured_box(demonstration)
    if box is None:
        return
    low, high = box
    known = np.isfinite(mean).all(axis=2)
    outside = known & ((mean < low) | (mean > high)).any(axis=2)
    share = outside.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    far = [i for i in range(len(names)) if share[i] > OUTSIDE_SHARE]
    if far:
        evidence = (
            f"{_listed([names[i] for i in far])}: outside the box of measured points in up to {max(share[far]):.0%} "
            "of the frames"
        )
        fix = "check that demonstration and scans were read in the same unit, and the cameras of `encode`"
        yield Finding("keypoints-outside", place, evidence, fix)


def measured_box(demonstration: Demonstration) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]] | None:
    """The box around what some frames measured, grown a little: metres, world frame; None without any depth."""
    points = []
    for camera in demonstration.cameras:
        for i in sampled(camera.n_frames, N_DEPTH_FRAMES):
            depth = camera.depth(i)[::STRIDE, ::STRIDE]
            v, u = np.nonzero(depth > 0)
            uv = np.stack([u, v], axis=1).astype(np.float64) * STRIDE
            points.append(
                transform(camera.world_from_cameras[i], unproject(uv, depth[v, u].astype(np.float64), camera.Ks[i]))
            )
    every = np.concatenate(points) if points else np.zeros((0, 3))
    if not len(every):
        return None
    low, high = every.min(axis=0), every.max(axis=0)
    room = ROOM_M + ROOM_SHARE * (high - low)
    return low - room, high + room


def _listed(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
