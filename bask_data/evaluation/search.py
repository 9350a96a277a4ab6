"""Search with a network for pixels of one image in another."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.pair_matches import PairMatches

if TYPE_CHECKING:
    import numpy as np
    import torch

    from bask_data.core.descriptor_scores import MapScores, Records
    from bask_data.nn.network import DescriptorNetwork

ALPHA = 4.0
"""Temperature of heat maps softmax(-alpha z) unless a network is used with another: that of the paper (von Hartz et
al. 2023, Sec. III-B) and the filters' default. Calibration is also measured at `ALPHAS`."""
ALPHAS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
"""Other temperatures, of which the best calibrated is reported."""
RADIUS = 0.04
"""Radius, as a share of the image's diagonal, within which a heat map's mass is its confidence, and matches count."""


class Described(NamedTuple):
    """An image's descriptors at the network's stride, far fewer than those of all pixels, and its (height, width)."""

    cells: torch.Tensor
    size: tuple[int, int]


class Cells:
    """A scene's frames as described by a network, each once."""

    def __init__(self, network: DescriptorNetwork, frames: Frames) -> None:
        self._network, self._frames = network, frames
        self._known: dict[Frame, Described] = {}

    def __getitem__(self, frame: Frame) -> Described:
        if frame not in self._known:
            self._known[frame] = described(self._network, self._frames.rgb(frame))
        return self._known[frame]


def described(network: DescriptorNetwork, rgb: np.ndarray) -> Described:
    """The descriptors of an image."""
    return Described(network.cells(rgb), (rgb.shape[0], rgb.shape[1]))


def descriptors_at(network: DescriptorNetwork, image: Described, uv: np.ndarray) -> torch.Tensor:
    """Descriptors (n, d) at pixels (n, 2) of the image."""
    import numpy as np
    import torch

    from bask_data.core.geometry import scale_pixels
    from bask_data.nn.resnet import sampled

    scaled = scale_pixels(uv.astype(np.float64), image.size, network.input_size(image.size)).astype(np.float32)
    return sampled(image.cells[None], torch.from_numpy(scaled).to(image.cells.device)[None])[0]


def looked_for(
    network: DescriptorNetwork, queries: torch.Tensor, image: Described, uv: np.ndarray, alpha: float
) -> MapScores:
    """Scores of an image's distance maps for descriptors (n, d) whose true pixels (n, 2) in it are known."""
    import numpy as np

    from bask_data.core.descriptor_scores import map_scores
    from bask_data.nn.network import maps_of_cells

    away = (queries - descriptors_at(network, image, uv)).square().sum(dim=1).sqrt() / queries.shape[1] ** 0.5
    return map_scores(
        maps_of_cells(image.cells[None], queries)[0].cpu().numpy(),
        away.cpu().numpy().astype(np.float64),
        uv,
        image.size,
        (alpha, *ALPHAS),
        RADIUS * float(np.hypot(*image.size)),
    )


def records_of(scores: MapScores, size: tuple[int, int], error_3d: np.ndarray | None = None) -> Records:
    """The records of matches in an image of this (height, width); 3D errors are NaN unless given."""
    import numpy as np

    from bask_data.core.descriptor_scores import Records

    diagonal = float(np.hypot(*size))
    return Records(
        error_px=scores.error_px,
        error_share=scores.error_px / diagonal,
        error_3d=np.full(len(scores.error_px), np.nan) if error_3d is None else error_3d,
        closer_share=scores.closer_share,
        false_positive_px=scores.false_positive_px,
        false_positive_share=scores.false_positive_px / diagonal,
        confidence=scores.confidence,
        is_near=scores.error_px <= RADIUS * diagonal,
    )


def found_matches(network: DescriptorNetwork, cells: Cells, frames: Frames, pair: PairMatches, alpha: float) -> Records:
    """The records of a pair's matches."""
    queries = descriptors_at(network, cells[pair.a], pair.uv_a)
    scores = looked_for(network, queries, cells[pair.b], pair.uv_b, alpha)
    return records_of(scores, frames.size(pair.b.camera), _error_3d(frames, pair, scores.best))


def _error_3d(frames: Frames, pair: PairMatches, best: np.ndarray) -> np.ndarray:
    """Distances (m,) between the surface at the best matches and the true points, metres; NaN without depth."""
    import numpy as np

    from bask_data.core.geometry import unproject
    from bask_data.core.match_errors import true_depth

    z = true_depth(frames.depth(pair.b), frames.labels(pair.b), best)
    points = unproject(best, np.where(z > 0, z, np.nan), frames.K(pair.b))
    return np.linalg.norm(points - pair.points_b, axis=1)
