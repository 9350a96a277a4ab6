from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.depth import cleaned, filled, flying, in_range, noise_share


def two_walls(near: float = 0.5, far: float = 0.8) -> np.ndarray:
    """A near wall on the left, a far one on the right, the edge between columns 9 and 10."""
    depth = np.full((20, 20), near, np.float32)
    depth[:, 10:] = far
    return depth


def test_a_clean_step_between_two_surfaces_is_left_alone() -> None:
    assert not flying(two_walls()).any()


def test_pixels_hanging_between_two_surfaces_are_found_and_no_others() -> None:
    depth = two_walls()
    depth[:, 10] = np.linspace(0.56, 0.74, 20)
    expected = np.zeros((20, 20), bool)
    expected[:, 10] = True
    assert np.array_equal(flying(depth), expected)


def test_a_ramp_two_pixels_wide_is_found() -> None:
    depth = two_walls()
    depth[:, 10], depth[:, 11] = 0.6, 0.7
    assert flying(depth)[:, 10:12].all()
    assert not flying(depth)[:, [9, 12]].any()


def test_a_wire_one_pixel_wide_in_front_of_a_wall_stays() -> None:
    depth = np.full((20, 20), 0.8, np.float32)
    depth[:, 7] = 0.5
    assert not flying(depth).any()


def test_a_lone_speckle_goes_in_front_behind_and_amid_nothing() -> None:
    depth = np.full((20, 30), 0.8, np.float32)
    depth[5, 5], depth[10, 10] = 0.5, 1.2
    depth[:, 15:] = 0
    depth[10, 22] = 0.7
    assert set(zip(*np.nonzero(flying(depth)), strict=True)) == {(5, 5), (10, 10), (10, 22)}


def test_steep_surfaces_and_sparse_depth_stay() -> None:
    v, u = np.mgrid[:60, :80]
    slope_of_80_degrees = (0.5 + 0.0008 * np.tan(np.deg2rad(80)) * u).astype(np.float32)
    assert not flying(slope_of_80_degrees).any()
    every_other_pixel = np.where((u % 2 == 0) & (v % 2 == 0), slope_of_80_degrees, np.float32(0))
    assert not flying(every_other_pixel).any()


@pytest.mark.parametrize("share", [0.005, 0.02])
@pytest.mark.parametrize("step", [1, 2])
def test_noise_is_measured_beside_edges_and_in_every_other_column(share: float, step: int) -> None:
    rng = np.random.default_rng(0)
    depth = np.where(np.arange(200) % 40 < 20, 0.5, 0.9) * rng.normal(1.0, share, (200, 200))
    sparse = np.zeros_like(depth)
    sparse[:, ::step] = depth[:, ::step]
    assert noise_share(sparse.astype(np.float32)) == pytest.approx(share, rel=0.1)


def test_noise_of_too_few_pixels_is_not_told() -> None:
    assert noise_share(np.full((20, 20), 0.5, np.float32)) == 0.0


def test_a_noisy_surface_is_no_cloud_of_flying_pixels() -> None:
    rng = np.random.default_rng(0)
    depth = (0.6 * rng.normal(1.0, 0.02, (200, 200))).astype(np.float32)
    depth[50, ::10] = 1.2
    found = flying(depth)
    assert found[50, ::10].all()
    assert found.mean() < 0.01


def test_gaps_of_a_pixel_inside_a_surface_are_closed_with_the_depth_around_them() -> None:
    v, u = np.mgrid[:60, :80]
    slope = (0.5 + 0.002 * u + 0.001 * v).astype(np.float32)
    gaps = (u % 5 == 2) | (v % 5 == 3)
    closed = filled(np.where(gaps, np.float32(0), slope))
    inner = (slice(1, -1), slice(1, -1))
    assert np.allclose(closed[inner], slope[inner], atol=0.0021), "to less than the step to the next pixel"
    assert np.array_equal(closed[~gaps], slope[~gaps])


def test_no_gap_is_closed_beyond_or_across_an_edge_nor_a_wide_one() -> None:
    edge = two_walls()
    edge[:, 10:] = 0
    assert np.array_equal(filled(edge), edge), "a surface does not grow"
    across = two_walls()
    across[:, 10] = 0
    assert np.array_equal(filled(across), across), "no depth between two surfaces is made up"
    wide = np.full((20, 20), 0.5, np.float32)
    wide[5:10, 5:10] = 0
    assert (filled(wide)[6:9, 6:9] == 0).all()


def test_range_cut_turns_what_is_outside_or_no_number_into_not_measured() -> None:
    depth = np.array([[0.0, 0.05, 0.1, 2.0, 2.1, np.nan, np.inf]], np.float32)
    assert np.array_equal(in_range(depth, 0.1, 2.0), np.array([[0, 0, 0.1, 2.0, 0, 0, 0]], np.float32))


def test_cleaned_changes_nothing_but_what_it_drops_and_not_its_argument() -> None:
    depth = two_walls()
    depth[4, 10] = 0.65
    depth[:, 0] = 0.05
    before = depth.copy()
    kept = cleaned(depth, 0.1, 2.0)
    assert np.array_equal(depth, before)
    assert kept[4, 10] == 0
    assert (kept[:, 0] == 0).all()
    assert np.array_equal(kept[kept > 0], depth[kept > 0])
    assert (kept > 0).sum() == 20 * 19 - 1


@pytest.mark.parametrize(("near", "far"), [(0.5, 0.5), (-0.1, 1.0), (1.0, 0.5)])
def test_a_range_that_holds_nothing_is_refused(near: float, far: float) -> None:
    with pytest.raises(ValueError, match="expected 0 <= near < far metres, got near"):
        in_range(two_walls(), near, far)


def test_a_radius_below_a_pixel_is_refused() -> None:
    with pytest.raises(ValueError, match="expected at least 1 pixel, got 0"):
        flying(two_walls(), radius=0)
