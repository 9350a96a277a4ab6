"""Matches compared with exact depth and cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.evaluation.scenes import scenes_with_truth
from bask_data.kinds import Correspondences, Scan, Truth
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

N_FRAMES_KEPT = 64
"""Frames of ground truth kept in memory; pairs are sorted by their first frame."""


@dataclass(frozen=True)
class MatchScore:
    """The matches of one scene compared with exact depth and cameras.

    Args:
        error_px: (n,) of each match.
        n_hidden: matches whose point is occluded in the second view.
    """

    error_px: np.ndarray
    n_hidden: int

    def figures(self) -> dict[str, float | None]:
        """Figures as plain JSON values; None without matches."""
        import numpy as np

        n = len(self.error_px)
        return {
            "matches": n,
            "median_px": float(np.median(self.error_px)) if n else None,
            "within_1px": float((self.error_px <= 1).mean()) if n else None,
            "within_2px": float((self.error_px <= 2).mean()) if n else None,
            "hidden": self.n_hidden,
        }


def matches_of(dataset: Dataset, scene: str) -> MatchScore:
    """Compare a scene's matches with ground truth.

    Raises:
        BadData: the ground truth has no exact depth.
    """
    import numpy as np

    from bask_data.core.match_errors import TrueView, match_errors

    scan, truth = Scan(dataset.path(Scan, scene)), Truth(dataset.path(Truth, scene))
    correspondences = Correspondences(dataset.path(Correspondences, scene))
    if not truth.has_depth:
        raise BadData(
            truth.path,
            "depth",
            expected="exact depth and cameras",
            got="labels only",
            fix="bask-data ingest sim OTHER_ROOT",
        )
    matches, n_done = correspondences.matches(), 0
    column = {name: matches[name].to_numpy() for name in matches.column_names}
    errors, n_hidden = [np.zeros(0)], 0
    seen = lru_cache(N_FRAMES_KEPT)(lambda camera, i: (truth.depth(camera, i), truth.instance(camera, i)))
    for pair in progress(correspondences.pairs().to_pylist(), f"measuring matches of {scene}"):
        mine = slice(n_done, n_done + pair["n_matches"])
        n_done = mine.stop
        uv_a, uv_b = (np.stack([column[f"u_{one}"][mine], column[f"v_{one}"][mine]], axis=1) for one in "ab")
        places = [(pair[f"camera_{one}"], pair[f"frame_{one}"]) for one in "ab"]
        a, b = (
            TrueView(*seen(camera, i), scan.camera(camera).Ks[i], truth.world_from_cameras(camera)[i])
            for camera, i in places
        )
        found = match_errors(uv_a, uv_b, a, b)
        errors.append(found.error_px)
        n_hidden += int(found.hidden().sum())
    return MatchScore(np.concatenate(errors), n_hidden)


def evaluated_correspondences(dataset: Dataset, only: Sequence[str] = ()) -> dict[str, Any]:
    """Scores of each scene with matches and ground truth, and over all of them, as plain JSON values.

    `within_1px` and `within_2px` are shares of the matches, `hidden` is their number.
    """
    import numpy as np

    scored = {scene: matches_of(dataset, scene) for scene in scenes_with_truth(dataset, Correspondences, only)}
    everything = MatchScore(
        np.concatenate([score.error_px for score in scored.values()]), sum(score.n_hidden for score in scored.values())
    )
    return {"scenes": {scene: score.figures() for scene, score in scored.items()}, "all": everything.figures()}
