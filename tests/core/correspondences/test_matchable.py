from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.core.correspondences.matchable import inside, matchable_view, unhidden
from tests import scenes
from tests.blocks import CAMERAS, HEIGHT, WIDTH, K, views_of


def test_surface_without_a_measurement_near_is_not_matched(images, surface):
    """A gripper's dark pads give no depth: what is in front there cannot be told. Single gaps are another matter."""
    measured = images[3].depth.copy()
    measured[::2] = 0.0
    measured[:, : WIDTH // 2] = 0.0
    one = matchable_view(measured, images[3].instance, K, CAMERAS[3], surface)
    whole = views_of(images, surface)[3].sure
    assert one.sure[:, : WIDTH // 2 - 2].max() == 0
    assert np.count_nonzero(one.sure[:, WIDTH // 2 :]) > 0.95 * np.count_nonzero(whole[:, WIDTH // 2 :])


def test_a_distrusted_pixel_is_not_matched(images, surface):
    distrusted = np.zeros((HEIGHT, WIDTH), bool)
    distrusted[:, : WIDTH // 2] = True
    one = matchable_view(images[3].depth, images[3].instance, K, CAMERAS[3], surface, distrusted=distrusted)
    assert one.sure[:, : WIDTH // 2].max() == 0
    np.testing.assert_array_equal(one.sure[:, WIDTH // 2 :], views_of(images, surface)[3].sure[:, WIDTH // 2 :])


def test_points_behind_others_are_hidden_by_the_surface(surface):
    points = np.array([[-0.07, -0.07, 0.08], [-0.07, -0.07, 0.0], [0.035, 0.085, 0.05]])
    above = scenes.look_at((0.0, 0.0, 0.7))
    assert unhidden(surface, points, above).tolist() == [True, False, True]


def steps_of(depth, axis):
    """The largest step between neighbours beyond 2 cm and 5 %."""
    one, other = np.moveaxis(depth, axis, 0)[1:], np.moveaxis(depth, axis, 0)[:-1]
    step = np.abs(one - other) - (0.02 + 0.05 * np.minimum(one, other))
    return step[(one > 0) & (other > 0)].max(initial=-1.0)


@given(seed=st.integers(0, 2**32 - 1), margin=st.integers(0, 3))
def test_only_the_inside_of_a_mask_is_sure(seed, margin):
    """Against a loop over windows: one label, no step in depth along its rows and its middle column."""
    rng = np.random.default_rng(seed)
    size = rng.integers(1, [14, 16])
    instance = np.zeros(size, np.uint8)
    for _ in range(5):
        v, u = rng.integers(-3, size)
        instance[max(v, 0) : v + 9, max(u, 0) : u + 9] = rng.choice(np.array([0, 1, 2, 255], np.uint8))
    depth = (
        rng.choice(np.array([0, 1, 1, 1, 1.05, 2], np.float32), size)
        if rng.random() < 0.5
        else np.ones(size, np.float32)
    )
    trusted = np.where(rng.random(size) > 0.1, instance, np.uint8(0))
    inner, pixels, first = inside(instance, trusted, depth, margin, (0.02, 0.05))
    expected = np.zeros_like(instance)
    for v, u in zip(*np.nonzero(trusted), strict=True):
        window = slice(max(v - margin, 0), v + margin + 1), slice(max(u - margin, 0), u + margin + 1)
        steps = max(steps_of(depth[window], 1), steps_of(depth[window[0], u : u + 1], 0))
        if depth[v, u] > 0 and (instance[window] == instance[v, u]).all() and steps <= 0:
            expected[v, u] = trusted[v, u]
    np.testing.assert_array_equal(inner, expected)
    for label in np.unique(instance[instance > 0]):
        mine = pixels[first[label] : first[int(label) + 1]]
        np.testing.assert_array_equal(mine, np.flatnonzero(inner == label))
    assert first[-1] == len(pixels) == np.count_nonzero(inner)


def test_depth_and_masks_of_two_sizes_and_negative_margins_are_refused(images):
    with pytest.raises(ValueError, match="measured and instance must have one size"):
        matchable_view(images[0].depth[1:], images[0].instance, K, CAMERAS[0])
    with pytest.raises(ValueError, match="margin and tolerance must be >= 0, got -1"):
        matchable_view(images[0].depth, images[0].instance, K, CAMERAS[0], margin=-1)
