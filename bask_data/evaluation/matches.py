"""Matches to evaluate descriptors on, spread over changes of scale, rotation and occlusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from bask_data.dataset import Dataset
from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.held_out import HeldOut
from bask_data.evaluation.pair_matches import LEAST_MATCHES, PairMatches, bin_counts
from bask_data.evaluation.true_matches import MOST_MATCHED_FRAMES, N_QUERIES, by_truth, projected, queries_of
from bask_data.kinds import Correspondences
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np


def candidate_pairs(dataset: Dataset, frames: Frames, held_out: HeldOut, seed: int) -> list[PairMatches]:
    """All pairs of a scene's held-out frames with enough matches, and some matches of each: by exact depth where there
    is ground truth, else the dataset's own. If `held_out` allows it, also pairs with one held-out frame.
    """
    import numpy as np

    rng = np.random.default_rng([seed, 0, *frames.scene.encode()])
    aside = held_out.frames(frames, MOST_MATCHED_FRAMES)
    chosen = [*held_out.partners(frames, MOST_MATCHED_FRAMES), *aside]
    if frames.truth is not None:
        pairs = by_truth(frames, chosen, rng)
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
    picked = filling(np.stack([bin_counts(pair) for pair in candidates]), random, n_pairs, rng)
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


def _by_correspondences(
    dataset: Dataset, frames: Frames, chosen: list[Frame], rng: np.random.Generator
) -> list[PairMatches]:
    """The dataset's pairs among the frames, with some of their matches.

    Scale and rotation are from the measured depth of the first frame, the points from that of the second.
    """
    import numpy as np

    from bask_data.core.geometry import unproject
    from bask_data.core.match_errors import true_depth
    from bask_data.core.nearest_depth import fill_depth

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
        queries = queries_of(frames, a, uv_a, label, fill_depth(frames.depth(a)))
        columns = projected(frames, b, queries, visible)
        z = true_depth(frames.depth(b), frames.labels(b), uv_b)
        points_b = unproject(uv_b, np.where(z > 0, z, np.nan), frames.K(b))
        pairs.append(PairMatches(frames.scene, a, b, False, **{**columns, "uv_b": uv_b, "points_b": points_b}))
    return pairs
