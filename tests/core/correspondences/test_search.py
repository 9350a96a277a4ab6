from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bask_data.core.correspondences.matchable import matchable_view
from bask_data.core.correspondences.search import REJECTIONS, depth_between, match, shares
from bask_data.core.geometry import invert_rigid, project, transform, unproject
from tests.blocks import CAMERAS, HEIGHT, SCENE, WIDTH, K, views_of


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
        found = match(views[a], views[b], rng, **options)
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
    a = matchable_view(images[4].depth, images[4].instance, K, CAMERAS[4], surface)
    # The masks do not know of the hand here; the depth alone must tell.
    b = matchable_view(hand, images[5].instance, K, CAMERAS[5], surface)
    found = match(a, b, np.random.default_rng(0))
    assert not (found.instance == 1).any()
    assert (found.instance == 2).any()
    c = match(b, a, np.random.default_rng(0))
    assert not (c.instance == 1).any()


def test_matches_show_one_instance_in_both_views(images, surface):
    views = views_of(images, surface)
    found = match(views[3], views[4], np.random.default_rng(0))
    u, v = np.rint(found.uv_a).astype(int).T
    np.testing.assert_array_equal(images[3].instance[v, u], found.instance)
    u, v = np.rint(found.uv_b).astype(int).T
    np.testing.assert_array_equal(images[4].instance[v, u], found.instance)


def test_every_attempt_is_a_match_or_a_rejection(images, surface):
    views = views_of(images, surface, noise=0.002, missing=0.3)
    for a, b in [(0, 1), (3, 8), (11, 2)]:
        found = match(views[a], views[b], np.random.default_rng(0), n_attempts=700, n_matches=150)
        assert len(found.instance) + found.rejections.sum() == found.n_attempts <= 700
        assert len(found.instance) <= 150
        assert found.rejections.shape == (len(found.tried), len(REJECTIONS))


def one_by_one(a, b, draws, n_attempts, n_matches, tolerance, max_cycle):
    """The same as `match`, in plain words: labels, pixels of both views and why the others failed."""
    b_from_a = np.linalg.inv(b.world_from_camera) @ a.world_from_camera
    waiting = {k: a.pixels[a.first[k] : a.first[k + 1]].tolist() for k in range(1, 256)}
    shared = [k for k in waiting if waiting[k] and b.first[k + 1] > b.first[k]]
    quota = dict(zip(shared, shares(np.array([len(waiting[k]) for k in shared]), n_attempts), strict=True))
    tried, matches, failed = dict.fromkeys(shared, 0), {k: [] for k in shared}, {k: [] for k in shared}
    for draw in draws:
        able = [k for k in shared if tried[k] < quota[k]]
        if not able or sum(map(len, matches.values())) == n_matches:
            break
        k = min(able, key=lambda k: (len(matches[k]), k))
        rest = waiting[k][tried[k] :]
        i = int(draw * len(rest))
        pixel, rest[i] = rest[i], rest[0]
        waiting[k][tried[k] :] = [pixel, *rest[1:]]
        tried[k] += 1
        u, v = pixel % WIDTH, pixel // WIDTH
        uv_b, why = followed(u, v, k, a, b, b_from_a, tolerance, max_cycle)
        if why:
            failed[k].append(why)
        else:
            matches[k].append((u, v, *uv_b))
    return shared, matches, failed


def is_crowded(depth, u, v, z, margin, tolerance):
    window = depth[max(v - margin, 0) : v + margin + 1, max(u - margin, 0) : u + margin + 1].astype(float)
    rows, columns = np.mgrid[max(v - margin, 0) : v + margin + 1, max(u - margin, 0) : u + margin + 1][
        :, : window.shape[0], : window.shape[1]
    ]
    slope = z / K[0, 0] * np.tan(np.deg2rad(75)) * np.hypot(rows - v, columns - u)
    return bool(((window > 0) & (z - window > 0.5 * (tolerance[0] + tolerance[1] * z) + slope)).any())


