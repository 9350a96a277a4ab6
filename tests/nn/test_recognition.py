from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from bask_data.core.agreement import AWAY
from bask_data.core.geometry import pixel_grid, transform, unproject
from bask_data.nn.recognition import Search
from bask_data.nn.selection import SelectionView
from tests.nn.test_selection import SIZE, K, position_views


def test_perfect_descriptors_are_found_where_they_are():
    views, points = position_views(4)
    chosen = points[0].reshape(-1, 3)[::97]
    found = Search.of(torch.from_numpy(chosen).float(), views[1:])
    seen = found.sightings(chosen)
    assert (seen.n_views > 0).mean() > 0.7
    # A pixel is up to 1 cm wide here, more where the surface is oblique.
    assert np.nanmedian(seen.error) < 0.01
    places, votes = found.agreed()
    several = votes >= 2
    assert several.mean() > 0.6
    assert np.median(np.linalg.norm(places - chosen, axis=1)[several]) < 0.01


def test_places_that_no_view_shows_have_no_sightings():
    views, points = position_views(3)
    chosen = points[0].reshape(-1, 3)[::500]
    nowhere = np.full_like(chosen, np.nan)
    nowhere[0] = [100.0, 0.0, 0.0]
    assert Search.of(torch.from_numpy(chosen).float(), views).sightings(nowhere).n_views.tolist() == [0] * len(chosen)


def facing_disc(shift: float) -> SelectionView:
    """A disc of 8 cm radius, 0.6 m in front of a camera, whose descriptor is the distance from its centre, decimetres;
    beside it lies a background with another descriptor."""
    depth = np.full(SIZE, 0.6)
    world_from_camera = np.eye(4)
    world_from_camera[0, 3] = shift
    world = transform(world_from_camera, unproject(pixel_grid(*SIZE), depth, K))
    radius = np.linalg.norm(world[..., :2], axis=-1)
    on_disc = radius < 0.08
    descriptors = np.stack([np.where(on_disc, 10 * radius, 1.0), np.where(on_disc, 0.0, 2.0)])
    return SelectionView(torch.from_numpy(descriptors).float(), depth, K, world_from_camera, on_disc.astype(np.uint8))


def test_a_point_on_a_ring_is_ambiguous_and_the_centre_is_not():
    views = [facing_disc(shift) for shift in (-0.05, 0.0, 0.05)]
    places = np.array([[0.06, 0.0, 0.6], [0.0, 0.0, 0.6]])
    descriptors = torch.tensor([[0.6, 0.0], [0.0, 0.0]])
    seen = Search.of(descriptors, views).sightings(places)
    assert seen.is_ambiguous.tolist() == [True, False]
    assert seen.tied[0].min() > AWAY
    # Without masks the whole image counts; this changes nothing, as the background differs.
    bare = [replace(view, instance=None) for view in views]
    assert Search.of(descriptors, bare).sightings(places).is_ambiguous.tolist() == [True, False]


def test_descriptors_may_be_coarser_than_depth():
    views, points = position_views(2)
    coarse = [replace(view, descriptors=view.descriptors[:, 1::2, 1::2]) for view in views]
    chosen = points[0].reshape(-1, 3)[::97]
    seen = Search.of(torch.from_numpy(chosen).float(), coarse).sightings(chosen)
    # Half of the coarse pixels' width on the table, which is 2 cm and more where it is oblique.
    assert 0 < np.nanmedian(seen.error) < 0.02
