"""Recordings of static scenes, and the points in them whose truth is known.

Surface points of a static scene are keypoints whose position is known, and measured depth shows when they are visible.
Corners are taken, no two at the same place, and divided into two halves; so are the frames, block by
block. One half is to fit likelihoods to and to take reference descriptors from, the other to report.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from keypoint_sets import Static

from bask_data.core.geometry import project, scale_intrinsics, transform
from bask_data.core.nearest_depth import shrink_depth
from bask_data.core.static_truth import Visibility, visibility
from bask_data.dataset import Dataset
from bask_data.kinds import Camera, Demonstration
from bask_data.progress import progress

BUILD = Path(__file__).resolve().parent.parent / "build" / "static_truth"
SPACING = 4
"""Pixels between the positions that descriptors are compared at, and that depth is read at."""
N_FRAMES, N_CORNERS = 40, 50
"""Frames that corners are taken from, and corners of each."""
N_BLOCKS = 10
"""Blocks of frames, of which every second one is reported: long enough for points to leave and return."""
SEEN_SHARE, GONE_SHARE = 0.3, 0.1
"""Least shares of the frames that show a point, and that do not."""
AWAY = 10
"""Frames for which a point is not seen before its return."""
N_SIGMAS = 3
"""Errors of depth and poses in a scene's tolerance. Points nearer than one error are the same."""
FLAT = 2
"""Tolerances of depth around a corner, at most: at an edge of the scene, the true point is a matter of chance."""


@dataclass(frozen=True)
class Points:
    """Points of a static scene and when they are seen.

    Attributes:
        world: (k, 3) metres.
        state: (t, k) `Visibility`.
        picked_in: (k,) frame of the reference descriptor: one of the half to fit, which shows the point nearest to its
            middle.
    """

    world: np.ndarray
    state: np.ndarray
    picked_in: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        return self.state == Visibility.VISIBLE

    @property
    def gone(self) -> np.ndarray:
        """Out of view or occluded; where no depth was measured, neither this nor seen."""
        return (self.state == Visibility.OUT_OF_VIEW) | (self.state == Visibility.OCCLUDED)

    def of(self, chosen: np.ndarray) -> Points:
        return Points(self.world[chosen], self.state[:, chosen], self.picked_in[chosen])


def opened(recording: Path, how: Static) -> Camera:
    """The recording as a demonstration; what is up to date is not read again."""
    command = ["ingest", "frames", recording / how.folder, BUILD / "dataset", "--scene", recording.name]
    command += ["--as", "demonstration", *how.ingest]
    subprocess.run([str(Path(sys.executable).with_name("bask-data")), *map(str, command)], check=True)
    dataset = Dataset(BUILD / "dataset")
    return Demonstration(dataset.path(Demonstration, recording.name)).cameras[0]


def unnamed(recording: Path, ingest: tuple[str, ...], tolerance: float) -> Static:
    """How a recording is read that no set names: as a part of 7-Scenes, unless `ingest` says otherwise."""
    intrinsics = next((str(file) for file in sorted(recording.glob("*intrinsics*.txt"))), "585,585,320,240")
    colour = "frame-*.color.jpg" if any(recording.glob("frame-*.color.jpg")) else "frame-*.color.png"
    usual = ("--intrinsics", intrinsics, "--color", colour, "--invalid-depth", "65535")
    return Static("of no set", "", ingest or usual, tolerance)


def halves(camera: Camera, tolerance: float) -> tuple[Points, Points]:
    """All points of the scene that are seen often: those to fit, and those to report."""
    places = _corners(camera, tolerance)
    state = np.stack(
        [_state(camera, i, places, tolerance) for i in progress(range(camera.n_frames), "which frames show points")]
    )
    seen = state == Visibility.VISIBLE
    fitted_in = ~reported_frames(camera.n_frames)
    good = np.flatnonzero((seen.mean(axis=0) >= SEEN_SHARE) & seen[fitted_in].any(axis=0))
    off = _from_the_middle(camera, places[good])
    picked_in = np.where(seen[:, good] & fitted_in[:, None], off, np.inf).argmin(axis=0)
    points = Points(places[good], state[:, good], picked_in)
    even = np.arange(len(good)) % 2 == 0
    return points.of(even), points.of(~even)