def followed(u, v, label, a, b, b_from_a, tolerance, max_cycle):
    z = float(a.depth[v, u])
    ray = np.linalg.solve(a.K, [u, v, 1.0])
    point = b_from_a @ np.append(z * ray, 1.0)
    if point[2] <= 0:
        return None, "outside_b"
    pixel = (b.K @ point[:3] / point[2])[:2]
    if not (-0.5 <= pixel[0] < WIDTH - 0.5 and -0.5 <= pixel[1] < HEIGHT - 0.5):
        return None, "outside_b"
    u0, v0 = (int(np.clip(np.floor(x), 0, n - 2)) for x, n in zip(pixel, (WIDTH, HEIGHT), strict=True))
    fu, fv = np.clip(pixel - (u0, v0), 0, 1)
    corners = {
        (i, j): (float(b.depth[v0 + j, u0 + i]), abs(1 - i - fu) * abs(1 - j - fv)) for i in (0, 1) for j in (0, 1)
    }
    known = {key: value for key, value in corners.items() if value[0] > 0}
    allowed = tolerance[0] + tolerance[1] * point[2]
    if not known:
        return pixel, "no_depth_in_b"
    depths = [value[0] for value in known.values()]
    if len(known) == 4 and max(depths) - min(depths) <= tolerance[0] + tolerance[1] * max(depths):
        z_b = sum(depth * weight for depth, weight in corners.values())
    else:
        z_b = max(known.values(), key=lambda value: value[1])[0]
    row, column = (round(float(pixel[1])), round(float(pixel[0])))
    back = np.linalg.inv(b_from_a) @ np.append(z_b * np.linalg.solve(b.K, [*pixel, 1.0]), 1.0)
    back = (a.K @ back[:3] / back[2])[:2]
    if min(depths) < point[2] - allowed:
        return pixel, "hidden_in_b"
    if abs(z_b - point[2]) > allowed:
        return pixel, "other_surface_in_b"
    if b.instance[row, column] != label:
        return pixel, "other_instance_in_b"
    if b.sure[row, column] != label:
        return pixel, "doubtful_in_b"
    if np.linalg.norm(back - (u, v)) > max_cycle:
        return pixel, "cycle"
    farther = b_from_a @ np.append((z + 2 * a.noise * (tolerance[0] + tolerance[1] * z)) * ray, 1.0)
    reach = round(np.linalg.norm((b.K @ farther[:3] / farther[2])[:2] - pixel))
    if is_crowded(b.depth, column, row, point[2], b.margin + min(reach, 6), tolerance):
        return pixel, "edge_in_b"
    return pixel, ""


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), n_matches=st.sampled_from([30, 200, 1000]), missing=st.sampled_from([0.0, 0.3]))
def test_the_compiled_search_is_the_plain_one(images, seed, n_matches, missing):
    rng = np.random.default_rng(seed)
    a, b = (views_of(images, noise=0.002, missing=missing)[i] for i in rng.choice(len(images), 2, replace=False))
    a = dataclasses.replace(a, noise=rng.uniform(0, 2))
    options = {"n_attempts": 400, "n_matches": n_matches, "tolerance": (0.004, 0.005), "max_cycle": 0.7}
    found = match(a, b, np.random.default_rng(seed), **options)
    shared, matches, failed = one_by_one(a, b, np.random.default_rng(seed).random(400), **options)
    assert found.tried.tolist() == shared
    for k, row in zip(shared, found.rejections, strict=True):
        mine = found.instance == k
        expected = np.array(matches[k]).reshape(-1, 4)
        np.testing.assert_array_equal(found.uv_a[mine], expected[:, :2])
        np.testing.assert_allclose(found.uv_b[mine], expected[:, 2:], atol=2e-5)
        assert row.tolist() == [failed[k].count(why) for why in REJECTIONS]


def test_matches_are_shared_out_evenly(images, surface):
    views = views_of(images, surface)
    found = match(views[3], views[4], np.random.default_rng(0), n_matches=90)
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
    assert shares(np.array(available, np.int64), total).tolist() == expected


def test_no_pixel_is_matched_twice_and_all_are_reached(images):
    a = views_of(images)[0]
    found = match(a, a, np.random.default_rng(0), 100_000, 100_000)
    pixels = found.uv_a[:, 1].astype(int) * WIDTH + found.uv_a[:, 0].astype(int)
    assert found.n_attempts == len(a.pixels)
    assert sorted(pixels) == sorted(set(pixels))
    assert len(pixels) > 0.8 * len(a.pixels)
    assert (a.sure.reshape(-1)[pixels] == found.instance).all()


