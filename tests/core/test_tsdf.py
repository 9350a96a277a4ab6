from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from bask_data.core.depth import cleaned
from bask_data.core.tsdf import (
    BLOCK_BYTES,
    BLOCK_RESOLUTION,
    ROOM,
    Mesh,
    Volume,
    VolumeTooLarge,
    blocks_inside,
    canonical,
    coarsening,
    distinct_views,
    expected_blocks,
    peak_bytes,
    room_for,
    touched_blocks,
)
from tests.scenes import Box, Plane, Scene, Sphere, intrinsics, look_at, noisy, orbit

HEIGHT, WIDTH = 120, 160
K = intrinsics(HEIGHT, WIDTH)
SCENE = Scene(
    (Sphere((0.0, 0.0, 0.05), 0.05), Box((0.03, 0.04, 0.02), look_at((0.12, 0.05, 0.02)))), (Plane(extent=0.3),)
)
BOUNDS = np.array([[-0.2, -0.2, -0.02], [0.2, 0.2, 0.15]])
VOXEL = 0.005


def fused(
    scene: Scene = SCENE,
    n_views: int = 12,
    sigma: float = 0.0,
    bounds: np.ndarray | None = BOUNDS,
    min_views: int = 3,
    world_from_world: np.ndarray | None = None,
) -> Mesh:
    volume = Volume(VOXEL, bounds=bounds)
    rng = np.random.default_rng(0)
    moved = np.eye(4) if world_from_world is None else world_from_world
    for world_from_camera in orbit(n_views, radius=0.5):
        view = scene.render(K, world_from_camera, HEIGHT, WIDTH)
        assert volume.integrate(noisy(view.depth, sigma, rng), view.rgb, K, moved @ world_from_camera)
    return volume.mesh(min_views)


def areas(mesh: Mesh) -> np.ndarray:
    corners = mesh.vertices[mesh.triangles].astype(float)
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def test_surface_lies_within_a_tenth_of_a_voxel_of_the_truth() -> None:
    # Half a pixel of shift in the camera model alone would cost 2 mm here, which is four times this bound.
    error = SCENE.surface_distance(fused().vertices.astype(float))
    assert np.median(error) < 0.1 * VOXEL
    assert np.percentile(error, 95) < VOXEL


def test_noise_of_a_millimetre_leaves_the_median_below_half_a_voxel() -> None:
    assert np.median(SCENE.surface_distance(fused(sigma=0.001).vertices.astype(float))) < 0.5 * VOXEL


def test_whole_surface_is_there_and_faces_outwards() -> None:
    mesh = fused(Scene((Sphere((0.0, 0.0, 0.0), 0.08),), (Plane(extent=0.3),)))
    upper = mesh.vertices[:, 2] > 0.02
    triangles = mesh.triangles[upper[mesh.triangles].all(axis=1)]
    cap = Mesh(mesh.vertices, triangles, mesh.colors)
    assert areas(cap).sum() == pytest.approx(2 * np.pi * 0.08 * 0.06, rel=0.05), "area of the cap above 2 cm"
    corners = mesh.vertices[triangles].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", normals, corners.mean(axis=1)) > 0).mean() > 0.99


def test_a_table_at_height_zero_is_not_doubled_by_the_lattice() -> None:
    mesh = fused(Scene((), (Plane(),)), bounds=np.array([[-0.1, -0.1, -0.02], [0.1, 0.1, 0.02]]))
    assert len(mesh.vertices) < 1.2 * (0.2 / VOXEL) ** 2


def test_colours_are_those_of_the_surface() -> None:
    plain = Scene((Sphere((0.0, 0.0, 0.0), 0.1),), ())
    volume = Volume(VOXEL)
    for world_from_camera in orbit(6, radius=0.5):
        view = plain.render(K, world_from_camera, HEIGHT, WIDTH)
        volume.integrate(view.depth, np.full_like(view.rgb, (200, 100, 50)), K, world_from_camera)
    assert np.array_equal(np.unique(volume.mesh().colors, axis=0), [[200, 100, 50]])


def test_mesh_ends_at_the_bounds() -> None:
    mesh = fused()
    assert (mesh.vertices >= BOUNDS[0].astype(np.float32)).all()
    assert (mesh.vertices <= BOUNDS[1].astype(np.float32)).all()
    table = mesh.vertices[np.abs(mesh.vertices[:, 2]) < 0.002]
    assert table[:, 0].max() > BOUNDS[1, 0] - 2 * VOXEL, "and not before"


