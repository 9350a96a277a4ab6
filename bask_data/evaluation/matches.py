"""Matches to evaluate descriptors on, spread over changes of scale, rotation and occlusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from bask_data.dataset import Dataset
from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.held_out import HeldOut
from bask_data.kinds import Correspondences
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

N_QUERIES = 24
"""Query pixels of a frame, shared among its objects, and matches used of a pair, at most."""
MOST_MATCHED_FRAMES = 60
"""Frames of a scene that are matched, at most."""
LEAST_MATCHES = 6
"""Pairs with fewer matches are left out."""
SEEN_TOLERANCE = (0.005, 0.01)
"""A point is visible where the depth is within a + b z metres of its own. With exact depth, this only allows for
rounding to a pixel on an oblique surface; occluders are farther in front."""
SMOOTH_TOLERANCE = (0.002, 0.002)
"""Depths of neighbouring pixels show one surface where they differ by no more than its slope and a + b z metres."""
EDGE_MARGIN_PX = 2
"""Distance of matches from the edges of objects and surfaces, pixels, as in training."""
N_HIDEABLE_POINTS = 1500
"""Points of an object's surface taken from a frame, to measure how much of it is occluded in others."""
SCALES = (1.25, 1.75)
"""Edges of the bins of changes of scale, as factors: neighbouring views of a path, up to most of an octave, more."""
ROTATIONS_DEG = (30.0, 60.0, 90.0)
"""Edges of the bins of rotations in the image, degrees; training rotates views by any angle."""
VISIBLE = (0.6, 0.9)
"""Edges of the bins of visible shares of the object. None of these edges changes a figure over all matches."""
BINS = {
    "scale": ("<1.25", "1.25-1.75", ">=1.75"),
    "rotation": ("0-30", "30-60", "60-90", ">=90"),
    "occlusion": ("visible <60%", "visible 60-90%", "visible >=90%"),
}


@dataclass(frozen=True)
class PairMatches:
    """Matches from one frame to another.

    Attributes:
        is_random: the pair was drawn at random, rather than to fill bins.
        uv_a, uv_b: pixels of the images (m, 2).
        label: object of each (m,).
        points_b: matched surface points (m, 3), metres, frame of the second camera; NaN without depth.
        scale: factor by which the images differ in scale (m,), at least 1; NaN without depth.
        rotation: rotation between the images (m,), radians in [0, pi]; NaN without depth.
        visible: share of the object that is not occluded in the second image (m,).
    """

    scene: str
    a: Frame
    b: Frame
    is_random: bool
    uv_a: np.ndarray
    uv_b: np.ndarray
    label: np.ndarray
    points_b: np.ndarray
    scale: np.ndarray
    rotation: np.ndarray
    visible: np.ndarray

    def some(self, which: np.ndarray) -> PairMatches:
        """The same pair with some of its matches."""
        names = ("uv_a", "uv_b", "label", "points_b", "scale", "rotation", "visible")
        return replace(self, **{name: getattr(self, name)[which] for name in names})

    def bins(self) -> dict[str, np.ndarray]:
        """Bin number of each match (m,), by kind of bin; -1 where it is unknown."""
        import numpy as np

        values = {"scale": self.scale, "rotation": np.degrees(self.rotation), "occlusion": self.visible}
        edges = {"scale": SCALES, "rotation": ROTATIONS_DEG, "occlusion": VISIBLE}
        return {
            name: np.where(np.isnan(value), -1, np.searchsorted(edges[name], value, side="right"))
            for name, value in values.items()
        }


def candidate_pairs(dataset: Dataset, frames: Frames, held_out: HeldOut, seed: int) -> list[PairMatches]:
    """All pairs of a scene's held-out frames with enough matches, and some matches of each: by exact depth where there
    is ground truth, else the dataset's own. If `held_out` allows it, also pairs with one held-out frame.
    """
    import numpy as np

    rng = np.random.default_rng([seed, 0, *frames.scene.encode()])
    aside = held_out.frames(frames, MOST_MATCHED_FRAMES)
    chosen = [*held_out.partners(frames, MOST_MATCHED_FRAMES), *aside]
    if frames.truth is not None:
        pairs = _by_truth(frames, chosen, rng)
    else:
        pairs = _by_correspondences(dataset, frames, chosen, rng)
    return [pair for pair in pairs if pair.a in aside or pair.b in aside]


