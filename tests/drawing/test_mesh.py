from __future__ import annotations

import numpy as np

from bask_data.drawing.mesh import BACKGROUND, MeshScene, Viewpoint, orbit_views
from tests.scenes import intrinsics, look_at


def sphere(radius: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh.create_sphere(radius, 30)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles, np.int32)


def test_a_mesh_is_drawn_in_its_colours_on_the_background():
    vertices, triangles = sphere()
    view = Viewpoint(intrinsics(48, 64), look_at((0.4, 0.0, 0.0)), 48, 64)
    red = np.tile(np.array([200, 0, 0], np.uint8), (len(vertices), 1))
    picture = MeshScene(vertices, triangles).render(red, view)
    assert picture[0, 0].tolist() == list(BACKGROUND)
    assert picture[24, 32, 0] > 190
    assert picture[24, 32, 1:].max() == 0
    rim = picture[24, :, 0][(picture[24, :, 1] == 0)]
    assert rim[0] < 150, "a surface seen from the side is darker"


def test_rays_pass_through_back_faces():
    vertices, triangles = sphere()
    inside_out = np.ascontiguousarray(triangles[:, ::-1])
    colours = np.zeros((len(vertices), 3), np.uint8)
    colours[vertices[:, 0] < 0] = (0, 200, 0)
    view = Viewpoint(intrinsics(48, 64), look_at((0.4, 0.0, 0.0)), 48, 64)
    picture = MeshScene(vertices, inside_out).render(colours, view, sharp=True)
    assert picture[24, 32, 1] > 180, "the far wall is seen through the near one"
    assert picture[0, 0].tolist() == list(BACKGROUND)


def test_views_from_above_show_the_whole_mesh_and_the_cameras():
    from bask_data.core.geometry import in_image, invert_rigid, project, transform

    vertices, _ = sphere()
    cameras = np.stack([look_at((0.4, y, 0.3)) for y in np.linspace(-0.2, 0.2, 5)])
    with_cameras, without = orbit_views(vertices, cameras, np.array([0.0, 0, 1]), height=60, width=80)
    for view, points in ((with_cameras, np.concatenate([vertices, cameras[:, :3, 3]])), (without, vertices)):
        pixel, z = project(transform(invert_rigid(view.world_from_camera), points.astype(float)), view.K)
        assert (z > 0).all()
        assert in_image(pixel, 60, 80).all()
        assert max(np.ptp(pixel[:, 0]) / 80, np.ptp(pixel[:, 1]) / 60) > 0.85, "fills the picture"
        assert view.world_from_camera[2, 3] > 0.1, "from above"
