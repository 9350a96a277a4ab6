from __future__ import annotations

import numpy as np

from bask_data.core.hidden_parts import is_inside, part_of
from tests.scenes import Plane, Scene
from tests.single_view import TABLE, TOWER, box, single_view


def instances_of(seen, found, body):
    """Instances of the vertices of a body, the most frequent first, with at least 20 vertices."""
    numbers, counts = np.unique(found.vertex_instance[seen.truth == body], return_counts=True)
    return [int(i) for i, n in zip(numbers, counts, strict=True) if i and n > 20]


def test_a_box_whose_middle_is_hidden_is_one_object():
    seen = single_view(Scene((TOWER, box(0.0, 0.05, (0.3, 0.08, 0.08))), (TABLE,)))
    found = seen.split()
    assert len(found.instances) == 2
    assert len(instances_of(seen, found, 2)) == 1
    assert instances_of(seen, found, 1) != instances_of(seen, found, 2)
    assert len(seen.split(with_view=False).instances) == 3


def test_two_boxes_behind_one_occluder_stay_two():
    for angle, shift, tall in ((0, 0.04, 0.08), (25, 0.0, 0.08), (0, 0.0, 0.12)):
        left, right = box(-0.11, 0.05, (0.1, 0.08, 0.08)), box(0.11, 0.05 + shift, (0.1, 0.08, tall), angle)
        found = single_view(Scene((TOWER, left, right), (TABLE,))).split()
        assert len(found.instances) == 3, (angle, shift, tall)


def test_boxes_in_a_row_with_the_table_seen_between_them_stay_two():
    left, right = box(-0.12, 0.05, (0.1, 0.08, 0.08)), box(0.02, 0.05, (0.1, 0.08, 0.08))
    assert len(single_view(Scene((left, right), (TABLE,))).split().instances) == 2


def test_parts_that_would_be_too_long_together_stay_apart():
    seen = single_view(Scene((TOWER, box(0.0, 0.05, (0.3, 0.08, 0.08))), (TABLE,)))
    assert len(seen.split(max_extent=0.25).instances) == 3


def shell(radius, angles_deg, inward):
    """A part of a vertical cylinder of 8 cm height, seen from inside or from outside."""
    angle, z = (
        axis.ravel() for axis in np.meshgrid(np.deg2rad(np.linspace(*angles_deg, 40)), np.linspace(0, 0.08, 20))
    )
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    points = radius * outward + np.stack([np.zeros_like(z), np.zeros_like(z), z], axis=1)
    return points, -outward if inward else outward


def test_the_inside_of_a_cup_belongs_to_its_outside():
    up = np.array([0.0, 0, 1])
    outside, inside = part_of(*shell(0.04, (180, 360), False)), part_of(*shell(0.04, (0, 180), True))
    assert is_inside(inside, outside, up, 0.04)
    assert not is_inside(outside, inside, up, 0.04)
    points, normals = shell(0.04, (0, 180), True)
    assert not is_inside(part_of(points + np.array([0, 0.05, 0]), normals), outside, up, 0.04)
    assert not is_inside(part_of(points + np.array([0, 0, 0.03]), normals), outside, up, 0.04)


def test_a_row_across_the_table_does_not_divide_the_support():
    row = [box(x, -0.05, (width, 0.08, 0.1)) for x, width in ((-0.3, 0.26), (0.0, 0.3), (0.3, 0.26))]
    far, near = box(0.1, 0.2, (0.06, 0.06, 0.08)), box(-0.1, -0.3, (0.06, 0.06, 0.05))
    seen = single_view(Scene((*row, far, near), (Plane(extent=0.4),)))
    found = seen.split(max_extent=0.9)
    assert all(instances_of(seen, found, body) for body in (4, 5))
    assert not found.warnings
    lost = seen.split(with_view=False, max_extent=0.9)
    assert not all(instances_of(seen, lost, body) for body in (4, 5))
