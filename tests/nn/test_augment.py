from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bask_data.core.geometry import in_image, scale_pixels
from bask_data.nn.augment import AugmentedView, AugmentSettings, Layer, Look, layer
from bask_data.nn.augment_look import GRAIN, _pieced, grain, grain_of, random_ground, random_look
from bask_data.nn.augment_motion import covered, moved, pasting_affine, random_affine, random_window, warped_labels
from bask_data.nn.rendering import drawn

SIZE = (90, 120)
UNCHANGED = AugmentSettings(brightness=0.0, contrast=0.0, saturation=0.0, hue=0.0, noise=0.0)
NO_LOOK = Look(np.eye(3, 4), blur=0.0, noise=0.0, grain=0)


def seen(image: np.ndarray, out_from_in: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The image as a view shows it, black where it has no pixels."""
    ground = Layer(np.zeros((1, 1, 3), np.uint8), np.eye(2, 3))
    shown = covered(image.shape[:2], out_from_in, size)
    return drawn(AugmentedView(size, (ground, layer(image, out_from_in, shown)), NO_LOOK))


def looked_at(rgb: np.ndarray, look: Look) -> np.ndarray:
    return drawn(AugmentedView(rgb.shape[:2], (Layer(rgb, np.eye(2, 3)),), look))


def dotted(size: tuple[int, int], uv: np.ndarray, sigma: float) -> np.ndarray:
    """An image with one smooth dot at a sub-pixel position, which can be located without the matrix."""
    v, u = np.mgrid[: size[0], : size[1]]
    dot = np.exp(-((u - uv[0]) ** 2 + (v - uv[1]) ** 2) / (2 * sigma**2))
    return np.rint(250 * np.dstack([dot, dot, dot])).astype(np.uint8)


def centre_of(image: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    weight = image[..., 0].astype(float) / image[..., 0].sum()
    return np.array([(u * weight).sum(), (v * weight).sum()])


@settings(max_examples=100)
@given(
    seed=st.integers(0, 2**31),
    u=st.floats(12, 107),
    v=st.floats(12, 77),
    zoom=st.tuples(st.floats(0.3, 1), st.floats(1, 2)),
    rotation=st.floats(0, np.pi),
    flipped=st.booleans(),
    out_size=st.sampled_from([(90, 120), (96, 128), (60, 80), (120, 96)]),
)
def test_an_augmented_match_shows_the_same_surface_within_half_a_pixel(seed, u, v, zoom, rotation, flipped, out_size):
    rng = np.random.default_rng(seed)
    uv = np.array([u, v])
    chosen = AugmentSettings(zoom=zoom, rotation=rotation)
    out_from_in = random_affine(SIZE, out_size, uv, flipped, chosen, rng)
    image = seen(dotted(SIZE, uv, 3.0), out_from_in, (3 * out_size[0], 3 * out_size[1]))
    found = moved(out_from_in, uv[None])[0]
    # The centre of mass is the centre of the dot only if the whole dot is in the image.
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
    np.testing.assert_array_equal(seen(image, affine, SIZE), image[:, ::-1])


def test_labels_are_never_interpolated():
    labels = np.zeros(SIZE, np.uint8)
    labels[20:60, 30:70] = 4
    labels[60:80, 30:70] = 200
    affine = random_affine(SIZE, (64, 96), np.array([50.0, 40.0]), False, AugmentSettings(), np.random.default_rng(5))
    assert set(np.unique(warped_labels(labels, affine, (64, 96)))) <= {0, 4, 200}


def test_labels_and_match_agree_at_an_edge():
    # The mask of the right half, rotated: its edge agrees with the coordinates to the nearest pixel.
    labels = np.zeros(SIZE, np.uint8)
    labels[:, 60:] = 1
    settings_ = AugmentSettings(zoom=(1.5, 1.5), rotation=0.5)
    affine = random_affine(SIZE, SIZE, np.array([60.0, 45.0]), False, settings_, np.random.default_rng(2))
    out = warped_labels(labels, affine, SIZE)
    in_from_out = np.linalg.inv(np.vstack([affine, [0, 0, 1]]))[:2]
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    source = moved(in_from_out, np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)).reshape(*SIZE, 2)
    safe = (np.abs(source[..., 0] - 59.5) > 0.1) & in_image(source, *SIZE)
    np.testing.assert_array_equal(out[safe], (source[..., 0] > 59.5)[safe])


@pytest.mark.parametrize("seed", range(5))
def test_padded_crops_never_magnify(seed):
    settings_ = AugmentSettings(zoom=(0.5, 2.0), crop="padded")
    affine = random_affine(SIZE, SIZE, np.array([60.0, 45.0]), False, settings_, np.random.default_rng(seed))
    assert 0.5 - 1e-9 <= np.sqrt(np.linalg.det(affine[:, :2])) <= 1.0 + 1e-9


@given(seed=st.integers(0, 2**31), u=st.floats(-0.5, 119.49), v=st.floats(-0.5, 89.49), zoom=st.floats(0.5, 3))
def test_a_window_contains_the_anchor_and_is_no_smaller_than_requested(seed, u, v, zoom):
    settings_ = AugmentSettings(zoom=(min(zoom, 1.0), zoom))
    window = random_window(SIZE, np.array([u, v]), settings_, np.random.default_rng(seed))
    for (first, end), length, at in zip([(w.start, w.stop) for w in window], SIZE, (v, u), strict=True):
        assert 0 <= first <= min(max(round(at), 0), length - 1) < end <= length
        assert end - first >= length / max(zoom, 1.0) - 1


def test_windows_have_all_sizes_and_positions():
    rng, rows = np.random.default_rng(0), []
    for _ in range(300):
        rows.append(random_window(SIZE, np.array([60.0, 45.0]), AugmentSettings(zoom=(1.0, 2.0)), rng)[0])
    heights, firsts = np.array([(w.stop - w.start, w.start) for w in rows]).T
    assert heights.min() <= 50
    assert heights.max() >= 85
    assert firsts.min() == 0
    assert firsts.max() >= 35


def test_centres_of_pasted_objects_lie_all_over_the_view():
    mask = np.zeros(SIZE, bool)
    mask[10:21, 70:91] = True
    rng, middles = np.random.default_rng(0), []
    for _ in range(200):
        affine = pasting_affine(mask, (64, 96), False, AugmentSettings(), rng)
        middles.append(moved(affine, np.array([[80.0, 15.0]]))[0])
    middles = np.array(middles)
    assert in_image(middles, 64, 96).all()
    np.testing.assert_allclose(middles.min(axis=0), [0, 0], atol=4)
    np.testing.assert_allclose(middles.max(axis=0), [95, 63], atol=4)


def test_covered_pixels_are_those_with_a_source_in_the_image():
    angle = 0.4
    linear = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    affine = np.column_stack([linear, [20.0, -10.0]])
    found = covered(SIZE, affine, (64, 96))
    in_from_out = np.linalg.inv(np.vstack([affine, [0, 0, 1]]))[:2]
    v, u = np.mgrid[:64, :96]
    source = moved(in_from_out, np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)).reshape(64, 96, 2)
    np.testing.assert_array_equal(found, in_image(source, *SIZE))
    halved = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25]])
    assert covered(SIZE, halved, (SIZE[0] // 2, SIZE[1] // 2)) is None


def test_minified_fine_texture_turns_grey_and_keeps_its_position():
    checks = np.indices(SIZE).sum(axis=0) % 2 * 255
    checks = np.repeat(checks[..., None], 3, axis=2).astype(np.uint8)
    for factor in (0.5, 0.4, 0.25):
        affine = np.column_stack([factor * np.eye(2), [0.3, 0.6]])
        view = AugmentedView((15, 20), (layer(checks, affine),), NO_LOOK)
        np.testing.assert_allclose(drawn(view).astype(float), 128, atol=1)
        dot = np.array([41.0, 37.0])
        small = seen(dotted(SIZE, dot, 6.0), affine, (50, 60))
        np.testing.assert_allclose(centre_of(small), moved(affine, dot[None])[0], atol=0.1)


def random_rgb() -> np.ndarray:
    return np.random.default_rng(0).integers(60, 180, (*SIZE, 3), dtype=np.uint8)


@pytest.mark.parametrize("seed", range(5))
def test_no_look_settings_change_nothing(seed):
    look = random_look(random_rgb(), UNCHANGED, np.random.default_rng(seed))
    np.testing.assert_array_equal(looked_at(random_rgb(), look), random_rgb())


def test_a_look_leaves_its_input_alone():
    rgb, before = random_rgb(), random_rgb()
    assert (looked_at(rgb, random_look(rgb, AugmentSettings(blur=2.0), np.random.default_rng(1))) != rgb).mean() > 0.5
    np.testing.assert_array_equal(rgb, before)


def changes(**settings_: float) -> list[np.ndarray]:
    """An image with twenty random looks that change one property."""
    chosen = replace(UNCHANGED, **settings_)
    return [
        looked_at(random_rgb(), random_look(random_rgb(), chosen, np.random.default_rng(seed))).astype(float)
        for seed in range(20)
    ]


def test_brightness_scales_all_pixels():
    factors = [(image / random_rgb()).mean() for image in changes(brightness=0.2)]
    assert np.exp(-0.25) < min(factors) < 0.9
    assert 1.1 < max(factors) < np.exp(0.25)


def test_contrast_keeps_the_mean_and_scales_the_spread():
    images = changes(contrast=0.3)
    np.testing.assert_allclose([image.mean() for image in images], random_rgb().mean(), atol=1)
    spreads = np.array([image.std() for image in images]) / random_rgb().std()
    assert np.exp(-0.31) < spreads.min() < 0.85
    assert 1.15 < spreads.max() < np.exp(0.31)


def test_saturation_and_hue_keep_greys():
    grey = np.repeat(random_rgb()[..., :1], 3, axis=2)
    settings_ = replace(UNCHANGED, saturation=0.5, hue=1.0)
    for seed in range(5):
        look = random_look(grey, settings_, np.random.default_rng(seed))
        np.testing.assert_array_equal(looked_at(grey, look), grey)
        assert np.abs(looked_at(random_rgb(), look).astype(int) - random_rgb()).mean() > 3


def test_rotating_the_hue_by_a_third_permutes_the_channels():
    settings_ = replace(UNCHANGED, hue=2 * np.pi / 3)
    looks = [random_look(random_rgb(), settings_, np.random.default_rng(seed)) for seed in range(500)]
    permutation = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    assert min(np.abs(look.matrix[:, :3] - permutation).max() for look in looks) < 0.03


def test_noise_has_the_drawn_deviation_and_is_never_the_same_twice():
    images = changes(noise=10.0)
    grains = [image - random_rgb() for image in images]
    deviations = [
        random_look(random_rgb(), replace(UNCHANGED, noise=10.0), np.random.default_rng(i)).noise for i in range(20)
    ]
    for found, expected in zip(grains, deviations, strict=True):
        assert abs(found.mean()) < 0.1
        assert found.std() == pytest.approx(np.hypot(expected, 0.29), rel=0.05, abs=0.2)
    assert abs(np.corrcoef(grains[0].ravel(), grains[1].ravel())[0, 1]) < 0.02
    assert 0 < min(deviations) < 3
    assert 7 < max(deviations) < 10


def test_noise_wraps_around_at_the_end_of_its_table():
    table = grain()
    assert table.shape == (GRAIN,)
    np.testing.assert_array_equal(grain_of((2, 3), 5), table[5:11].reshape(2, 3))
    np.testing.assert_array_equal(grain_of((4,), GRAIN - 2), table[[-2, -1, 0, 1]])


def test_blur_widens_a_dot_and_does_not_shift_it():
    uv = np.array([61.3, 40.8])
    image = dotted(SIZE, uv, 2.0)
    widths = set()
    for seed in range(10):
        look = random_look(image, replace(UNCHANGED, blur=3.0), np.random.default_rng(seed))
        blurred = looked_at(image, look)
        np.testing.assert_allclose(centre_of(blurred), uv, atol=0.1)
        assert blurred.max() == pytest.approx(250 * 4 / (4 + look.blur**2), rel=0.03, abs=2)
        widths.add(look.blur)
    assert max(widths) > 2
    assert 0 <= min(widths) < 1


def test_grounds_are_plain_coloured_or_tiles_and_often_noisy():
    picture = np.random.default_rng(0).integers(100, 110, (*SIZE, 3), dtype=np.uint8)
    kinds = []
    for seed in range(80):
        ground = random_ground((60, 80), picture, np.zeros(SIZE, np.uint8), np.random.default_rng(seed))
        image = drawn(AugmentedView((60, 80), (ground,), NO_LOOK)).astype(int)
        if image.min() >= 98 and image.max() <= 110:
            kinds.append("pieces")
        elif np.ptp(image.reshape(-1, 3), axis=0).max() == 0:
            kinds.append("plain")
        else:
            bends = np.abs(np.diff(image, n=2, axis=1)).sum(axis=2)
            kinds.append("grainy" if np.median(bends) > 12 else "coloured")
    counts = {kind: kinds.count(kind) for kind in ("pieces", "plain", "coloured", "grainy")}
    assert min(counts.values()) >= 5, counts


@pytest.mark.parametrize("seed", range(30))
def test_no_tile_of_a_picture_contains_an_object(seed):
    picture = np.full((*SIZE, 3), 100, np.uint8)
    labels = np.zeros(SIZE, np.uint8)
    labels[30:50, 40:70] = 3
    picture[labels > 0] = [250, 20, 250]
    image = _pieced(picture, labels > 0, np.random.default_rng(seed))
    np.testing.assert_array_equal(image, np.full((*SIZE, 3), 100))


def test_tiles_change_places():
    picture = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    image = _pieced(picture, np.zeros(SIZE, bool), np.random.default_rng(0))
    assert image.shape == picture.shape
    assert (image != picture).mean() > 0.8
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 1000


def test_a_picture_full_of_objects_becomes_grey():
    picture = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    image = _pieced(picture, np.ones(SIZE, bool), np.random.default_rng(0))
    np.testing.assert_array_equal(image, np.full((*SIZE, 3), 128))
