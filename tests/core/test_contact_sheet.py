from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.contact_sheet import CAPTION, contact_sheet


def test_images_stand_in_rows_under_titles_and_long_rows_are_continued() -> None:
    images = [(str(i), np.full((20, 20, 3), 10 * i, np.uint8)) for i in range(3)]
    sheet = contact_sheet([("first", images), ("second", images[:1])], n_columns=2)
    assert sheet.shape == (2 * CAPTION + 3 * (20 + CAPTION), 40, 3)
    tops = [CAPTION, CAPTION + 20 + CAPTION, 2 * CAPTION + 2 * (20 + CAPTION)]
    for (row, column), (_, image) in zip([(0, 0), (0, 1), (1, 0), (2, 0)], [*images, images[0]], strict=True):
        found = sheet[tops[row] : tops[row] + 20, 20 * column : 20 * column + 20]
        np.testing.assert_array_equal(found, image)
    assert sheet[:CAPTION].min() < 100  # A title is written.


def test_nothing_to_show_is_refused() -> None:
    with pytest.raises(ValueError, match="expected images, got none"):
        contact_sheet([("empty", [])])
