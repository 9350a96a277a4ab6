"""Analytic scenes: spheres, boxes and a table, ray-cast exactly. What the tests hold the pipeline against.

Every ray has a z component of 1 in the camera frame, so the ray parameter of a hit *is* its z-depth and no conversion
can be got wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray

from bask_data.core.geometry import invert_rigid, pixel_grid, transform, unproject

MISS = np.inf
NEAREST_HIT = 1e-9
"""A hit this close to the camera, metres, is the camera itself."""


@dataclass(frozen=True)
class Sphere:
    """A ball; `colour` is the base colour its texture varies around."""

    centre: tuple[float, float, float]
    radius: float
    colour: tuple[int, int, int] = (200, 80, 60)

    def cast(self, origin: Float[ndarray, "3"], directions: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Ray parameter of the first hit in front of the origin, or infinity."""
        offset = origin - np.asarray(self.centre)
        a = np.einsum("ij,ij->i", directions, directions)
        half_b = directions @ offset
        discriminant = half_b**2 - a * (offset @ offset - self.radius**2)
        root = np.sqrt(np.maximum(discriminant, 0.0))
        near, far = (-half_b - root) / a, (-half_b + root) / a
        hit = np.where(near > NEAREST_HIT, near, far)
        return np.where((discriminant >= 0) & (hit > NEAREST_HIT), hit, MISS)

    def distance(self, points_world: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Unsigned distance to the surface, metres."""
        return np.abs(np.linalg.norm(points_world - np.asarray(self.centre), axis=1) - self.radius)

    def local(self, points_world: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """Points in the body's own frame, where its texture lives."""
        return points_world - np.asarray(self.centre)


@dataclass(frozen=True)
class Box:
    """A solid box with half edge lengths `half`, anywhere and at any angle."""

    half: tuple[float, float, float]
    world_from_box: Float[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    colour: tuple[int, int, int] = (60, 120, 200)

    def cast(self, origin: Float[ndarray, "3"], directions: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Ray parameter of the first hit in front of the origin, or infinity (slab method)."""
        box_from_world = invert_rigid(self.world_from_box)
        start = transform(box_from_world, origin)
        slope = directions @ box_from_world[:3, :3].T
        # A ray parallel to a slab divides by zero; a tiny slope gives the same limits without NaN.
        slope = np.where(np.abs(slope) < 1e-15, 1e-15, slope)
        half = np.asarray(self.half)
        first, second = (-half - start) / slope, (half - start) / slope
        enter, leave = (
            np.minimum(first, second).max(axis=1),
            np.maximum(first, second).min(axis=1),
        )
        hit = np.where(enter > NEAREST_HIT, enter, leave)
        return np.where((enter <= leave) & (hit > NEAREST_HIT), hit, MISS)

    def distance(self, points_world: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Unsigned distance to the surface, metres."""
        excess = np.abs(self.local(points_world)) - np.asarray(self.half)
        outside = np.linalg.norm(np.maximum(excess, 0.0), axis=1)
        inside = np.minimum(excess.max(axis=1), 0.0)
        return np.abs(outside + inside)

    def local(self, points_world: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """Points in the body's own frame, where its texture lives."""
        return transform(invert_rigid(self.world_from_box), points_world)


@dataclass(frozen=True)
class Plane:
    """The plane n.x + d = 0, seen from both sides; limited to a disc of `extent` metres around `centre` when that is
    finite."""

    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    offset: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extent: float = np.inf
    colour: tuple[int, int, int] = (150, 140, 120)

    def cast(self, origin: Float[ndarray, "3"], directions: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Ray parameter of the hit in front of the origin, or infinity."""
        normal = np.asarray(self.normal)
        slope = directions @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            hit = -(origin @ normal + self.offset) / slope
            where = origin + hit[:, None] * directions
            inside = np.linalg.norm(where - np.asarray(self.centre), axis=1) <= self.extent
        return np.where(np.isfinite(hit) & (hit > NEAREST_HIT) & inside, hit, MISS)

    def distance(self, points_world: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Unsigned distance to the surface, metres."""
        signed = points_world @ np.asarray(self.normal) + self.offset
        in_plane = points_world - signed[:, None] * np.asarray(self.normal)
        beyond = np.maximum(
            np.linalg.norm(in_plane - np.asarray(self.centre), axis=1) - self.extent,
            0.0,
        )
        return np.hypot(signed, beyond)

    def local(self, points_world: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """Points in the body's own frame, where its texture lives."""
        return points_world


Body = Sphere | Box | Plane


@dataclass(frozen=True)
class View:
    """One exact image of a scene."""

    depth: Float32[ndarray, "h w"]
    """z-depth, metres; 0 where the ray hits nothing."""
    instance: UInt8[ndarray, "h w"]
    """0 background, 1..k the scene's objects in order."""
    rgb: UInt8[ndarray, "h w 3"]


@dataclass(frozen=True)
class Scene:
    """Bodies: `objects` are instances 1..k in order, `background` (the table, walls) is instance 0."""

    objects: tuple[Body, ...]
    background: tuple[Body, ...] = (Plane(),)

    @property
    def n_objects(self) -> int:
        return len(self.objects)

    def cast(
        self,
        K: Float[ndarray, "3 3"],
        world_from_camera: Float[ndarray, "4 4"],
        height: int,
        width: int,
    ) -> Float[ndarray, "bodies n"]:
        """z-depth of every body alone at every pixel, infinity where it is missed; background bodies first."""
        uv = pixel_grid(height, width).reshape(-1, 2)
        directions = unproject(uv, np.ones(len(uv)), K) @ world_from_camera[:3, :3].T
        return np.stack([body.cast(world_from_camera[:3, 3], directions) for body in self.background + self.objects])

    def render(
        self,
        K: Float[ndarray, "3 3"],
        world_from_camera: Float[ndarray, "4 4"],
        height: int,
        width: int,
    ) -> View:
        """Exact depth, instances and texture of one camera."""
        hits = self.cast(K, world_from_camera, height, width)
        nearest = np.argmin(hits, axis=0)
        depth = hits[nearest, np.arange(hits.shape[1])]
        seen = np.isfinite(depth)
        instance = np.where(seen, np.maximum(nearest - len(self.background) + 1, 0), 0)
        uv = pixel_grid(height, width).reshape(-1, 2)
        points_world = transform(world_from_camera, unproject(uv, np.where(seen, depth, 0.0), K))
        rgb = np.zeros((len(depth), 3), np.uint8)
        for i_body, body in enumerate(self.background + self.objects):
            mine = seen & (nearest == i_body)
            rgb[mine] = texture(body.local(points_world[mine]), np.asarray(body.colour), i_body)
        return View(
            np.where(seen, depth, 0.0).astype(np.float32).reshape(height, width),
            instance.astype(np.uint8).reshape(height, width),
            rgb.reshape(height, width, 3),
        )

    def amodal(
        self,
        K: Float[ndarray, "3 3"],
        world_from_camera: Float[ndarray, "4 4"],
        height: int,
        width: int,
    ) -> Bool[ndarray, "k h w"]:
        """The pixels each object would cover with nothing in front of it."""
        hits = self.cast(K, world_from_camera, height, width)[len(self.background) :]
        return np.isfinite(hits).reshape(self.n_objects, height, width)

    def surface_distance(self, points_world: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Unsigned distance to the nearest surface, metres.

        A body that stands on the table hides its own underside and the table below it: no camera sees those, but they
        exist, and the distance is to them where they are nearest.
        """
        return np.stack([body.distance(points_world) for body in self.background + self.objects]).min(axis=0)

    def instance_at(self, points_world: Float[ndarray, "n 3"], table_margin: float = 0.0) -> Int[ndarray, "n"]:
        """The instance whose surface is nearest; the background wins when it is nearer by `table_margin` metres or
        less than the object."""
        background = np.stack([body.distance(points_world) for body in self.background]).min(axis=0)
        if not self.objects:
            return np.zeros(len(points_world), np.int32)
        objects = np.stack([body.distance(points_world) for body in self.objects])
        nearest = objects.argmin(axis=0)
        is_object = objects.min(axis=0) + table_margin < background
        return np.where(is_object, nearest + 1, 0).astype(np.int32)


def texture(
    points: Float[ndarray, "n 3"],
    colour: Float[ndarray, "3"] | Int[ndarray, "3"],
    seed: int,
) -> UInt8[ndarray, "n 3"]:
    """Smooth, non-repeating colours fixed to the surface: sums of sine waves of 1 to 8 cm, the same for the same
    seed."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(6, 3))
    waves *= (2 * np.pi / rng.uniform(0.01, 0.08, size=6) / np.linalg.norm(waves, axis=1))[:, None]
    phases = rng.uniform(0, 2 * np.pi, size=6)
    mixing = rng.uniform(-22, 22, size=(6, 3))
    return np.clip(colour + np.sin(points @ waves.T + phases) @ mixing, 0, 255).astype(np.uint8)


def intrinsics(height: int, width: int, field_of_view_deg: float = 60.0) -> Float[ndarray, "3 3"]:
    """A pinhole camera whose horizontal field of view is given; the principal point is the middle of the image."""
    focal = width / 2 / np.tan(np.deg2rad(field_of_view_deg) / 2)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])


def look_at(
    eye: Sequence[float] | Float[ndarray, "3"],
    target: Sequence[float] | Float[ndarray, "3"] = (0.0, 0.0, 0.0),
    up: Sequence[float] | Float[ndarray, "3"] = (0.0, 0.0, 1.0),
) -> Float[ndarray, "4 4"]:
    """`world_from_camera` of a camera at `eye` that looks at `target`; `up` in the world is up in the image (y points
    down)."""
    forward = np.asarray(target, float) - np.asarray(eye, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, float))
    if np.linalg.norm(right) < 1e-9:  # Looking straight along `up`: any horizontal axis will do.
        right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    world_from_camera[:3, 3] = eye
    return world_from_camera


def orbit(
    n_cameras: int,
    radius: float = 0.7,
    target: Sequence[float] = (0.0, 0.0, 0.03),
    elevation_deg: tuple[float, float] = (20.0, 70.0),
    n_turns: float = 2.5,
) -> Float[ndarray, "n_cameras 4 4"]:
    """`world_from_cameras` on a spiral over the upper hemisphere, all looking at `target`."""
    fraction = (np.arange(n_cameras) + 0.5) / n_cameras
    azimuth = 2 * np.pi * n_turns * fraction
    elevation = np.deg2rad(elevation_deg[0] + (elevation_deg[1] - elevation_deg[0]) * fraction)
    heading = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    return np.stack([look_at(np.asarray(target) + radius * direction, target) for direction in heading])


def tabletop(n_objects: int, seed: int = 0, spread: float = 0.2, gap: float = 0.05) -> Scene:
    """Boxes and spheres of 4 to 12 cm on a table z = 0, at least `gap` metres apart.

    Spheres stand half way in the table: a whole sphere touches it in a point, where no fusion of images can tell the
    two apart.
    """
    rng = np.random.default_rng(seed)
    bodies: list[Body] = []
    footprints: list[tuple[ndarray, float]] = []
    for i_object in range(n_objects):
        for attempt in range(10_000):
            is_sphere = i_object % 3 == 2
            half = rng.uniform(0.02, 0.06, size=3)
            footprint = float(half[0] if is_sphere else np.hypot(half[0], half[1]))
            # The table grows when there is no room left, so that any number of objects can be placed.
            where = rng.uniform(-1, 1, size=2) * (spread + attempt * 1e-4)
            if all(np.linalg.norm(where - other) > footprint + radius + gap for other, radius in footprints):
                break
        footprints.append((where, footprint))
        red, green, blue = rng.integers(40, 216, size=3)
        colour = (int(red), int(green), int(blue))
        if is_sphere:
            bodies.append(Sphere((float(where[0]), float(where[1]), 0.0), float(half[0]), colour))
            continue
        angle = rng.uniform(0, np.pi)
        world_from_box = np.eye(4)
        world_from_box[:2, :2] = [
            [np.cos(angle), -np.sin(angle)],
            [np.sin(angle), np.cos(angle)],
        ]
        world_from_box[:3, 3] = [where[0], where[1], half[2]]
        bodies.append(Box((float(half[0]), float(half[1]), float(half[2])), world_from_box, colour))
    return Scene(tuple(bodies))


def noisy(
    depth: Float32[ndarray, "h w"],
    sigma: float,
    rng: np.random.Generator,
    share_missing: float = 0.0,
) -> Float32[ndarray, "h w"]:
    """The depth with Gaussian noise of `sigma` metres and a share of pixels not measured; 0 stays 0."""
    measured = (depth > 0) & (rng.random(depth.shape) >= share_missing)
    noise = rng.normal(scale=sigma, size=depth.shape) if sigma > 0 else np.zeros(depth.shape)
    return np.where(measured, np.maximum(depth + noise, 1e-4), 0.0).astype(np.float32)