def test_an_object_that_b_hides_leaves_its_matches_to_the_others(images):
    a, b = views_of(images)[3:5]
    hand = b.depth.copy()
    hand[b.instance == 1] = 0.2
    hidden = dataclasses.replace(b, depth=hand)
    found = match(a, hidden, np.random.default_rng(0), n_attempts=900, n_matches=60)
    assert np.bincount(found.instance, minlength=4)[1:].tolist() == [0, 30, 30]
    [row] = found.rejections[found.tried == 1]
    assert dict(zip(REJECTIONS, row.tolist(), strict=True))["hidden_in_b"] == row.sum() >= 300


def test_early_matches_are_a_fair_draw_of_all_there_are(images):
    """Half of an object's matches are left of their median; so are half of those of searches that end early."""
    a, b = views_of(images)[3:5]
    every = match(a, b, np.random.default_rng(0), 100_000, 100_000)
    few = [match(a, b, np.random.default_rng(i), n_matches=60) for i in range(50)]
    for k in every.tried:
        middle = np.median(every.uv_a[every.instance == k], axis=0)
        drawn = np.concatenate([one.uv_a[one.instance == k] for one in few])
        share = (every.uv_a[every.instance == k] < middle).mean(axis=0)
        # Four standard deviations of a share of so many.
        assert (drawn < middle).mean(axis=0) == pytest.approx(share, abs=2 / np.sqrt(len(drawn)))


def test_depth_between_pixels_never_mixes_foreground_and_background():
    depth = np.full((4, 4), 1.0, np.float32)
    depth[:, 2:] = 0.5
    depth[3, 0] = 0.0
    uv = np.array([[0.5, 0.5], [1.4, 1.0], [1.6, 1.0], [0.2, 2.9], [3.4, 3.4]])
    between = [depth_between(depth, u, v, (0.01, 0.0)) for u, v in uv]
    np.testing.assert_allclose([value for value, _ in between], [1.0, 1.0, 0.5, 1.0, 0.5])
    np.testing.assert_allclose([nearest for _, nearest in between], [1.0, 0.5, 0.5, 1.0, 0.5])
    slope = np.add.outer(np.arange(4) * 0.002, np.arange(4) * 0.001).astype(np.float32) + 1
    value, _ = depth_between(slope, 1.25, 2.5, (0.01, 0.0))
    assert value == pytest.approx(1 + 1.25 * 0.001 + 2.5 * 0.002, abs=1e-6)
    nothing = np.zeros((4, 4), np.float32)
    assert [depth_between(nothing, u, v, (0.01, 0.0)) for u, v in uv] == [(0.0, 0.0)] * len(uv)


def test_a_surface_inside_an_object_is_not_matched_at_its_edges(images):
    """A step within one mask, of one label on both sides: it is up to chance which of the two a pixel there shows."""
    depth = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    depth[:, 80:] = 0.6
    a = matchable_view(depth, np.ones((HEIGHT, WIDTH), np.uint8), K, np.eye(4))
    found = match(a, a, np.random.default_rng(0), 100_000, 100_000)
    columns = np.unique(found.uv_a[:, 0]).astype(int)
    assert set(range(80)) - set(columns) == {78, 79}
    assert set(range(80, 160)) - set(columns) == {80, 81}
    moved = np.eye(4)
    moved[0, 3] = 0.1
    b = matchable_view(depth, np.ones((HEIGHT, WIDTH), np.uint8), K, moved)
    a = dataclasses.replace(a, noise=3.0)
    why = match(a, b, np.random.default_rng(0)).rejections.sum(axis=0)
    assert why[REJECTIONS.index("edge_in_b")] > 0


def test_views_that_share_no_object_have_no_matches(images):
    views = views_of(images)
    empty = matchable_view(images[0].depth, np.zeros((HEIGHT, WIDTH), np.uint8), K, CAMERAS[0])
    found = match(views[1], empty, np.random.default_rng(0))
    assert (len(found.instance), found.n_attempts, found.rejections.shape) == (
        0,
        0,
        (0, len(REJECTIONS)),
    )


def test_same_seed_same_matches(images, surface):
    views = views_of(images, surface, noise=0.001)
    one, two = (match(views[2], views[3], np.random.default_rng(5)) for _ in range(2))
    assert one.uv_a.tobytes() == two.uv_a.tobytes()
    assert one.uv_b.tobytes() == two.uv_b.tobytes()


def test_wrong_arguments_are_refused(images):
    [a, *_] = views_of(images[:1] * 12)
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="tolerance and max_cycle must be >= 0"):
        match(a, a, rng, max_cycle=-1.0)
    with pytest.raises(ValueError, match="n_attempts and n_matches >= 1"):
        match(a, a, rng, n_matches=0)
