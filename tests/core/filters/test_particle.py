from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.stats import norm
from scipy.stats.qmc import Sobol

from bask_data.core.filters.observation import Motion, Observation
from bask_data.core.filters.particle import particle_step
from bask_data.core.filters.particle.belief import ParticleBelief, new_belief
from bask_data.core.filters.particle.draw import draw
from bask_data.core.filters.particle.estimate import mode
from bask_data.core.filters.particle.likelihood import frame_likelihood
from bask_data.core.filters.particle.lookalikes import known_lookalikes
from bask_data.core.filters.particle.motion import move
from bask_data.core.filters.particle.resample import refresh, stratified
from bask_data.core.filters.particle.settings import ParticleSettings

HEIGHT, WIDTH = 40, 60
K = np.array([[60.0, 0, 29.5], [0, 60.0, 19.5], [0, 0, 1]])
PURE = ParticleSettings(alpha=4.0, redraw_share=0.0, resample_below=0.0, tau=0.1, residual_sigma=0.0)
"""The bare Bayes filter: no restarts, no resampling, the covariance of the posterior."""


def camera_at(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> np.ndarray:
    world_from_camera = np.eye(4)
    world_from_camera[:3, 3] = x, y, z
    c, s = np.cos(turn), np.sin(turn)
    world_from_camera[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    return world_from_camera


def wall(
    world_from_camera: np.ndarray, keypoints: list[list[float]], length: float = 0.05, distance: float = 1.0
) -> Observation:
    """A wall z = `distance` in the world, whose descriptors are its points: distances rise with the distance to a
    keypoint."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - 29.5) / 60, (v - 19.5) / 60, np.ones_like(u)], -1) @ world_from_camera[:3, :3].T
    depth = (distance - world_from_camera[2, 3]) / rays[..., 2]
    points = world_from_camera[:3, 3] + rays * depth[..., None]
    z = [1 - np.exp(-((points - k) ** 2).sum(-1) / (2 * length**2)) for k in keypoints]
    return Observation(np.stack(z).astype(np.float32), depth.astype(np.float32), K, world_from_camera)


def cloud(mean: list[float], deviation: float | list[float], n: int, seed: int = 0) -> ParticleBelief:
    points = np.asarray(mean) + np.asarray(deviation) * np.random.default_rng(seed).standard_normal((1, n, 3))
    return even(points)


def even(points: np.ndarray) -> ParticleBelief:
    """Points of equal weight, none of them held."""
    return new_belief(points, np.full(points.shape[:2], 1.0 / points.shape[1]))


def likelihood(points: np.ndarray, seen: Observation, settings: ParticleSettings) -> tuple[np.ndarray, np.ndarray]:
    found = frame_likelihood(points, seen, settings)
    return found.likelihood, found.seen


def likelihood_by_hand(point: np.ndarray, seen: Observation, s: ParticleSettings) -> float:
    """The paper's sum for one point, with `math` alone."""
    x, y, x_d = (np.linalg.inv(seen.world_from_camera) @ np.append(point, 1.0))[:3]
    if x_d <= 0:
        return s.tau
    u, v = K[0, 0] * x / x_d + K[0, 2], K[1, 1] * y / x_d + K[1, 2]
    if not (-0.5 <= u < WIDTH - 0.5 and -0.5 <= v < HEIGHT - 0.5):
        return s.tau
    z_d = float(seen.depth[round(v), round(u)])
    u, v = min(max(u, 0), WIDTH - 1), min(max(v, 0), HEIGHT - 1)
    i, j = min(int(v), HEIGHT - 2), min(int(u), WIDTH - 2)
    a, b, map_ = v - i, u - j, seen.distance[0].astype(np.float64)
    z = (1 - a) * ((1 - b) * map_[i, j] + b * map_[i, j + 1]) + a * ((1 - b) * map_[i + 1, j] + b * map_[i + 1, j + 1])
    p_c = math.exp(-s.alpha * z)
    if z_d == 0:
        return 0.5 * s.tau + 0.5 * p_c
    sigma = s.depth_noise * x_d + s.depth_noise_floor
    p_o = 1 - 0.5 * (1 + math.erf((z_d - (x_d - s.occlusion_margin)) / sigma / math.sqrt(2)))
    p_d = math.exp(-((z_d - x_d) ** 2) / (2 * sigma**2))
    return p_o * s.tau + (1 - p_o) * p_d * p_c


def test_the_likelihood_is_the_papers_sum() -> None:
    seen = wall(camera_at(0.1, -0.05, 0.1, 0.3), [[0.0, 0, 1]])
    seen.depth[10:20, 20:40] = 0
    seen.depth[:, 45:] *= 0.6
    points = np.random.default_rng(0).uniform([-1.5, -0.7, -0.5], [1.0, 0.7, 1.5], (400, 3))
    expected = [likelihood_by_hand(p, seen, PURE) for p in points]
    got, _ = likelihood(points[None], seen, PURE)
    np.testing.assert_allclose(got[0], np.maximum(expected, 1e-30), rtol=1e-9)


def test_behind_a_surface_is_hidden_on_it_is_seen_and_before_it_is_impossible() -> None:
    seen = wall(np.eye(4), [[0.0, 0, 1]])
    points = np.array([[[0.0, 0, 1.3], [0, 0, 1.0], [0, 0, 0.7]]])
    total, visible = likelihood(points, seen, ParticleSettings(tau=0.2, alpha=4.0))
    np.testing.assert_allclose(total[0, 0], 0.2, rtol=1e-6)
    assert visible[0, 0] < 1e-9
    assert visible[0, 1] / total[0, 1] > 0.98
    assert total[0, 1] > 0.7
    assert total[0, 2] < 1e-20


def test_closer_behind_than_the_margin_is_not_hidden_yet() -> None:
    seen = wall(np.eye(4), [[0.0, 0, 1]])
    points = np.array([[[0.0, 0, 1.02], [0, 0, 1.12]]])
    total, visible = likelihood(points, seen, ParticleSettings(depth_noise=0.0, depth_noise_floor=0.01))
    share = visible / total
    assert share[0, 0] > 0.9
    assert share[0, 1] < 0.1


def test_a_pixel_without_depth_says_nothing_of_depth_but_still_of_correspondence() -> None:
    seen = wall(np.eye(4), [[0.0, 0, 1]])
    seen = replace(seen, depth=0 * seen.depth)
    ray = np.array([0.05, 0.02, 1.0])
    total, _ = likelihood(np.array([[0.5 * ray, ray, 3 * ray]]), seen, ParticleSettings())
    np.testing.assert_allclose(total[0], total[0, 0], rtol=1e-12)
    off, _ = likelihood(np.array([[[0.3, 0.2, 1.0]]]), seen, ParticleSettings())
    assert total[0, 0] > 1.5 * off[0, 0]


def test_missing_depth_is_the_limit_of_infinite_noise() -> None:
    seen = wall(np.eye(4), [[0.0, 0, 1]])
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 0.8], [0.4, 0.3, 1.2], (1, 50, 3))
    noisy, _ = likelihood(points, seen, ParticleSettings(depth_noise_floor=1e9))
    missing, _ = likelihood(points, replace(seen, depth=0 * seen.depth), ParticleSettings())
    np.testing.assert_allclose(noisy, missing, rtol=1e-6)


