from __future__ import annotations

import numpy as np

from bask_data.formats.kept_frames import MOST_BYTES, KeptFrames


def test_a_frame_is_decoded_once_for_all_checks_and_the_reading_after_them() -> None:
    decoded: list[int] = []

    def decode(i: int) -> np.ndarray:
        decoded.append(i)
        return np.full((2, 3), i, np.uint8)

    frames = KeptFrames(decode)
    assert [int(frames(i)[0, 0]) for i in (3, 5, 3, 5)] == [3, 5, 3, 5] and decoded == [3, 5]
    frames.hand_out()
    assert [int(frames(i)[0, 0]) for i in (3, 4, 5)] == [3, 4, 5] and decoded == [3, 5, 4]
    frames(3)
    assert decoded == [3, 5, 4, 3]  # It was kept for one reading only.


def test_no_more_than_a_bounded_number_of_bytes_is_kept() -> None:
    decoded: list[int] = []

    def decode(i: int) -> np.ndarray:
        decoded.append(i)
        return np.zeros(MOST_BYTES // 2, np.uint8)

    frames = KeptFrames(decode)
    for _ in range(2):
        for i in range(4):
            frames(i)
    assert decoded == [0, 1, 2, 3, 2, 3]
