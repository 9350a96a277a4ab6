from __future__ import annotations

import numpy as np

from bask_data.core.object_doubts import moves_with_camera, seen_share
from bask_data.core.objects import vertex_normals_and_areas
from bask_data.core.sightings import PosedDepth
from tests import scenes
from tests.meshes import block
from tests.scenes import Plane, Scene
from tests.single_view import HEIGHT, TABLE, WIDTH, K, box, single_view


def doubts_of(body, background=TABLE, **options):
    """The doubts of the instance that is most of a body, the last of a scene."""
    seen = single_view(Scene(body, (background,)))
    found = seen.split(**options)
    own = found.vertex_instance[seen.truth == len(body)]
    return found.instances[np.bincount(own[own > 0]).argmax() - 1].doubts


def test_a_box_on_the_table_is_not_doubted():
    assert doubts_of((box(0, 0, (0.1, 0.08, 0.1)),)) == ()


def test_a_box_above_the_table_does_not_stand_on_it():
    assert doubts_of((box(0.2, -0.1, (0.1, 0.08, 0.1)), box(-0.1, 0, (0.1, 0.08, 0.1), bottom=0.1))) == ("floating",)


def test_a_box_whose_foot_is_hidden_may_stand():
    assert doubts_of((box(0, -0.2, (0.3, 0.05, 0.1)), box(0, -0.08, (0.1, 0.05, 0.2)))) == ()


def test_an_arm_that_enters_from_the_border_is_cut_and_does_not_stand():
    arm = box(0.45, 0.0, (0.5, 0.06, 0.06), bottom=0.15)
    assert set(doubts_of((box(-0.1, 0, (0.1, 0.08, 0.1)), arm), Plane(extent=0.9))) == {"cut", "floating"}


def test_a_laptop_at_the_side_of_the_image_is_cut_unless_another_view_shows_it_whole():
    bodies, table = (box(-0.1, 0, (0.1, 0.08, 0.1)), box(0.5, 0, (0.3, 0.2, 0.05))), Plane(extent=0.9)
    assert doubts_of(bodies, table) == ("cut",)
    camera = scenes.look_at((0.5, -0.75, 0.45), (0.5, 0, 0))
    other = PosedDepth(Scene(bodies, (table,)).render(K, camera, HEIGHT, WIDTH).depth, K, camera)
    seen = single_view(Scene(bodies, (table,)))
    assert doubts_of(bodies, table, views=(seen.view, other)) == ()


def test_what_reaches_the_workspace_is_cut():
    body = (box(0, 0, (0.1, 0.08, 0.1)),)
    assert doubts_of(body, bounds=np.array([[-0.4, -0.4, -0.02], [0.052, 0.4, 0.4]])) == ("cut",)
    assert doubts_of(body, bounds=np.array([[-0.4, -0.4, 0.0], [0.4, 0.4, 0.4]])) == ()


def test_a_card_is_flat():
    assert doubts_of((box(-0.2, 0, (0.1, 0.08, 0.1)), box(0.1, 0, (0.15, 0.1, 0.008)))) == ("flat",)


def test_what_one_view_of_four_shows_moves_with_the_camera():
    body = box(0, 0, (0.1, 0.08, 0.1))
    cameras = scenes.orbit(4)

    def view(camera, bodies):
        return PosedDepth(Scene(bodies, (TABLE,)).render(K, camera, HEIGHT, WIDTH).depth, K, camera)

    points = np.random.default_rng(0).uniform(-0.04, 0.04, (200, 3))
    points[:, 2] = 0.1  # Its top, which all cameras see.
    once = [view(camera, (body,) if i == 0 else ()) for i, camera in enumerate(cameras)]
    assert moves_with_camera(points, once)
    assert not moves_with_camera(points, [view(camera, (body,)) for camera in cameras])


def test_share_seen_all_around_from_one_side_and_of_one_face():
    vertices, triangles = block(0, 0, (0.1, 0.06, 0.08), 0.004)
    normals, _ = vertex_normals_and_areas(vertices, triangles)
    plane = np.array([0.0, 0, 1, 0])

    def share(chosen):
        return seen_share(vertices[chosen], normals[chosen], plane, 0.01, np.random.default_rng(0))

    assert share(np.ones(len(vertices), bool)) > 0.97
    # The front, 0.1 x 0.08, and the top, 0.1 x 0.06, of a total of 0.0316 m2 without the underside.
    front_and_top = (vertices[:, 1] < 1e-6) | (vertices[:, 2] > 0.08 - 1e-6)
    assert abs(share(front_and_top) - 0.014 / 0.0316) < 0.12
    assert share(vertices[:, 1] < 1e-6) < 0.6
