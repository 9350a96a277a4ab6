from __future__ import annotations

import numpy as np
import pytest

from bask_data.nn.appearance import CROP, OFF_OBJECT, Appearance, squared


@pytest.fixture(scope="module")
def appearance() -> Appearance:
    return Appearance()


def image_of(pattern: str) -> tuple[np.ndarray, np.ndarray]:
    """An image (60, 80, 3) with a disc of stripes or dots, and its mask."""
    v, u = np.mgrid[:60, :80]
    waves = np.sin(u / 1.5) if pattern == "stripes" else np.sin(u / 2.5) * np.sin(v / 2.5)
    grey = np.where(waves > 0, 200, 60).astype(np.uint8)
    return np.stack([grey, grey // 2, grey // 3], axis=-1), (v - 30) ** 2 + (u - 40) ** 2 < 20**2


def test_an_object_is_centred_and_fills_the_square_without_its_surroundings() -> None:
    rgb = np.full((60, 80, 3), 9, np.uint8)
    mask = np.zeros((60, 80), bool)
    mask[10:20, 50:70] = True
    rgb[mask] = (200, 100, 50)
    crop, shown = squared(rgb, mask)
    v, u = np.nonzero(shown)
    assert crop.shape == (CROP, CROP, 3)
    assert np.ptp(u) + 1 == pytest.approx(CROP / 1.2, abs=6) and np.ptp(v) + 1 == pytest.approx(CROP / 2.4, abs=6)
    assert (u.min() + u.max()) / 2 == pytest.approx((CROP - 1) / 2, abs=3)
    assert (crop[CROP // 2, CROP // 2] == (200, 100, 50)).all()
    assert (crop[0] == OFF_OBJECT).all() and not (crop == 9).any()


def test_an_empty_mask_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a mask with pixels, got an empty one"):
        squared(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), bool))


def test_vectors_tell_textures_apart_and_not_other_lights_or_surroundings(appearance: Appearance) -> None:
    (stripes, mask), (dots, _) = image_of("stripes"), image_of("dots")
    elsewhere = np.where(mask[:, :, None], stripes, np.uint8(255))
    darker = (stripes * 0.8).astype(np.uint8)
    vectors = appearance([squared(image, mask) for image in (stripes, elsewhere, darker, dots)])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, rtol=1e-5)
    _, same, dark, other = 1 - vectors @ vectors[0]
    assert same == pytest.approx(0, abs=1e-6)
    assert 0 < 3 * dark < other
