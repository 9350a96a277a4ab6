"""Random recordings of analytic scenes, with the errors of real ones: noise, holes, depth in whole units, poses off.

Boxes and balls on a table or in a room are ray-cast exactly, then depth is given noise of 2 % (half of its variance
per pixel, half in patches) and holes of 30 % in patches, and stored in 16 bit. Poses are off by 5 mm and 0.5 degrees,
root mean square, half of the variance a slow wander of the whole recording, half from frame to frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from jaxtyping import Float, Float32, UInt16
from numpy import ndarray
from scipy.spatial.transform import Rotation

from tests.scenes import intrinsics, look_at

HEIGHT, WIDTH = 120, 160
MARGIN = 8
"""Poses before the first and after the last frame, for clocks that are off."""

UNITS = (0.001, 1 / 5000, 1 / 4000, 0.0001)
"""Metres per unit of raw depth: what cameras and data sets have. 0.1 mm ends at 6.5 m."""

NEAREST_SURFACE = 0.1
"""Metres; a camera nearer to something is drawn again: sensors measure nothing there."""


@dataclass(frozen=True)
class Bodies:
    """Solid bodies; a ray that starts in one of them hits it from inside, so a room is a box.

    Args:
        box_from_world: (b, 4, 4); halves: half edge lengths (b, 3), metres.
        balls: centre and radius (s, 4), metres.
    """

    box_from_world: Float[ndarray, "b 4 4"]
    halves: Float[ndarray, "b 3"]
    balls: Float[ndarray, "s 4"]

    def depth(self, K: Float[ndarray, "3 3"], world_from_camera: Float[ndarray, "4 4"]) -> Float32[ndarray, "h w"]:
        """Exact z-depth, metres; 0 where a ray hits nothing."""
        return _cast(HEIGHT, WIDTH, K, world_from_camera, self.box_from_world, self.halves, self.balls)


@dataclass(frozen=True)
class Errors:
    """How far a recording is from the truth; root mean square. 0 everywhere: an exact one.

    Args:
        depth: share of the depth.
        position: metres; angle: degrees.
        holes: share of the pixels.
    """

    depth: float = 0.02
    position: float = 0.005
    angle_deg: float = 0.5
    holes: float = 0.3


@dataclass(frozen=True)
class RandomRecording:
    """Frames of one camera.

    Args:
        raw: depth in units of `depth_scale` metres.
        world_from_cameras: as a tracker would give them, with errors; `MARGIN` more on both sides than frames.
    """

    name: str
    raw: UInt16[ndarray, "t h w"]
    depth_scale: float
    K: Float[ndarray, "3 3"]
    world_from_cameras: Float[ndarray, "_ 4 4"]

    @property
    def n_frames(self) -> int:
        return len(self.raw)

    def poses(self, lag: int = 0) -> Float[ndarray, "t 4 4"]:
        """Of each frame, or of the frame `lag` later."""
        return self.world_from_cameras[MARGIN + lag : MARGIN + lag + self.n_frames]


Motion = Callable[[np.random.Generator, int, Float[ndarray, "3"], float], Float[ndarray, "t 4 4"]]
"""World_from_cameras from a generator, the number of frames, the target, and the usual distance to it in metres."""


def random_recording(
    seed: int,
    motion: str = "",
    place: str = "",
    errors: Errors | None = None,
    n_frames: int = 0,
) -> RandomRecording:
    """The recording of a seed.

    Args:
        motion: one of `MOTIONS`; random if empty, of those whose reading and unit can be told.
        place: one of `PLACES`; random if empty, table or room.
    """
    errors = errors or Errors()
    rng = np.random.default_rng([seed, 15])
    place = place or str(rng.choice(["table", "table", "room"]))
    motion = motion or str(rng.choice(["hand", "wrist", "approach"]))
    n_frames = n_frames or int(rng.integers(20, 80))
    K = intrinsics(HEIGHT, WIDTH, float(rng.uniform(50, 75)))
    for _ in range(50):
        bodies, target, distance = PLACES[place](rng)
        exact = MOTIONS[motion](rng, n_frames + 2 * MARGIN, target, distance)
        depth = np.stack([bodies.depth(K, pose) for pose in exact[MARGIN : MARGIN + n_frames]])
        nearest = depth[depth > 0].min() if (depth > 0).any() else 0.0
        if nearest > NEAREST_SURFACE and (depth > 0).mean() > 0.5:
            break
    else:
        raise ValueError(f"expected a free path within 50 draws, got none for seed {seed}")
    scale = float(rng.choice(UNITS))
    raw = np.stack([_stored(_measured(each, errors, rng), scale) for each in depth])
    return RandomRecording(f"{motion} {place} {seed}", raw, scale, K, tracked(exact, errors, rng))


def tracked(
    exact: Float[ndarray, "t 4 4"], errors: Errors, rng: np.random.Generator, n_anchors: int = 6
) -> Float[ndarray, "t 4 4"]:
    """Poses with a slow wander, over `n_anchors` parts of the recording, and errors of single frames."""
    t = len(exact)
    anchors = rng.normal(size=(n_anchors, 6))
    at = np.linspace(0, n_anchors - 1, t)
    slow = np.stack([np.interp(at, np.arange(n_anchors), anchors[:, k]) for k in range(6)], axis=1)
    slow /= max(float(np.sqrt((slow**2).mean())), 1e-9)
    both = (slow + rng.normal(size=(t, 6))) / np.sqrt(2) / np.sqrt(3)
    off = np.tile(np.eye(4), (t, 1, 1))
    off[:, :3, 3] = both[:, :3] * errors.position
    off[:, :3, :3] = Rotation.from_rotvec(both[:, 3:] * np.radians(errors.angle_deg)).as_matrix()
    return exact @ off


# Scenes ---------------------------------------------------------------------------------------------------------------


def _table(rng: np.random.Generator) -> tuple[Bodies, Float[ndarray, "3"], float]:
    """A table of finite size above a floor with three to eight things on it."""
    boxes = [_box([0, 0, -0.02], [rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.5), 0.02], 0.0)]
    boxes.append(_box([0, 0, -0.8], [6, 6, 0.05], 0.0))
    if rng.random() < 0.5:
        boxes.append(_box([0, rng.uniform(1.2, 2.0), 0.5], [4, 0.05, 2], rng.uniform(-0.5, 0.5)))
    more, balls = _things(rng, int(rng.integers(3, 9)), 0.25, 0.0)
    return _bodies(boxes + more, balls), np.array([0, 0, 0.05]) + rng.normal(size=3) * 0.03, rng.uniform(0.5, 0.9)


def _room(rng: np.random.Generator) -> tuple[Bodies, Float[ndarray, "3"], float]:
    """A room with furniture; the target stands in a corner."""
    half = np.array([rng.uniform(1.8, 2.6), rng.uniform(1.8, 2.6), 1.3])
    boxes = [_box([0, 0, 1.3], half, 0.0)]
    corner = np.array([half[0] - 0.7, half[1] - 0.7, 0.0])
    for _ in range(int(rng.integers(4, 9))):
        size = rng.uniform([0.1, 0.1, 0.1], [0.4, 0.4, 0.6])
        where = corner + np.array([*rng.uniform(-0.8, 0.6, 2), 0])
        boxes.append(_box(where + np.array([0, 0, size[2]]), size, rng.uniform(0, np.pi)))
    balls = [[*(corner[:2] + rng.uniform(-0.8, 0.5, 2)), 0.3, rng.uniform(0.1, 0.3)] for _ in range(3)]
    return _bodies(boxes, balls), corner + np.array([0, 0, 0.5]), rng.uniform(1.3, 1.9)


def _plane(rng: np.random.Generator) -> tuple[Bodies, Float[ndarray, "3"], float]:
    """A single plane without an edge in sight."""
    return _bodies([_box([0, 0, -1], [60, 60, 1], 0.0)], []), np.zeros(3), rng.uniform(0.6, 1.0)


def _ball(rng: np.random.Generator) -> tuple[Bodies, Float[ndarray, "3"], float]:
    """A ball on an endless plane: the same from all sides."""
    radius = rng.uniform(0.1, 0.2)
    return _bodies([_box([0, 0, -1], [60, 60, 1], 0.0)], [[0, 0, radius, radius]]), np.array([0, 0, radius]), 0.8


def _slats(rng: np.random.Generator) -> tuple[Bodies, Float[ndarray, "3"], float]:
    """Equal bars at equal distances."""
    pitch = rng.uniform(0.08, 0.14)
    boxes = [_box([0, 0, -1], [60, 60, 1], 0.0)]
    boxes += [_box([i * pitch, 0, 0.03], [0.3 * pitch, 60, 0.03], 0.0) for i in range(-20, 21)]
    return _bodies(boxes, []), np.zeros(3), rng.uniform(0.5, 0.8)


PLACES = {"table": _table, "room": _room, "plane": _plane, "ball": _ball, "slats": _slats}
"""Scenes by name; in the last three, the motion can hardly be told."""


def _things(
    rng: np.random.Generator, n: int, spread: float, floor: float
) -> tuple[list[tuple[Float[ndarray, "4 4"], list[float]]], list[list[float]]]:
    """Boxes and balls of 4 to 20 cm that stand on a floor."""
    boxes, balls = [], []
    for _ in range(n):
        x, y = rng.uniform(-spread, spread, 2)
        if rng.random() < 0.3:
            radius = rng.uniform(0.03, 0.08)
            balls.append([x, y, floor + radius, radius])
        else:
            half = rng.uniform([0.02, 0.02, 0.02], [0.08, 0.08, 0.12])
            boxes.append(_box([x, y, floor + half[2]], half, rng.uniform(0, np.pi)))
    return boxes, balls


def _box(
    centre: list[float] | ndarray, half: list[float] | ndarray, turn: float
) -> tuple[Float[ndarray, "4 4"], list[float]]:
    """A box turned about the vertical."""
    box_from_world = np.eye(4)
    box_from_world[:3, :3] = Rotation.from_euler("z", -turn).as_matrix()
    box_from_world[:3, 3] = -box_from_world[:3, :3] @ np.asarray(centre, float)
    return box_from_world, list(half)


def _bodies(boxes: list[tuple[Float[ndarray, "4 4"], list[float]]], balls: list[list[float]]) -> Bodies:
    return Bodies(
        np.stack([box for box, _ in boxes]),
        np.array([half for _, half in boxes], float),
        np.array(balls, float).reshape(-1, 4),
    )


# Motions --------------------------------------------------------------------------------------------------------------


def _on_sphere(
    target: ndarray, azimuth: ndarray, elevation: ndarray, distance: ndarray, aim: ndarray, roll: ndarray
) -> Float[ndarray, "t 4 4"]:
    """Cameras around a target, angles in radians, that look at it but for `aim` (t, 3) metres, turned by `roll`."""
    heading = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    poses = np.stack([look_at(target + d * h, target + a) for d, h, a in zip(distance, heading, aim, strict=True)])
    turn = np.tile(np.eye(4), (len(poses), 1, 1))
    turn[:, :3, :3] = Rotation.from_rotvec(roll[:, None] * [0, 0, 1]).as_matrix()
    return poses @ turn


def _wander(rng: np.random.Generator, t: int, size: float, n_columns: int = 1, n_anchors: int = 8) -> ndarray:
    """A smooth random path (t, n_columns) with a standard deviation of about `size`."""
    fine, at = np.linspace(0, n_anchors - 1, t), np.arange(n_anchors)
    anchors = rng.normal(size=(n_anchors, n_columns)) * size
    path = np.stack([np.interp(fine, at, anchors[:, k]) for k in range(n_columns)], axis=1)
    return cv2.GaussianBlur(path, (1, 0), 1, sigmaY=max(t / n_anchors / 2, 0.5)) if t > 2 else path


def _arc(rng: np.random.Generator, degrees: tuple[float, float], t: int, into: str = "any") -> ndarray:
    """Azimuths in radians over an arc, around a random direction, or one into the room."""
    span = np.radians(rng.uniform(*degrees)) * rng.choice([-1, 1])
    middle = rng.uniform(0, 2 * np.pi) if into == "any" else np.radians(rng.uniform(205, 245))
    return middle + span * np.linspace(-0.5, 0.5, t)


def _into(target: ndarray) -> str:
    """Whether cameras must stay on one side: targets in a room stand in a corner."""
    return "room" if np.linalg.norm(target[:2]) > 0.5 else "any"


def _hand(rng: np.random.Generator, t: int, target: ndarray, distance: float) -> ndarray:
    """A jittery arc of 30 to 90 degrees, as of a hand."""
    azimuth = _arc(rng, (30, 90), t, _into(target)) + _wander(rng, t, 0.04)[:, 0]
    elevation = np.radians(rng.uniform(20, 50)) + _wander(rng, t, 0.12)[:, 0]
    away = distance * (1 + _wander(rng, t, 0.08)[:, 0])
    aim = _wander(rng, t, 0.06 * distance, 3) + rng.normal(size=(t, 3)) * 0.004
    return _on_sphere(target, azimuth, elevation, away, aim, _wander(rng, t, 0.08)[:, 0] + rng.normal(size=t) * 0.004)


def _wrist(rng: np.random.Generator, t: int, target: ndarray, distance: float) -> ndarray:
    """Rings of a dome, as of a robot's wrist: 60 to 300 degrees around, there and back at rising elevation."""
    degrees = (60, 90) if _into(target) == "room" else (60, 300)
    n_rings = int(rng.integers(1, 4))
    arc = _arc(rng, degrees, 200, _into(target))
    there_and_back = np.abs((np.linspace(0, n_rings, t) + 1) % 2 - 1)
    azimuth = np.interp(there_and_back, np.linspace(0, 1, 200), arc)
    low, high = np.radians(rng.uniform(20, 30)), np.radians(rng.uniform(50, 75))
    elevation = np.linspace(low, high, t)
    still = np.zeros((t, 3))
    roll = np.full(t, rng.uniform(-np.pi, np.pi))
    return _on_sphere(target, azimuth, elevation, np.full(t, distance), still, roll)


