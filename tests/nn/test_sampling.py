from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bask_data.core.geometry import in_image, scale_pixels
from bask_data.nn.augment import AugmentSettings
from bask_data.nn.sampling import LEAST_SHOWN, SampleSettings, batch_of_step, non_matches, plan_of_step, rendered
from tests.nn.pairs import RAMP_SIZE, RAMP_STEP, SIZE, RampPairs, ScenePairs

SAMPLE = SampleSettings(size=(48, 64), n_pairs=2, n_matches=32, n_non_matches=20)
COLOURLESS = AugmentSettings(brightness=0.0, contrast=0.0, saturation=0.0, hue=0.0, noise=0.0)
PLAIN = replace(COLOURLESS, zoom=(1.0, 1.0), rotation=0.0, flip=0.0, background=0.0)
GEOMETRY = {
    "zoom": st.tuples(st.floats(0.6, 1.0), st.floats(1.0, 2.5)),
    "crop": st.sampled_from(["resized", "padded"]),
    "rotation": st.floats(0, np.pi),
    "flip": st.floats(0, 1),
    "background": st.floats(0, 1),
    "composition": st.floats(0, 1),
}
LOOK = {
    "brightness": st.floats(0, 1),
    "contrast": st.floats(0, 1),
    "saturation": st.floats(0, 1),
    "hue": st.floats(0, np.pi),
    "noise": st.floats(0, 20),
    "blur": st.floats(0, 3),
}
OUT_SIZES = st.sampled_from([(48, 64), (40, 48), (56, 56)])


