from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bask_data.core import planes
from tests import scenes


def disc(rng, n, radius, noise=0.0):
    """Points and normals of a level disc at z = 0, seen from above."""
    r, angle = radius * np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
    points = np.stack([r * np.cos(angle), r * np.sin(angle), rng.normal(scale=noise, size=n)], axis=1)
    return points, np.tile([0.0, 0.0, 1.0], (n, 1))


def table_and_wall(rng, noise=0.001):
    """A table of 0.8 m2 facing up, a wall of 1.2 m2 facing -x, and clutter that faces all ways."""
    table = np.stack([*rng.uniform(-0.5, 0.5, (2, 4000)) * [[0.8], [1.0]], rng.normal(scale=noise, size=4000)], axis=1)
    wall = np.stack(
        [0.45 + rng.normal(scale=noise, size=6000), rng.uniform(-0.5, 0.5, 6000), rng.uniform(0, 1.2, 6000)], axis=1
    )
    clutter = rng.uniform(-0.3, 0.3, (1500, 3))
    facing = rng.normal(size=(1500, 3))
    normals = np.concatenate(
        [
            np.tile([0.0, 0, 1], (4000, 1)),
            np.tile([-1.0, 0, 0], (6000, 1)),
            facing / np.linalg.norm(facing, axis=1)[:, None],
        ]
    )
    return np.concatenate([table, wall, clutter]), normals, np.full(11500, 2e-4)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_plane_and_its_noise_are_found_in_any_frame(seed):
    rng = np.random.default_rng(seed)
    points, normals = disc(rng, 5000, 0.4, noise=0.002)
    clutter = rng.uniform(-0.3, 0.3, (1000, 3))
    points = np.concatenate([points, clutter])
    normals = np.concatenate([normals, np.tile([1.0, 0, 0], (1000, 1))])
    rotation, offset = Rotation.random(random_state=int(seed)).as_matrix(), rng.normal(size=3)
    moved = points @ rotation.T + offset

    [found] = planes.find_planes(moved, normals @ rotation.T, np.full(6000, 1e-4), rng)

    assert np.degrees(np.arccos(min(1.0, found.plane[:3] @ rotation[:, 2]))) < 0.1
    assert abs(found.plane[:3] @ offset + found.plane[3]) < 2e-4
    assert found.noise == pytest.approx(0.002, rel=0.15)
    assert found.area == pytest.approx(0.5, rel=0.02)


def test_the_larger_plane_comes_first_unless_it_cannot_be_up():
    points, normals, areas = table_and_wall(np.random.default_rng(0))
    plain = planes.find_planes(points, normals, areas, np.random.default_rng(1))
    guessed = planes.find_planes(
        points, normals, areas, np.random.default_rng(1), planes.PlaneSearch(guess_up=np.array([0.0, 0.6, 0.8]))
    )
    told = planes.find_planes(
        points, normals, areas, np.random.default_rng(1), planes.PlaneSearch(up=np.array([0.0, 0.0, 1.0]))
    )
    np.testing.assert_allclose([one.plane for one in plain], [[-1, 0, 0, 0.45], [0, 0, 1, 0]], atol=2e-3)
    np.testing.assert_allclose([one.plane for one in guessed], [[0, 0, 1, 0], [-1, 0, 0, 0.45]], atol=2e-3)
    np.testing.assert_allclose([one.plane for one in told], [[0, 0, 1, 0]], atol=2e-3)


def test_a_table_ten_times_the_rest_wins_against_a_wrong_guess():
    rng = np.random.default_rng(0)
    points, normals = disc(rng, 20_000, 0.5, 0.001)
    side = np.stack([np.zeros(1000), *rng.uniform(0, 0.1, (2, 1000))], axis=1)
    all_normals = np.concatenate([normals, np.tile([1.0, 0, 0], (1000, 1))])
    found = planes.find_planes(
        np.concatenate([points, side]),
        all_normals,
        np.full(21_000, 4e-5),
        rng,
        planes.PlaneSearch(guess_up=np.array([0.6, 0.0, -0.8])),
    )
    np.testing.assert_allclose(found[0].plane, [0, 0, 1, 0], atol=2e-3)


