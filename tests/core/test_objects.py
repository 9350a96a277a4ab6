from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bask_data.core import creases, objects
from bask_data.core.geometry import transform
from tests.meshes import THREE, block, joined, sheet, table


def split(vertices, triangles, seed=0, **options):
    return objects.split_objects(
        vertices, triangles, np.random.default_rng(seed), objects.SplitSettings(**{"voxel_size": 0.004, **options})
    )


def test_every_object_is_found_and_numbered_by_its_surface():
    vertices, triangles, truth = table(THREE)
    result = split(vertices, triangles)
    assert [round(one.area, 4) for one in result.instances] == pytest.approx([0.0316, 0.0208, 0.0125], abs=0.0015)
    expected = np.array([0, 1, 3, 2])[truth]
    assert (result.vertex_instance == expected).mean() > 0.995
    np.testing.assert_allclose(result.background.support.plane, [0, 0, 1, 0], atol=1e-4)
    np.testing.assert_allclose(result.instances[0].extents, (0.10, 0.06, 0.08), atol=0.005)
    np.testing.assert_allclose(result.instances[0].centroid[:2], (-0.15, -0.07), atol=1e-3)
    assert result.instances[0].n_vertices == (result.vertex_instance == 1).sum()
    assert result.warnings == ()


def test_the_lowest_centimetre_belongs_to_the_object():
    vertices, triangles, truth = table(THREE, step=0.002)
    result = split(vertices, triangles, voxel_size=0.004)
    low = (truth > 0) & (vertices[:, 2] < 0.01) & (vertices[:, 2] > 0)
    assert (result.vertex_instance[low] > 0).all()
    assert (result.vertex_instance[truth == 0] == 0).all()


def test_without_its_feet_an_object_ends_at_the_cut():
    vertices, triangles, truth = table(THREE, step=0.002)
    result = split(vertices, triangles, above=(0.01, 1.0))
    below = (truth > 0) & (vertices[:, 2] > 0) & (vertices[:, 2] < 0.01)
    feet = np.flatnonzero(below)
    assert (result.vertex_instance[feet] > 0).all()
    # The same vertices are lost when the mesh does not join them to the object.
    z = vertices[triangles][:, :, 2]
    loose = triangles[~((z > 0.009).any(axis=1) & (z < 0.011).any(axis=1))]
    assert (split(vertices, loose, above=(0.01, 1.0)).vertex_instance[feet] == 0).mean() > 0.9


def test_bumps_of_the_table_beside_an_object_are_table():
    vertices, triangles, truth = table(THREE, step=0.004)
    # Small bumps, within eps of the first block and higher than the cut.
    bump = (truth == 0) & (np.abs(vertices[:, 0] + 0.15) < 0.008) & (np.abs(vertices[:, 1] + 0.115) < 0.005)
    assert bump.any()
    vertices[bump, 2] = 0.0055
    result = split(vertices, triangles)
    assert (result.vertex_instance[bump] == 0).all()
    assert len(result.instances) == 3


def test_a_thin_flat_object_is_an_object():
    vertices, triangles, truth = table([*THREE, (-0.25, 0.1, (0.12, 0.09, 0.008))], step=0.002)
    result = split(vertices, triangles)
    assert len(result.instances) == 4
    flat = result.vertex_instance[truth == 4]
    assert (flat == np.bincount(flat).argmax()).mean() > 0.98
    assert np.bincount(flat).argmax() > 0