def seen_at(rgb: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours of the pixels at matches."""
    u, v = np.rint(uv).astype(int).T
    return rgb[v, u].astype(float)


def plane_from_pixels(rgb: np.ndarray, uv: np.ndarray, marker: float) -> np.ndarray | None:
    """Affine map from pixels (u, v, 1) to the plane, fitted to an object's colours; None if too little is visible.

    Starts with the pixels around the matches and adds all others that agree: filled pixels may have the object's blue
    by chance, but are inconsistent with its plane.
    """
    v, u = np.nonzero(np.abs(rgb[..., 2].astype(float) - marker) <= 1)
    pixels, plane = np.column_stack([u, v, np.ones(len(u))]), rgb[v, u, :2] / RAMP_STEP
    kept = (np.abs(pixels[:, None, :2] - np.rint(uv)).max(axis=-1) <= 1).any(axis=1)
    for _ in range(6):
        if kept.sum() < 9 or np.linalg.matrix_rank(pixels[kept]) < 3:
            return None
        fitted = np.linalg.lstsq(pixels[kept], plane[kept], rcond=None)[0]
        kept = np.linalg.norm(pixels @ fitted - plane, axis=1) < 0.4
    return fitted if kept.sum() >= 40 else None


def read_errors(source: RampPairs, rgb: np.ndarray, uv: np.ndarray, marker: float) -> tuple[np.ndarray, float]:
    """Positions of matches on the plane, read from the image only, and the largest error, pixels."""
    matrix = plane_from_pixels(rgb, uv, marker)
    if matrix is None:
        return np.full((len(uv), 2), np.nan), np.nan
    instance, points = source.points()
    points = points[instance == source.instance_of(marker)]
    plane = np.column_stack([uv, np.ones(len(uv))]) @ matrix
    nearest = np.linalg.norm(plane[:, None] - points, axis=-1).argmin(axis=1)
    # Mapped back to the image, since the tolerance is in its pixels.
    return points[nearest], np.linalg.norm((plane - points[nearest]) @ np.linalg.inv(matrix[:2]), axis=1).max()


@given(
    step=st.integers(0, 2**31),
    n_objects=st.integers(1, 2),
    size=OUT_SIZES,
    augment=st.builds(lambda **chosen: replace(COLOURLESS, **chosen), **GEOMETRY),
)
@settings(max_examples=100)
def test_every_match_lies_on_its_surface_point_under_all_augmentations(step, n_objects, size, augment):
    source = RampPairs(n_objects, n_scans=2)
    batch = batch_of_step(source, 0, step, replace(SAMPLE, size=size), augment)
    for rgb_a, rgb_b, uv_a, uv_b in zip(batch.rgb_a, batch.rgb_b, batch.uv_a, batch.uv_b, strict=True):
        markers = np.unique(np.concatenate([seen_at(rgb_a, uv_a), seen_at(rgb_b, uv_b)])[:, 2])
        assert len(markers) == 1, "a match is hidden or on another object"
        points_a, error_a = read_errors(source, rgb_a, uv_a, markers[0])
        points_b, error_b = read_errors(source, rgb_b, uv_b, markers[0])
        assert not error_a >= 0.5
        assert not error_b >= 0.5
        both = np.isfinite(points_a) & np.isfinite(points_b)
        np.testing.assert_array_equal(points_a[both], points_b[both])


def places_on_plane(rgb: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Positions of matches on the plane, and the map from pixels (u, v, 1) to it; None if too little is visible."""
    matrix = plane_from_pixels(rgb, uv, seen_at(rgb, uv)[0, 2])
    return None if matrix is None else (np.column_stack([uv, np.ones(len(uv))]) @ matrix, matrix)


@given(step=st.integers(0, 2**31), augment=st.builds(lambda **chosen: replace(COLOURLESS, **chosen), **GEOMETRY))
@settings(max_examples=50)
def test_matches_of_an_image_with_itself_are_exact(step, augment):
    batch = batch_of_step(RampPairs(2, n_scans=2), 0, step, replace(SAMPLE, n_pairs=1, self_pairs=1.0), augment)
    a, b = places_on_plane(batch.rgb_a[0], batch.uv_a[0]), places_on_plane(batch.rgb_b[0], batch.uv_b[0])
    if a is not None and b is not None:
        for _, matrix in (a, b):
            assert np.linalg.norm((a[0] - b[0]) @ np.linalg.inv(matrix[:2]), axis=1).max() < 0.5


def test_matches_of_an_image_with_itself_lie_all_over_the_object():
    # Matches of two images are 5 pixels apart here, and on real objects only where both have depth.
    source = RampPairs(1)
    _, listed = source.points()
    away = []
    for step in range(10):
        sample = replace(SAMPLE, n_pairs=1, self_pairs=1.0)
        batch = batch_of_step(source, 0, step, sample, replace(COLOURLESS, zoom=(1.0, 1.0)))
        found = places_on_plane(batch.rgb_a[0], batch.uv_a[0])
        assert found is not None
        away.append(np.linalg.norm(found[0][:, None] - listed, axis=-1).min(axis=1))
    assert 0.8 < np.mean(np.concatenate(away) > 0.7) < 1.0


def test_matches_can_be_read_from_nearly_all_images():
    # The test above skips images that show too little of an object.
    source, n_read = RampPairs(2, n_scans=2), 0
    augment = replace(COLOURLESS, zoom=(0.6, 2.5), composition=0.5)
    for step in range(50):
        batch = batch_of_step(source, 0, step, SAMPLE, augment)
        marker = seen_at(batch.rgb_b[0], batch.uv_b[0])[0, 2]
        n_read += np.isfinite(read_errors(source, batch.rgb_b[0], batch.uv_b[0], marker)[1])
    assert n_read >= 45


@given(
    step=st.integers(0, 2**31),
    geometry=st.fixed_dictionaries(GEOMETRY),
    look=st.fixed_dictionaries(LOOK),
)
@settings(max_examples=30)
def test_photometric_changes_move_no_match(step, geometry, look):
    # Results for images without photometric changes thus hold for all others.
    source, plain = RampPairs(2, n_scans=2), replace(COLOURLESS, **geometry)
    coloured = batch_of_step(source, 0, step, SAMPLE, replace(plain, **look))
    colourless = batch_of_step(source, 0, step, SAMPLE, plain)
    for name in ("uv_a", "uv_b", "non_matches_b", "foreground", "valid"):
        np.testing.assert_array_equal(getattr(coloured, name), getattr(colourless, name))


def assert_same(first, second):
    for a, b in zip(astuple(first), astuple(second), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_batch_depends_on_seed_and_step_only():
    source = ScenePairs()
    first = [batch_of_step(source, 7, step, SAMPLE, AugmentSettings(composition=0.5)) for step in (0, 1, 2)]
    again = [batch_of_step(source, 7, step, SAMPLE, AugmentSettings(composition=0.5)) for step in (2, 0, 1)]
    for batch, repeated in zip(first, [again[1], again[2], again[0]], strict=True):
        assert_same(batch, repeated)
    other_seed = batch_of_step(source, 8, 0, SAMPLE, AugmentSettings(composition=0.5))
    assert not np.array_equal(first[0].rgb_a, other_seed.rgb_a)
    assert not np.array_equal(first[0].rgb_a, first[1].rgb_a)


def test_some_examples_of_a_step_are_those_of_the_whole_step():
    sample = replace(SAMPLE, n_pairs=4)
    whole = batch_of_step(ScenePairs(), 3, 5, sample, AugmentSettings())
    for part in (range(1), range(1, 4), range(1, 4, 2)):
        some = batch_of_step(ScenePairs(), 3, 5, sample, AugmentSettings(), part)
        for a, b in zip(astuple(some), astuple(whole), strict=True):
            np.testing.assert_array_equal(a, b[part.start : part.stop : part.step])
    assert not np.array_equal(whole.rgb_a[0], whole.rgb_a[1])


def test_a_plan_rendered_by_torch_is_the_batch_rendered_by_opencv():
    augment = AugmentSettings(zoom=(0.5, 2.0), composition=1.0, crop="padded", blur=1.5)
    for step in range(4):
        batch = batch_of_step(ScenePairs(), 1, step, SAMPLE, augment)
        there = rendered(plan_of_step(ScenePairs(), 1, step, SAMPLE, augment), torch.device("cpu"))
        for name in ("uv_a", "uv_b", "non_matches_b", "foreground", "valid"):
            np.testing.assert_array_equal(getattr(there, name).numpy(), getattr(batch, name))
        for name in ("rgb_a", "rgb_b"):
            difference = np.abs(getattr(there, name).numpy().astype(int) - getattr(batch, name))
            assert difference.max() <= 4
            assert difference.mean() < 0.5
        on = batch.on(torch.device("cpu"))
        assert all(torch.equal(torch.from_numpy(a), b) for a, b in zip(astuple(batch), astuple(on), strict=True))


def test_all_coordinates_are_in_the_images():
    for step in range(10):
        batch = batch_of_step(ScenePairs(), 0, step, SAMPLE, AugmentSettings(zoom=(0.6, 2.0)))
        for uv in (batch.uv_a, batch.uv_b, batch.non_matches_b):
            assert in_image(uv, *SAMPLE.size).all()
        assert batch.rgb_a.shape == (2, 48, 64, 3)


def test_a_pair_shows_one_instance_and_its_matches_are_those_of_the_source():
    source = ScenePairs()
    seen = set()
    for step in range(12):
        batch = batch_of_step(source, 3, step, replace(SAMPLE, n_pairs=1), PLAIN)
        found = np.concatenate([batch.uv_a[0], batch.uv_b[0]], axis=1)
        for i_pair in range(source.n_pairs):
            pair = source.pair(i_pair)
            known = np.concatenate([scale_pixels(uv, SIZE, SAMPLE.size) for uv in (pair.uv_a, pair.uv_b)], axis=1)
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


def test_the_share_of_self_pairs_is_as_requested():
    alone = replace(SAMPLE, n_pairs=1)

    def is_one_image(step: int, share: float) -> bool:
        batch = batch_of_step(ScenePairs(), 0, step, replace(alone, self_pairs=share), PLAIN)
        same = bool((batch.rgb_a == batch.rgb_b).all())
        assert same == bool((batch.uv_a == batch.uv_b).all())
        return same

    assert all(is_one_image(step, 1.0) for step in range(5))
    assert not any(is_one_image(step, 0.0) for step in range(5))
    assert 5 < sum(is_one_image(step, 0.5) for step in range(30)) < 25


def pasted_share(rgb: np.ndarray, marker: int) -> float:
    return (rgb[..., 2] == marker).mean()


def test_an_object_of_the_same_scan_is_pasted_if_the_scan_has_several():
    source = RampPairs(2, n_scans=2, n_pairs=2)
    n_more = 0
    for step in range(30):
        sample = replace(SAMPLE, n_pairs=1)
        before = batch_of_step(source, 0, step, sample, replace(PLAIN, rotation=1.0))
        after = batch_of_step(source, 0, step, sample, replace(PLAIN, rotation=1.0, composition=1.0))
        own = int(seen_at(after.rgb_b[0], after.uv_b[0])[0, 2])
        scan = (own - 80) // 40
        (other,) = {source.marker(scan, instance) for instance in (1, 2)} - {own}
        elsewhere = [source.marker(1 - scan, instance) for instance in (1, 2)]
        assert pasted_share(after.rgb_b[0], own) < pasted_share(before.rgb_b[0], own) + 0.02
        n_more += pasted_share(after.rgb_b[0], other) > pasted_share(before.rgb_b[0], other)
        assert sum(pasted_share(after.rgb_b[0], marker) for marker in elsewhere) < 0.02
    assert n_more >= 15


def test_an_object_of_another_scan_is_pasted_if_each_scan_has_one():
    source = RampPairs(1, n_scans=3, n_pairs=2)
    n_pasted = 0
    for step in range(30):
        batch = batch_of_step(source, 0, step, replace(SAMPLE, n_pairs=1), replace(PLAIN, composition=1.0))
        own = int(seen_at(batch.rgb_b[0], batch.uv_b[0])[0, 2])
        others = [source.marker(scan, 1) for scan in range(3) if source.marker(scan, 1) != own]
        n_pasted += max(pasted_share(batch.rgb_b[0], marker) for marker in others) > 0.02
    assert n_pasted >= 20


def test_pasted_objects_count_as_background():
    source = RampPairs(1, n_scans=2)
    sample = replace(SAMPLE, n_pairs=1, n_non_matches=200, foreground_share=0.5)
    other_seen = False
    for step in range(20):
        batch = batch_of_step(source, 0, step, sample, replace(PLAIN, composition=1.0))
        own = seen_at(batch.rgb_b[0], batch.uv_b[0])[0, 2]
        colours = seen_at(batch.rgb_b[0], batch.non_matches_b[0].reshape(-1, 2))[:, 2].reshape(32, 200)
        (other,) = {80, 100} - {own}
        # Colours blend at the edge of an object, so a few pixels belong to neither.
        assert (colours[batch.foreground[0]] == own).mean() > 0.9
        assert not (colours[batch.foreground[0]] == other).any()
        other_seen |= bool((colours[~batch.foreground[0]] == other).any())
    assert other_seen


def test_nothing_is_pasted_that_would_hide_the_object():
    source, sample = RampPairs(1, n_scans=2), replace(SAMPLE, n_pairs=1, n_matches=2000, n_non_matches=0)
    fewest = 1.0
    for step in range(40):
        before, after = (
            len(np.unique(batch_of_step(source, 0, step, sample, replace(PLAIN, composition=share)).uv_b[0], axis=0))
            for share in (0.0, 1.0)
        )
        fewest = min(fewest, after / before)
    # Each of the two images may lose three quarters of the remaining matches.
    assert LEAST_SHOWN**2 <= fewest < 0.9


def test_nothing_is_pasted_if_there_is_no_other_object():
    source = RampPairs(1, n_scans=1)
    for step in range(3):
        images = [batch_of_step(source, 0, step, SAMPLE, replace(PLAIN, composition=c)).rgb_a for c in (0.0, 1.0)]
        assert (images[0] == images[1]).mean() > 0.99


def test_a_padded_crop_keeps_its_scale_and_the_rest_is_filled():
    source, sample = RampPairs(1), replace(SAMPLE, size=RAMP_SIZE, n_pairs=1)
    shares = []
    for step in range(60):
        batch = batch_of_step(source, 0, step, sample, replace(PLAIN, zoom=(1.0, 2.0), crop="padded"))
        rgb, uv = batch.rgb_a[0], batch.uv_a[0]
        matrix = plane_from_pixels(rgb, uv, source.marker(0, 1))
        assert np.sqrt(abs(np.linalg.det(matrix[:2]))) == pytest.approx(1.0, abs=0.2)
        plain = batch_of_step(source, 0, step, sample, PLAIN).rgb_a[0]
        kept = np.abs(rgb.astype(int) - plain).max(axis=-1) == 0
        rows, columns = np.flatnonzero(kept.mean(axis=1) > 0.4), np.flatnonzero(kept.mean(axis=0) > 0.4)
        assert len(rows) >= 0.5 * RAMP_SIZE[0] - 1
        assert len(columns) >= 0.5 * RAMP_SIZE[1] - 1
        shares.append((len(rows) / RAMP_SIZE[0], len(columns) / RAMP_SIZE[1]))
    heights, widths = np.array(shares).T
    assert min(heights) < 0.6
    assert max(heights) > 0.9
    assert abs(np.corrcoef(heights, widths)[0, 1]) < 0.5


def test_the_background_is_replaced_and_the_objects_are_not():
    source, sample = RampPairs(2), replace(SAMPLE, size=RAMP_SIZE)
    for step in range(6):
        plain = batch_of_step(source, 0, step, sample, PLAIN)
        painted = batch_of_step(source, 0, step, sample, replace(PLAIN, background=1.0))
        for before, after in ((plain.rgb_a, painted.rgb_a), (plain.rgb_b, painted.rgb_b)):
            is_object = np.isin(before[..., 2], [source.marker(0, instance) for instance in (1, 2)])
            same = (before == after).all(axis=-1)
            assert same[is_object].mean() > 0.98
            # Tiles of the picture's own background may by chance return to their place.
            assert same[before[..., 2] == 20].mean() < 0.2


def test_the_margin_around_a_small_image_shows_no_second_object():
    source, sample = RampPairs(1), replace(SAMPLE, size=RAMP_SIZE, n_pairs=1)
    marker = source.marker(0, 1)
    for step in range(10):
        whole = batch_of_step(source, 0, step, sample, PLAIN).rgb_a[0]
        small = batch_of_step(source, 0, step, sample, replace(PLAIN, zoom=(0.6, 0.6))).rgb_a[0]
        # Extended by reflection, as layers are, the image would show more of the object than before.
        assert (small[..., 2] == marker).sum() < 0.5 * (whole[..., 2] == marker).sum()


def test_both_images_of_a_pair_are_mirrored_or_neither():
    source, n_mirrored = RampPairs(1), 0
    for step in range(20):
        batch = batch_of_step(source, 0, step, replace(SAMPLE, n_pairs=1), replace(PLAIN, flip=0.5, rotation=1.0))
        images = ((batch.rgb_a[0], batch.uv_a[0]), (batch.rgb_b[0], batch.uv_b[0]))
        matrices = [plane_from_pixels(rgb, uv, source.marker(0, 1)) for rgb, uv in images]
        is_mirrored = [np.linalg.det(matrix[:2]) < 0 for matrix in matrices]
        assert is_mirrored[0] == is_mirrored[1]
        n_mirrored += is_mirrored[0]
    assert 4 <= n_mirrored <= 16


def test_a_match_at_the_very_edge_of_its_object_is_used_if_there_is_no_other():
    source = RampPairs(1)
    pair = source.pair(0)
    at_edge = replace(
        pair,
        instance_a=np.zeros_like(pair.instance_a),
        instance=pair.instance[:1],
        uv_a=pair.uv_a[:1],
        uv_b=pair.uv_b[:1],
    )
    source.pair = lambda i_pair: at_edge
    batch = batch_of_step(source, 0, 0, replace(SAMPLE, n_pairs=1), replace(PLAIN, composition=1.0))
    assert len(np.unique(batch.uv_a[0], axis=0)) == 1


@pytest.mark.parametrize("foreground_share", ["auto", 0.3])
def test_non_matches_lie_on_or_off_the_instance_as_stated_and_away_from_the_match(foreground_share):
    mask = np.zeros((40, 50), bool)
    mask[5:25, 10:35] = True
    uv = np.stack([np.linspace(11, 33, 30), np.linspace(6, 23, 30)], axis=-1).astype(np.float32)
    sample = replace(SAMPLE, n_non_matches=100, foreground_share=foreground_share)
    pixels, foreground, valid = non_matches(mask, uv, sample, np.random.default_rng(0))
    assert pixels.shape == (30, 100, 2)
    np.testing.assert_array_equal(mask[pixels[..., 1].astype(int), pixels[..., 0].astype(int)], foreground)
    distance = np.linalg.norm(pixels - uv[:, None], axis=-1)
    assert (distance[valid] >= sample.clearance).all()
    assert (distance[~valid] < sample.clearance).all()
    assert valid.mean() > 0.99
    expected = mask.mean() if foreground_share == "auto" else 0.3
    assert foreground.mean() == pytest.approx(expected, abs=0.006)


def test_background_non_matches_reach_every_corner_of_the_image():
    mask = np.zeros((40, 50), bool)
    mask[15:25, 20:30] = True
    uv = np.full((200, 2), [24.5, 19.5], np.float32)
    sample = replace(SAMPLE, n_non_matches=400, foreground_share=0.0)
    pixels, _, _ = non_matches(mask, uv, sample, np.random.default_rng(0))
    hit = np.zeros(mask.shape, bool)
    hit[pixels[..., 1].astype(int), pixels[..., 0].astype(int)] = True
    assert (hit == ~mask).all()


def test_an_object_smaller_than_the_clearance_gives_no_valid_foreground():
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


def occluded(source: RampPairs, n_steps: int) -> set[tuple[tuple[int, int], tuple[int, int]]]:
    """Sampled objects and those whose colour is more in their second image than without pasting, by scan and number."""
    places = {source.marker(scan, i): (scan, i) for scan in set(source.scans) for i in range(1, source.n_objects + 1)}
    sample, pasted = replace(SAMPLE, n_pairs=1), set()
    for step in range(n_steps):
        images = [batch_of_step(source, 0, step, sample, replace(PLAIN, composition=share)) for share in (0.0, 1.0)]
        own = places[int(seen_at(images[1].rgb_b[0], images[1].uv_b[0])[0, 2])]
        for marker, place in places.items():
            before, after = (pasted_share(each.rgb_b[0], marker) for each in images)
            if after > before + 0.02:
                pasted.add((own, place))
    return pasted


def test_an_object_is_not_pasted_over_itself_as_another_scan_shows_it():
    source = RampPairs(1, n_scans=3, n_pairs=2)
    assert ((0, 1), (1, 1)) in occluded(source, 40)
    source.identities[[0, 1], 1] = 5
    assert occluded(source, 40) == {
        (a, b) for a in [(0, 1), (1, 1), (2, 1)] for b in [(0, 1), (1, 1), (2, 1)] if (2, 1) in (a, b) and a != b
    }


def test_scans_of_several_objects_take_from_others_what_is_known_to_differ():
    source = RampPairs(2, n_scans=2, n_pairs=2)
    # The first scan shows identities 1 and 2 together, the second one 2 and an unknown object.
    source.identities[0, [1, 2]] = 1, 2
    source.identities[1, 1] = 2
    within = {((scan, i), (scan, 3 - i)) for scan in (0, 1) for i in (1, 2)}
    across = {((0, 1), (1, 1)), ((1, 1), (0, 1))}
    assert occluded(source, 80) == within | across


def test_twins_of_one_scan_are_not_pasted_over_each_other():
    source = RampPairs(2, n_scans=1, n_pairs=2)
    source.identities[0, [1, 2]] = 3
    assert occluded(source, 20) == set()
