from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest

from bask_data.core.geometry import in_image
from bask_data.nn.augment import AugmentSettings, fitting_affine, moved
from bask_data.nn.sampling import SampleSettings, batch_of_step, non_matches
from tests.nn.pairs import SIZE, ScenePairs

SAMPLE = SampleSettings(size=(48, 64), n_pairs=2, n_matches=32, n_non_matches=20)
PLAIN = AugmentSettings(
    zoom=(1.0, 1.0),
    rotation=0.0,
    flip=0.0,
    background=0.0,
    brightness=0.0,
    contrast=0.0,
    saturation=0.0,
    hue=0.0,
    noise=0.0,
)


def test_a_batch_depends_on_seed_and_step_alone():
    source = ScenePairs()
    first = [batch_of_step(source, 7, step, SAMPLE, AugmentSettings()) for step in (0, 1, 2)]
    again = [batch_of_step(source, 7, step, SAMPLE, AugmentSettings()) for step in (2, 0, 1)]
    for one, other in zip(first, [again[1], again[2], again[0]], strict=True):
        for a, b in zip(astuple(one), astuple(other), strict=True):
            np.testing.assert_array_equal(a, b)
    other_seed = batch_of_step(source, 8, 0, SAMPLE, AugmentSettings())
    assert not np.array_equal(first[0].rgb_a, other_seed.rgb_a)
    assert not np.array_equal(first[0].rgb_a, first[1].rgb_a)


def test_all_coordinates_are_in_the_images():
    for step in range(10):
        batch = batch_of_step(ScenePairs(), 0, step, SAMPLE, AugmentSettings(zoom=(0.6, 2.0)))
        for uv in (batch.uv_a, batch.uv_b, batch.non_matches_b):
            assert in_image(uv, *SAMPLE.size).all()
        assert batch.rgb_a.shape == (2, 48, 64, 3)


def test_a_pair_is_of_one_instance_and_its_matches_are_the_given_ones():
    source = ScenePairs()
    seen = set()
    for step in range(12):
        batch = batch_of_step(source, 3, step, replace(SAMPLE, n_pairs=1), PLAIN)
        found = np.concatenate([batch.uv_a[0], batch.uv_b[0]], axis=1)
        affine = fitting_affine(SIZE, SAMPLE.size)
        for i_pair in range(source.n_pairs):
            pair = source.pair(i_pair)
            known = np.concatenate([moved(affine, pair.uv_a), moved(affine, pair.uv_b)], axis=1)
            swapped = np.abs(found[:, None] - known[None][..., [2, 3, 0, 1]]).max(axis=-1)
            distance = np.abs(found[:, None] - known[None]).max(axis=-1)
            distance = distance if distance.min(axis=1).max() < swapped.min(axis=1).max() else swapped
            if (distance.min(axis=1) < 1e-3).all():
                instances = pair.instance[distance.argmin(axis=1)]
                assert len(np.unique(instances)) == 1
                seen.add(int(instances[0]))
                break
        else:
            pytest.fail("matches belong to no pair")
    assert len(seen) > 1


@pytest.mark.parametrize("foreground_share", ["auto", 0.3])
def test_non_matches_lie_where_they_say_and_away_from_the_match(foreground_share):
    mask = np.zeros((40, 50), bool)
    mask[5:25, 10:35] = True
    uv = np.stack([np.linspace(11, 33, 30), np.linspace(6, 23, 30)], axis=-1).astype(np.float32)
    sample = replace(SAMPLE, n_non_matches=100, foreground_share=foreground_share)
    pixels, foreground, valid = non_matches(mask, uv, sample, np.random.default_rng(0))
    assert pixels.shape == (30, 100, 2)
    np.testing.assert_array_equal(mask[pixels[..., 1].astype(int), pixels[..., 0].astype(int)], foreground)
    distance = np.linalg.norm(pixels - uv[:, None], axis=-1)
    assert (distance[valid] >= sample.clearance).all()
    assert valid.mean() > 0.99
    expected = mask.mean() if foreground_share == "auto" else 0.3
    assert foreground.mean() == pytest.approx(expected, abs=0.006)


def test_background_non_matches_reach_every_corner_of_the_image():
    mask = np.zeros((40, 50), bool)
    mask[15:25, 20:30] = True
    uv = np.full((200, 2), [24.5, 19.5], np.float32)
    sample = replace(SAMPLE, n_non_matches=100, foreground_share=0.0)
    pixels, _, _ = non_matches(mask, uv, sample, np.random.default_rng(0))
    hit = np.zeros(mask.shape, bool)
    hit[pixels[..., 1].astype(int), pixels[..., 0].astype(int)] = True
    assert (hit == ~mask).all()


def test_an_object_smaller_than_the_clearance_gives_no_foreground_that_counts():
    mask = np.zeros((40, 50), bool)
    mask[20:22, 30:32] = True
    uv = np.full((3, 2), [30.5, 20.5], np.float32)
    sample = replace(SAMPLE, foreground_share=0.5)
    _, foreground, valid = non_matches(mask, uv, sample, np.random.default_rng(0))
    assert not valid[foreground].any()
    assert valid[~foreground].all()


@pytest.mark.parametrize("filled", [True, False])
def test_an_image_all_object_or_all_background_still_gives_non_matches(filled):
    uv = np.full((3, 2), 10, np.float32)
    _, foreground, valid = non_matches(np.full((40, 50), filled), uv, SAMPLE, np.random.default_rng(0))
    assert (foreground == filled).all()
    assert valid.all()