def reported_frames(n_frames: int) -> np.ndarray:
    """(t,) bool: every second block of frames, the first not."""
    return np.arange(n_frames) * N_BLOCKS // n_frames % 2 == 1


def drawn(points: Points, n: int, rng: np.random.Generator) -> Points:
    """Some points of a half: those that leave and come back, and only if the recording has too few, any."""
    gone = points.gone.mean(axis=0) >= GONE_SHARE
    back = np.array([bool(starts_again(points.seen[:, i])) for i in range(points.seen.shape[1])], dtype=bool)
    rank = np.where(gone & back, 0, np.where(gone, 1, 2))
    order = rng.permutation(len(rank))
    return points.of(np.sort(order[rank[order].argsort(kind="stable")][:n]))


def depth_of(camera: Camera, i_frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth at the resolution of the distance maps, which is denser where it is sparse, and its intrinsics."""
    size = (camera.height // SPACING, camera.width // SPACING)
    K = scale_intrinsics(camera.Ks[i_frame], (camera.height, camera.width), size)
    return shrink_depth(camera.depth(i_frame), size), K


def pixels(camera: Camera, i_frame: int, points: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of world points (n, 3) in a frame."""
    camera_from_world = np.linalg.inv(camera.world_from_cameras[i_frame])
    return project(transform(camera_from_world, points), camera.Ks[i_frame])[0]


def runs(seen: np.ndarray) -> Iterator[tuple[int, int]]:
    """First frame, and the one after the last, of each time a point (t,) is seen in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(int), [0]])))
    return zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def starts_again(seen: np.ndarray) -> list[int]:
    """First frames of a point (t,) after it was not seen for long."""
    spans = list(runs(seen))
    return [b for (_, a), (b, _) in pairwise(spans) if b - a >= AWAY]


def _corners(camera: Camera, tolerance: float) -> np.ndarray:
    """Corners (n, 3) of some frames, in random order, none at the place of an earlier one."""
    rng = np.random.default_rng(0)
    found = []
    for i in rng.choice(camera.n_frames, min(N_FRAMES, camera.n_frames), replace=False).tolist():
        depth, _ = depth_of(camera, i)
        flat = cv2.resize(
            _inner(depth, FLAT * tolerance).astype(np.uint8),
            (camera.width, camera.height),
            interpolation=cv2.INTER_NEAREST,
        )
        grey = cv2.cvtColor(camera.rgb(i), cv2.COLOR_RGB2GRAY)
        corners = cv2.goodFeaturesToTrack(grey, N_CORNERS, 0.01, 10, mask=flat)
        if corners is not None:
            uv = corners.reshape(-1, 2)
            u, v = (uv // SPACING).astype(int).T.clip(0, [[depth.shape[1] - 1], [depth.shape[0] - 1]])
            found.append(camera.points_world(i, uv, depth[v, u]))
    places = np.concatenate(found)
    kept: list[np.ndarray] = []
    for place in places[rng.permutation(len(places))]:
        if not kept or np.linalg.norm(np.array(kept) - place, axis=1).min() >= tolerance / N_SIGMAS:
            kept.append(place)
    return np.array(kept)


def _inner(depth: np.ndarray, most: float) -> np.ndarray:
    """Pixels (h, w) with depth, which differs by less than `most` metres around them."""
    around = np.ones((5, 5), np.uint8)
    far, near = cv2.dilate(depth, around), cv2.erode(depth, around)
    return (near > 0) & (far - near < most)


def _state(camera: Camera, i_frame: int, places: np.ndarray, tolerance: float) -> np.ndarray:
    depth, K = depth_of(camera, i_frame)
    return visibility(places, depth, K, camera.world_from_cameras[i_frame], tolerance)


def _from_the_middle(camera: Camera, places: np.ndarray) -> np.ndarray:
    """Pixels between each point and the middle of each image (t, k)."""
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    return np.stack([np.linalg.norm(pixels(camera, i, places) - middle, axis=1) for i in range(camera.n_frames)])
