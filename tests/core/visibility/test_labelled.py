from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.visibility.labelled import LabelledSurface


def test_triangles_between_two_instances_are_divided_at_their_middle() -> None:
    vertices = np.array([[-0.3, 0, 0], [0.3, -0.1, 0], [0.3, 0.1, 0]], np.float32)
    surface = LabelledSurface(vertices, np.array([[0, 1, 2]], np.int32), np.array([1, 2, 2], np.int32), 2)
    rays = np.array([[0, 0, 1, x, y, -1] for x, y in ((-0.2, 0), (0.2, 0), (0, 0.3))], np.float32)
    _, label = surface.cast(rays)
    assert label.tolist() == [1, 2, 0]


def test_wrong_arguments_are_refused_in_words() -> None:
    vertices, triangle = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)
    with pytest.raises(ValueError, match="triangles: expected at least one, got none"):
        LabelledSurface(vertices, np.zeros((0, 3), np.int32), np.zeros(3, np.int32), 0)
    with pytest.raises(ValueError, match=r"vertex_instance: expected 0\.\.1, got 0\.\.2"):
        LabelledSurface(vertices, triangle, np.array([0, 1, 2], np.int32), 1)
    with pytest.raises(ValueError, match="n_instances: expected at most 255, got 256"):
        LabelledSurface(vertices, triangle, np.zeros(3, np.int32), 256)
