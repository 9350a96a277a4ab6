from __future__ import annotations

import numpy as np

from bask_data.dataset import Dataset
from bask_data.kinds import Correspondences, Scan, VisibleMasks
from bask_data.stages.pairs import Pairs, ScanPairs
from tests.nn.pairs import ScenePairs


def test_pairs_are_those_of_the_correspondences(learnable):
    pairs = scan_pairs(learnable)
    source = ScenePairs(5, 0)
    assert pairs.n_pairs == source.n_pairs
    for i in (0, 7, 19):
        found, known = pairs.pair(i), source.pair(i)
        for name in ("rgb_a", "rgb_b", "instance_a", "instance_b", "instance", "uv_a", "uv_b"):
            np.testing.assert_allclose(getattr(found, name), getattr(known, name), atol=1e-5)


def test_matches_follow_when_frames_are_shrunk(learnable):
    pairs = scan_pairs(learnable)
    whole = pairs.pair(3)
    pairs.shrink_to((48, 64))
    shrunk = pairs.pair(3)
    assert shrunk.rgb_a.shape == (48, 64, 3)
    np.testing.assert_allclose(shrunk.uv_a, (whole.uv_a + 0.5) / 2 - 0.5)
    # Away from edges, where a pixel holds several objects, the shrunk mask shows what the match says.
    row, column = np.rint(shrunk.uv_a[:, 1]).astype(int), np.rint(shrunk.uv_a[:, 0]).astype(int)
    assert (shrunk.instance_a[row, column] == shrunk.instance).mean() > 0.9


def scan_pairs(dataset: Dataset) -> Pairs:
    scan = ScanPairs(*(kind(dataset.path(kind, "a")) for kind in (Scan, VisibleMasks, Correspondences)))
    return Pairs([(scan, i) for i in range(len(scan.frames))])