def spread_pairs(candidates: Sequence[PairMatches], n_pairs: int, seed: int) -> list[PairMatches]:
    """At most n_pairs pairs: half of them random, the others chosen to fill the emptiest bins."""
    import numpy as np

    from bask_data.core.descriptor_scores import filling

    if not candidates:
        return []
    rng = np.random.default_rng([seed, 1])
    random = rng.permutation(len(candidates))[: (n_pairs + 1) // 2].tolist()
    picked = filling(np.stack([_bin_counts(pair) for pair in candidates]), random, n_pairs, rng)
    pairs = [replace(candidates[i], is_random=place < len(random)) for place, i in enumerate(picked)]
    # Sorted by frame, so that depth and labels are read once.
    return sorted(pairs, key=lambda pair: (pair.b, pair.a))


def alike_pairs(candidates: Sequence[PairMatches], n_pairs: int, seed: int) -> list[PairMatches]:
    """At most n_pairs pairs with small changes of scale and rotation, with the matches for which this holds."""
    import numpy as np

    pairs: list[PairMatches] = []
    for i in np.random.default_rng([seed, 2]).permutation(len(candidates)):
        bins = candidates[i].bins()
        alike = (bins["scale"] == 0) & (bins["rotation"] == 0)
        if len(pairs) < n_pairs and np.count_nonzero(alike) >= LEAST_MATCHES:
            pairs.append(candidates[i].some(alike))
    return pairs


def _bin_counts(pair: PairMatches) -> np.ndarray:
    """Number of matches in each bin of each kind, one after the other."""
    import numpy as np

    bins = pair.bins()
    return np.concatenate([np.bincount(bins[name] + 1, minlength=len(BINS[name]) + 1)[1:] for name in BINS])


# By ground truth ------------------------------------------------------------------------------------------------------


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


def _queries(frames: Frames, frame: Frame, uv: np.ndarray, label: np.ndarray, depth: np.ndarray) -> Queries:
    from bask_data.core.geometry import transform
    from bask_data.core.local_warp import surface_tangents

    K, world = frames.K(frame.camera), frames.world_from_camera(frame)
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

    from bask_data.core import scores

    labels = frames.labels(frame)
    off = np.abs(scores.true_depth(frames.depth(frame), labels, uv) - z)
    return (scores.label_at(labels, uv) == label) & (off <= SEEN_TOLERANCE[0] + SEEN_TOLERANCE[1] * z)


def _clear(frames: Frames, frame: Frame) -> np.ndarray:
    """Pixels (h, w) whose surface is seen at less than 75 degrees from its normal and continues all around them.

    Elsewhere it is a matter of chance which surface a pixel shows; nobody picks keypoints there, and `correspondences`
    leaves such pixels out.
    """
    from bask_data.core.correspondences.matchable import matchable_view

    K, world_from_camera = frames.K(frame.camera), frames.world_from_camera(frame)
    depth, labels = frames.depth(frame), frames.labels(frame)
    known = matchable_view(depth, labels, K, world_from_camera, None, SMOOTH_TOLERANCE, EDGE_MARGIN_PX)
    return known.sure > 0


def _by_truth(frames: Frames, chosen: list[Frame], rng: np.random.Generator) -> list[PairMatches]:
    """All pairs of the frames with enough matches of the first frame's queries."""
    import numpy as np

    from bask_data.core.scores import label_at

    clear = {frame: _clear(frames, frame) for frame in chosen}
    queries = [
        _queries(frames, frame, *drawn_pixels(frames, frame, clear[frame], N_QUERIES, rng), frames.depth(frame))
        for frame in chosen
    ]
    i_first = np.repeat(np.arange(len(chosen)), [len(of_frame.label) for of_frame in queries])
    everything = Queries(
        **{name: np.concatenate([getattr(of_frame, name) for of_frame in queries]) for name in vars(queries[0])}
    )
    surface = _surfaces(frames, chosen)
    pairs = []
    for b in progress(chosen, f"finding true matches of {frames.scene}"):
        columns = _projected(frames, b, everything, _visible_shares(frames, b, surface))
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
    camera = frames.K(frame.camera), frames.world_from_camera(frame)
    result = np.full(256, np.nan)
    for label, points in surface.items():
        if (labels == label).any():
            result[label] = visible_share(points, label, depth, labels, *camera)
    return result


def _projected(frames: Frames, b: Frame, queries: Queries, visible: np.ndarray) -> dict[str, np.ndarray]:
    """Queries projected into another frame, visible there or not: columns of `PairMatches` by name."""
    import numpy as np

    from bask_data.core.geometry import invert_rigid, project, transform
    from bask_data.core.local_warp import image_warp, turn_of

    K, b_from_world = frames.K(b.camera), invert_rigid(frames.world_from_camera(b))
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


# By the dataset's own matches -----------------------------------------------------------------------------------------


def _by_correspondences(
    dataset: Dataset, frames: Frames, chosen: list[Frame], rng: np.random.Generator
) -> list[PairMatches]:
    """The dataset's pairs among the frames, with some of their matches.

    Scale and rotation are from the measured depth of the first frame, the points from that of the second.
    """
    import numpy as np

    from bask_data.core.geometry import unproject
    from bask_data.core.nearest_depth import fill_depth
    from bask_data.core.scores import true_depth

    stored = Correspondences(dataset.path(Correspondences, frames.scene))
    matches, wanted, pairs, end = stored.matches(), set(chosen), [], 0
    column = {name: matches[name].to_numpy() for name in matches.column_names}
    fractions = {name: frames.masks.camera(name).visible_fraction for name in frames.cameras}
    for row in progress(stored.pairs().to_pylist(), f"reading matches of {frames.scene}"):
        first, end = end, end + row["n_matches"]
        a, b = Frame(row["camera_a"], row["frame_a"]), Frame(row["camera_b"], row["frame_b"])
        if a not in wanted or b not in wanted or end - first < LEAST_MATCHES:
            continue
        rows = np.sort(rng.permutation(np.arange(first, end))[:N_QUERIES])
        uv_a, uv_b = (np.stack([column[f"u_{x}"][rows], column[f"v_{x}"][rows]], axis=1).astype(float) for x in "ab")
        label = column["instance"][rows].astype(np.int64)
        visible = np.full(256, np.nan)
        visible[1 : 1 + frames.masks.n_instances] = fractions[b.camera][b.i]
        # Where depth is missing, the nearest measurement is close enough to that of the surface.
        queries = _queries(frames, a, uv_a, label, fill_depth(frames.depth(a)))
        columns = _projected(frames, b, queries, visible)
        z = true_depth(frames.depth(b), frames.labels(b), uv_b)
        points_b = unproject(uv_b, np.where(z > 0, z, np.nan), frames.K(b.camera))
        pairs.append(PairMatches(frames.scene, a, b, False, **{**columns, "uv_b": uv_b, "points_b": points_b}))
    return pairs
