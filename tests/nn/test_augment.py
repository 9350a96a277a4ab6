from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bask_data.core.geometry import in_image, scale_pixels
from bask_data.nn.augment import (
    AugmentSettings,
    fitting_affine,
    moved,
    painted_over,
    random_affine,
    recoloured,
    warped,
)

SIZE = (90, 120)


def dotted(size: tuple[int, int], uv: np.ndarray, sigma: float) -> np.ndarray:
    """An image with one smooth dot at a sub-pixel position: its surface point can be found again without the matrix."""
    v, u = np.mgrid[: size[0], : size[1]]
    dot = np.exp(-((u - uv[0]) ** 2 + (v - uv[1]) ** 2) / (2 * sigma**2))
    return np.rint(250 * dot).astype(np.uint8)


def centre_of(image: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    weight = image.astype(float) / image.sum()
    return np.array([(u * weight).sum(), (v * weight).sum()])


@settings(max_examples=100)
@given(
    seed=st.integers(0, 2**31),
    u=st.floats(12, 107),
    v=st.floats(12, 77),
    zoom=st.tuples(st.floats(0.5, 1), st.floats(1, 2)),
    rotation=st.floats(0, np.pi),
    flipped=st.booleans(),
    out_size=st.sampled_from([(90, 120), (96, 128), (60, 80), (120, 96)]),
)
def test_an_augmented_match_shows_the_same_surface_within_half_a_pixel(seed, u, v, zoom, rotation, flipped, out_size):
    rng = np.random.default_rng(seed)
    uv = np.array([u, v])
    chosen = AugmentSettings(zoom=zoom, rotation=rotation)
    out_from_in = random_affine(SIZE, out_size, uv, flipped, chosen, rng)
    image = warped(dotted(SIZE, uv, 3.0), out_from_in, (3 * out_size[0], 3 * out_size[1]), smooth=True)
    found = moved(out_from_in, uv[None])[0]
    # Only where the whole dot is in the picture is its centre of mass where the dot is.
    if (found >= 25).all():
        np.testing.assert_allclose(centre_of(image), found, atol=0.5)


@settings(max_examples=100)
@given(
    seed=st.integers(0, 2**31),
    u=st.floats(0, 119),
    v=st.floats(0, 89),
    zoom=st.tuples(st.floats(0.5, 1), st.floats(1, 3)),
    rotation=st.floats(0, np.pi),
    out_size=st.sampled_from([(96, 128), (64, 64)]),
)
def test_the_anchor_stays_in_view(seed, u, v, zoom, rotation, out_size):
    rng = np.random.default_rng(seed)
    anchor = np.array([u, v])
    affine = random_affine(SIZE, out_size, anchor, bool(seed % 2), AugmentSettings(zoom=zoom, rotation=rotation), rng)
    assert in_image(moved(affine, anchor[None]), *out_size).all()


def test_without_zoom_and_rotation_the_whole_image_is_resized_edge_to_edge():
    settings_ = AugmentSettings(zoom=(1.0, 1.0), rotation=0.0)
    affine = random_affine((90, 120), (60, 80), np.array([3.0, 4.0]), False, settings_, np.random.default_rng(0))
    np.testing.assert_allclose(affine, fitting_affine((90, 120), (60, 80)), atol=1e-12)
    uv = np.array([[0.0, 0.0], [119.0, 89.0], [17.3, 55.1]])
    np.testing.assert_allclose(moved(affine, uv), scale_pixels(uv, (90, 120), (60, 80)))


def test_zoom_two_shows_half_of_the_image():
    settings_ = AugmentSettings(zoom=(2.0, 2.0), rotation=0.0)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        affine = random_affine(SIZE, SIZE, np.array([60.0, 45.0]), False, settings_, rng)
        in_from_out = np.linalg.inv(np.vstack([affine, [0, 0, 1]]))[:2]
        corners = moved(in_from_out, np.array([[-0.5, -0.5], [119.5, 89.5]]))
        np.testing.assert_allclose(corners[1] - corners[0], [60, 45])
        assert (corners[0] >= -0.5 - 1e-9).all()
        assert (corners[1] <= [119.5 + 1e-9, 89.5 + 1e-9]).all()


def test_a_flip_mirrors():
    settings_ = AugmentSettings(zoom=(1.0, 1.0), rotation=0.0)
    affine = random_affine(SIZE, SIZE, np.array([60.0, 45.0]), True, settings_, np.random.default_rng(0))
    image = np.random.default_rng(1).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    np.testing.assert_array_equal(warped(image, affine, SIZE, smooth=True), image[:, ::-1])


def test_labels_are_never_mixed():
    labels = np.zeros(SIZE, np.uint8)
    labels[20:60, 30:70] = 4
    labels[60:80, 30:70] = 200
    affine = random_affine(SIZE, (64, 96), np.array([50.0, 40.0]), False, AugmentSettings(), np.random.default_rng(5))
    assert set(np.unique(warped(labels, affine, (64, 96), smooth=False))) <= {0, 4, 200}


def test_labels_and_match_agree_at_an_edge():
    # The mask of the right half, turned by 30 degrees: its edge is where the coordinates say, to the nearest pixel.
    labels = np.zeros(SIZE, np.uint8)
    labels[:, 60:] = 1
    settings_ = AugmentSettings(zoom=(1.5, 1.5), rotation=0.5)
    affine = random_affine(SIZE, SIZE, np.array([60.0, 45.0]), False, settings_, np.random.default_rng(2))
    out = warped(labels, affine, SIZE, smooth=False)
    in_from_out = np.linalg.inv(np.vstack([affine, [0, 0, 1]]))[:2]
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    source = moved(in_from_out, np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)).reshape(*SIZE, 2)
    safe = (np.abs(source[..., 0] - 59.5) > 0.1) & in_image(source, *SIZE)
    np.testing.assert_array_equal(out[safe], (source[..., 0] > 59.5)[safe])


def test_colour_changes_stay_in_range_and_leave_the_input_alone():
    rgb = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    before = rgb.copy()
    changed = recoloured(rgb, AugmentSettings(blur=2.0), np.random.default_rng(1))
    np.testing.assert_array_equal(rgb, before)
    assert changed.dtype == np.uint8
    assert changed.shape == rgb.shape
    assert (changed != rgb).mean() > 0.5


def test_no_colour_settings_change_nothing():
    rgb = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    nothing = AugmentSettings(brightness=0.0, contrast=0.0, saturation=0.0, hue=0.0, noise=0.0)
    np.testing.assert_array_equal(recoloured(rgb, nothing, np.random.default_rng(1)), rgb)


@pytest.mark.parametrize("seed", range(8))
def test_only_what_is_off_the_objects_is_painted_over(seed):
    rgb = np.random.default_rng(0).integers(100, 110, (*SIZE, 3), dtype=np.uint8)
    kept = np.zeros(SIZE, bool)
    kept[30:50, 40:70] = True
    out = painted_over(rgb, kept, cv2.flip(rgb, 0), np.random.default_rng(seed))
    np.testing.assert_array_equal(out[kept], rgb[kept])
    assert (out[~kept] != rgb[~kept]).mean() > 0.5
