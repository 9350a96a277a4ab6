from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bask_data.core.identity import (
    EVIDENCE,
    ObjectLook,
    all_differences,
    between_views,
    differences,
    log_odds_of,
    oriented_extents,
)
from bask_data.core.identity_colour import chroma_distances, colour_histogram, lightness_distances


def surface_of(edges: tuple[float, float, float], seed: int = 0) -> np.ndarray:
    """Points spread evenly by area over the surface of a box (n, 3)."""
    rng, half = np.random.default_rng(seed), np.array(edges) / 2
    areas = np.array([edges[1] * edges[2], edges[0] * edges[2], edges[0] * edges[1]])
    points = rng.uniform(-half, half, (20_000, 3))
    axis = rng.choice(3, len(points), p=areas / areas.sum())
    points[np.arange(len(points)), axis] = half[axis] * rng.choice([-1, 1], len(points))
    return points


def one_colour(red: int, green: int, blue: int, n: int = 200) -> np.ndarray:
    return colour_histogram(np.tile(np.array([[red, green, blue]], np.uint8), (n, 1)))[None]


def a_look(**changed: np.ndarray) -> ObjectLook:
    given = {"extents": np.array([0.2, 0.1, 0.05]), "colours": one_colour(200, 40, 40), "appearances": np.eye(3)[:1]}
    return ObjectLook(**{**given, **changed})


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_the_edges_of_a_box_do_not_depend_on_its_pose(seed: int) -> None:
    points = surface_of((0.20, 0.12, 0.05))
    turned = points @ Rotation.random(random_state=seed).as_matrix().T + np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(oriented_extents(turned, np.ones(len(points))), (0.20, 0.12, 0.05), rtol=0.03)


def test_edges_follow_the_area_that_vertices_represent_not_their_number() -> None:
    points = surface_of((0.20, 0.12, 0.05))
    crowd = np.tile(points[:1], (200_000, 1))
    areas = np.concatenate([np.ones(len(points)), np.full(len(crowd), 1e-9)])
    extents = oriented_extents(np.concatenate([points, crowd]), areas)
    np.testing.assert_allclose(extents, oriented_extents(points, np.ones(len(points))), rtol=0.01)


def test_a_surface_without_area_or_on_a_line_is_refused() -> None:
    with pytest.raises(ValueError, match="expected points with an area, got none"):
        oriented_extents(np.zeros((5, 3)), np.zeros(5))
    with pytest.raises(ValueError, match="expected points that span a surface"):
        oriented_extents(np.outer(np.arange(9.0), [1.0, 0, 0]), np.ones(9))


def test_another_brightness_of_the_light_changes_lightness_only() -> None:
    bright, dark, other = one_colour(200, 100, 60), one_colour(120, 60, 36), one_colour(60, 100, 200)
    assert chroma_distances(bright, dark).item() < 0.05
    assert lightness_distances(bright, dark).item() > 0.5
    assert chroma_distances(bright, other).item() > 0.95
    with pytest.raises(ValueError, match="expected pixels, got none"):
        colour_histogram(np.zeros((0, 3), np.uint8))


def test_views_are_compared_with_the_most_similar_ones_of_the_other_object() -> None:
    distances = np.array([[0.0, 0.9], [0.7, 0.1], [0.2, 0.8]])
    expected = ((0.0 + 0.1 + 0.2) / 3 + (0.0 + 0.1) / 2) / 2
    assert between_views(distances) == pytest.approx(expected)
    assert between_views(distances.T) == pytest.approx(expected)


def test_each_difference_is_of_what_was_changed_and_lowers_the_odds() -> None:
    same = differences(a_look(), a_look())
    np.testing.assert_allclose(same, 0, atol=1e-6)
    changes = [
        a_look(colours=one_colour(40, 40, 200)),
        a_look(appearances=np.array([[0.8, 0.6, 0.0]])),
        a_look(extents=np.array([0.4, 0.2, 0.05])),
    ]
    found = np.array([differences(a_look(), changed) for changed in changes])
    assert len(EVIDENCE) == len(changes)
    assert (found.argmax(axis=1) == np.arange(3)).all() and (found[~np.eye(3, dtype=bool)] < 1e-6).all()
    np.testing.assert_allclose(found[[1, 2], [1, 2]], (0.2, np.log(2)))
    [of_same] = log_odds_of(same[None])
    assert of_same > 0 and (log_odds_of(found) < of_same).all()


def test_the_edge_that_one_side_hides_is_not_compared() -> None:
    flat = a_look(extents=np.array([0.2, 0.1, 0.001]))
    assert differences(a_look(), flat)[2] == 0


def test_differences_of_all_pairs_are_those_of_each() -> None:
    looks = [a_look(), a_look(colours=one_colour(40, 40, 200)), a_look(extents=np.array([0.4, 0.2, 0.05]))]
    found = all_differences(looks)
    for i, one in enumerate(looks):
        for j, other in enumerate(looks):
            np.testing.assert_allclose(found[i, j], differences(one, other) if i != j else 0.0, atol=1e-12)