def test_moving_world_and_cameras_moves_the_mesh() -> None:
    shift = np.eye(4)
    shift[:3, 3] = np.array([4, -7, 2]) * VOXEL * BLOCK_RESOLUTION
    moved = fused(bounds=BOUNDS + shift[:3, 3], world_from_world=shift)
    here = fused()
    assert abs(len(moved.vertices) - len(here.vertices)) < 0.002 * len(here.vertices)
    error = SCENE.surface_distance(moved.vertices.astype(float) - shift[:3, 3])
    assert np.median(error) < 0.1 * VOXEL


def test_one_or_two_views_give_a_surface_but_among_many_a_single_sighting_does_not_count() -> None:
    assert len(fused(n_views=1).vertices) > 1000
    assert len(fused(n_views=2).vertices) > 1000
    volume = Volume(VOXEL, bounds=BOUNDS)
    for i_view, world_from_camera in enumerate(orbit(20, radius=0.5)):
        ghost = (Sphere((-0.1, -0.1, 0.1), 0.03),) if i_view == 4 else ()
        view = Scene(SCENE.objects + ghost, SCENE.background).render(K, world_from_camera, HEIGHT, WIDTH)
        volume.integrate(view.depth, view.rgb, K, world_from_camera)
    assert volume.mesh().vertices[:, 2].max() < 0.11
    assert volume.mesh(min_views=1).vertices[:, 2].max() > 0.12


def test_a_frame_without_depth_is_counted_out_and_changes_nothing() -> None:
    volume, plain = Volume(VOXEL, bounds=BOUNDS), Volume(VOXEL, bounds=BOUNDS)
    for world_from_camera in orbit(4, radius=0.5):
        view = SCENE.render(K, world_from_camera, HEIGHT, WIDTH)
        assert not volume.integrate(np.zeros_like(view.depth), view.rgb, K, world_from_camera)
        assert volume.integrate(view.depth, view.rgb, K, world_from_camera)
        plain.integrate(view.depth, view.rgb, K, world_from_camera)
    assert volume.n_integrated == 4
    assert volume.mesh().vertices.tobytes() == plain.mesh().vertices.tobytes()


def test_a_frame_that_sees_nothing_of_the_workspace_adds_nothing() -> None:
    volume = Volume(VOXEL, bounds=np.array([[5.0, 5, 5], [6, 6, 6]]))
    view = SCENE.render(K, orbit(1)[0], HEIGHT, WIDTH)
    assert not volume.integrate(view.depth, view.rgb, K, orbit(1)[0])
    assert len(volume.mesh().triangles) == 0


def test_a_volume_without_frames_has_an_empty_mesh() -> None:
    mesh = Volume(VOXEL).mesh()
    assert mesh.vertices.shape == (0, 3)
    assert mesh.triangles.shape == (0, 3)


def test_a_volume_grows_beyond_the_blocks_expected() -> None:
    volume = Volume(VOXEL, n_blocks=4)
    view = SCENE.render(K, orbit(1)[0], HEIGHT, WIDTH)
    volume.integrate(view.depth, view.rgb, K, orbit(1)[0])
    assert volume.n_blocks > 100
    assert len(volume.mesh().triangles) > 1000


PRINT_DIGEST = """
import hashlib
from tests.core.test_tsdf import fused
mesh = fused(sigma=0.001, n_views=5)
print(hashlib.sha256(mesh.vertices.tobytes() + mesh.triangles.tobytes() + mesh.colors.tobytes()).hexdigest())
"""


def test_bytes_do_not_depend_on_the_number_of_threads() -> None:
    digests = set()
    for n_threads in ("1", "2", "3"):
        run = subprocess.run(
            [sys.executable, "-c", PRINT_DIGEST],
            env={"OMP_NUM_THREADS": n_threads, "PYTHONPATH": ":".join(sys.path)},
            capture_output=True,
            text=True,
            check=True,
        )
        digests.add(run.stdout.split()[-1])
    assert len(digests) == 1


