from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bask_data.core import correspondences
from bask_data.core.geometry import invert_rigid, project, transform, unproject
from tests import meshes, scenes

HEIGHT, WIDTH = 120, 160
K = scenes.intrinsics(HEIGHT, WIDTH)


def box(x, y, size):
    """The box that `meshes.block` makes, as a body to be ray-cast."""
    world_from_box = np.eye(4)
    world_from_box[:3, 3] = [x + size[0] / 2, y + size[1] / 2, size[2] / 2]
    return scenes.Box(tuple(np.asarray(size) / 2), world_from_box)


BLOCKS = [(-0.12, -0.1, (0.10, 0.06, 0.08)), (0.0, 0.05, (0.07, 0.07, 0.05)), (0.1, -0.12, (0.05, 0.05, 0.12))]
SCENE = scenes.Scene(tuple(box(*one) for one in BLOCKS))
CAMERAS = scenes.orbit(12, radius=0.5)


@pytest.fixture(scope="module")
def surface():
    vertices, triangles, _ = meshes.table(BLOCKS, step=0.01)
    return correspondences.Surface(vertices, triangles)


@pytest.fixture(scope="module")
def images():
    return [SCENE.render(K, camera, HEIGHT, WIDTH) for camera in CAMERAS]


def views_of(images, surface=None, noise=0.0, missing=0.0, **options):
    rng = np.random.default_rng(0)
    return [
        correspondences.view(
            scenes.noisy(image.depth, noise, rng, missing), image.instance, K, camera, surface, **options
        )
        for image, camera in zip(images, CAMERAS, strict=True)
    ]


def truth(uv_a, camera_a, camera_b, scene=SCENE):
    """Where the surface seen at pixels of a is in b, and how far something is in front of it there, metres."""
    rays = unproject(uv_a, np.ones(len(uv_a)), K) @ camera_a[:3, :3].T
    z = np.stack([body.cast(camera_a[:3, 3], rays) for body in scene.background + scene.objects]).min(axis=0)
    points_world = transform(camera_a, unproject(uv_a, z, K))
    uv_b, z_b = project(transform(invert_rigid(camera_b), points_world), K)
    rays = unproject(uv_b, np.ones(len(uv_b)), K) @ camera_b[:3, :3].T
    first = np.stack([body.cast(camera_b[:3, 3], rays) for body in scene.background + scene.objects]).min(axis=0)
    return uv_b, z_b - first


def errors(views, n_pairs=30, seed=0, **options):
    """Pixel error and hiding distance of the matches of some pairs, and how many attempts there were."""
    rng = np.random.default_rng(seed)
    error, hidden, n_attempts = [], [], 0
    for _ in range(n_pairs):
        a, b = rng.choice(len(views), 2, replace=False)
        found = correspondences.match(views[a], views[b], rng, **options)
        uv_b, in_front = truth(found.uv_a.astype(float), CAMERAS[a], CAMERAS[b])
        error.append(np.linalg.norm(found.uv_b - uv_b, axis=1))
        hidden.append(in_front)
        n_attempts += found.n_attempts
    return np.concatenate(error), np.concatenate(hidden), n_attempts


def test_exact_depth_gives_exact_matches_and_none_is_hidden(images, surface):
    for views in (views_of(images), views_of(images, surface)):
        error, hidden, n_attempts = errors(views)
        assert len(error) > 0.1 * n_attempts
        assert (error < 0.01).all()
        assert (hidden < 1e-4).all()


def test_the_surface_takes_the_noise_of_depth_out_of_the_matches(images, surface):
    """Pixels are four times those of a usual camera here, so that the same noise moves matches a quarter as far."""
    with_surface, hidden, _ = errors(views_of(images, surface, noise=0.003))
    without, _, _ = errors(views_of(images, noise=0.003))
    assert (with_surface <= 0.25).mean() >= 0.97
    assert (without <= 0.25).mean() < 0.7
    assert (hidden < 1e-3).all()


def test_sparse_depth_loses_no_matches_where_there_is_a_surface(images, surface):
    dense, _, n_dense = errors(views_of(images, surface, noise=0.001))
    sparse, _, n_sparse = errors(views_of(images, surface, noise=0.001, missing=0.7))
    assert len(sparse) / n_sparse > 0.95 * len(dense) / n_dense
    assert (sparse <= 0.25).mean() >= 0.97


def test_a_hand_in_front_hides_what_the_surface_shows(images, surface):
    hand = images[5].depth.copy()
    region = images[5].instance == 1
    hand[region] = 0.2
    a = correspondences.view(images[4].depth, images[4].instance, K, CAMERAS[4], surface)
    # The masks do not know of the hand here; the depth alone must tell.
    b = correspondences.view(hand, images[5].instance, K, CAMERAS[5], surface)
    found = correspondences.match(a, b, np.random.default_rng(0))
    assert not (found.instance == 1).any()
    assert (found.instance == 2).any()
    c = correspondences.match(b, a, np.random.default_rng(0))
    assert not (c.instance == 1).any()


