from __future__ import annotations

import numpy as np

from bask_data.core.creases import divided, in_crease
from tests.meshes import block
from tests.scenes import Scene
from tests.single_view import TABLE, box, single_view


def test_boxes_that_touch_and_stand_on_each_other_are_divided_when_asked():
    bodies = (
        box(-0.05, 0.05, (0.24, 0.16, 0.06)),
        box(-0.08, 0.05, (0.09, 0.08, 0.1), bottom=0.06),
        box(0.15, -0.02, (0.16, 0.07, 0.12)),
    )
    seen = single_view(Scene(bodies, (TABLE,)))
    found = seen.split(divide=True)
    assert len(seen.split().instances) == 1
    assert len(found.instances) == 3
    owner = [np.bincount(found.vertex_instance[seen.truth == body], minlength=4).argmax() for body in (1, 2, 3)]
    assert sorted(owner) == [1, 2, 3]
    right = np.array([0, *owner])[seen.truth] == found.vertex_instance
    assert right[seen.truth > 0].mean() > 0.93
    assert all(not one.doubts for one in found.instances)
    assert any("--touching one keeps them" in text for text in found.warnings)


def test_a_box_alone_has_no_crease_and_the_inside_of_a_cup_neither():
    vertices, _ = block(0, 0, (0.1, 0.06, 0.08), 0.004)
    side = np.abs(vertices - np.array([0.05, 0.03, 0.04])) / np.array([0.05, 0.03, 0.04])
    normals = np.where(side > 0.999, np.sign(vertices - np.array([0.05, 0.03, 0.04])), 0.0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert not in_crease(vertices.astype(float), normals).any()
    angle, z = (axis.ravel() for axis in np.meshgrid(np.arange(0, 2 * np.pi, 0.1), np.arange(0, 0.08, 0.004)))
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    points = 0.04 * outward + np.stack([np.zeros_like(z), np.zeros_like(z), z], axis=1)
    assert not in_crease(points, -outward).any()


def test_pieces_too_small_go_to_the_nearest():
    points = np.array([[0.0, 0, 0], [0.004, 0, 0], [0.1, 0, 0]])
    up = np.tile([0.0, 0, 1], (3, 1))
    edges = np.array([[0, 1]])
    assert divided(points, up, np.full(3, 1e-4), edges, 1.5e-4).tolist() == [0, 0, 0]
    assert divided(points, up, np.full(3, 1e-4), edges, 0.5e-4).tolist() == [0, 0, 1]
    assert divided(points, up, np.full(3, 1e-4), edges, 1.0).tolist() == [0, 0, 0]
