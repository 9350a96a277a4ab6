from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.background import BackgroundSettings, MeshVertices, find_background, is_another
from bask_data.core.objects import vertex_normals_and_areas
from bask_data.core.planes import Plane
from tests.meshes import THREE, block, joined, sheet, table

HEIGHT = 0.25


def background(parts, **options):
    """The background of a mesh of several parts, and the part each vertex came from."""
    vertices, triangles, source = joined([part[:2] for part in parts])
    surface = MeshVertices(vertices, *vertex_normals_and_areas(vertices, triangles))
    found = find_background(surface, np.random.default_rng(0), BackgroundSettings(**{"voxel_size": 0.004, **options}))
    return found, vertices, source


def bin_with(blocks, turn, step=0.004):
    """A bin of 0.4 x 0.3 m, open at -x and above, in which blocks stand; and the number of its parts."""
    walls = [
        # The floor goes on a little behind the walls, or it alone would bound the scene.
        sheet((0, -0.01, 0), (0.41, 0, 0), (0, 0.32, 0), step),
        sheet((0.4, 0, 0), (0, 0, HEIGHT), (0, 0.3, 0), step),
        sheet((0, 0, 0), (0, 0, HEIGHT), (0.4, 0, 0), step),
        sheet((0, 0.3, 0), (0.4, 0, 0), (0, 0, HEIGHT), step),
    ]
    parts = [*walls, *(block(*one, step) for one in blocks)]
    return [(part[0] @ turn.T, part[1]) for part in parts], len(walls)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0])
def test_walls_of_a_bin_are_background_and_what_stands_in_it_is_not(angle):
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    # One block in a corner, its back 6 mm from two walls; one as long as half the bin.
    blocks = [(0.294, 0.194, (0.10, 0.10, 0.12)), (0.1, 0.08, (0.2, 0.05, 0.2))]
    parts, n_walls = bin_with(blocks, turn)
    found, vertices, source = background(parts, guess_up=np.array([0, 0, 1.0]))
    np.testing.assert_allclose(found.support.plane, [0, 0, 1, 0], atol=1e-3)
    assert len(found.structure) == 3
    facing = sorted((turn.T @ one.plane[:3]).round(2).tolist() for one in found.structure)
    np.testing.assert_allclose(facing, [[-1, 0, 0], [0, -1, 0], [0, 1, 0]], atol=0.02)
    high = vertices[:, 2] > 0.01
    assert found.foreground[high & (source >= n_walls)].mean() > 0.99
    assert found.foreground[high & (source < n_walls)].mean() < 0.01
    kept = background(parts, guess_up=np.array([0, 0, 1.0]), support="plane")[0]
    assert kept.structure == ()
    assert kept.foreground[high & (source < n_walls)].mean() > 0.5


@pytest.mark.parametrize(
    ("size", "where"),
    [
        ((0.30, 0.06, 0.25), (-0.15, 0.0)),  # A cereal box in the middle.
        ((0.45, 0.05, 0.20), (-0.22, 0.24)),  # Wider, and at the far edge.
        ((0.55, 0.40, 0.30), (-0.27, -0.2)),  # As large as a microwave: the table is behind it.
    ],
)
def test_the_sides_of_a_box_are_no_walls(size, where):
    vertices, triangles, source = table([(*where, size)])
    surface = MeshVertices(vertices, *vertex_normals_and_areas(vertices, triangles))
    found = find_background(surface, np.random.default_rng(0), BackgroundSettings(voxel_size=0.004))
    assert found.structure == ()
    assert found.foreground[(source == 1) & (vertices[:, 2] > 0.005)].all()


def test_a_shelf_above_the_table_is_structure_when_longer_than_an_object_may_be():
    shelf = sheet((-0.34, 0.0, 0.2), (0.68, 0, 0), (0, 0.2, 0), 0.004)
    parts = [table(THREE)[:2], shelf, block(-0.1, 0.05, (0.06, 0.06, 0.06), 0.004, bottom=0.2)]
    found, vertices, source = background(parts)
    [one] = found.structure
    np.testing.assert_allclose(one.plane, [0, 0, 1, -0.2], atol=1e-3)
    assert not found.foreground[source == 1].any()
    assert found.foreground[(source == 2) & (vertices[:, 2] > 0.205)].all()
    assert background(parts, max_extent=0.8)[0].structure == ()