def test_matches_show_one_instance_in_both_views(images, surface):
    views = views_of(images, surface)
    found = correspondences.match(views[3], views[4], np.random.default_rng(0))
    u, v = np.rint(found.uv_a).astype(int).T
    np.testing.assert_array_equal(images[3].instance[v, u], found.instance)
    u, v = np.rint(found.uv_b).astype(int).T
    np.testing.assert_array_equal(images[4].instance[v, u], found.instance)


def test_every_attempt_is_a_match_or_a_rejection(images, surface):
    views = views_of(images, surface, noise=0.002, missing=0.3)
    for a, b in [(0, 1), (3, 8), (11, 2)]:
        found = correspondences.match(views[a], views[b], np.random.default_rng(0), n_attempts=700, n_matches=150)
        assert len(found.instance) + found.rejections.total() == found.n_attempts <= 700
        assert len(found.instance) <= 150
        assert set(found.rejections) <= set(correspondences.REJECTIONS)


def loop(a, b, uv_a, label, tolerance, max_cycle):
    """The same as `follow`, match by match."""
    result = []
    b_from_a = np.linalg.inv(b.world_from_camera) @ a.world_from_camera
    for (u, v), k in zip(uv_a.astype(int), label, strict=True):
        z = float(a.depth[v, u])
        point = b_from_a @ np.append(z * np.linalg.solve(a.K, [u, v, 1.0]), 1.0)
        if point[2] <= 0:
            result.append((None, "outside_b"))
            continue
        pixel = (b.K @ point[:3] / point[2])[:2]
        if not (-0.5 <= pixel[0] < WIDTH - 0.5 and -0.5 <= pixel[1] < HEIGHT - 0.5):
            result.append((None, "outside_b"))
            continue
        u0, v0 = (int(np.clip(np.floor(x), 0, n - 2)) for x, n in zip(pixel, (WIDTH, HEIGHT), strict=True))
        fu, fv = np.clip(pixel - (u0, v0), 0, 1)
        corners = {
            (i, j): (float(b.depth[v0 + j, u0 + i]), abs(1 - i - fu) * abs(1 - j - fv)) for i in (0, 1) for j in (0, 1)
        }
        known = {key: value for key, value in corners.items() if value[0] > 0}
        allowed = tolerance[0] + tolerance[1] * point[2]
        if not known:
            result.append((pixel, "no_depth_in_b"))
            continue
        depths = [value[0] for value in known.values()]
        if len(known) == 4 and max(depths) - min(depths) <= tolerance[0] + tolerance[1] * max(depths):
            z_b = sum(depth * weight for depth, weight in corners.values())
        else:
            z_b = max(known.values(), key=lambda value: value[1])[0]
        row, column = (round(float(pixel[1])), round(float(pixel[0])))
        back = np.linalg.inv(b_from_a) @ np.append(z_b * np.linalg.solve(b.K, [*pixel, 1.0]), 1.0)
        back = (a.K @ back[:3] / back[2])[:2]
        if min(depths) < point[2] - allowed:
            reason = "hidden_in_b"
        elif abs(z_b - point[2]) > allowed:
            reason = "other_surface_in_b"
        elif b.instance[row, column] != k:
            reason = "other_instance_in_b"
        elif b.sure[row, column] != k:
            reason = "doubtful_in_b"
        elif np.linalg.norm(back - (u, v)) > max_cycle:
            reason = "cycle"
        else:
            reason = ""
        result.append((pixel, reason))
    return result


