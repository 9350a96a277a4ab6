from __future__ import annotations

import numpy as np
import torch

from bask_data.core.geometry import pixel_grid, transform, unproject
from bask_data.nn.selection import SelectionView, found_again, inner_pixels, spread_out
from tests.scenes import intrinsics, orbit, tabletop

SIZE = (60, 80)
K = intrinsics(*SIZE, 60.0)


def test_inner_pixels_keep_away_from_the_edges_and_have_depth():
    mask = np.zeros((50, 60), bool)
    mask[0:30, 20:50] = True
    depth = np.ones((50, 60))
    depth[:, ::2] = 0
    uv = inner_pixels(mask, depth, 5.0, 10_000, np.random.default_rng(0))
    assert len(uv) > 0
    u, v = uv.T
    assert (u % 2 == 1).all()
    # Distances from the nearest pixels off the mask: columns 19 and 50, row 30, and row -1 outside the image.
    assert u.min() - 19 > 5
    assert 50 - u.max() > 5
    assert 30 - v.max() > 5
    assert v.min() + 1 > 5
    assert len(inner_pixels(mask, depth, 5.0, 7, np.random.default_rng(0))) == 7


def position_views(n_views: int) -> tuple[list[SelectionView], list[np.ndarray]]:
    """Views with perfect descriptors: the world coordinates of the visible points; and these points."""
    scene, views, points = tabletop(3, seed=1), [], []
    for world_from_camera in orbit(n_views, n_turns=0.2, elevation_deg=(40.0, 60.0)):
        image = scene.render(K, world_from_camera, *SIZE)
        world = transform(world_from_camera, unproject(pixel_grid(*SIZE), image.depth.astype(float), K))
        points.append(world)
        views.append(SelectionView(torch.from_numpy(world).float().permute(2, 0, 1), image.depth, K, world_from_camera))
    return views, points


def test_points_are_re_found_by_perfect_descriptors_and_not_by_equal_ones():
    views, points = position_views(4)
    chosen = points[0].reshape(-1, 3)[::97]
    perfect = torch.from_numpy(chosen).float()
    share, shown = found_again(chosen, perfect, views[1:])
    assert (shown > 0).mean() > 0.7
    assert (share[shown > 0] > 0.9).mean() > 0.95
    confused, _ = found_again(chosen, perfect.mean(dim=0).expand_as(perfect), views[1:])
    assert confused.mean() < 0.1


def test_points_that_no_view_shows_are_not_re_found():
    views, _ = position_views(2)
    hidden = np.array([[0.0, 0.0, -0.5], [100.0, 0.0, 0.0]])
    share, shown = found_again(hidden, torch.zeros(2, 3), views)
    assert shown.tolist() == [0, 0]
    assert share.tolist() == [0.0, 0.0]


def test_chosen_points_are_far_apart_and_re_found_often():
    rng = np.random.default_rng(0)
    points = rng.uniform(size=(200, 3))
    share = np.where(points[:, 0] < 0.5, 1.0, 0.2)
    chosen = spread_out(points, share, 8)
    assert len(set(chosen.tolist())) == 8
    assert (share[chosen] == 1.0).all()
    apart = np.linalg.norm(points[chosen][:, None] - points[chosen][None], axis=-1)[np.triu_indices(8, 1)].min()
    random = [
        np.linalg.norm(p[:, None] - p[None], axis=-1)[np.triu_indices(8, 1)].min()
        for p in (points[share == 1][rng.permutation(int((share == 1).sum()))[:8]] for _ in range(50))
    ]
    assert apart > max(random)


def test_all_points_are_chosen_if_there_are_fewer_than_requested():
    assert sorted(spread_out(np.eye(3), np.array([0.1, 0.5, 0.2]), 5).tolist()) == [0, 1, 2]
