"""Search for keypoints in frames of a static scan: where each frame finds them, and how wrong it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from bask_data.core.agreement import Sightings, agreed_place, sightings_of, tied_distance
from bask_data.core.geometry import pixel_grid, scale_pixels, transform, unproject
from bask_data.core.static_truth import Visibility, visibility
from bask_data.nn.network import distance_maps
from bask_data.nn.selection import DEPTH_TOLERANCE, SelectionView


@dataclass(frozen=True)
class Search:
    """What a search for k keypoints in views of one scan finds.

    Args:
        matches: best match of each keypoint in each view, metres; NaN: no depth there.
        tied: see `tied_distance`.
        nearest: descriptor distance of each best match.
    """

    views: Sequence[SelectionView]
    matches: Float[ndarray, "k v 3"]
    tied: Float[ndarray, "k v"]
    nearest: Float[ndarray, "k v"]

    @staticmethod
    def of(descriptors: Float[torch.Tensor, "k d"], views: Sequence[SelectionView]) -> Search:
        """Search for descriptors, which are from other frames than the views."""
        shape = (len(descriptors), len(views))
        matches, tied, nearest = np.empty((*shape, 3)), np.empty(shape), np.empty(shape)
        for i, view in enumerate(views):
            matches[:, i], tied[:, i], nearest[:, i] = _best(descriptors, view)
        return Search(views, matches, tied, nearest)

    def agreed(self) -> tuple[Float[ndarray, "k 3"], Int[ndarray, "k"]]:
        """The places that most views agree on, and how many do."""
        agreed = [agreed_place(each) for each in self.matches]
        return np.array([place for place, _ in agreed]).reshape(-1, 3), np.array([votes for _, votes in agreed], int)

    def sightings(self, places: Float[ndarray, "k 3"]) -> Sightings:
        """What the views that show the keypoints' places, metres, say about them; a place of NaN is shown by none."""
        shown = np.zeros(self.tied.shape, bool)
        known = np.isfinite(places).all(axis=1)
        for i, view in enumerate(self.views):
            seen = visibility(places[known], view.depth, view.K, view.world_from_camera, DEPTH_TOLERANCE)
            shown[known, i] = seen == Visibility.VISIBLE
        return sightings_of(self.matches, shown, self.tied, places)


def _best(
    descriptors: Float[torch.Tensor, "k d"], view: SelectionView
) -> tuple[Float[ndarray, "k 3"], Float[ndarray, "k"], Float[ndarray, "k"]]:
    """A view's best matches, metres, the distance to those that match equally well, and their descriptor distance."""
    maps = distance_maps(view.descriptors, descriptors).cpu().numpy()
    height, width = maps.shape[1:]
    depth = _at(view.depth, (height, width)).astype(float)
    uv = scale_pixels(pixel_grid(height, width), (height, width), view.depth.shape)
    points = transform(view.world_from_camera, unproject(uv, depth, view.K))
    points[depth <= 0] = np.nan
    on_object = depth > 0 if view.instance is None else _at(view.instance, (height, width)) > 0
    best = maps.reshape(len(maps), -1).argmin(axis=1)
    tied = np.array([tied_distance(z, points, on_object) for z in maps])
    return points.reshape(-1, 3)[best], tied, maps.reshape(len(maps), -1).min(axis=1)


def _at(image: ndarray, size: tuple[int, int]) -> ndarray:
    """The image's nearest pixel at each pixel of an image of `size`."""
    if image.shape == size:
        return image
    uv = np.rint(scale_pixels(pixel_grid(*size), size, image.shape)).astype(int)
    return image[uv[..., 1].clip(0, image.shape[0] - 1), uv[..., 0].clip(0, image.shape[1] - 1)]