def test_canonical_order_undoes_any_shuffle_of_vertices_and_triangles() -> None:
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(50, 3)).astype(np.float32)
    triangles = np.stack([rng.permutation(50)[:3] for _ in range(80)])
    colors = rng.random((50, 3))
    shuffle = rng.permutation(50)
    turned = np.stack([np.roll(row, rng.integers(3)) for row in np.argsort(shuffle)[triangles]])
    one = canonical(vertices, triangles, colors)
    other = canonical(vertices[shuffle], rng.permutation(turned), colors[shuffle])
    for name in ("vertices", "triangles", "colors"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
    corners = one.vertices[one.triangles].reshape(-1, 9)
    expected = np.concatenate([np.roll(vertices[triangles], turn, axis=1).reshape(-1, 9) for turn in range(3)])
    assert set(map(bytes, corners)) <= set(map(bytes, expected)), "no triangle changes shape or winding"
    assert len(corners) == 80


def test_canonical_joins_vertices_at_one_place_and_drops_what_has_no_area_or_use() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, 0], [9, 9, 9]], np.float32)
    mesh = canonical(vertices, np.array([[0, 1, 2], [3, 1, 0]]), np.zeros((5, 3)))
    assert len(mesh.vertices) == 3
    assert len(mesh.triangles) == 1


def test_views_are_thinned_by_distance_or_by_angle() -> None:
    along_x = np.stack([np.eye(4)] * 10)
    along_x[:, 0, 3] = np.arange(10) * 0.03
    assert distinct_views(along_x, 0.0, 0.0).tolist() == list(range(10))
    assert distinct_views(along_x, 0.05, 0.0).tolist() == [0, 2, 4, 6, 8]
    assert distinct_views(along_x, 0.0, 0.1).tolist() == [0]
    turning = np.stack(
        [look_at((0, 0, 0), (np.cos(angle), np.sin(angle), 0)) for angle in np.deg2rad(np.arange(0, 50, 5))]
    )
    assert distinct_views(turning, 0.05, np.deg2rad(9.9)).tolist() == [0, 2, 4, 6, 8]
    assert distinct_views(along_x[:0], 0.05, 0.0).tolist() == []


def touched_by(cameras: np.ndarray, voxel_size: float = VOXEL) -> list[np.ndarray]:
    """Blocks inside the bounds that each camera's noisy view touches."""
    found = []
    for i_view, camera in enumerate(cameras):
        rng = np.random.default_rng(i_view)
        depth = cleaned(noisy(SCENE.render(K, camera, HEIGHT, WIDTH).depth, 0.001, rng), 0.1, 2.0)
        blocks = touched_blocks(depth, K, camera, voxel_size)
        found.append(blocks[blocks_inside(blocks, voxel_size, BOUNDS)])
    return found


def test_touched_blocks_are_those_that_fusing_fills() -> None:
    volume, camera = Volume(VOXEL, bounds=BOUNDS), orbit(1)[0]
    view = SCENE.render(K, camera, HEIGHT, WIDTH)
    volume.integrate(view.depth, view.rgb, K, camera)
    touched = touched_blocks(view.depth, K, camera, VOXEL)
    assert blocks_inside(touched, VOXEL, BOUNDS).sum() == volume.n_blocks
    assert len(touched) > volume.n_blocks, "the table goes on beyond the bounds"
    assert len(touched_blocks(np.zeros_like(view.depth), K, camera, VOXEL)) == 0


def test_expected_blocks_are_exact_when_every_frame_is_looked_at() -> None:
    touched = touched_by(orbit(6, radius=0.5))
    n_blocks = len(np.unique(np.concatenate(touched), axis=0))
    assert expected_blocks(touched, 6) == n_blocks
    assert expected_blocks([], 6) == 0
    assert expected_blocks(touched[:1] * 5, 60) == n_blocks_of(touched[:1]), "frames that agree leave nothing unseen"


def n_blocks_of(touched: list[np.ndarray]) -> int:
    return len(np.unique(np.concatenate(touched), axis=0))


@pytest.mark.parametrize("voxel_size", [0.005, 0.002])
def test_a_few_of_many_frames_tell_the_blocks_of_all(voxel_size: float) -> None:
    touched = touched_by(orbit(60, radius=0.5), voxel_size)
    expected = expected_blocks(touched[::5], 60)
    assert n_blocks_of(touched[::5]) < n_blocks_of(touched)
    assert ROOM * expected >= n_blocks_of(touched), "there is room for all"
    assert expected < 1.25 * n_blocks_of(touched)


def test_coarser_voxels_need_the_blocks_foreseen() -> None:
    fine = np.unique(np.concatenate(touched_by(orbit(6, radius=0.5), 0.003)), axis=0)
    for factor in (1.3, 2.0, 3.0):
        n_coarse = n_blocks_of(touched_by(orbit(6, radius=0.5), 0.003 * factor))
        assert 0.95 * n_coarse < coarsening(fine, factor) * len(fine) < 1.5 * n_coarse, "rather too many"
    assert coarsening(fine[:0], 2.0) == 1.0


