"""Matches by ground truth: pixels of one frame, projected into others by exact depth and cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.pair_matches import LEAST_MATCHES, PairMatches
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

N_QUERIES = 24
"""Query pixels of a frame, shared among its objects, and matches used of a pair, at most."""
MOST_MATCHED_FRAMES = 60
"""Frames of a scene that are matched, at most."""
SEEN_TOLERANCE = (0.005, 0.01)
"""A point is visible where the depth is within a + b z metres of its own. With exact depth, this only allows for
rounding to a pixel on an oblique surface; occluders are farther in front."""
SMOOTH_TOLERANCE = (0.002, 0.002)
"""Depths of neighbouring pixels show one surface where they differ by no more than its slope and a + b z metres."""
EDGE_MARGIN_PX = 2
"""Distance of matches from the edges of objects and surfaces, pixels, as in training."""
N_HIDEABLE_POINTS = 1500
"""Points of an object's surface taken from a frame, to measure how much of it is occluded in others."""


@dataclass(frozen=True)
class Queries:
    """Pixels of one frame to look for elsewhere, and the surface they show.

    Attributes:
        points_world, tangents_world: (n, 3) and (n, 3, 2), as `core.local_warp.surface_tangents` has them.
        magnification: (n,) heights of the image that a metre there is high.
    """

    uv: np.ndarray
    label: np.ndarray
    points_world: np.ndarray
    tangents_world: np.ndarray
    magnification: np.ndarray


def queries_of(frames: Frames, frame: Frame, uv: np.ndarray, label: np.ndarray, depth: np.ndarray) -> Queries:
    """Pixels of a frame with their surface points and the surface's tangents, as far as depth gives them."""
    from bask_data.core.geometry import transform
    from bask_data.core.local_warp import surface_tangents

    K, world = frames.K(frame), frames.world_from_camera(frame)
    points, tangents = surface_tangents(uv, depth, frames.labels(frame), K)
    magnification = K[1, 1] / points[:, 2] / frames.size(frame.camera)[0]
    return Queries(uv, label, transform(world, points), world[:3, :3] @ tangents, magnification)


