"""Depth whose 16 bits are rotated left by three, as in APC and SUN RGB-D, told from depth by its own steps.

Rotated values are multiples of 8 up to 8191 steps of the sensor; beyond, they start again at 1. Where a surface passes
there, the values of neighbouring pixels differ by nearly all that 16 bits hold, and rotated back by a step or two.
Without such a place, rotated depth cannot be told from depth that was multiplied by 8, and needs not to be: with an
eighth of the unit it is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt16
from numpy import ndarray

ROTATED_BY = 3
"""Bits that depth is rotated by to the left, in all data sets that are known to do so."""

LEAST_ALIKE = 0.7
"""Share of neighbours of different values whose three last bits are the same: 0.99 and more in three rotated
recordings, at most 0.14 in ten others."""

WRAP_JUMP = 60_000
"""Units that neighbours must differ by to count as a jump. Chosen; sensitivity not measured."""

MENDED = (65_536 - WRAP_JUMP) // 8
"""Units that the neighbours of a jump differ by at most when rotated back, if their bits were rotated: 7 cm in APC's.
If values have steps of 8, but were not rotated, they differ by ten times as much."""

LEAST_MENDED, MENDED_SHARE = 10, 0.9
"""Jumps that rotating must take away to tell, and their share of all jumps. Of eight frames each of three rotated
recordings, on which they were chosen, rotating takes all 44 to 233 jumps away, in ten others not one of up to 209."""


@dataclass(frozen=True)
class BitPairs:
    """What neighbouring pixels of depth say about its bits.

    Args:
        n_changed: pairs of different values.
        n_alike: those of them whose three last bits are the same.
        n_jumps: pairs that differ by nearly all of 16 bits.
        n_mended: those of them that hardly differ when rotated back.
    """

    n_changed: int = 0
    n_alike: int = 0
    n_jumps: int = 0
    n_mended: int = 0

    def __add__(self, other: BitPairs) -> BitPairs:
        return BitPairs(
            self.n_changed + other.n_changed,
            self.n_alike + other.n_alike,
            self.n_jumps + other.n_jumps,
            self.n_mended + other.n_mended,
        )

    @property
    def may_be_rotated(self) -> bool:
        """Whether the values have steps of 8, as rotated and as multiplied ones have."""
        return self.n_alike >= LEAST_ALIKE * self.n_changed > 0

    @property
    def is_rotated(self) -> bool:
        """Whether the bits are surely rotated."""
        return self.may_be_rotated and self.n_mended >= max(LEAST_MENDED, MENDED_SHARE * self.n_jumps)


def bit_pairs(raw: UInt16[ndarray, "h w"]) -> BitPairs:
    """What the neighbours in a depth image say; 0, no measurement, has none."""
    total = BitPairs()
    pairs: Sequence[tuple[ndarray, ndarray]] = ((raw[:, :-1], raw[:, 1:]), (raw[:-1], raw[1:]))
    for first, second in pairs:
        is_changed = (first != second) & (first > 0) & (second > 0)
        a, b = first[is_changed], second[is_changed]
        is_jump = np.abs(a.astype(np.int32) - b) > WRAP_JUMP
        back_a, back_b = rotated_back(a[is_jump]).astype(np.int32), rotated_back(b[is_jump])
        n_alike = np.count_nonzero((a ^ b) & np.uint16(2**ROTATED_BY - 1) == 0)
        n_mended = np.count_nonzero(np.abs(back_a - back_b) <= MENDED)
        total += BitPairs(len(a), int(n_alike), int(np.count_nonzero(is_jump)), int(n_mended))
    return total


def rotated_back(raw: UInt16[ndarray, "*n"]) -> UInt16[ndarray, "*n"]:
    """Values whose bits were rotated left by three, as they were before."""
    return (raw >> np.uint16(ROTATED_BY)) | (raw << np.uint16(16 - ROTATED_BY))