def test_noise_of_the_table_is_no_object():
    vertices, triangles, _ = table(THREE, noise=0.0015)
    result = split(vertices, triangles)
    assert len(result.instances) == 3
    assert result.background.support.noise == pytest.approx(0.0015, rel=0.1)
    assert result.background.low == pytest.approx(4 * result.background.support.noise)


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_rigid_motion_changes_nothing(seed):
    from scipy.spatial.transform import Rotation

    vertices, triangles, truth = table(THREE)
    moved_from_world = np.eye(4)
    moved_from_world[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    moved_from_world[:3, 3] = np.random.default_rng(seed).normal(size=3)
    moved = transform(moved_from_world, vertices.astype(float)).astype(np.float32)
    result = split(moved, triangles, seed=seed % 1000)
    assert (result.vertex_instance == np.array([0, 1, 3, 2])[truth]).mean() > 0.99
    assert moved_from_world[:3, 2] @ result.background.support.plane[:3] > 0.99999


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_permuting_the_vertices_permutes_the_labels(seed):
    vertices, triangles, _ = table(THREE)
    order = np.random.default_rng(seed).permutation(len(vertices))
    place = np.argsort(order).astype(np.int32)
    plane = np.array([0.0, 0, 1, 0])
    original = split(vertices, triangles, plane=plane).vertex_instance
    permuted = split(vertices[order], place[triangles], plane=plane).vertex_instance
    np.testing.assert_array_equal(original[order], permuted)


@pytest.mark.parametrize("step", [0.002, 0.004, 0.006])
def test_the_count_does_not_depend_on_how_finely_the_surface_is_sampled(step):
    vertices, triangles, _ = table([*THREE, (-0.1, -0.25, (0.03, 0.03, 0.02))], step=step)
    assert len(split(vertices, triangles, voxel_size=step).instances) == 4


def test_a_given_plane_is_kept_and_bounds_nothing_but_below():
    vertices, triangles, truth = table(THREE)
    # Only the objects, as when a shiny floor is not seen at all.
    triangles = triangles[(truth[triangles] > 0).all(axis=1)]
    result = split(vertices, triangles, plane=np.array([0.0, 0, 2.0, -0.02]))
    np.testing.assert_array_equal(result.background.support.plane, [0, 0, 1, -0.01])
    assert len(result.instances) == 3
    assert split(vertices, triangles, support="none").background.support is None
    assert len(split(vertices, triangles, support="none").instances) == 3


def test_without_a_plane_the_table_joins_what_stands_on_it():
    vertices, triangles, _ = table(THREE)
    [only] = split(vertices, triangles, support="none", max_extent=1.0).instances
    assert only.n_vertices == len(vertices)


def test_too_small_and_too_large_clusters_are_counted_background():
    vertices, triangles, truth = table([*THREE, (-0.3, 0.2, (0.35, 0.02, 0.02)), (0.2, 0.2, (0.012, 0.012, 0.012))])
    result = split(vertices, triangles, max_extent=0.3)
    assert (result.n_too_small, result.n_too_large, len(result.instances)) == (1, 1, 3)
    assert (result.vertex_instance[truth >= 4] == 0).all()


def test_what_is_beside_the_table_or_far_above_it_is_background():
    vertices, triangles, truth = table(
        [
            *THREE,
            (0.45, 0.0, (0.1, 0.1, 0.1)),
            (
                0.1,
                0.15,
                (0.1, 0.1, 0.1),
            ),
        ]
    )
    hanging = truth == 5
    vertices[hanging, 2] += 0.8
    result = split(vertices, triangles, above=(0.004, 0.6))
    assert (result.vertex_instance[(truth == 4) | hanging] == 0).all()
    assert len(result.instances) == 3


def test_more_surface_beside_the_seen_table_than_on_it_is_told_with_a_margin_that_finds_it():
    beside = (0.45, 0.0, (0.2, 0.2, 0.2))
    vertices, triangles, _ = table([(0.0, 0.0, (0.06, 0.06, 0.06)), beside])
    result = split(vertices, triangles)
    assert len(result.instances) == 1 and "pass --margin 0.3" in " ".join(result.warnings)
    wider = split(vertices, triangles, margin=0.3)
    assert len(wider.instances) == 2 and not any("--margin" in text for text in wider.warnings)


def test_no_more_than_255_instances():
    row = [block(0.03 * i, 0.03 * j, (0.01, 0.01, 0.01), 0.01) for i in range(20) for j in range(14)]
    small_vertices, small_triangles, _ = joined(row)
    result = split(small_vertices, small_triangles, support="none", eps=0.015, max_extent=9.0, min_area=1e-5)
    assert (len(result.instances), result.n_too_many) == (255, 25)
    assert result.vertex_instance.max() == 255


def test_equal_objects_are_numbered_by_where_they_are():
    same = (0.05, 0.05, 0.05)
    vertices, triangles, _ = table([(0.2, 0.1, same), (-0.2, 0.1, same), (-0.2, -0.15, same)], step=0.005)
    result = split(vertices, triangles, plane=np.array([0.0, 0, 1, 0]))
    centroids = [one.centroid[:2] for one in result.instances]
    np.testing.assert_allclose(centroids, [(-0.175, -0.125), (-0.175, 0.125), (0.225, 0.125)], atol=1e-3)


def test_an_empty_table_has_no_objects_and_an_empty_mesh_no_plane():
    vertices, triangles, _ = table([])
    result = split(vertices, triangles)
    assert result.instances == ()
    assert not result.vertex_instance.any()
    nothing = split(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    assert nothing.background.support is None
    assert "no support plane was found" in nothing.warnings[0]


def test_a_rival_plane_is_reported():
    floor = sheet((-0.3, -0.3, 0), (0.6, 0, 0), (0, 0.6, 0), 0.006)
    wall = sheet((0.3, -0.3, 0), (0, 0.6, 0), (-1e-9, 0, 0.5), 0.006)
    vertices, triangles, _ = joined([floor, (wall[0], wall[1][:, ::-1])])
    result = split(vertices, triangles)
    np.testing.assert_allclose(result.background.support.plane, [0, 0, 1, 0], atol=1e-3)
    assert "a second plane, [-1.0, " in result.warnings[0]
    assert split(vertices, triangles, up=np.array([0.0, 0, 1])).warnings == ()


def test_same_seed_same_labels():
    vertices, triangles, _ = table(THREE, noise=0.001)
    one, two = split(vertices, triangles, seed=3), split(vertices, triangles, seed=3)
    np.testing.assert_array_equal(one.vertex_instance, two.vertex_instance)
    np.testing.assert_array_equal(one.background.support.plane, two.background.support.plane)


@pytest.mark.parametrize("options", [{"voxel_size": 0.0}, {"eps": 0.0}])
def test_sizes_that_are_not_positive_are_refused(options):
    with pytest.raises(ValueError, match="voxel_size and eps must be > 0 metres"):
        split(*table([])[:2], **options)


def test_a_plane_without_a_normal_is_refused():
    with pytest.raises(ValueError, match="normal must not be zero"):
        split(*table([])[:2], plane=np.zeros(4))


def test_vertex_areas_sum_to_the_surface_and_normals_face_the_seen_side():
    vertices, triangles, _ = joined([block(0, 0, (0.1, 0.2, 0.05), 0.01)])
    stray = np.concatenate([vertices, np.float32([[9, 9, 9]])])
    normals, areas = objects.vertex_normals_and_areas(stray, triangles)
    assert areas.sum() == pytest.approx(0.1 * 0.2 + 2 * 0.05 * (0.1 + 0.2))
    top = (vertices[:, 2] > 0.049) & (np.abs(vertices[:, 0] - 0.05) < 0.03) & (np.abs(vertices[:, 1] - 0.1) < 0.05)
    np.testing.assert_allclose(normals[:-1][top], np.tile([0, 0, 1], (top.sum(), 1)), atol=1e-6)
    assert not normals[-1].any()
    assert areas[-1] == 0


def test_objects_that_touch_are_far_from_convex_and_a_box_is_not():
    # A low block and a tower that touches it become one; the third stands alone.
    blocks = [(-0.22, -0.1, (0.12, 0.12, 0.03)), (-0.1, -0.1, (0.05, 0.12, 0.15)), (0.1, 0.0, (0.08, 0.08, 0.1))]
    result = split(*table(blocks)[:2])
    joined_share, alone_share = (one.concave_share for one in result.instances)
    assert joined_share > creases.CONCAVE_SHARE
    assert alone_share == 0
    assert creases.concave_share(np.zeros((9, 3)), np.ones(9)) == 0


def test_pairs_within_reach_are_neighbours_with_their_gap():
    blocks = [(-0.2, 0.0, (0.05, 0.05, 0.05)), (-0.125, 0.0, (0.05, 0.05, 0.06)), (0.0, 0.0, (0.05, 0.05, 0.07))]
    result = split(*table(blocks)[:2], eps=0.02)
    # Numbered by surface: the one in the middle is 2.5 cm from the small one and 7.5 cm from the large one.
    [pair] = result.neighbours
    assert (pair.a, pair.b) == (2, 3)
    assert pair.gap == pytest.approx(0.025, abs=1e-4)
    assert split(*table(blocks)[:2], eps=0.012).neighbours == ()


def test_a_support_that_nothing_stands_on_is_told():
    vertices, triangles, truth = table(THREE)
    vertices[truth > 0, 2] += 0.1
    floating = triangles[(truth[triangles] > 0).all(axis=1) | (truth[triangles] == 0).all(axis=1)]
    result = split(vertices, floating)
    assert result.warnings == (
        "nothing stands on the support found: the lowest object begins 10 cm above it; give `plane` or `up`",
    )