def test_the_top_of_a_crate_is_no_support_although_more_of_it_is_seen_than_of_the_table():
    crate = block(-0.3, -0.2, (0.6, 0.4, 0.2), 0.005)
    floor = sheet((-0.4, -0.3, 0), (0.8, 0, 0), (0, 0.1, 0), 0.005)
    found = background([crate, floor], guess_up=np.array([0, 0, 1.0]))[0]
    np.testing.assert_allclose(found.support.plane, [0, 0, 1, 0], atol=1e-3)
    # Without the floor there is no better plane, and it is said what is wrong with the top.
    alone = background([crate], guess_up=np.array([0, 0, 1.0]))[0]
    assert alone.warnings[0].startswith("below the support found, [0.0, 0.0, 1.0, -0.2], lie 0.")
    assert alone.warnings[0].endswith("m2 of surface: it may be the top of an object or a shelf; give `plane` or `up`")


def test_a_support_as_small_as_the_face_of_an_object_is_doubted():
    found = background([sheet((0, 0, 0), (0.12, 0, 0), (0, 0.08, 0), 0.004)])[0]
    assert found.warnings == (
        "the support found is only 12 cm long: it may be the face of an object; give `plane` or `up`, or a larger "
        "workspace",
    )


def test_a_range_of_heights_replaces_the_cut_and_the_ceiling():
    parts = [table(THREE)[:2]]
    found, vertices, _ = background(parts, above=(0.04, 0.07))
    np.testing.assert_array_equal(found.foreground, (vertices[:, 2] > 0.04) & (vertices[:, 2] < 0.07))
    assert found.low == 0.04
    # What is just above the table may be a foot even then; what is between that and the range may not.
    assert found.feet.any()
    assert vertices[found.feet, 2].max() <= 0.03


def test_without_a_support_everything_with_a_surface_is_foreground():
    vertices, triangles, _ = table(THREE)
    stray = np.concatenate([vertices, np.float32([[9, 9, 9]])])
    surface = MeshVertices(stray, *vertex_normals_and_areas(stray, triangles))
    found = find_background(surface, np.random.default_rng(0), BackgroundSettings(voxel_size=0.004, support="none"))
    assert found.foreground[:-1].all()
    assert not found.foreground[-1]
    assert found.support is None


def test_a_tilted_plane_through_a_table_is_the_same_table_and_a_level_shelf_is_another():
    shelf = sheet((-0.34, 0.0, 0.2), (0.68, 0, 0), (0, 0.2, 0), 0.004)
    vertices, triangles, _ = joined([table([])[:2], shelf])
    surface = MeshVertices(vertices, *vertex_normals_and_areas(vertices, triangles))
    best, tilted, level = (
        Plane(np.array(one, float), 0.0, 0.1) for one in ([0, 0, 1, 0], [0.03, 0, 0.9996, 0], [0, 0, 1, -0.2])
    )
    assert not is_another(tilted, best, surface, 0.01)
    assert is_another(level, best, surface, 0.01)


def test_noise_of_a_bad_sensor_is_neither_an_object_nor_a_step():
    vertices, triangles, source = table(THREE, noise=0.006)
    surface = MeshVertices(vertices, *vertex_normals_and_areas(vertices, triangles))
    found = find_background(surface, np.random.default_rng(0), BackgroundSettings(voxel_size=0.004))
    assert found.structure == ()
    assert 0.015 < found.low <= 0.025
    assert found.foreground[source == 0].mean() < 0.005
    assert found.foreground[(source > 0) & (vertices[:, 2] > 0.03)].all()


def test_a_support_that_faces_level_cameras_is_doubted_unless_up_is_told():
    wall = sheet((0, 0, 0), (0.5, 0, 0), (0, 0, 0.5), 0.005)
    guess_up = np.array([0.0, -0.447, 0.894])
    [told] = background([wall], guess_up=guess_up)[0].warnings
    assert told.startswith("the support found, [0.0, -1.0, 0.0, 0.0], faces the cameras more than up: right if they")
    assert background([wall], guess_up=guess_up, up=np.array([0, -1.0, 0]))[0].warnings == ()
