"""Where the objects of `apc_shelf` stand in `labelfusion_shelf`: writes `shelf_truth.json`.

    python datasets/align_shelf_objects.py [--pictures FOLDER]

The tissue box shows another of its sides in the second recording, but they are printed alike: a dark band on top with
small white print at its left, plain below. Alignment is front side to front side, which is what a descriptor of
appearance can know. The bag of chenille stems lies on its other side there, in other colours, so only its outline is
aligned: where its axis, its front end and its top are.

Neither the labels (drawn some pixels off) nor the camera poses (the box moves by up to ten pixels against them) are
good enough to stand alone. The box is fitted to the edges of its front in all 30 colour images and to the measured
depth together, with one size for both recordings; a shift of a few pixels is found for each image along with it.
"""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import theilslopes

from bask_data.core.geometry import in_image, invert_rigid, pixel_grid, project, transform, unproject
from bask_data.formats import FORMATS
from bask_data.formats.recording import CameraRecording

HERE = Path(__file__).parent
BOX, STEMS = 132, 48
ALONG_EDGE = np.linspace(0.06, 0.94, 24)
EDGE_PX, SHIFT_PX, DEPTH = 1.0, 3.0, 0.004
"""Expected errors: of a found edge, of an image against its pose, and of a patch of depth in metres."""
STEMS_WIDTH = 0.082
STEMS_REGION = {
    "apc_shelf": ((0.0, 0.2), (-0.11, 0.03), (-0.012, 0.03)),
    "labelfusion_shelf": ((1.48, 1.68), (0.15, 0.252), (1.02, 1.06)),
}
"""Where the bag of stems lies, metres in each world: x, y, z. The labels of the second recording are too far off."""
START = {
    "apc_shelf": (0.299, 0.020, 0.043, -0.2, 0.0, 0.0),
    "labelfusion_shelf": (1.528, 0.315, 1.090, 0.14, -0.1, 0.0),
}
"""Centre of the box's front (metres, world) and its turn about z, y, x (radians), read off the depth by eye."""


