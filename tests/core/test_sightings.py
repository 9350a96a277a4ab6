from __future__ import annotations

import numpy as np

from bask_data.core.sightings import PosedDepth, fitting, sighted
from tests.scenes import intrinsics, look_at


def test_points_before_on_and_behind_a_measured_wall():
    K = intrinsics(20, 40)
    depth = np.full((20, 40), 1.0, np.float32)
    depth[:, 20:] = 0
    view = PosedDepth(depth, K, np.eye(4))
    x = -0.1
    points = np.array([[x, 0, 0.5], [x, 0, 1.01], [x, 0, 1.5], [-x, 0, 0.5], [-9, 0, 1.0], [x, 0, -1.0]])
    seen = sighted(points, [view])
    assert seen.passed.tolist() == [True, False, False, False, False, False]
    assert seen.hidden.tolist() == [False, False, True, False, False, False]
    assert seen.framed.tolist() == [True, True, True, True, False, False]


def test_what_another_view_sees_through_is_not_hidden():
    K = intrinsics(20, 40)
    wall = PosedDepth(np.full((20, 40), 1.0, np.float32), K, np.eye(4))
    far = PosedDepth(np.full((20, 40), 3.0, np.float32), K, look_at((0, 1e-3, -0.5), (0, 0, 1.0), (0, -1, 0)))
    point = np.array([[0.0, 0, 1.5]])
    assert sighted(point, [wall]).hidden.all()
    assert not sighted(point, [wall, far]).hidden.any()
    assert sighted(point, [wall, far]).passed.all()


def test_a_view_that_sees_through_the_surface_does_not_fit_it():
    K = intrinsics(20, 40)
    near = PosedDepth(np.full((20, 40), 1.0, np.float32), K, np.eye(4))
    through = PosedDepth(np.full((20, 40), 2.0, np.float32), K, np.eye(4))
    blind = PosedDepth(np.zeros((20, 40), np.float32), K, np.eye(4))
    surface = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 3)) * [1, 1, 0] + [0, 0, 1.0]
    assert fitting([near, through, blind], surface) == (near,)
    assert near.contradicted(surface) == (50, 0)
    assert through.contradicted(surface) == (0, 50)
