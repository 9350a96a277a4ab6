from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy import ndarray

from bask_data.core.rotated_bits import BitPairs, bit_pairs, rotated_back

TILTED = (6000 + 30 * np.arange(100) + np.random.default_rng(0).integers(0, 20, size=(20, 100))).astype(np.uint16)
"""Depth of a tilted plane with noise, 0.6 to 0.9 m in units of 0.1 mm: rotated bits start again in it, at 0.8192 m."""


def rotated(raw: ndarray) -> ndarray:
    return (raw << np.uint16(3)) | (raw >> np.uint16(13))


@given(st.integers(0, 65535))
def test_rotating_back_undoes_rotating(value: int) -> None:
    assert rotated_back(rotated(np.uint16([value])))[0] == value


def test_rotated_bits_are_told_where_a_surface_passes_the_place_at_which_they_start_again() -> None:
    pairs = bit_pairs(rotated(TILTED))
    assert pairs.is_rotated
    # Each row passes it once, unless noise takes it back.
    assert 20 <= pairs.n_mended == pairs.n_jumps <= 200


@pytest.mark.parametrize("nearer", [0, 3000])
def test_other_depth_is_not_told(nearer: int) -> None:
    raw = TILTED - np.uint16(nearer)
    assert not bit_pairs(raw).may_be_rotated and not bit_pairs(rotated_back(raw)).may_be_rotated


def test_steps_of_8_alone_may_be_rotated_but_are_not_surely() -> None:
    near = TILTED - np.uint16(2000)
    assert np.array_equal(rotated(near), 8 * near)
    pairs = bit_pairs(8 * near)
    assert pairs.may_be_rotated and not pairs.is_rotated


@pytest.mark.parametrize("beside", [65535, 65528])
def test_values_that_mean_too_far_beside_near_surfaces_are_no_rotation(beside: int) -> None:
    raw = 8 * (TILTED // np.uint16(16))
    raw[:, ::5] = beside
    pairs = bit_pairs(raw)
    assert pairs.n_jumps > 100 and not pairs.is_rotated


def test_no_measurement_has_no_neighbours() -> None:
    raw = np.zeros((4, 4), np.uint16)
    raw[1, 1] = raw[3, 3] = 65528
    assert bit_pairs(raw) == BitPairs()
    assert not BitPairs().may_be_rotated


def test_frames_are_counted_together() -> None:
    one = bit_pairs(rotated(TILTED)[:6, 60:90])
    assert 6 <= one.n_mended < 10 and not one.is_rotated
    assert (one + one).is_rotated and (one + one).n_changed == 2 * one.n_changed