@dataclass
class Scene:
    """A recording, and the images in which the box's front stands out."""

    name: str
    camera: CameraRecording

    def __post_init__(self) -> None:
        assert self.camera.labels is not None
        self.labels = [self.camera.labels(i) for i in range(self.camera.n_frames)]
        self.teal = [_teal(self.camera.read(i)[0]) for i in range(self.camera.n_frames)]
        near = np.ones((9, 9), np.uint8)
        others = [((label > 0) & (label != BOX)).astype(np.uint8) for label in self.labels]
        self.covered = [cv2.dilate(other, near) > 0 for other in others]
        self.depth_points = [self._box_points(i) for i in range(self.camera.n_frames)]

    def pixels(self, points_world: Float[ndarray, "n 3"], i: int) -> Float[ndarray, "n 2"]:
        return project(transform(invert_rigid(self.camera.world_from_cameras[i]), points_world), self.camera.K)[0]

    def points(self, i: int, where: ndarray) -> Float[ndarray, "n 3"]:
        """Measured points in the world at the pixels of a mask."""
        depth = self.camera.read(i)[1] * self.camera.depth_scale
        seen = where & (depth > 0)
        points = unproject(pixel_grid(*depth.shape)[seen], depth[seen], self.camera.K)
        return transform(self.camera.world_from_cameras[i], points)

    def _box_points(self, i: int) -> Float[ndarray, "n 3"]:
        inner = cv2.erode((self.labels[i] == BOX).astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
        return self.points(i, inner)


def _teal(rgb: ndarray) -> ndarray:
    """Bright where an image is green and blue rather than red: on the box's lit front, not around it."""
    image = cv2.GaussianBlur(rgb.astype(np.float32) / 255, (0, 0), 1.0)
    return (image[..., 1] + image[..., 2]) / 2 - image[..., 0] + 0.25 * image[..., 1]


def world_from_front(pose: Float[ndarray, "6"]) -> Float[ndarray, "4 4"]:
    """The frame of the box's front: origin in its centre, x into the box, y left, z up."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("zyx", pose[3:]).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix


def front_corners(pose: Float[ndarray, "6"], size: Float[ndarray, "2"]) -> Float[ndarray, "4 3"]:
    """Top left, top right, bottom right, bottom left."""
    y, z = size / 2
    return transform(world_from_front(pose), np.array([[0, y, z], [0, -y, z], [0, -y, -z], [0, y, -z]]))


def on_edges(corners: ndarray) -> ndarray:
    """Points along the four edges."""
    t = ALONG_EDGE[:, None]
    return np.concatenate([corners[k] * (1 - t) + corners[(k + 1) % 4] * t for k in range(4)])


def find_edges(scene: Scene, i: int, pose: ndarray, size: ndarray, shift: ndarray, reach: float) -> tuple[ndarray, ...]:
    """Where the front ends in image i, looked for up to `reach` pixels across the expected edges.

    Returns:
        found (n,2) pixels, outward normals (n,2), and which were found (n,).
    """
    corners_px = scene.pixels(front_corners(pose, size), i) + shift
    expected = scene.pixels(on_edges(front_corners(pose, size)), i) + shift
    along = np.roll(corners_px, -1, axis=0) - corners_px
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    outward = np.sign(np.einsum("ij,ij->i", normal, corners_px - corners_px.mean(axis=0)))
    normal = np.repeat(normal * outward[:, None], len(ALONG_EDGE), axis=0)
    offsets = np.arange(-reach - 2, reach + 2.01, 0.5)
    at = (expected[:, None] + offsets[None, :, None] * normal[:, None]).astype(np.float32)
    value = cv2.remap(scene.teal[i], at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    drop = np.full_like(value, -1.0)
    drop[:, 4:-4] = value[:, :-8] - value[:, 8:]
    drop[:, np.abs(offsets) > reach] = -1.0
    best = drop.argmax(axis=1)
    height, width = scene.teal[i].shape
    inside = ((at > 2) & (at < np.array([width - 3, height - 3]))).all(axis=(1, 2))
    u, v = np.clip(np.rint(expected).astype(int), 0, [width - 1, height - 1]).T
    found = inside & ~scene.covered[i][v, u] & (drop.max(axis=1) > 0.06)
    return expected + offsets[best, None] * normal, normal, found


def depth_offsets(scene: Scene, i: int, pose: ndarray) -> Float[ndarray, "4"]:
    """Median distance of measured points from the front's plane, metres, in its quarters; 0 where there are few."""
    points = transform(invert_rigid(world_from_front(pose)), scene.depth_points[i])
    near = points[np.abs(points[:, 0]) < 0.03]
    quarters = [near[((near[:, 1] > 0) == left) & ((near[:, 2] > 0) == up), 0] for left in (0, 1) for up in (0, 1)]
    return np.array([np.median(quarter) if len(quarter) > 50 else 0.0 for quarter in quarters])


def fit_box(scenes: list[Scene]) -> tuple[list[ndarray], ndarray, list[ndarray], list[ndarray]]:
    """Poses of the front, its width and height, the images' shifts, and the edges' residuals in pixels."""
    n = [scene.camera.n_frames for scene in scenes]
    x = np.concatenate([*(START[scene.name] for scene in scenes), [0.111, 0.126], np.zeros(2 * sum(n))])

    def unpack(x: ndarray) -> tuple[list[ndarray], ndarray, list[ndarray]]:
        shifts = x[14:].reshape(-1, 2)
        return [x[:6], x[6:12]], x[12:14], [shifts[: n[0]], shifts[n[0] :]]

    def edge_residuals(x: ndarray, edges: list[list[tuple[ndarray, ...]]]) -> list[ndarray]:
        poses, size, shifts = unpack(x)
        residuals = []
        for k, scene in enumerate(scenes):
            points = on_edges(front_corners(poses[k], size))
            for i, (target, normal, found) in enumerate(edges[k]):
                distance = ((scene.pixels(points, i) + shifts[k][i] - target) * normal).sum(axis=1)
                residuals.append(np.where(found, distance, 0.0))
        return residuals

    for reach in (14, 14, 10, 8, 6, 5, 4, 4, 4, 4):
        poses, size, shifts = unpack(x)
        edges = [
            [find_edges(scene, i, poses[k], size, shifts[k][i], reach) for i in range(n[k])]
            for k, scene in enumerate(scenes)
        ]

        def cost(x: ndarray, edges: list[list[tuple[ndarray, ...]]] = edges) -> ndarray:
            poses, _, _ = unpack(x)
            depth = [depth_offsets(scene, i, poses[k]) for k, scene in enumerate(scenes) for i in range(n[k])]
            # Neighbouring points on an edge err together: a side counts as about four measurements, not as 24.
            edge = np.concatenate(edge_residuals(x, edges)) / EDGE_PX / np.sqrt(len(ALONG_EDGE) / 4)
            return np.concatenate([_robust(edge), _robust(np.concatenate(depth) / DEPTH), x[14:] / SHIFT_PX])

        x = least_squares(cost, x, jac_sparsity=_sparsity(n), x_scale=_scale(n), max_nfev=30).x
    residuals = [r[f] for r, f in zip(edge_residuals(x, edges), (e[2] for scene in edges for e in scene), strict=True)]
    return (*unpack(x), [np.concatenate(residuals[: n[0]]), np.concatenate(residuals[n[0] :])])


def _robust(residual: ndarray) -> ndarray:
    """Residuals whose square grows linearly beyond one: edges and depth have outliers. Shifts must not escape so."""
    return np.sign(residual) * np.sqrt(2 * (np.sqrt(1 + residual**2) - 1))


def _sparsity(n: list[int]) -> ndarray:
    """Which residuals depend on which unknowns: an image's shift moves only that image's edges."""
    n_edge, n_depth, n_shift = 4 * len(ALONG_EDGE) * sum(n), 4 * sum(n), 2 * sum(n)
    sparsity = np.zeros((n_edge + n_depth + n_shift, 14 + n_shift), dtype=np.uint8)
    sparsity[: n_edge + n_depth, :14] = 1
    sparsity[:n_edge, 14:] = np.kron(np.eye(sum(n)), np.ones((4 * len(ALONG_EDGE), 2)))
    sparsity[n_edge + n_depth :, 14:] = np.eye(n_shift)
    return sparsity


def _scale(n: list[int]) -> ndarray:
    """Steps of about equal effect: centimetres, a few degrees, pixels."""
    return np.r_[np.tile([0.01] * 3 + [0.05] * 3, 2), 0.01, 0.01, np.ones(2 * sum(n))]


def moved_depth(scan: Scene, demo: Scene, demo_from_scan: Float[ndarray, "4 4"]) -> float:
    """How far the scan's measured front, moved, lies from the demonstration's measured depth: the median, metres."""
    points = transform(demo_from_scan, np.concatenate(scan.depth_points)[::10])
    distances = []
    for i in range(demo.camera.n_frames):
        depth = demo.camera.read(i)[1] * demo.camera.depth_scale
        camera_from_world = invert_rigid(demo.camera.world_from_cameras[i])
        uv, z = project(transform(camera_from_world, points), demo.camera.K)
        inside = in_image(uv, *depth.shape)
        u, v = np.rint(uv[inside]).astype(int).T
        on_box = (demo.labels[i][v, u] == BOX) & (depth[v, u] > 0)
        distances.append(np.abs(z[inside] - depth[v, u])[on_box])
    return float(np.median(np.concatenate(distances)))


def fit_stems(scene: Scene) -> Float[ndarray, "4 4"]:
    """The frame of the bag of stems: origin on top in the middle of its front end, x along it inwards, y left, z up.

    Its left side stands clear in both recordings, its right side touches a book or a wall: the middle is taken half a
    width off.
    """
    everything = np.ones((scene.camera.height, scene.camera.width), dtype=bool)
    points = np.concatenate([scene.points(i, everything) for i in range(scene.camera.n_frames)])
    low, high = np.array(STEMS_REGION[scene.name]).T
    x, y, z = points[((points > low) & (points < high)).all(axis=1)].T
    # The upright front end is what the cameras see best: a peak of points along x.
    counts, edges = np.histogram(x, np.arange(low[0] + 0.01, high[0], 0.0025))
    front = edges[counts.argmax()] + 0.00125
    slices = np.arange(front + 0.015, front + 0.125, 0.01)
    left = np.array([_left_edge(y[(x > at) & (x < at + 0.01)], low[1], high[1]) for at in slices])
    slope, offset, *_ = theilslopes(left, slices + 0.005)
    direction = np.array([1.0, slope, 0.0]) / np.hypot(1.0, slope)
    leftwards = np.array([-direction[1], direction[0], 0.0])
    on_top = (x > front + 0.01) & (x < front + 0.06)
    world_from_stems = np.eye(4)
    world_from_stems[:3, :3] = np.stack([direction, leftwards, [0, 0, 1]], axis=1)
    world_from_stems[:3, 3] = [front, offset + slope * front, np.median(z[on_top])]
    world_from_stems[:3, 3] -= leftwards * STEMS_WIDTH / 2
    return world_from_stems


def _left_edge(y: ndarray, low: float, high: float) -> float:
    """The largest y up to which points lie densely."""
    counts, edges = np.histogram(y, np.arange(low, high, 0.002))
    dense = np.flatnonzero(counts > 0.3 * np.median(counts[counts > 0.2 * counts.max()]))
    return float(edges[dense[-1] + 1])


def box_picture(scan: Scene, demo: Scene, poses: list[ndarray], size: ndarray, shifts: list[ndarray]) -> ndarray:
    """Frames of the demonstration, and the same with the scan's view of the front put over the right half of it."""
    tiles = []
    for i_scan, i in ((2, 2), (7, 7), (12, 12), (0, 0)):
        source = (scan.pixels(front_corners(poses[0], size), i_scan) + shifts[0][i_scan]).astype(np.float32)
        target = (demo.pixels(front_corners(poses[1], size), i) + shifts[1][i]).astype(np.float32)
        view = demo.camera.read(i)[0]
        warp = cv2.getPerspectiveTransform(source, target)
        moved = cv2.warpPerspective(scan.camera.read(i_scan)[0], warp, view.shape[1::-1])
        half = np.zeros(view.shape[:2], np.uint8)
        middle = (target[[0, 3]] + target[[1, 2]]) / 2
        cv2.fillConvexPoly(half, np.rint([middle[0], target[1], target[2], middle[1]]).astype(np.int32), 1)
        mixed = np.where(half[..., None] > 0, np.clip(moved * 1.3, 0, 255).astype(np.uint8), view)
        tiles.append(np.hstack([_crop(view, target), _crop(mixed, target)]))
    return np.vstack([np.hstack(tiles[:2]), np.hstack(tiles[2:])])


def stems_picture(scenes: list[Scene], frames: list[ndarray]) -> ndarray:
    """Both recordings with the bag's outline as fitted: a rectangle of the stated width, 12 cm long."""
    y = STEMS_WIDTH / 2
    outline = np.array([[0, y, 0], [0.12, y, 0], [0.12, -y, 0], [0, -y, 0]])
    rows = []
    for scene, world_from_stems in zip(scenes, frames, strict=True):
        tiles = []
        for i in (2, 7, 12, 14):
            view, pixels = scene.camera.read(i)[0].copy(), scene.pixels(transform(world_from_stems, outline), i)
            cv2.polylines(view, [np.rint(pixels * 16).astype(np.int32)], True, (255, 255, 0), 1, cv2.LINE_AA, 4)
            tiles.append(_crop(view, pixels))
        rows.append(np.hstack(tiles))
    return np.vstack(rows)


def _crop(image: ndarray, around: ndarray) -> ndarray:
    """A window of 240 by 240 pixels, twice as large."""
    u, v = np.clip(np.rint(around.mean(axis=0)).astype(int) - 120, 0, np.array(image.shape[1::-1]) - 240)
    return np.repeat(np.repeat(image[v : v + 240, u : u + 240], 2, axis=0), 2, axis=1)


def main() -> None:
    """Fits, prints the residuals, writes the transforms and, if asked, the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, help="folder for pictures to look at")
    arguments = parser.parse_args()
    apc = next(item for item in FORMATS if item.name == "apc")
    scan, demo = (Scene(name, apc.read(HERE / name, apc.options()).cameras[0]) for name in START)
    poses, size, shifts, residuals = fit_box([scan, demo])
    quality = {}
    for k, scene in enumerate((scan, demo)):
        depth = 1000 * np.array([depth_offsets(scene, i, poses[k]) for i in range(scene.camera.n_frames)])
        quality[scene.name] = {
            "edge_px_median": round(float(np.median(np.abs(residuals[k]))), 2),
            "image_shift_px_rms": [round(float(s), 1) for s in np.sqrt((shifts[k] ** 2).mean(axis=0))],
            "depth_mm_median": round(float(np.median(np.abs(depth))), 1),
            "turn_deg_zyx": [round(float(a), 1) for a in np.degrees(poses[k][3:])],
        }
    stems = [fit_stems(scene) for scene in (scan, demo)]
    demo_from_scan_box = world_from_front(poses[1]) @ invert_rigid(world_from_front(poses[0]))
    truth = {
        "scan": scan.name,
        "demo": demo.name,
        "frames": "demo_from_scan takes the scan's world to the demo's, as `ingest apc` reads both; metres",
        "objects": [
            {
                "name": "tissue box",
                "label": BOX,
                "demo_from_scan": np.round(demo_from_scan_box, 6).tolist(),
                "accuracy_mm": 8,
                "same_appearance": True,
                "meaning": "front side onto front side: another side of the box, alike but for the small print",
                "front_size_mm": [round(float(s), 1) for s in 1000 * size],
                "world_from_front": {
                    scene.name: np.round(world_from_front(poses[k]), 6).tolist() for k, scene in enumerate((scan, demo))
                },
                "moved_depth_mm_median": round(1000 * moved_depth(scan, demo, demo_from_scan_box), 1),
                "residuals": quality,
            },
            {
                "name": "chenille stems",
                "label": STEMS,
                "demo_from_scan": np.round(stems[1] @ invert_rigid(stems[0]), 6).tolist(),
                "accuracy_mm": 12,
                "same_appearance": False,
                "meaning": "outline only (front end, axis, top): the bag lies on its other side, in other colours",
            },
        ],
    }
    # A row of numbers on a line: a matrix should look like one.
    text = re.sub(
        r"\[\s+(-?\d[^\[\]]*?)\s+\]", lambda row: f"[{' '.join(row[1].split())}]", json.dumps(truth, indent=1)
    )
    (HERE / "shelf_truth.json").write_text(text + "\n")
    print(text)
    # What `ingest apc` reads beside the frames. The two recordings show different sides of the stems: no
    # point of theirs has a true place in both, so they have no pose here.
    box = truth["objects"][0]
    for scene, world in ((scan, "bin"), (demo, "robot")):
        matrix = ",\n    ".join(str(row) for row in box["world_from_front"][scene.name])
        (HERE / scene.name / "object_poses.json").write_text(
            f'{{"world": "{world}", "objects": {{"{BOX}": '
            f'{{"error": {box["accuracy_mm"] / 1000}, "world_from_object": [\n    {matrix}]}}}}}}\n'
        )
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
        for name, picture in (
            ("box", box_picture(scan, demo, poses, size, shifts)),
            ("stems", stems_picture([scan, demo], stems)),
        ):
            cv2.imwrite(str(arguments.pictures / f"{name}.png"), picture[..., ::-1])


if __name__ == "__main__":
    main()
