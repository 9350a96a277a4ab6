from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bask_data.nn.augment import AugmentedView, Layer, Look
from bask_data.nn.augment_look import GRAIN
from bask_data.nn.rendering import drawn, drawn_on, to_device

CPU = torch.device("cpu")
SIZE = (40, 56)
NO_LOOK = Look(np.eye(3, 4), blur=0.0, noise=0.0, grain=0)


def picture(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def difference(views: list[AugmentedView]) -> np.ndarray:
    return np.abs(drawn_on(views, CPU).numpy().astype(int) - np.stack([drawn(view) for view in views]))


@given(
    scale=st.floats(0.4, 2.5),
    angle=st.floats(-np.pi, np.pi),
    shift=st.tuples(st.floats(-30, 30), st.floats(-30, 30)),
    mirrored=st.booleans(),
    shape=st.sampled_from([(40, 56), (33, 21), (1, 1), (7, 90)]),
)
@settings(max_examples=60)
def test_torch_places_a_picture_as_opencv_does(scale, angle, shift, mirrored, shape):
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    affine = np.column_stack([linear @ np.diag([-1.0 if mirrored else 1.0, 1.0]), shift])
    assert difference([AugmentedView(SIZE, (Layer(picture(*shape), affine),), NO_LOOK)]).max() <= 1


def test_a_picture_of_the_views_size_is_unchanged_in_both():
    view = AugmentedView(SIZE, (Layer(picture(*SIZE), np.eye(2, 3)),), NO_LOOK)
    np.testing.assert_array_equal(drawn(view), picture(*SIZE))
    np.testing.assert_array_equal(drawn_on([view], CPU)[0].numpy(), picture(*SIZE))


def test_upper_layers_cover_the_lower_ones_in_their_masks():
    ground, middle, top = (Layer(np.full((3, 3, 3), level, np.uint8), np.eye(2, 3)) for level in (10, 20, 30))
    left, upper = np.zeros(SIZE, bool), np.zeros(SIZE, bool)
    left[:, :20], upper[:15] = True, True
    layers = (ground, Layer(middle.picture, np.eye(2, 3), left), Layer(top.picture, np.eye(2, 3), upper))
    expected = np.full((*SIZE, 3), 10)
    expected[left] = 20
    expected[upper] = 30
    np.testing.assert_array_equal(drawn(AugmentedView(SIZE, layers, NO_LOOK)), expected)
    # Views of a batch may differ in the number and sizes of their layers.
    views = [AugmentedView(SIZE, layers[:n], NO_LOOK) for n in (1, 3, 2)]
    np.testing.assert_array_equal(drawn_on(views, CPU)[1].numpy(), expected)
    assert difference(views).max() == 0


def test_both_apply_a_look_equally():
    rng = np.random.default_rng(3)
    views = [
        AugmentedView(
            SIZE,
            (Layer(picture(30 + 10 * (i % 2), 50, i), np.eye(2, 3)),),
            Look(
                np.column_stack([np.eye(3) + rng.uniform(-0.3, 0.3, (3, 3)), rng.uniform(-40, 40, 3)]),
                blur=blur,
                noise=noise,
                grain=first,
            ),
        )
        for i, (blur, noise, first) in enumerate(
            [(0.0, 5.0, 7), (0.8, 0.0, 0), (2.5, 20.0, GRAIN - 100), (0.0, 0.0, 0)]
        )
    ]
    # OpenCV rounds to grey levels after every step, torch at the end.
    assert difference(views).max() <= 2
    assert difference(views).mean() < 0.3


@pytest.mark.parametrize("array", [np.arange(6.0).reshape(2, 3), np.array([True, False])])
def test_an_array_is_the_same_on_a_device(array):
    np.testing.assert_array_equal(to_device(array, CPU).numpy(), array)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_renders_the_same_image_as_opencv():
    views = [
        AugmentedView(SIZE, (Layer(picture(*SIZE, i), np.eye(2, 3)),), Look(np.eye(3, 4), 1.0, 9.0, i))
        for i in range(3)
    ]
    found = drawn_on(views, torch.device("cuda")).cpu().numpy().astype(int)
    assert np.abs(found - np.stack([drawn(view) for view in views])).max() <= 2