def test_a_volume_with_room_for_the_expected_blocks_does_not_grow() -> None:
    cameras = orbit(30, radius=0.5)
    volume = Volume(VOXEL, bounds=BOUNDS, n_blocks=expected_blocks(touched_by(cameras[::3]), 30))
    small = Volume(VOXEL, bounds=BOUNDS, n_blocks=10)
    for camera in cameras:
        view = SCENE.render(K, camera, HEIGHT, WIDTH)
        volume.integrate(view.depth, view.rgb, K, camera)
        small.integrate(view.depth, view.rgb, K, camera)
    assert volume.n_grown == 0
    assert volume.capacity == room_for(expected_blocks(touched_by(cameras[::3]), 30)), "nor does Open3D grow it"
    assert small.capacity < 2 * volume.capacity
    assert 0 < small.n_grown < 12, "it grows by a share, not by a step"
    assert small.mesh().vertices.tobytes() == volume.mesh().vertices.tobytes()


def test_a_volume_grows_to_its_limit_and_not_beyond() -> None:
    # The last sees more than those before it: the others look at the table from close by.
    cameras = [look_at((0.0, 0.0, 0.25)), look_at((0.05, 0.0, 0.25), (0.05, 0.0, 0.0)), look_at((0.3, 0.0, 0.4))]
    views = [(SCENE.render(K, camera, HEIGHT, WIDTH), camera) for camera in cameras]
    free = Volume(VOXEL, bounds=BOUNDS)
    for view, camera in views:
        free.integrate(view.depth, view.rgb, K, camera)
    exact = Volume(VOXEL, bounds=BOUNDS, n_blocks=10, max_blocks=free.n_blocks)
    tight = Volume(VOXEL, bounds=BOUNDS, n_blocks=10, max_blocks=free.n_blocks - 1)
    for view, camera in views:
        exact.integrate(view.depth, view.rgb, K, camera)
    assert exact.n_blocks == free.n_blocks
    assert exact.capacity == room_for(free.n_blocks)
    last, camera = views[-1]
    for view, earlier in views[:-1]:
        tight.integrate(view.depth, view.rgb, K, earlier)
    with pytest.raises(VolumeTooLarge, match=f"^{free.n_blocks} voxel blocks$") as error:
        tight.integrate(last.depth, last.rgb, K, camera)
    assert error.value.n_needed == free.n_blocks
    assert tight.n_blocks < free.n_blocks


def test_peak_memory_is_that_of_the_volume_and_of_what_the_mesh_is_made_with() -> None:
    assert peak_bytes(1000) > 1000 * (ROOM * BLOCK_BYTES + BLOCK_RESOLUTION**3 * 16)
    assert peak_bytes(1000) == 1000 * peak_bytes(1)


def test_a_released_volume_is_empty() -> None:
    volume, view = Volume(VOXEL, bounds=BOUNDS), SCENE.render(K, orbit(1)[0], HEIGHT, WIDTH)
    volume.integrate(view.depth, view.rgb, K, orbit(1)[0])
    kept = volume.mesh()
    assert volume.mesh(release=True).vertices.tobytes() == kept.vertices.tobytes()
    assert volume.n_blocks == 0


def test_wrong_arguments_are_refused_in_words() -> None:
    with pytest.raises(ValueError, match="voxel_size: expected > 0 metres, got -1"):
        Volume(-1.0)
    with pytest.raises(ValueError, match="truncation_voxels: expected at least 1 voxel, got 0.5"):
        Volume(VOXEL, truncation_voxels=0.5)
    with pytest.raises(ValueError, match="bounds: expected lowest below highest corner"):
        Volume(VOXEL, bounds=BOUNDS[::-1].copy())
    with pytest.raises(ValueError, match="view change: expected limits >= 0, got -1"):
        distinct_views(orbit(2), -1.0, 0.0)


def test_frames_open3d_would_take_without_a_word_are_refused() -> None:
    view = SCENE.render(K, orbit(1)[0], HEIGHT, WIDTH)
    mirrored = orbit(1)[0] @ np.diag([-1.0, 1, 1, 1])
    for wrong, why in (
        (np.full((4, 4), np.nan), "not finite"),
        (mirrored, "mirrored"),
        (np.diag([2.0, 2, 2, 1]), "scaled"),
    ):
        with pytest.raises(ValueError, match=f"world_from_camera: expected a rigid transform, got .*{why}"):
            Volume(VOXEL).integrate(view.depth, view.rgb, K, wrong)
    with pytest.raises(ValueError, match="rgb: expected the size of the depth image"):
        Volume(VOXEL).integrate(view.depth, view.rgb[:60], K, orbit(1)[0])