def _approach(rng: np.random.Generator, t: int, target: ndarray, distance: float) -> ndarray:
    """Towards the target, to half the distance, on a curve of 30 to 60 degrees."""
    azimuth = _arc(rng, (30, 60), t, _into(target))
    elevation = np.radians(np.linspace(rng.uniform(25, 40), rng.uniform(40, 70), t))
    away = distance * np.linspace(1.2, 0.6, t)
    aim = _wander(rng, t, 0.02 * distance, 3)
    return _on_sphere(target, azimuth, elevation, away, aim, np.full(t, rng.uniform(-0.3, 0.3)))


def _start(rng: np.random.Generator, target: ndarray, distance: float) -> Float[ndarray, "4 4"]:
    """One camera that looks at the target."""
    azimuth, elevation = _arc(rng, (0, 1), 1, _into(target)), np.radians([rng.uniform(30, 50)])
    return _on_sphere(target, azimuth, elevation, np.array([distance]), np.zeros((1, 3)), np.zeros(1))[0]


def _moved(start: ndarray, shifts: ndarray, turns: ndarray) -> Float[ndarray, "t 4 4"]:
    """A camera moved and turned in its own frame: metres (t, 3), rotation vectors (t, 3)."""
    own = np.tile(np.eye(4), (len(shifts), 1, 1))
    own[:, :3, 3] = shifts
    own[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    return start @ own


def _along(rng: np.random.Generator, t: int, target: ndarray, distance: float, axis: int) -> ndarray:
    """Along one axis of the camera, without turning."""
    shifts = np.zeros((t, 3))
    shifts[:, axis] = np.linspace(-0.5, 0.5, t) * distance * rng.uniform(0.3, 0.7) * rng.choice([-1, 1])
    return _moved(_start(rng, target, distance), shifts, np.zeros((t, 3)))


def _sideways(rng: np.random.Generator, t: int, target: ndarray, distance: float) -> ndarray:
    """To the side only."""
    return _along(rng, t, target, distance, 0)


def _upward(rng: np.random.Generator, t: int, target: ndarray, distance: float) -> ndarray:
    """Up or down in the image only."""
    return _along(rng, t, target, distance, 1)


def _forward(rng: np.random.Generator, t: int, target: ndarray, distance: float) -> ndarray:
    """Along the optical axis only."""
    return _along(rng, t, target, distance, 2)


def _rotation(rng: np.random.Generator, t: int, target: ndarray, distance: float) -> ndarray:
    """Turning about its own centre only, by some 40 degrees."""
    turns = np.linspace(-0.5, 0.5, t)[:, None] * rng.normal(size=3) * [0.5, 0.5, 0.3] + _wander(rng, t, 0.05, 3)
    return _moved(_start(rng, target, distance), np.zeros((t, 3)), turns)


def _resting(rng: np.random.Generator, t: int, target: ndarray, distance: float) -> ndarray:
    """On a stand."""
    return _moved(_start(rng, target, distance), np.zeros((t, 3)), np.zeros((t, 3)))


def _tiny(rng: np.random.Generator, t: int, target: ndarray, distance: float) -> ndarray:
    """Within some 5 mm and 0.5 degrees."""
    return _moved(_start(rng, target, distance), _wander(rng, t, 0.003, 3), _wander(rng, t, 0.005, 3))


def _turntable(rng: np.random.Generator, t: int, target: ndarray, distance: float) -> ndarray:
    """Around the vertical at one height, all around."""
    azimuth = np.linspace(0, 2 * np.pi, t) * rng.uniform(0.5, 1.0)
    elevation = np.full(t, np.radians(rng.uniform(25, 55)))
    return _on_sphere(target, azimuth, elevation, np.full(t, distance), np.zeros((t, 3)), np.zeros(t))


MOTIONS: dict[str, Motion] = {
    "hand": _hand,
    "wrist": _wrist,
    "approach": _approach,
    "sideways": _sideways,
    "upward": _upward,
    "forward": _forward,
    "rotation": _rotation,
    "resting": _resting,
    "tiny": _tiny,
    "turntable": _turntable,
}
"""By name; the first three tell reading and unit."""


# Faults of sensors ----------------------------------------------------------------------------------------------------


def _patches(rng: np.random.Generator) -> Float[ndarray, "h w"]:
    """Noise that is alike over some 10 pixels, of deviation 1."""
    coarse = rng.normal(size=(HEIGHT // 10, WIDTH // 10)).astype(np.float32)
    smooth = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return smooth / smooth.std()


def _measured(depth: Float32[ndarray, "h w"], errors: Errors, rng: np.random.Generator) -> Float32[ndarray, "h w"]:
    """What a sensor returns for exact depth, metres."""
    noise = (_patches(rng) + rng.normal(size=depth.shape)) / np.sqrt(2)
    measured = depth * (1 + errors.depth * noise)
    if errors.holes > 0:
        patches = _patches(rng)
        measured = np.where(patches < np.quantile(patches, errors.holes), 0, measured)
    return measured.astype(np.float32)


def _stored(depth: Float32[ndarray, "h w"], scale: float) -> UInt16[ndarray, "h w"]:
    """Depth in whole units; what does not fit into 16 bit is no measurement."""
    units = np.round(depth / scale)
    return np.where((units > 0) & (units < 65535), units, 0).astype(np.uint16)


@numba.njit(cache=True)
def _cast(
    height: int,
    width: int,
    K: ndarray,
    world_from_camera: ndarray,
    box_from_world: ndarray,
    halves: ndarray,
    balls: ndarray,
) -> ndarray:
    depth = np.zeros((height, width), np.float32)
    R, o = world_from_camera[:3, :3].copy(), world_from_camera[:3, 3].copy()
    # Slopes of rays in each box's axes are linear in x and y, and all rays start at one point.
    slopes = np.zeros((len(halves), 3, 3))
    starts = np.zeros((len(halves), 3))
    for i in range(len(halves)):
        slopes[i] = box_from_world[i, :3, :3].copy() @ R
        starts[i] = box_from_world[i, :3, :3].copy() @ o + box_from_world[i, :3, 3]
    for v in range(height):
        y = (v - K[1, 2]) / K[1, 1]
        for u in range(width):
            # The ray has z = 1 in the camera, so its parameter is the z-depth.
            x = (u - K[0, 2]) / K[0, 0]
            nearest = np.inf
            for i in range(len(halves)):
                enter, leave = -np.inf, np.inf
                for k in range(3):
                    slope = slopes[i, k, 0] * x + slopes[i, k, 1] * y + slopes[i, k, 2]
                    per = 1 / slope if abs(slope) > 1e-12 else 1e12
                    first, second = (-halves[i, k] - starts[i, k]) * per, (halves[i, k] - starts[i, k]) * per
                    enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
                    if enter > leave or enter > nearest:
                        break
                if enter <= leave:
                    hit = enter if enter > 1e-6 else leave
                    if 1e-6 < hit < nearest:
                        nearest = hit
            if len(balls):
                dx = R[0, 0] * x + R[0, 1] * y + R[0, 2]
                dy = R[1, 0] * x + R[1, 1] * y + R[1, 2]
                dz = R[2, 0] * x + R[2, 1] * y + R[2, 2]
            for i in range(len(balls)):
                px, py, pz = o[0] - balls[i, 0], o[1] - balls[i, 1], o[2] - balls[i, 2]
                a = dx * dx + dy * dy + dz * dz
                b = dx * px + dy * py + dz * pz
                c = px * px + py * py + pz * pz - balls[i, 3] ** 2
                if b * b - a * c >= 0:
                    hit = (-b - np.sqrt(b * b - a * c)) / a
                    if 1e-6 < hit < nearest:
                        nearest = hit
            if nearest < np.inf:
                depth[v, u] = nearest
    return depth
