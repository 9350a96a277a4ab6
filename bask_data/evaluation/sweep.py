"""Scale and rotation alone: similar views, one of them zoomed or turned by a known amount."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from bask_data.evaluation.frames import Frames
from bask_data.evaluation.pair_matches import PairMatches
from bask_data.evaluation.search import Cells, described, descriptors_at, looked_for, records_of
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.descriptor_scores import Records
    from bask_data.nn.network import DescriptorNetwork

ZOOMS = {"1/2": 0.5, "1": 1.0, "2": 2.0}
TURNS_DEG = (0.0, 45.0, 90.0, 135.0, 180.0)
"""Rotations of a view, degrees; the other half circle mirrors them."""
CONDITIONS = {"zoom": tuple(ZOOMS), "turn": tuple(f"{angle:g}" for angle in TURNS_DEG)}
"""Names of conditions: scale of the target relative to the reference, and its rotation in degrees."""


def about(centre: np.ndarray, zoom: float, turn_deg: float) -> np.ndarray:
    """The affine map of pixels (2, 3) that scales and rotates an image about a pixel."""
    import numpy as np

    angle = np.radians(turn_deg)
    linear = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([linear, centre - linear @ centre]) if zoom != 1 or turn_deg else np.eye(2, 3)


def moved_pixels(uv: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) mapped by an affine map (2, 3)."""
    return uv @ way[:, :2].T + way[:, 2]


def moved(rgb: np.ndarray, way: np.ndarray) -> np.ndarray:
    """The image mapped by an affine map, with its edges repeated outside."""
    import cv2

    return cv2.warpAffine(rgb, way, rgb.shape[1::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _ways(pair: PairMatches, size: tuple[int, int]) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]:
    """By condition, the affine maps of both images."""
    import numpy as np

    middle_a, middle_b = np.median(pair.uv_a, axis=0), np.median(pair.uv_b, axis=0)
    middle = np.array([size[1] - 1, size[0] - 1]) / 2
    ways = {}
    for name, zoom in ZOOMS.items():
        ways["zoom", name] = about(middle_a, max(1 / zoom, 1.0), 0.0), about(middle_b, max(zoom, 1.0), 0.0)
    for angle in TURNS_DEG:
        ways["turn", f"{angle:g}"] = np.eye(2, 3), about(middle, 1.0, angle)
    return ways


def _stay(pair: PairMatches, frames: Frames, way_a: np.ndarray, way_b: np.ndarray) -> np.ndarray:
    """Which matches (m,) stay in both images."""
    from bask_data.core.geometry import in_image

    in_a = in_image(moved_pixels(pair.uv_a, way_a), *frames.size(pair.a.camera))
    return in_a & in_image(moved_pixels(pair.uv_b, way_b), *frames.size(pair.b.camera))


def swept(
    network: DescriptorNetwork, frames: Frames, pairs: Sequence[PairMatches], alpha: float, name: str
) -> Iterator[tuple[str, str, Records]]:
    """The records of each pair under each condition, for the matches that stay in the image under all of them.

    Views are zoomed about the median of the matches and turned about the middle of the image, which loses nothing in
    half a turn. For zoom 1/2 the reference is enlarged, because a smaller target would lack surroundings.
    """
    import numpy as np

    cells = Cells(network, frames)
    for pair in progress(pairs, f"zooming and turning views of {frames.scene} for {name}"):
        rgb_a, rgb_b = frames.rgb(pair.a), frames.rgb(pair.b)
        ways = _ways(pair, rgb_b.shape[:2])
        kept = np.all([_stay(pair, frames, *way) for way in ways.values()], axis=0)
        if not kept.any():
            continue
        uv_a, uv_b = pair.uv_a[kept], pair.uv_b[kept]
        for (what, condition), (way_a, way_b) in ways.items():
            a = cells[pair.a] if np.array_equal(way_a, np.eye(2, 3)) else described(network, moved(rgb_a, way_a))
            b = cells[pair.b] if np.array_equal(way_b, np.eye(2, 3)) else described(network, moved(rgb_b, way_b))
            queries = descriptors_at(network, a, moved_pixels(uv_a, way_a))
            yield what, condition, records_of(looked_for(network, queries, b, moved_pixels(uv_b, way_b), alpha), b.size)