@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1))
def test_all_at_once_is_the_same_as_one_by_one(images, seed):
    rng = np.random.default_rng(seed)
    views = views_of(images, noise=0.003, missing=0.3)
    a, b = (views[i] for i in rng.choice(len(views), 2, replace=False))
    tried = correspondences.candidates(a, b, 400, rng)
    uv_a = np.stack([tried % WIDTH, tried // WIDTH], axis=1).astype(float)
    label = a.instance.reshape(-1)[tried]
    uv_b, failed = correspondences.follow(uv_a, label, a, b, (0.004, 0.005), 0.7)
    for i, (pixel, reason) in enumerate(loop(a, b, uv_a, label, (0.004, 0.005), 0.7)):
        assert reason == (correspondences.REJECTIONS[failed[i]] if failed[i] >= 0 else "")
        if pixel is not None:
            np.testing.assert_allclose(uv_b[i], pixel, atol=1e-6)


def test_matches_are_shared_out_evenly(images, surface):
    views = views_of(images, surface)
    found = correspondences.match(views[3], views[4], np.random.default_rng(0), n_matches=90)
    assert np.bincount(found.instance, minlength=4)[1:].tolist() == [30, 30, 30]


@pytest.mark.parametrize(
    ("available", "total", "expected"),
    [
        ([10, 10, 10], 9, [3, 3, 3]),
        ([1, 10, 10], 9, [1, 4, 4]),
        ([2, 3], 100, [2, 3]),
        ([5, 5], 5, [2, 3]),
        ([], 5, []),
    ],
)
def test_shares_are_as_equal_as_can_be(available, total, expected):
    assert correspondences.shares(np.array(available, np.int64), total).tolist() == expected


def test_no_pixel_is_tried_twice(images):
    views = views_of(images)
    tried = correspondences.candidates(views[0], views[1], 10_000, np.random.default_rng(0))
    assert len(np.unique(tried)) == len(tried)
    assert (views[0].sure.reshape(-1)[tried] > 0).all()


def test_depth_between_pixels_never_mixes_foreground_and_background():
    depth = np.full((4, 4), 1.0, np.float32)
    depth[:, 2:] = 0.5
    depth[3, 0] = 0.0
    uv = np.array([[0.5, 0.5], [1.4, 1.0], [1.6, 1.0], [0.2, 2.9], [3.4, 3.4]])
    value, nearest = correspondences.depth_between(depth, uv, (0.01, 0.0))
    np.testing.assert_allclose(value, [1.0, 1.0, 0.5, 1.0, 0.5])
    np.testing.assert_allclose(nearest, [1.0, 0.5, 0.5, 1.0, 0.5])
    slope = np.add.outer(np.arange(4) * 0.002, np.arange(4) * 0.001).astype(np.float32) + 1
    value, _ = correspondences.depth_between(slope, np.array([[1.25, 2.5]]), (0.01, 0.0))
    assert value[0] == pytest.approx(1 + 1.25 * 0.001 + 2.5 * 0.002, abs=1e-6)
    nothing, _ = correspondences.depth_between(np.zeros((4, 4), np.float32), uv, (0.01, 0.0))
    assert not nothing.any()


def test_a_surface_that_is_off_is_corrected_and_one_that_is_not_is_left():
    rng = np.random.default_rng(0)
    rendered = np.full((60, 80), 0.6, np.float32)
    measured = (rendered + rng.normal(scale=0.001, size=rendered.shape)).astype(np.float32)
    measured[20:40, 20:40] += 0.004
    measured[50:, :] = 0.3
    measured[0, 0] = 0.0
    best, contradicted = correspondences.refined(measured, rendered, (0.01, 0.01))
    assert best[21:39, 21:39] == pytest.approx(0.604, abs=0.0015)
    flat = best[2:18, 2:18]
    assert (flat == np.float32(0.6)).mean() > 0.9
    assert (best[50:] == np.float32(0.3)).all()
    assert contradicted[50:].all()
    assert best[0, 0] == pytest.approx(0.6, abs=0.001)
    assert not contradicted[:50].any()


def test_only_the_inside_of_a_mask_is_sure():
    instance = np.zeros((20, 20), np.uint8)
    instance[5:15, 5:10], instance[5:15, 10:] = 1, 2
    np.testing.assert_array_equal(correspondences.inside(instance, 0), instance)
    sure = correspondences.inside(instance, 2)
    expected = np.zeros_like(instance)
    expected[7:13, 7:8], expected[7:13, 12:] = 1, 2
    np.testing.assert_array_equal(sure, expected)


def test_views_that_share_no_object_have_no_matches(images):
    views = views_of(images)
    empty = correspondences.view(images[0].depth, np.zeros((HEIGHT, WIDTH), np.uint8), K, CAMERAS[0])
    found = correspondences.match(views[1], empty, np.random.default_rng(0))
    assert (len(found.instance), found.n_attempts, found.rejections.total()) == (0, 0, 0)


def test_same_seed_same_matches(images, surface):
    views = views_of(images, surface, noise=0.001)
    one, two = (correspondences.match(views[2], views[3], np.random.default_rng(5)) for _ in range(2))
    assert one.uv_a.tobytes() == two.uv_a.tobytes()
    assert one.uv_b.tobytes() == two.uv_b.tobytes()


def test_wrong_arguments_are_refused(images):
    [a, *_] = views_of(images[:1] * 12)
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="measured and instance must have one size"):
        correspondences.view(images[0].depth[1:], images[0].instance, K, CAMERAS[0])
    with pytest.raises(ValueError, match="margin and tolerance must be >= 0, got -1"):
        correspondences.view(images[0].depth, images[0].instance, K, CAMERAS[0], margin=-1)
    with pytest.raises(ValueError, match="tolerance and max_cycle must be >= 0"):
        correspondences.match(a, a, rng, max_cycle=-1.0)
    with pytest.raises(ValueError, match="n_attempts and n_matches >= 1"):
        correspondences.match(a, a, rng, n_matches=0)
