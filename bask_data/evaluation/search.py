"""Looking with a network for pixels of one image in another."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.matches import PairMatches

if TYPE_CHECKING:
    import numpy as np
    import torch

    from bask_data.core.descriptor_scores import MapScores, Records
    from bask_data.nn.network import DescriptorNetwork

ALPHA = 4.0
"""Temperature of heat maps softmax(-alpha z) where nothing says with which a network is used: that of the paper (von
Hartz et al. 2023, Sec. III-B) and of the filters by default. Calibration is measured at `ALPHAS`, too."""
ALPHAS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
"""Others, of which the one that fits the network best is told."""
RADIUS = 0.04
"""Share of the image's diagonal within which a heat map's mass is its confidence, and a match is right."""


class Described(NamedTuple):
    """An image: its descriptors at the network's stride, a small part of what those of all its pixels would be, and its
    (height, width)."""

    cells: torch.Tensor
    size: tuple[int, int]


class Cells:
    """A scene's frames as a network describes them, each once."""

    def __init__(self, network: DescriptorNetwork, frames: Frames) -> None:
        self._network, self._frames = network, frames
        self._known: dict[Frame, Described] = {}

    def __getitem__(self, frame: Frame) -> Described:
        if frame not in self._known:
            self._known[frame] = described(self._network, self._frames.rgb(frame))
        return self._known[frame]


def described(network: DescriptorNetwork, rgb: np.ndarray) -> Described:
    """An image as a network describes it."""
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
    """What the distance maps of an image say of descriptors (n, d) whose true places in it are known (n, 2)."""
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


def records_of(found: MapScores, size: tuple[int, int], error_3d: np.ndarray | None = None) -> Records:
    """The records of matches in an image of this (height, width); without 3D errors these are not known."""
    import numpy as np

    from bask_data.core.descriptor_scores import Records

    diagonal = float(np.hypot(*size))
    return Records(
        error_px=found.error_px,
        error_share=found.error_px / diagonal,
        error_3d=np.full(len(found.error_px), np.nan) if error_3d is None else error_3d,
        closer_share=found.closer_share,
        false_positive_px=found.false_positive_px,
        false_positive_share=found.false_positive_px / diagonal,
        confidence=found.confidence,
        is_near=found.error_px <= RADIUS * diagonal,
    )


def found_matches(network: DescriptorNetwork, cells: Cells, frames: Frames, pair: PairMatches, alpha: float) -> Records:
    """The records of a pair's matches."""
    queries = descriptors_at(network, cells[pair.a], pair.uv_a)
    found = looked_for(network, queries, cells[pair.b], pair.uv_b, alpha)
    return records_of(found, frames.size(pair.b.camera), _error_3d(frames, pair, found.best))


def _error_3d(frames: Frames, pair: PairMatches, best: np.ndarray) -> np.ndarray:
    """Metres between the surface at the best matches and the true points; NaN without depth."""
    import numpy as np

    from bask_data.core.geometry import unproject
    from bask_data.core.scores import true_depth

    z = true_depth(frames.depth(pair.b), frames.labels(pair.b), best)
    found = unproject(best, np.where(z > 0, z, np.nan), frames.K(pair.b.camera))
    return np.linalg.norm(found - pair.points_b, axis=1)
