"""How often depth beside colour is told, on scans of datasets whose colour is moved by 12 to 30 pixels of 640.

    python benchmarks/shifted_depth.py data/demo --seed 1

Of each scan, all of its frames and three random runs of 12 to 60 frames are tried, unmoved once and moved three times.
Printed per scan: how often depth was told to lie on colour, or beside it, and the largest error of the shift.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np

from bask_data.dataset import Dataset
from bask_data.formats.recording import CameraRecording
from bask_data.formats.registration import registration
from bask_data.kinds import Camera, Scan

SMALLEST, LARGEST = 12, 30
"""Shifts, pixels of 640."""

WIDTHS = (14, 8, 7, 12, 8, 7, 6)
"""Of the columns, characters."""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("roots", nargs="+", type=Path)
    arguments.add_argument("--seed", type=int, default=0)
    options = arguments.parse_args()
    rng = np.random.default_rng(options.seed)
    columns = ("unmoved: fits", "shifted", "unsure", "moved: fits", "shifted", "unsure", "error")
    print(f"{'scan':24}", *(f"{column:>{WIDTHS[i]}}" for i, column in enumerate(columns)))
    for root in options.roots:
        dataset = Dataset.open_if_any(root)
        assert dataset is not None, root
        for name in dataset.items("scene"):
            row(name, Scan(root / "scan" / name).cameras[0], rng)


def row(name: str, camera: Camera, rng: np.random.Generator) -> None:
    """Print a scan's row."""
    unmoved: Counter[str] = Counter()
    moved: Counter[str] = Counter()
    error = 0.0
    for frames in runs(camera.n_frames, rng):
        unmoved[registration(shifted(camera, frames, (0, 0))).verdict] += 1
        for _ in range(3):
            angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(SMALLEST, LARGEST) * camera.width / 640
            shift = (int(length * np.cos(angle)), int(length * np.sin(angle)))
            found = registration(shifted(camera, frames, shift))
            moved[found.verdict] += 1
            if found.verdict == "shifted":
                error = max(error, float(np.hypot(*np.subtract(found.shift, shift))))
    of = [(counts["fits"], counts["shifted"], counts["cannot tell"]) for counts in (unmoved, moved)]
    figures = (*of[0], *of[1], f"{error:.0f}")
    print(f"{name:24}", *(f"{figure:>{WIDTHS[i]}}" for i, figure in enumerate(figures)), flush=True)


def runs(n_frames: int, rng: np.random.Generator) -> list[np.ndarray]:
    """All frames, and three random runs of frames that follow each other."""
    chosen = [np.arange(n_frames)]
    for _ in range(3 if n_frames > 12 else 0):
        n = int(rng.integers(12, min(n_frames, 60)))
        chosen.append(np.arange(n) + rng.integers(0, n_frames - n))
    return chosen


def shifted(camera: Camera, frames: np.ndarray, shift: tuple[int, int]) -> CameraRecording:
    """Some frames of a stored camera, with colour moved by (u, v) pixels."""

    def read(i: int) -> tuple[np.ndarray, np.ndarray]:
        k = int(frames[i])
        return np.roll(camera.rgb(k), shift[::-1], axis=(0, 1)), camera.depth_raw(k)

    return CameraRecording(
        "camera",
        camera.Ks[frames],
        camera.height,
        camera.width,
        camera.depth_scale,
        camera.world_from_cameras[frames],
        np.asarray(camera.time)[frames],
        read,
        lambda i: camera.depth_raw(int(frames[i])),
    )


if __name__ == "__main__":
    main()