def drawn_pixels(
    frames: Frames, frame: Frame, allowed: np.ndarray, n: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """At most n of the allowed pixels (h, w) on objects (m, 2), and their labels (m,), shared equally as far as
    possible."""
    import numpy as np

    from bask_data.core.correspondences.search import shares

    labels = frames.labels(frame)
    pixels = {label: np.flatnonzero((labels == label) & allowed) for label in frames.objects}
    taken = shares(np.array([len(of_label) for of_label in pixels.values()]), n)
    drawn = [rng.choice(of_label, k, replace=False) for of_label, k in zip(pixels.values(), taken, strict=True)]
    v, u = np.divmod(np.concatenate(drawn), labels.shape[1])
    return np.stack([u, v], axis=1).astype(float), np.repeat(list(pixels), taken)


def shows(frames: Frames, frame: Frame, uv: np.ndarray, z: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Whether points of objects are visible in a frame (m,), given their pixels (m, 2), depth and labels (m,)."""
    import numpy as np

    from bask_data.core.landings import label_at
    from bask_data.core.match_errors import true_depth

    labels = frames.labels(frame)
    off = np.abs(true_depth(frames.depth(frame), labels, uv) - z)
    return (label_at(labels, uv) == label) & (off <= SEEN_TOLERANCE[0] + SEEN_TOLERANCE[1] * z)


def _clear(frames: Frames, frame: Frame) -> np.ndarray:
    """Pixels (h, w) whose surface is seen at less than 75 degrees from its normal and continues all around them.

    Elsewhere it is a matter of chance which surface a pixel shows; nobody picks keypoints there, and `correspondences`
    leaves such pixels out.
    """
    from bask_data.core.correspondences.matchable import matchable_view

    K, world_from_camera = frames.K(frame), frames.world_from_camera(frame)
    depth, labels = frames.depth(frame), frames.labels(frame)
    known = matchable_view(depth, labels, K, world_from_camera, None, SMOOTH_TOLERANCE, EDGE_MARGIN_PX)
    return known.sure > 0


def by_truth(frames: Frames, chosen: list[Frame], rng: np.random.Generator) -> list[PairMatches]:
    """All pairs of the frames with enough matches of the first frame's queries."""
    import numpy as np

    from bask_data.core.landings import label_at

    clear = {frame: _clear(frames, frame) for frame in chosen}
    queries = [
        queries_of(frames, frame, *drawn_pixels(frames, frame, clear[frame], N_QUERIES, rng), frames.depth(frame))
        for frame in chosen
    ]
    i_first = np.repeat(np.arange(len(chosen)), [len(of_frame.label) for of_frame in queries])
    everything = Queries(
        **{name: np.concatenate([getattr(of_frame, name) for of_frame in queries]) for name in vars(queries[0])}
    )
    surface = _surfaces(frames, chosen)
    pairs = []
    for b in progress(chosen, f"finding true matches of {frames.scene}"):
        columns = projected(frames, b, everything, _visible_shares(frames, b, surface))
        is_clear = label_at(clear[b].astype(np.uint8), columns["uv_b"]) == 1
        is_shown = shows(frames, b, columns["uv_b"], columns["points_b"][:, 2], columns["label"])
        seen = np.flatnonzero(is_clear & is_shown)
        # Already sorted by the first frame, as they were drawn.
        bounds = np.searchsorted(i_first[seen], np.arange(len(chosen) + 1))
        for a, first, end in zip(chosen, bounds[:-1], bounds[1:], strict=True):
            if a != b and end - first >= LEAST_MATCHES:
                mine = seen[first:end]
                matched = {name: column[mine] for name, column in columns.items()}
                pairs.append(PairMatches(frames.scene, a, b, False, **matched))
    return pairs


def _surfaces(frames: Frames, chosen: list[Frame]) -> dict[int, np.ndarray]:
    """Points (m, 3) of each object's whole surface, as far as the frames show it, metres, world frame."""
    import numpy as np

    return {
        label: np.concatenate([np.zeros((0, 3)), *(frames.points(frame, label, N_HIDEABLE_POINTS) for frame in chosen)])
        for label in frames.objects
    }


def _visible_shares(frames: Frames, frame: Frame, surface: dict[int, np.ndarray]) -> np.ndarray:
    """By label (256,): share of the object that is not occluded in a frame; NaN if the frame does not show it."""
    import numpy as np

    from bask_data.core.local_warp import visible_share

    depth, labels = frames.depth(frame), frames.labels(frame)
    camera = frames.K(frame), frames.world_from_camera(frame)
    result = np.full(256, np.nan)
    for label, points in surface.items():
        if (labels == label).any():
            result[label] = visible_share(points, label, depth, labels, *camera)
    return result


def projected(frames: Frames, b: Frame, queries: Queries, visible: np.ndarray) -> dict[str, np.ndarray]:
    """Queries projected into another frame, visible there or not: columns of `PairMatches` by name."""
    import numpy as np

    from bask_data.core.geometry import invert_rigid, project, transform
    from bask_data.core.local_warp import image_warp, turn_of

    K, b_from_world = frames.K(b), invert_rigid(frames.world_from_camera(b))
    points_b = transform(b_from_world, queries.points_world)
    uv_b, z = project(points_b, K)
    with np.errstate(divide="ignore", invalid="ignore"):
        larger = K[1, 1] / z / frames.size(b.camera)[0] / queries.magnification
        scale = np.maximum(larger, 1 / larger)
        rotation = turn_of(image_warp(points_b, b_from_world[:3, :3] @ queries.tangents_world, K))
    return {
        "uv_a": queries.uv,
        "uv_b": uv_b,
        "label": queries.label,
        "points_b": points_b,
        "scale": scale,
        "rotation": rotation,
        "visible": visible[queries.label],
    }