@pytest.mark.parametrize(
    "case", ["one dip", "two dips", "edge of a nearer surface", "no depth in the half", "edge of view"]
)
def test_many_particles_agree_with_the_posterior_on_a_grid(case: str) -> None:
    """Two steps of prediction and update; the likelihood is held against the paper's sum above."""
    settings = replace(PURE, walk=0.01)
    keypoints = [[0.03, 0.01, 1.0]]
    prior, deviation = np.array([0.0, 0.0, 1.0]), np.array([0.05, 0.03, 0.03])
    cameras = [camera_at(), camera_at(0.05, 0.02, -0.1, 0.1)]
    if case == "edge of view":
        cameras = [camera_at(-0.49), camera_at(0.5, 0.02, -0.1, 0.0)]
    frames = [wall(camera, keypoints) for camera in cameras]
    for frame in frames:
        if case == "two dips":
            second = wall(frame.world_from_camera, [[-0.07, 0, 1]])
            frame.distance[:] = np.minimum(frame.distance, second.distance + 0.1)
        if case == "edge of a nearer surface":
            frame.depth[:, :28] *= 0.8
        if case == "no depth in the half":
            frame.depth[:20] = 0

    axes = [np.linspace(p - 6 * s, p + 6 * s, m) for p, s, m in zip(prior, deviation, (151, 91, 91), strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    grid = np.exp(-(((points - prior) / deviation) ** 2).sum(-1) / 2)
    grid /= grid.sum()
    log_evidence, rng = 0.0, np.random.default_rng(2)
    for frame in frames:
        for axis in range(3):
            step = axes[axis][1] - axes[axis][0]
            grid = gaussian_filter1d(grid, settings.walk / step, axis=axis, mode="constant", truncate=6)
        # Anywhere in the cell, or a cell cut by the edge of a pixel would count as a whole on one side.
        cells = points + rng.uniform(-0.5, 0.5, points.shape) * [a[1] - a[0] for a in axes]
        grid = grid * likelihood(cells.reshape(1, -1, 3), frame, settings)[0].reshape(grid.shape)
        log_evidence += np.log(grid.sum())
        grid /= grid.sum()
    mean = (grid[..., None] * points).sum((0, 1, 2))
    covariance = np.einsum("xyz,xyzi,xyzj->ij", grid, points - mean, points - mean)

    rng = np.random.default_rng(1)
    belief = even((prior + deviation * norm.ppf(Sobol(3, rng=0).random_base2(17)))[None])
    got_evidence = 0.0
    for frame in frames:
        belief, estimate = particle_step(belief, [frame], None, rng, settings)
        got_evidence += estimate.log_evidence[0]
    spread = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((estimate.mean[0] - mean) / spread, 0, atol=0.01)
    unit = np.outer(spread, spread)
    np.testing.assert_allclose(estimate.covariance[0] / unit, covariance / unit, atol=0.015)
    np.testing.assert_allclose(got_evidence, log_evidence, atol=0.01)


def test_few_particles_have_no_bias_over_seeds() -> None:
    """Many steps with resampling in them, against the same with very many particles."""
    settings = replace(PURE, walk=0.004, resample_below=0.5, n_particles=500)
    frames = [wall(camera_at(0.01 * i, 0, -0.02 * i, 0.02 * i), [[0.03, 0.01, 1.0]]) for i in range(6)]

    def track(n: int, seed: int) -> np.ndarray:
        belief, rng = cloud([0.0, 0, 1], 0.04, n, seed), np.random.default_rng(seed)
        for frame in frames:
            belief, estimate = particle_step(belief, [frame], None, rng, settings)
        return estimate.mean[0]

    truth = track(200_000, 12345)
    means = np.array([track(500, seed) for seed in range(200)])
    standard_error = means.std(axis=0) / np.sqrt(len(means))
    assert (np.abs(means.mean(axis=0) - truth) < 4 * standard_error + 1e-4).all()
    assert (standard_error < 5e-4).all()


def test_stratified_resampling_takes_each_particle_as_often_as_it_weighs() -> None:
    rng = np.random.default_rng(0)
    weight = rng.random(20) ** 4
    weight /= weight.sum()
    counts = np.array([np.bincount(stratified(weight, rng.random(20)), minlength=20) for _ in range(20_000)])
    np.testing.assert_allclose(counts.mean(axis=0), 20 * weight, atol=0.03)
    assert (np.abs(counts - 20 * weight) < 2).all()


def test_resampling_happens_only_below_the_threshold() -> None:
    belief = cloud([0.0, 0, 1], 0.05, 1000)
    weight = np.where(np.arange(1000) < 200, 1.0, 1e-9)[None]
    weight /= weight.sum()
    settings = replace(PURE, resample_below=0.1)
    belief = replace(belief, weight=weight, held=np.arange(1000)[None] % 3 == 0)
    _, estimate = particle_step(belief, [], None, np.random.default_rng(0), settings)
    kept = refresh(belief, estimate, [], [], np.random.default_rng(0), settings)
    np.testing.assert_array_equal(kept.points_world, belief.points_world)
    np.testing.assert_array_equal(kept.weight, weight)
    fresh = refresh(belief, estimate, [], [], np.random.default_rng(0), replace(settings, resample_below=0.3))
    np.testing.assert_allclose(fresh.weight, 1e-3)
    came_from = {point: i for i, point in enumerate(belief.points_world[0, :, 0])}
    index = np.array([came_from[x] for x in fresh.points_world[0, :, 0]])
    assert (index < 200).mean() > 0.999
    np.testing.assert_array_equal(fresh.held[0], index % 3 == 0)


def test_out_of_view_the_belief_stays_as_it_was() -> None:
    belief = cloud([0.0, 0, 1], 0.05, 5000)
    past_it = replace(wall(np.eye(4), [[0.0, 0, 1]]), world_from_camera=camera_at(0, 0, 2))
    settings = replace(PURE, walk=0.0)
    after, estimate = particle_step(belief, [past_it], None, None, settings)
    np.testing.assert_allclose(after.weight, belief.weight, rtol=1e-9)
    np.testing.assert_array_equal(after.points_world, belief.points_world)
    np.testing.assert_allclose(estimate.log_evidence, np.log(settings.tau), rtol=1e-9)
    assert not estimate.observed.any()


def test_no_camera_at_all_is_a_frame_in_which_only_time_passes() -> None:
    belief = cloud([0.0, 0, 1], 0.05, 5000)
    after, estimate = particle_step(belief, [], None, np.random.default_rng(1), replace(PURE, walk=0.02))
    assert estimate.pixel.shape == (0, 1, 2)
    np.testing.assert_allclose(estimate.log_evidence, 0, atol=1e-9)
    np.testing.assert_allclose(after.points_world[0].std(axis=0), np.hypot(0.05, 0.02), rtol=0.05)


def test_the_first_particles_lie_where_the_first_heat_map_is_hot() -> None:
    seen = wall(camera_at(0.1, 0.0, 0.2, 0.1), [[0.03, 0.01, 1.0]])
    settings = ParticleSettings(alpha=4.0, draw_sharpness=2.0)
    drawn = draw(seen, 20_000, np.random.default_rng(0), settings)
    points = drawn.points_world
    heat = np.exp(-8.0 * seen.distance[0].astype(np.float64))
    uv = np.rint(_pixels(points[0], seen)).astype(int)
    counts = np.zeros((HEIGHT, WIDTH))
    inside = (uv >= 0).all(1) & (uv < [WIDTH, HEIGHT]).all(1)
    np.add.at(counts, (uv[inside, 1], uv[inside, 0]), 1)
    hot = heat > 0.1
    np.testing.assert_allclose(counts[hot].sum() / 20_000, heat[hot].sum() / heat.sum(), atol=0.01)
    np.testing.assert_allclose(points[0, :, 2].mean(), 1.0, atol=0.003)
    at = np.sqrt(heat[uv[inside, 1], uv[inside, 0]])  # exp(-4 z), of the pixel or, by its noise, of the next
    np.testing.assert_allclose(np.median(drawn.match[0, inside] / at), 1.0, atol=0.001)


def _pixels(points: np.ndarray, seen: Observation) -> np.ndarray:
    camera = (points - seen.world_from_camera[:3, 3]) @ seen.world_from_camera[:3, :3]
    return camera[:, :2] / camera[:, 2:] * 60 + [29.5, 19.5]


def test_the_first_evidence_is_the_mean_likelihood_of_the_image() -> None:
    seen = wall(np.eye(4), [[0.0, 0, 1]])
    _, estimate = particle_step(None, [seen], None, np.random.default_rng(0))
    expected = np.log(np.exp(-ParticleSettings().alpha * seen.distance[0].astype(np.float64)).mean())
    np.testing.assert_allclose(estimate.log_evidence[0], expected, rtol=1e-5)


def test_nothing_is_drawn_from_pixels_without_depth() -> None:
    seen = wall(np.eye(4), [[0.0, 0, 1]])
    seen.depth[:, :30] = 0
    points = draw(seen, 3000, np.random.default_rng(0), ParticleSettings(), block=4).points_world
    assert (points[0, :, 0] > -0.001).all()


def follow(turns: list[float], keypoints: list[list[float]], settings: ParticleSettings, **kwargs: float) -> list:
    belief, rng, estimates = None, np.random.default_rng(0), []
    for turn in turns:
        belief, estimate = particle_step(belief, [wall(camera_at(turn=turn), keypoints, **kwargs)], None, rng, settings)
        estimates.append(estimate)
    return estimates


def test_a_point_that_leaves_the_view_is_remembered_and_met_again() -> None:
    turns = [0.0] * 8 + list(np.linspace(0, 0.9, 15)) + [0.9] * 50 + list(np.linspace(0.9, 0, 15)) + [0.0] * 5
    truth = np.array([[0.0, 0.05, 1.0], [0.1, -0.1, 1.0]])
    estimates = follow(turns, truth.tolist(), ParticleSettings())
    errors = np.array([np.linalg.norm(e.mean - truth, axis=1) for e in estimates])
    observed = np.array([e.observed[0] for e in estimates])
    assert observed[3:8].all()
    assert not observed[25:70].any()
    assert observed[-4:].all()
    assert errors[5:8].max() < 0.015
    assert errors[20:75].max() < 0.03
    assert errors[-4:].max() < 0.015


def test_a_point_first_met_late_is_found() -> None:
    turns = [0.9] * 10 + [0.0] * 15
    estimates = follow(turns, [[0.0, 0.05, 1.0]], ParticleSettings())
    assert np.linalg.norm(estimates[-1].mean[0] - [0, 0.05, 1]) < 0.02
    assert not estimates[5].observed.any()
    assert estimates[-1].observed.all()


def test_a_hidden_point_stays_where_it_was_and_is_said_to_be_hidden() -> None:
    rng, belief = np.random.default_rng(0), None
    truth = np.array([0.0, 0.05, 1.0])
    for i in range(40):
        seen = wall(np.eye(4), [truth.tolist()])
        if 10 <= i < 35:
            seen.depth[10:35, 15:45] = 0.6
            seen.distance[:, 10:35, 15:45] = 0.9
        belief, estimate = particle_step(belief, [seen], None, rng)
        if 12 <= i < 35:
            assert not estimate.observed.any()
        assert i < 5 or np.linalg.norm(estimate.mean[0] - truth) < 0.03


def test_a_twin_that_appears_later_does_not_take_the_keypoint_over() -> None:
    rng = np.random.default_rng(0)
    belief = None
    for i in range(60):
        seen = wall(np.eye(4), [[-0.1, 0.0, 1.0]])
        if i >= 10:
            twin = wall(np.eye(4), [[0.2, 0.0, 1.0]])
            seen = replace(seen, distance=np.minimum(seen.distance, twin.distance))
        belief, estimate = particle_step(belief, [seen], None, rng)
    assert np.linalg.norm(estimate.mode[0] - [-0.1, 0, 1]) < 0.02
    assert np.linalg.norm(estimate.mean[0] - [-0.1, 0, 1]) < 0.03


def test_a_second_camera_settles_what_the_first_cannot() -> None:
    truth, twin = [-0.1, 0.0, 1.0], [0.2, 0.0, 1.0]
    rng, alone, both = np.random.default_rng(0), None, None
    for _ in range(6):
        one = wall(np.eye(4), [truth])
        one = replace(one, distance=np.minimum(one.distance, wall(np.eye(4), [twin]).distance))
        other = wall(camera_at(-0.2, 0.0, 0.4), [truth])
        alone, unsure = particle_step(alone, [one], None, rng)
        both, sure = particle_step(both, [one, other], None, rng)
    assert np.sqrt(np.trace(unsure.covariance[0])) > 0.1
    assert np.sqrt(np.trace(sure.covariance[0])) < 0.05
    assert np.linalg.norm(sure.mean[0] - truth) < 0.02
    assert sure.observed.shape == (2, 1)


def test_particles_near_the_gripper_take_part_in_its_rotation_and_far_ones_do_not() -> None:
    before = camera_at(0.0, 0.0, 1.0)
    now = camera_at(0.1, 0.0, 1.0, np.pi / 2)
    n = 20_000
    points = np.stack([np.tile([0.0, 0.0, 1.1], (n, 1)), np.tile([0.0, 0.0, 2.0], (n, 1))])
    settings = ParticleSettings(walk=0.0, gripper_probability=0.3, gripper_memory=0.0)
    after = move(even(points), Motion(before, now), np.random.default_rng(0), settings)
    moved = after.points_world
    carried = np.isclose(moved[0], [0.2, 0.0, 1.0]).all(axis=1)
    np.testing.assert_allclose(carried.mean(), 0.3, atol=0.01)
    np.testing.assert_allclose(moved[0, ~carried], points[0, ~carried])
    np.testing.assert_array_equal(moved[1], points[1])
    np.testing.assert_array_equal(after.held, [carried, np.zeros(n, dtype=bool)])
    settings = replace(settings, gripper_reach=np.inf)
    everywhere = move(even(points), Motion(before, now), np.random.default_rng(0), settings).points_world
    np.testing.assert_allclose(np.isclose(everywhere[1], points[1]).all(axis=1).mean(), 0.7, atol=0.01)


def test_an_object_carried_by_the_gripper_is_followed_out_of_sight() -> None:
    rng, belief = np.random.default_rng(0), None
    settings = ParticleSettings(gripper_probability=0.9, gripper_memory=0.0, residual_sigma=0.0)
    away = camera_at(turn=2.0)
    for _ in range(20):
        belief, _ = particle_step(belief, [wall(np.eye(4), [[0.0, 0.05, 1.0]])], None, rng, settings)
    for i in range(10):
        motion = Motion(camera_at(0.02 * i, 0.05, 1.0), camera_at(0.02 * (i + 1), 0.05, 1.0))
        blind = wall(camera_at(), [[9.0, 9, 9]])
        belief, estimate = particle_step(belief, [replace(blind, world_from_camera=away)], motion, rng, settings)
    assert 0.1 < estimate.mean[0, 0] < 0.2
    assert np.sqrt(estimate.covariance[0, 0, 0]) > 0.01


def test_the_mode_is_the_heavier_of_two_clusters_wherever_the_grid_cuts_it() -> None:
    rng = np.random.default_rng(0)
    for shift in np.linspace(0, 0.06, 7):
        heavy = rng.normal([shift, shift, 1], 0.008, (600, 3))
        light = rng.normal([0.4, 0.03, 1.03], 0.008, (400, 3))
        points = np.concatenate([heavy, light])[None]
        found = mode(points, np.full((1, 1000), 1e-3), ParticleSettings().mode_radius)
        np.testing.assert_allclose(found[0], [shift, shift, 1], atol=0.003)


def test_permuting_keypoints_permutes_everything_and_others_change_nothing() -> None:
    order = np.array([2, 0, 1])
    points = [[0.0, 0.05, 1.0], [0.1, -0.1, 1.0], [-0.2, 0.0, 1.0]]
    runs = []
    for chosen in ([0, 1, 2], order.tolist(), [1]):
        runs.append(follow([0.0, 0.1, 0.3, 0.1], [points[i] for i in chosen], ParticleSettings(resample_below=0.5))[-1])
    ours, theirs, alone = runs
    for name in ("mean", "covariance", "mode", "n_eff", "log_evidence"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name)[order], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(getattr(alone, name)[0], getattr(ours, name)[1], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(theirs.observed, ours.observed[:, order])


def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not() -> None:
    def run(seed: int) -> bytes:
        belief, rng = None, np.random.default_rng(seed)
        for turn in (0.0, 0.2, 0.1):
            belief, estimate = particle_step(belief, [wall(camera_at(turn=turn), [[0.0, 0.05, 1.0]])], None, rng)
        return estimate.mean.tobytes() + belief.points_world.tobytes() + belief.weight.tobytes()

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_a_rigid_motion_of_the_world_moves_the_estimate_with_it() -> None:
    world_from_old = camera_at(0.5, -0.2, 0.3, 0.8)
    seen = wall(camera_at(turn=0.1), [[0.0, 0.05, 1.0]])
    moved = replace(seen, world_from_camera=world_from_old @ seen.world_from_camera)
    _, here = particle_step(None, [seen], None, np.random.default_rng(0))
    _, there = particle_step(None, [moved], None, np.random.default_rng(0))
    expected = here.mean @ world_from_old[:3, :3].T + world_from_old[:3, 3]
    np.testing.assert_allclose(there.mean, expected, atol=1e-9)
    np.testing.assert_allclose(there.n_eff, here.n_eff, rtol=1e-6)


def test_without_any_depth_yet_there_is_no_belief() -> None:
    seen = wall(np.eye(4), [[0.0, 0, 1]])
    belief, estimate = particle_step(None, [replace(seen, depth=0 * seen.depth)])
    assert belief is None
    assert np.isnan(estimate.mean).all()
    assert not estimate.observed.any()


def test_weights_always_sum_to_one_even_when_no_particle_can_be_right() -> None:
    belief = cloud([0.0, 0, 0.3], 0.001, 500)
    after, estimate = particle_step(belief, [wall(np.eye(4), [[0.0, 0, 1]])], None, np.random.default_rng(0))
    np.testing.assert_allclose(after.weight.sum(), 1.0)
    assert np.isfinite(estimate.mean).all()


def test_an_object_that_jumps_is_found_again_within_few_frames() -> None:
    rng, belief = np.random.default_rng(0), None
    for i in range(20):
        place = [-0.2, 0.0, 1.0] if i < 10 else [0.2, 0.05, 1.0]
        seen = wall(np.eye(4), [place])
        # As far apart as the descriptors of trained networks are.
        belief, estimate = particle_step(belief, [replace(seen, distance=2 * seen.distance)], None, rng)
        if i == 15:
            assert np.linalg.norm(estimate.mode[0] - place) < 0.03
    assert np.linalg.norm(estimate.mean[0] - [0.2, 0.05, 1.0]) < 0.03


def both(one: Observation, other: Observation) -> Observation:
    return replace(one, distance=np.minimum(one.distance, other.distance))


def test_a_twin_that_was_seen_beside_the_keypoint_stays_one_when_it_is_alone() -> None:
    """The camera turns from the keypoint to both and on to its twin, which then is all there is to see."""
    truth, twin = [-0.3, 0.0, 1.0], [0.3, 0.0, 1.0]
    turns = [-0.5] * 8 + list(np.linspace(-0.5, 0, 8)) + [0.0] * 8 + list(np.linspace(0, 0.5, 10)) + [0.5] * 30
    errors = {}
    for n_lookalikes in (64, 0):
        belief, rng = None, np.random.default_rng(0)
        for turn in turns:
            seen = both(wall(camera_at(turn=turn), [truth]), wall(camera_at(turn=turn), [twin]))
            settings = ParticleSettings(n_lookalikes=n_lookalikes)
            belief, estimate = particle_step(belief, [seen], None, rng, settings)
        errors[n_lookalikes] = np.linalg.norm(estimate.mean[0] - truth)
        assert not estimate.observed.any() or n_lookalikes == 0
    assert errors[64] < 0.03
    assert errors[0] > 0.5  # What the paper's filter makes of it.


def test_what_matches_better_than_a_lookalike_did_is_another_thing_at_its_place() -> None:
    belief = even(np.zeros((1, 10, 3)))
    belief = replace(
        belief, lookalikes=np.array([[[0.5, 0.0, 1.0], [np.nan] * 3]]), lookalike_match=np.array([[0.4, 0]])
    )
    points = np.array([[[0.5, 0.01, 1.0], [0.5, 0.01, 1.0], [0.5, 0.07, 1.0], [np.nan] * 3]])
    same = known_lookalikes(belief, points, np.array([[0.5, 0.7, 0.5, 0.5]]), ParticleSettings())
    np.testing.assert_array_equal(same, [[True, False, False, False]])


def test_a_lookalike_that_matches_better_than_the_track_is_not_remembered() -> None:
    """The track may be wrong: what it began with, before the keypoint came into view, is not the keypoint."""
    belief, rng = None, np.random.default_rng(0)
    for turn in [0.9] * 10 + [0.0] * 15:
        belief, estimate = particle_step(belief, [wall(camera_at(turn=turn), [[0.0, 0.05, 1.0]])], None, rng)
    near = np.linalg.norm(belief.lookalikes[0] - [0, 0.05, 1], axis=1) < 0.03
    assert not near.any()
    assert np.linalg.norm(estimate.mean[0] - [0, 0.05, 1]) < 0.02


def test_out_of_sight_weighs_at_least_a_share_of_what_the_track_used_to_match() -> None:
    seen = wall(np.eye(4), [[9.0, 9, 9]])
    points = np.array([[[0.0, 0.0, 2.0]]])
    settings = ParticleSettings(tau_match=0.25, tau_ratio=1e-9)
    hidden, _ = likelihood(points, seen, settings)
    assert hidden[0, 0] < 1e-6
    usual = frame_likelihood(points, seen, settings, np.array([0.8]))
    np.testing.assert_allclose(usual.likelihood[0, 0], 0.2, rtol=1e-6)
    fixed = frame_likelihood(points, seen, replace(settings, tau=0.01), np.array([0.8]))
    np.testing.assert_allclose(fixed.likelihood[0, 0], 0.01, rtol=1e-6)


def test_the_usual_match_follows_what_is_seen_and_holds_while_nothing_is() -> None:
    belief, rng, usual = None, np.random.default_rng(0), []
    for i in range(30):
        seen = wall(camera_at(turn=0.0 if i < 15 else 0.9), [[0.0, 0, 1]])
        belief, _ = particle_step(belief, [seen], None, rng)
        usual.append(belief.usual_match[0])
    assert 0.6 < usual[14] <= 1.0
    np.testing.assert_array_equal(usual[15:], usual[14])


def test_held_particles_stay_held_for_as_long_as_memory_says() -> None:
    settings = ParticleSettings(walk=0.0, gripper_probability=0.2, gripper_memory=0.9)
    belief, rng = even(np.zeros((1, 20_000, 3))), np.random.default_rng(0)
    for i in range(60):
        motion = Motion(camera_at(0.001 * i), camera_at(0.001 * (i + 1)))
        before, belief = belief.held, move(belief, motion, rng, settings)
    np.testing.assert_allclose(belief.held.mean(), 0.2, atol=0.02)
    np.testing.assert_allclose(belief.held[before].mean(), 0.9 + 0.1 * 0.2, atol=0.02)
    np.testing.assert_allclose(belief.held[~before].mean(), 0.1 * 0.2, atol=0.01)


def test_the_authors_gripper_does_not_turn_what_it_carries() -> None:
    settings = ParticleSettings(walk=0.0, gripper_probability=1.0, gripper_memory=0.0, gripper_turns=False)
    motion = Motion(camera_at(0.0, 0.0, 1.0), camera_at(0.1, 0.0, 1.0, np.pi / 2))
    moved = move(even(np.array([[[0.0, 0.0, 1.1]]])), motion, np.random.default_rng(0), settings)
    np.testing.assert_allclose(moved.points_world[0, 0], [0.1, 0.0, 1.1])


def test_a_pixel_without_depth_can_be_made_to_say_nothing_at_all() -> None:
    seen = wall(np.eye(4), [[0.0, 0, 1]])
    total, visible = likelihood(
        np.array([[[0.0, 0, 1.0]]]), replace(seen, depth=0 * seen.depth), replace(PURE, hidden_without_depth=1.0)
    )
    np.testing.assert_allclose(total, PURE.tau)
    np.testing.assert_array_equal(visible, 0)


def test_systematic_resampling_differs_from_a_share_by_less_than_one() -> None:
    weight = np.random.default_rng(0).random(50) ** 4
    weight /= weight.sum()
    counts = np.bincount(stratified(weight, np.full(50, 0.3)), minlength=50)
    assert (np.abs(counts - 50 * weight) < 1).all()
    belief = replace(cloud([0.0, 0, 1], 0.05, 50), weight=weight[None])
    _, estimate = particle_step(belief, [], None, np.random.default_rng(0), PURE)
    settings = replace(PURE, resample_below=1.0, resampling="systematic")
    fresh = refresh(belief, estimate, [], [], np.random.default_rng(1), settings)
    drawn = np.array([(fresh.points_world[0] == point).all(axis=1).sum() for point in belief.points_world[0]])
    assert (np.abs(drawn - 50 * weight) < 1).all()


def test_a_share_of_one_resamples_in_every_frame() -> None:
    weight = np.random.default_rng(0).uniform(0.9, 1.1, 50)
    belief = replace(cloud([0.0, 0, 1], 0.05, 50), weight=(weight / weight.sum())[None])
    _, estimate = particle_step(belief, [], None, np.random.default_rng(0), PURE)
    assert estimate.n_eff[0] > 49
    always, seldom = (
        refresh(belief, estimate, [], [], np.random.default_rng(1), replace(PURE, resample_below=below))
        for below in (1.0, 0.9)
    )
    np.testing.assert_array_equal(always.weight, 1 / 50)
    np.testing.assert_array_equal(seldom.weight, belief.weight)


@pytest.mark.parametrize(("sharpness", "alpha"), [(None, 8.0), (16.0, 64.0)])
def test_redrawn_particles_come_from_heat_maps_of_their_own_sharpness(sharpness: float | None, alpha: float) -> None:
    seen = wall(np.eye(4), [[0.03, 0.01, 1.0]])
    settings = ParticleSettings(
        alpha=4.0, draw_sharpness=2.0, redraw_sharpness=sharpness, redraw_share=0.5, draw_block=1, n_lookalikes=0
    )
    away = cloud([5.0, 5.0, 1.0], 0.01, 10_000)
    _, estimate = particle_step(away, [], None, np.random.default_rng(0), PURE)
    fresh = refresh(away, estimate, [], [seen], np.random.default_rng(1), settings)
    new = np.abs(fresh.points_world[0, :, 0]) < 2
    assert new.sum() == 5000
    heat = np.exp(-alpha * seen.distance[0].astype(np.float64))
    uv = np.rint(_pixels(fresh.points_world[0, new], seen)).astype(int).clip(0, [WIDTH - 1, HEIGHT - 1])
    hot = heat > 0.5
    np.testing.assert_allclose(hot[uv[:, 1], uv[:, 0]].mean(), heat[hot].sum() / heat.sum(), atol=0.03)


def test_a_long_run_of_any_kind_of_frames_leaves_every_number_finite() -> None:
    rng, belief = np.random.default_rng(0), None
    for i in range(150):
        seen = wall(camera_at(turn=float(rng.uniform(-1, 1)) if i % 7 == 0 else 0.0), [[0.0, 0.05, 1.0], [0.1, 0, 1]])
        seen = replace(seen, distance=seen.distance * np.float32(rng.choice([0.0, 0.3, 1.0, 20.0])))
        seen.depth[rng.random(seen.depth.shape) < rng.random()] = 0
        belief, estimate = particle_step(belief, [seen], None, rng, ParticleSettings(n_particles=200))
        assert np.isfinite(estimate.mean).all()
        assert np.isfinite(estimate.mode).all()
        np.testing.assert_allclose(belief.weight.sum(axis=1), 1.0)
        assert (belief.weight >= 0).all()
