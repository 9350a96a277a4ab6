"""How well `refine` finds errors of poses: hand-eye errors of 10 mm and 2 degrees, drift of 3 cm, and none.

    python benchmarks/refine_errors.py DATASET/scan/NAME ... [--errors 12]

Random errors are put into the poses of scans; those given count as right. Prints a row per scan and kind of error.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bask_data.core.depth import in_range
from bask_data.core.geometry import invert_rigid, rotation_angle
from bask_data.core.pair_alignment import moved
from bask_data.core.pose_refinement import Refinement, refined
from bask_data.kinds import Camera, Scan

SHIFT, TURN = 0.010, np.radians(2.0)
"""Size of the hand-eye errors, metres and radians, in random directions."""

DRIFT, DRIFT_TURN = 0.030, np.radians(1.5)
"""Error of the last pose, metres and radians; it grows evenly over the recording."""

NEAR, FAR = 0.15, 4.0
"""The defaults of `refine`, metres."""

BAR = (2.0, 0.3)
"""What a hand-eye error must be found to, millimetres and degrees, where it is said to be found."""

KINDS = ("none", "hand-eye", "drift")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scans", nargs="+", type=Path)
    parser.add_argument("--errors", type=int, default=12, help="random errors of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=KINDS)
    arguments = parser.parse_args()
    print(
        "| scan | error put in | verdicts | error left, median (worst) | silent | residual before -> after | s each |"
    )
    print("|---|---|---|---|---|---|---|")
    for path in arguments.scans:
        camera = Scan(path).cameras[-1]
        depths = [in_range(camera.depth(i), NEAR, FAR) for i in range(camera.n_frames)]
        for kind in arguments.kinds:
            rng = np.random.default_rng(arguments.seed)
            n = 1 if kind == "none" else arguments.errors
            print(f"| {path.parent.parent.name}/{path.name} | {row(kind, camera, depths, n, rng)} |", flush=True)


def row(kind: str, camera: Camera, depths: list[np.ndarray], n: int, rng: np.random.Generator) -> str:
    """Figures of one scan and kind of error as cells."""
    verdicts: Counter[str] = Counter()
    left, n_silent, before, after, begun = [], 0, [], [], time.perf_counter()
    for given, true in trials(kind, camera.world_from_cameras, n, rng):
        made = refined(depths.__getitem__, camera.Ks, given)
        model = f" ({made.model})" if made.verdict == "refined" else ""
        verdicts[made.verdict + model] += 1
        if made.before and made.after:
            before.append(1000 * made.before.mean)
            after.append(1000 * made.after.mean)
        if made.verdict == "refined":
            left.append(error_left(kind, made, given, true))
            n_silent += kind == "hand-eye" and (left[-1][0] > BAR[0] or left[-1][1] > BAR[1])
    seconds = (time.perf_counter() - begun) / n
    figures = np.array(left)
    shown = "-"
    if left:
        (shift, angle), (most_shift, most_angle) = np.median(figures, axis=0), figures.max(axis=0)
        shown = f"{shift:.2f} ({most_shift:.2f}) mm, {angle:.3f} ({most_angle:.3f}) degrees"
    words = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())
    residual = f"{np.mean(before):.2f} -> {np.mean(after):.2f} mm" if before else "-"
    return f"{kind} | {words} | {shown} | {n_silent} | {residual} | {seconds:.1f}"


def trials(kind: str, true: np.ndarray, n: int, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Given poses (t, 4, 4) with an error, and what they should be."""
    for _ in range(n):
        turn, shift = direction(rng), direction(rng)
        if kind == "none":
            yield true, true
        elif kind == "hand-eye":
            yield true @ invert_rigid(moved(np.r_[TURN * turn, SHIFT * shift])), true
        else:
            share = np.linspace(0, 1, len(true))
            errors = [moved(s * np.r_[DRIFT_TURN * turn, DRIFT * shift]) for s in share]
            yield true @ np.stack(errors), true


def direction(rng: np.random.Generator) -> np.ndarray:
    """A random unit vector."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def error_left(kind: str, made: Refinement, given: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Millimetres and degrees by which poses are wrong: each camera's, or for drift relative to the first."""
    poses = made.world_from_cameras
    if kind == "drift":
        poses, true = invert_rigid(poses[0]) @ poses, invert_rigid(true[0]) @ true
    change = invert_rigid(true) @ poses
    shift = 1000 * np.linalg.norm(change[:, :3, 3], axis=1)
    return float(shift.mean()), float(np.degrees(rotation_angle(change[:, :3, :3])).mean())


if __name__ == "__main__":
    main()