def test_the_feet_of_what_stands_on_a_plane_do_not_tilt_it():
    rng = np.random.default_rng(0)
    points, normals = disc(rng, 5000, 0.3, 0.0003)
    # Facing up and within a centimetre: by position and normal alone these could be the table.
    foot = np.stack([*rng.uniform(0.1, 0.2, (2, 600)), rng.uniform(0.004, 0.008, 600)], axis=1)
    points, normals = np.concatenate([points, foot]), np.tile([0.0, 0, 1], (5600, 1))
    found = planes.find_planes(points, normals, np.full(5600, 5e-5), rng)[0]
    np.testing.assert_allclose(found.plane, [0, 0, 1, 0], atol=3e-4)


def test_no_surface_and_clutter_hold_no_plane():
    rng = np.random.default_rng(0)
    assert planes.find_planes(np.zeros((5, 3)), np.zeros((5, 3)), np.zeros(5), rng) == []
    facing = rng.normal(size=(3000, 3))
    facing /= np.linalg.norm(facing, axis=1)[:, None]
    assert (
        planes.find_planes(
            rng.uniform(-1, 1, (3000, 3)), facing, np.full(3000, 1e-3), rng, planes.PlaneSearch(min_share=0.1)
        )
        == []
    )


def test_an_inlier_distance_that_is_not_positive_is_refused():
    with pytest.raises(ValueError, match="inlier must be > 0 metres, got 0\\.0"):
        planes.find_planes(
            np.zeros((5, 3)), np.zeros((5, 3)), np.ones(5), np.random.default_rng(0), planes.PlaneSearch(inlier=0.0)
        )


def test_cameras_round_a_table_and_level_ones_before_a_shelf_agree_on_up():
    assert planes.upward(scenes.orbit(30))[2] > 0.95
    level = np.stack([scenes.look_at((-1.0, y, 0.1), (0.0, y / 3, 0.1)) for y in np.linspace(-0.3, 0.3, 7)])
    up = planes.upward(level)
    floor, wall = np.array([0.0, 0, 1]), np.array([-1.0, 0, 0])
    assert floor @ up > 1.5 * (wall @ up) > 0


def test_the_footprint_covers_what_the_objects_hide_and_no_level_shelf_elsewhere():
    rng = np.random.default_rng(0)
    table = np.concatenate([rng.uniform(-0.3, 0.3, (8000, 2)), np.zeros((8000, 1))], axis=1)
    table = table[np.linalg.norm(table[:, :2], axis=1) > 0.1]  # Hidden under an object.
    shelf = np.concatenate([rng.uniform(0.6, 0.7, (300, 2)), np.zeros((300, 1))], axis=1)
    surface = np.concatenate([table, shelf])
    plane = np.array([0.0, 0, 1, 0])
    points = np.array([[0, 0, 0.1], [0.25, 0.25, 0.4], [0.33, 0, 0.1], [0.65, 0.65, 0.1], [0.45, 0.45, 0.1]])
    inside = planes.above_footprint(points, plane, surface, np.full(len(surface), 1e-4))
    widened = planes.above_footprint(points, plane, surface, np.full(len(surface), 1e-4), margin=0.04)
    np.testing.assert_array_equal(inside, [True, True, False, False, False])
    np.testing.assert_array_equal(widened, [True, True, True, False, False])


@pytest.mark.parametrize("surface", [np.zeros((2, 3)), np.linspace(0, 1, 50)[:, None] * [[1.0, 0, 0]]])
def test_nothing_stands_on_a_support_without_extent(surface):
    plane = np.array([0.0, 0, 1, 0])
    assert not planes.above_footprint(np.zeros((3, 3)), plane, surface, np.ones(len(surface))).any()
