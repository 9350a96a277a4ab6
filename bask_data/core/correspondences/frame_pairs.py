"""Pairs of frames to match: those that see the same surface from clearly different places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from bask_data.core.geometry import in_image, invert_rigid, project, transform, view_change

SLANT = np.cos(np.deg2rad(75.0))
"""Cosine of the angle of incidence below which surface does not count as seen: there, a pixel covers too much of it to
be matched. Chosen, sensitivity not measured."""
MAX_CANDIDATES = 200_000
"""Most pairs considered; for a long scan, a random sample. Chosen to bound time, sensitivity not measured."""
# Edges of the classes over which pairs are spread; chosen, sensitivity not measured.
ANGLE_BINS = np.deg2rad([15.0, 30.0, 60.0])
"""View angle, radians."""
SCALE_BINS = np.log2([0.71, 0.87, 1.15, 1.41])
"""Change of scale, logarithm to base 2."""
TURN_BINS = np.deg2rad([-90.0, -30.0, 30.0, 90.0])
"""Rotation about the viewing axis, radians."""


@dataclass(frozen=True)
class FramePairs:
    """Chosen pairs of frames.

    Args:
        frames: (a, b), numbers of frames.
        distance: metres between the camera centres.
        angle: radians between the camera orientations.
        n_looked_at: number of pairs considered.
        n_too_similar: of those, pairs without enough change of view.
        n_too_little_overlap: of the others, pairs that share too little surface.
    """

    frames: Int[ndarray, "p 2"]
    distance: Float[ndarray, "p"]
    angle: Float[ndarray, "p"]
    n_looked_at: int
    n_too_similar: int
    n_too_little_overlap: int


def seen(
    points_world: Float[ndarray, "m 3"],
    normals_world: Float[ndarray, "m 3"],
    Ks: Float[ndarray, "t 3 3"],
    world_from_cameras: Float[ndarray, "t 4 4"],
    height: int,
    width: int,
) -> Bool[ndarray, "t m"]:
    """Points inside each image and facing its camera; occlusion is not considered.

    Args:
        points_world, normals_world: metres and unit vectors, world frame.
    """
    result = np.zeros((len(world_from_cameras), len(points_world)), bool)
    for i_frame, (K, world_from_camera) in enumerate(zip(Ks, world_from_cameras, strict=True)):
        uv, z = project(transform(invert_rigid(world_from_camera), points_world), K)
        ray = world_from_camera[:3, 3] - points_world
        facing = np.einsum("ij,ij->i", ray, normals_world) > SLANT * np.linalg.norm(ray, axis=1)
        result[i_frame] = in_image(uv, height, width) & (z > 0) & facing
    return result


def choose_pairs(
    world_from_cameras: Float[ndarray, "t 4 4"],
    is_seen: Bool[ndarray, "t m"],
    points_world: Float[ndarray, "m 3"],
    n_pairs: int,
    rng: np.random.Generator,
    min_distance: float = 0.2,
    min_angle: float = np.deg2rad(20.0),
    min_overlap: float = 0.15,
) -> FramePairs:
    """At most `n_pairs` pairs, spread over view angle, scale, rotation and frames.

    Args:
        is_seen: `points_world` that each frame shows.
        min_distance, min_angle: metres, radians; a pair must exceed one of them. The default distance assumes a
            tabletop.
        min_overlap: least share of the points seen by either frame that both see.
    """
    n_frames = len(world_from_cameras)
    a, b = candidates(n_frames, rng)
    distance, angle = view_change(world_from_cameras[a], world_from_cameras[b])
    differ = (distance > min_distance) | (angle > min_angle)
    a, b, distance, angle = a[differ], b[differ], distance[differ], angle[differ]
    shared = overlap(is_seen, a, b)
    enough = shared >= min_overlap
    a, b, distance, angle = a[enough], b[enough], distance[enough], angle[enough]
    order = spread(view_class(world_from_cameras, is_seen, points_world, a, b), a, b, n_frames, n_pairs, rng)
    return FramePairs(
        np.stack([a[order], b[order]], axis=1),
        distance[order],
        angle[order],
        len(differ),
        int(len(differ) - differ.sum()),
        int(len(enough) - enough.sum()),
    )


def candidates(n_frames: int, rng: np.random.Generator) -> tuple[Int[ndarray, "c"], Int[ndarray, "c"]]:
    """Pairs of different frames, each once and its two in random order: all of them, or a sample."""
    if n_frames * (n_frames - 1) // 2 <= MAX_CANDIDATES:
        a, b = np.triu_indices(n_frames, k=1)
    else:
        drawn = np.sort(rng.integers(n_frames, size=(MAX_CANDIDATES, 2)), axis=1)
        a, b = np.unique(drawn[drawn[:, 0] < drawn[:, 1]], axis=0).T
    swap = rng.random(len(a)) < 0.5
    return np.where(swap, b, a), np.where(swap, a, b)


def overlap(is_seen: Bool[ndarray, "t m"], a: Int[ndarray, "c"], b: Int[ndarray, "c"]) -> Float[ndarray, "c"]:
    """Points that both frames of each pair see, over those that either sees; 0 where neither sees any."""
    shared = np.empty(len(a))
    n_seen = is_seen.sum(axis=1)
    # A pair takes as many bytes as there are points; in chunks, the pairs of a long scan fit into memory.
    for start in range(0, len(a), 4096):
        chunk = slice(start, start + 4096)
        shared[chunk] = (is_seen[a[chunk]] & is_seen[b[chunk]]).sum(axis=1)
    return shared / np.maximum(n_seen[a] + n_seen[b] - shared, 1)


def view_class(
    world_from_cameras: Float[ndarray, "t 4 4"],
    is_seen: Bool[ndarray, "t m"],
    points_world: Float[ndarray, "m 3"],
    a: Int[ndarray, "c"],
    b: Int[ndarray, "c"],
) -> Int[ndarray, "c"]:
    """Class of each pair by the angle between its views, its change of scale and its turn about the viewing axis."""
    centre = points_world.mean(axis=0) if len(points_world) else np.zeros(3)
    n_seen = np.maximum(is_seen.sum(axis=1, keepdims=True), 1)
    target = np.where(is_seen.any(axis=1, keepdims=True), is_seen.astype(np.float64) @ points_world / n_seen, centre)
    from_target = world_from_cameras[:, :3, 3] - target
    reach = np.maximum(np.linalg.norm(from_target, axis=1), 1e-9)
    heading = from_target / reach[:, None]
    parallax = np.arccos(np.clip(np.einsum("ij,ij->i", heading[a], heading[b]), -1, 1))
    a_from_b = np.swapaxes(world_from_cameras[a, :3, :3], 1, 2) @ world_from_cameras[b, :3, :3]
    turn = np.arctan2(a_from_b[:, 1, 0] - a_from_b[:, 0, 1], a_from_b[:, 0, 0] + a_from_b[:, 1, 1])
    i_angle = np.digitize(parallax, ANGLE_BINS)
    i_scale = np.digitize(np.log2(reach[a] / reach[b]), SCALE_BINS)
    i_turn = np.digitize(turn, TURN_BINS)
    return (i_angle * (len(SCALE_BINS) + 1) + i_scale) * (len(TURN_BINS) + 1) + i_turn


def spread(
    group: Int[ndarray, "c"],
    a: Int[ndarray, "c"],
    b: Int[ndarray, "c"],
    n_frames: int,
    n_pairs: int,
    rng: np.random.Generator,
) -> Int[ndarray, "p"]:
    """Indices of pairs drawn from the groups in turn: in each, the one of a few random pairs whose frames were used
    least. Sorted by frames, so that neighbours in the list read the same frames."""
    waiting = [list(rng.permutation(np.flatnonzero(group == label))) for label in np.unique(group)]
    n_used = np.zeros(n_frames, np.int64)
    chosen: list[int] = []
    while waiting and len(chosen) < n_pairs:
        for members in waiting:
            last = np.asarray(members[-16:])
            pair = members.pop(len(members) - len(last) + int(np.argmin(n_used[a[last]] + n_used[b[last]])))
            n_used[[a[pair], b[pair]]] += 1
            chosen.append(int(pair))
            if len(chosen) == n_pairs:
                break
        waiting = [members for members in waiting if members]
    picked = np.array(chosen, np.int64)
    return picked[np.lexsort((b[picked], a[picked]))]
