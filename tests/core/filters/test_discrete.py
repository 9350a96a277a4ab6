from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bask_data.core.filters.discrete import CameraBelief, DiscreteSettings, carry, discrete_step, predict
from bask_data.core.filters.observation import Motion, Observation

SMALL_K = np.array([[4.0, 0, 1.0], [0, 4.0, 1.0], [0, 0, 1]])


def camera_at(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    world_from_camera = np.eye(4)
    world_from_camera[:3, 3] = x, y, z
    c, s = np.cos(yaw), np.sin(yaw)
    world_from_camera[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    return world_from_camera


def transition_by_hand(
    before: Observation, now: Observation, motion: Motion | None, settings: DiscreteSettings
) -> np.ndarray:
    """The matrix (states now, states before), cell by cell; the last state is outside. Depth has no holes here."""
    height, width = before.depth.shape
    n = height * width
    index = {(v, u): v * width + u for v in range(height) for u in range(width)}

    def point_at(a: Observation, v: int, u: int) -> np.ndarray:
        d = float(a.depth[v, u])
        point = np.array([(u - a.K[0, 2]) / a.K[0, 0] * d, (v - a.K[1, 2]) / a.K[1, 1] * d, d, 1.0])
        return a.world_from_camera @ point

    def seen_from(point: np.ndarray, b: Observation) -> tuple[float, float]:
        x, y, z, _ = np.linalg.inv(b.world_from_camera) @ point
        return b.K[0, 0] * x / z + b.K[0, 2], b.K[1, 1] * y / z + b.K[1, 2]

    warp = np.zeros((n + 1, n + 1))
    warp[n, n] = 1
    for (v, u), i in index.items():
        point = point_at(before, v, u)
        shares = [(1.0, point)]
        if motion is not None:
            gripper = motion.world_from_gripper_before
            if np.linalg.norm(point[:3] - gripper[:3, 3]) < settings.gripper_reach:
                p = settings.gripper_probability
                shares = [(1 - p, point), (p, motion.world_from_gripper @ np.linalg.inv(gripper) @ point)]
        for share, moved in shares:
            new_u, new_v = seen_from(moved, now)
            for dv, du in itertools.product((0, 1), (0, 1)):
                corner_v, corner_u = int(np.floor(new_v)) + dv, int(np.floor(new_u)) + du
                weight = (1 - abs(new_u - corner_u)) * (1 - abs(new_v - corner_v))
                warp[index.get((corner_v, corner_u), n), i] += share * weight
    uncovered = []
    for (v, u), i in index.items():
        old_u, old_v = seen_from(point_at(now, v, u), before)
        if not (-0.5 <= old_u < width - 0.5 and -0.5 <= old_v < height - 0.5):
            uncovered.append(i)
    back = len(uncovered) / (len(uncovered) + settings.outside_area * n)
    reveal = np.eye(n + 1)
    reveal[n, n] = 1 - back
    for i in uncovered:
        reveal[i, n] = back / len(uncovered)

    reach = (round(settings.walk_px * 8 + 1) | 1) // 2
    taps = {k: np.exp(-(k**2) / (2 * settings.walk_px**2)) for k in range(-reach, reach + 1)}
    total = sum(taps.values())
    walk = np.zeros((n + 1, n + 1))
    walk[n, n] = 1
    for (v, u), i in index.items():
        for dv, du in itertools.product(taps, taps):
            walk[index.get((v + dv, u + du), n), i] += taps[dv] * taps[du] / total**2
    restart = (1 - settings.restart) * np.eye(n + 1)
    restart[:n] += settings.restart / n
    return restart @ walk @ reveal @ warp


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 4), st.integers(2, 3), st.booleans(), st.booleans())
def test_the_posterior_is_the_sum_over_all_paths(
    seed: int, height: int, width: int, is_fixed: bool, has_gripper: bool
) -> None:
    """Any motions of camera and gripper, any small grid, tau given or not; one path for each state of each frame."""
    rng = np.random.default_rng(seed)
    chosen = DiscreteSettings(
        alpha=float(rng.uniform(0.5, 6)),
        walk_px=float(rng.uniform(0.3, 1.5)),
        tau=float(rng.uniform(0.01, 0.5)) if is_fixed else None,
        outside_area=float(rng.uniform(0.3, 2)),
        restart=float(rng.uniform(0, 0.1)),
        gripper_probability=float(rng.uniform(0, 1)),
        gripper_reach=float(rng.uniform(0.1, 0.5)),
    )
    cameras = [camera_at(*rng.uniform(-0.2, 0.2, 3), rng.uniform(-0.3, 0.3)) for _ in range(3)]
    frames = [
        Observation(
            rng.uniform(0, 1, (2, height, width)).astype(np.float32),
            rng.uniform(0.8, 1.2, (height, width)).astype(np.float32),
            SMALL_K,
            camera,
        )
        for camera in cameras
    ]
    n = height * width
    likelihoods = []
    for frame in frames:
        likelihood = np.exp(-chosen.alpha * frame.distance.astype(np.float64)).reshape(2, -1)
        some = np.exp(-chosen.alpha * frame.distance[:, ::2, ::2].astype(np.float64)).mean(axis=(1, 2))
        tau = np.minimum(2 * some, 0.3) if chosen.tau is None else np.full(2, chosen.tau)
        likelihoods.append(np.concatenate([likelihood, tau[:, None]], axis=1))
    grippers = [camera_at(*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.8, 1.2), rng.uniform(-0.3, 0.3)) for _ in range(3)]
    motions = [None, Motion(grippers[0], grippers[1]), Motion(grippers[1], grippers[2]) if has_gripper else None]
    transitions = [
        transition_by_hand(a, b, motion, chosen)
        for (a, b), motion in zip(itertools.pairwise(frames), motions[1:], strict=True)
    ]
    for transition in transitions:
        np.testing.assert_allclose(transition.sum(axis=0), 1.0)

    posterior = np.zeros((2, n + 1))
    for path in itertools.product(range(n), range(n + 1), range(n + 1)):
        p = 1 / n * likelihoods[0][:, path[0]]
        for t in range(2):
            p = p * transitions[t][path[t + 1], path[t]] * likelihoods[t + 1][:, path[t + 1]]
        posterior[:, path[-1]] += p
    evidence = posterior.sum(axis=1)
    posterior /= evidence[:, None]

    belief, log_evidence = None, np.zeros(2)
    for frame, motion in zip(frames, motions, strict=True):
        belief, estimate = discrete_step(belief, [frame], motion, settings=chosen)
        log_evidence += estimate.log_evidence
    got = np.concatenate([belief.cameras[0].inside.reshape(2, -1), belief.cameras[0].outside[:, None]], axis=1)
    np.testing.assert_allclose(got, posterior, atol=1e-6)
    np.testing.assert_allclose(log_evidence, np.log(evidence), atol=1e-6)


def view(distance: np.ndarray, world_from_camera: np.ndarray, depth: np.ndarray | None = None) -> Observation:
    height, width = distance.shape[1:]
    K = np.array([[100.0, 0, (width - 1) / 2], [0, 100.0, (height - 1) / 2], [0, 0, 1]])
    return Observation(
        distance, np.ones((height, width), dtype=np.float32) if depth is None else depth, K, world_from_camera
    )


def flat(k: int = 1, height: int = 20, width: int = 30) -> np.ndarray:
    return np.ones((k, height, width), dtype=np.float32)


def test_a_camera_that_moves_by_two_pixels_moves_the_belief_by_two_pixels() -> None:
    before, now = view(flat(), camera_at()), view(flat(), camera_at(0.02))
    inside = np.random.default_rng(0).random((1, 20, 30))
    belief = CameraBelief(inside, np.zeros(1), before.depth, before.K, before.world_from_camera)
    moved = (carry(belief, now) @ inside.reshape(-1)).reshape(20, 30)
    np.testing.assert_allclose(moved[:, :-2], inside[0, :, 2:], atol=1e-12)
    np.testing.assert_allclose(moved[:, -2:], 0, atol=1e-12)


def test_motions_of_a_third_of_a_pixel_add_up() -> None:
    settings = DiscreteSettings(walk_px=0.0, restart=0.0)
    inside = np.zeros((1, 20, 30))
    inside[0, 10, 20] = 1
    start = view(flat(), np.eye(4))
    belief = CameraBelief(inside, np.zeros(1), start.depth, start.K, start.world_from_camera)
    for i in range(1, 10):
        belief = predict(belief, view(flat(), camera_at(0.01 * i / 3)), settings)
    u = belief.inside[0].sum(axis=0) @ np.arange(30)
    np.testing.assert_allclose(u, 17.0, atol=1e-6)


def test_a_camera_that_stands_still_leaves_only_the_random_walk() -> None:
    distance = flat()
    distance[0, 10, 15] = 0
    settings = DiscreteSettings(walk_px=1.5, restart=0.0, alpha=20.0)
    belief, _ = discrete_step(None, [view(distance, np.eye(4))], settings=settings)
    spread = predict(belief.cameras[0], view(flat(), np.eye(4)), settings).inside[0]
    grid = np.arange(30) - 15
    np.testing.assert_allclose(spread.sum(axis=0) @ grid**2 / spread.sum(), 1.5**2, rtol=0.02)


@given(st.integers(0, 2**32 - 1))
def test_no_mass_is_lost_or_made_by_any_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = (rng.uniform(0.3, 2, (20, 30)) * (rng.random((20, 30)) < 0.7)).astype(np.float32)
    before = view(flat(2), camera_at(), depth)
    now = view(flat(2), camera_at(*rng.uniform(-0.5, 0.5, 3), rng.uniform(-3, 3)), depth[::-1])
    inside = rng.random((2, 20, 30))
    outside = rng.random(2)
    total = inside.sum((1, 2)) + outside
    inside, outside = inside / total[:, None, None], outside / total
    belief = CameraBelief(inside, outside, before.depth, before.K, before.world_from_camera)
    after = predict(belief, now, DiscreteSettings())
    np.testing.assert_allclose(after.inside.sum((1, 2)) + after.outside, 1.0, rtol=1e-9)
    assert (after.inside >= 0).all()
    assert (after.outside >= 0).all()


def test_cells_without_depth_move_with_their_nearest_neighbour_that_has_some() -> None:
    depth = np.ones((20, 30), dtype=np.float32)
    depth[8:13, 13:18] = 0
    distance = flat()
    distance[0, 10, 15] = 0
    belief, _ = discrete_step(None, [view(distance, camera_at(), depth)], settings=DiscreteSettings(alpha=30.0))
    after = predict(belief.cameras[0], view(flat(), camera_at(0.03), depth), DiscreteSettings(walk_px=0.0, restart=0.0))
    assert np.unravel_index(after.inside[0].argmax(), (20, 30)) == (10, 12)


def test_without_any_depth_the_rotation_still_carries_the_belief() -> None:
    nothing = np.zeros((20, 30), dtype=np.float32)
    distance = flat()
    distance[0, 10, 15] = 0
    belief, _ = discrete_step(None, [view(distance, camera_at(), nothing)], settings=DiscreteSettings(alpha=30.0))
    turned = view(flat(), camera_at(0.03, yaw=np.arctan(0.05)), nothing)
    after = predict(belief.cameras[0], turned, DiscreteSettings(walk_px=0.0, restart=0.0))
    assert np.unravel_index(after.inside[0].argmax(), (20, 30)) == (10, 10)


def test_what_the_gripper_holds_stays_where_a_camera_on_it_sees_it() -> None:
    """The camera is the gripper's; all that it sees is within reach, or nothing is."""
    distance = flat()
    distance[0, 10, 15] = 0
    belief, _ = discrete_step(None, [view(distance, np.eye(4))], settings=DiscreteSettings(alpha=30.0))
    turned = camera_at(0.02, -0.01, 0.03, yaw=0.1)
    for reach, place in ((2.0, (10, 15)), (0.5, (11, 3))):
        held = DiscreteSettings(walk_px=0.0, restart=0.0, gripper_probability=1.0, gripper_reach=reach)
        after = predict(belief.cameras[0], view(flat(), turned), held, Motion(np.eye(4), turned))
        assert np.unravel_index(after.inside[0].argmax(), (20, 30)) == place


@pytest.mark.parametrize("every", [1, 3])
def test_what_is_carried_past_a_camera_that_stands_still_is_followed(every: int) -> None:
    """A blob in the hand, seven pixels from one frame that is given to the next; without the gripper's motion it is
    lost."""
    errors = []
    for probability in (DiscreteSettings().gripper_probability, 0.0):
        settings = DiscreteSettings(gripper_probability=probability)
        belief, before = None, None
        for i, x in enumerate(np.linspace(-0.25, 0.25, 7 * every + 1)):
            gripper, u = camera_at(x, 0, 1), round(29.5 + 100 * x)
            distance = flat(height=40, width=60)
            distance[0, 17:24, u - 3 : u + 4] = 0.2
            motion = None if before is None else Motion(before, gripper)
            seen = None if i % every else view(distance, np.eye(4))
            belief, estimate = discrete_step(belief, [seen], motion, settings=settings)
            before = gripper
        errors.append(np.linalg.norm(estimate.mean[0] - [0.25, 0.005, 1]))
    followed, lost = errors
    assert followed < 0.02
    assert lost > 0.05


def test_a_gripper_that_passes_by_unseen_moves_no_estimate() -> None:
    """What is behind the object is not where the object may be carried to."""
    distance, depth = flat(), np.full((20, 30), 1.0, np.float32)
    distance[0, 8:13, 13:18], depth[6:15, 11:20] = 0, 0.6
    belief = None
    for _ in range(5):
        belief, before = discrete_step(belief, [view(distance, np.eye(4), depth)])
    for i in range(15):
        motion = Motion(camera_at(0.015 * i, 0, 0.6), camera_at(0.015 * (i + 1), 0, 0.6))
        belief, estimate = discrete_step(belief, [None], motion)
    assert np.linalg.norm(estimate.mean - before.mean) < 0.005
    np.testing.assert_array_equal(belief.cameras[0].world_from_gripper, camera_at(0, 0, 0.6))


def pan(turn: float, twin: bool = False) -> Observation:
    """A wall one metre away; the keypoint is on it straight ahead of a camera that has not turned, its twin beside
    it."""
    world_from_camera = camera_at(yaw=turn)
    height, width = 40, 60
    K = np.array([[60.0, 0, 29.5], [0, 60.0, 19.5], [0, 0, 1]])
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - 29.5) / 60, (v - 19.5) / 60, np.ones_like(u)], -1) @ world_from_camera[:3, :3].T
    depth = 1 / rays[..., 2]
    points = rays * depth[..., None]
    z = 1 - np.exp(-(((points - [0, 0, 1]) ** 2).sum(-1)) / (2 * 0.05**2))
    if twin:
        z = np.minimum(z, 1 - np.exp(-(((points - [0.25, 0, 1]) ** 2).sum(-1)) / (2 * 0.05**2)))
    return Observation(z[None].astype(np.float32), depth.astype(np.float32), K, world_from_camera)


def test_a_keypoint_that_leaves_is_known_to_be_outside_and_is_found_again() -> None:
    belief = None
    turns = [0.0] * 5 + list(np.linspace(0, 0.9, 15)) + [0.9] * 10 + list(np.linspace(0.9, 0, 15)) + [0.0] * 5
    errors, observed = [], []
    for turn in turns:
        belief, estimate = discrete_step(belief, [pan(turn)])
        errors.append(np.linalg.norm(estimate.mean[0] - [0, 0, 1]))
        observed.append(estimate.observed[0, 0])
    assert all(observed[:5])
    assert not any(observed[20:30])
    assert all(observed[-5:])
    assert errors[4] < 0.03
    assert max(errors[20:30]) < 0.15
    assert errors[-1] < 0.03


def test_what_was_seen_before_tells_a_keypoint_from_its_twin() -> None:
    belief = None
    for _ in range(8):
        belief, _ = discrete_step(belief, [pan(0.0)])
    for _ in range(20):
        belief, estimate = discrete_step(belief, [pan(0.0, twin=True)])
    assert np.linalg.norm(estimate.mode[0] - [0, 0, 1]) < 0.03
    assert np.linalg.norm(estimate.mean[0] - [0, 0, 1]) < 0.05


def test_a_grid_of_any_size_gives_the_same_place() -> None:
    means = []
    for grid in (None, (14, 20), (17, 60), (40, 25), (50, 70)):
        belief = None
        for seen in [pan(0.1)] * 3 + [pan(0.15), None, pan(0.1)]:
            belief, estimate = discrete_step(belief, [seen], settings=DiscreteSettings(grid=grid))
        means.append(estimate.mean[0])
        assert belief.cameras[0].inside.shape == (1, *(grid or (40, 60)))
        np.testing.assert_allclose(belief.cameras[0].inside.sum() + belief.cameras[0].outside, 1.0)
    np.testing.assert_allclose(means, means[:1] * 5, atol=0.012)


def test_the_walk_is_as_wide_on_any_grid() -> None:
    """In pixels of the distance map, while no frame comes, too."""
    distance = flat(height=60, width=60)
    distance[0, 28:32, 28:32] = 0
    walk = DiscreteSettings(walk_px=6.0, restart=0.0, alpha=20.0, grid=(15, 30))
    belief, _ = discrete_step(None, [view(distance, np.eye(4))], settings=walk)
    after, _ = discrete_step(belief, [None], settings=walk)
    inside = after.cameras[0].inside[0]
    for axis, n, cell in ((0, 30, 2), (1, 15, 4)):
        place = (np.arange(n) + 0.5) * cell - 30
        np.testing.assert_allclose(np.sqrt(inside.sum(axis=axis) @ place**2 / inside.sum()), 6.0, rtol=0.1)


def test_permuting_keypoints_permutes_everything() -> None:
    rng = np.random.default_rng(1)
    order = np.array([2, 0, 1])
    a = b = None
    for i in range(4):
        z = rng.uniform(0, 1, (3, 20, 30)).astype(np.float32)
        a, ours = discrete_step(a, [view(z, camera_at(0.013 * i))])
        b, theirs = discrete_step(b, [view(z[order], camera_at(0.013 * i))])
    for name in ("mean", "covariance", "mode", "n_eff", "log_evidence"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name)[order], rtol=1e-9)
    np.testing.assert_array_equal(theirs.observed, ours.observed[:, order])


def test_two_cameras_agree_on_one_place() -> None:
    belief = None
    for _ in range(6):
        belief, estimate = discrete_step(belief, [pan(0.1), pan(-0.2)])
    assert len(belief.cameras) == 2
    assert np.linalg.norm(estimate.mean[0] - [0, 0, 1]) < 0.02
    assert estimate.pixel.shape == (2, 1, 2)


def test_a_keypoint_with_no_probability_left_in_the_image_is_outside() -> None:
    """Without a restart it may all have left, or have become too small for a number; it then keeps its last place."""
    chosen = DiscreteSettings(tau=0.1, restart=0.0)
    distance = np.array([[[0.9, 0.1, 0.8], [0.9, 0.7, 0.8], [0.9, 0.9, 0.8]]], dtype=np.float32)
    seen = Observation(distance, np.ones((3, 3), dtype=np.float32), SMALL_K, camera_at())
    belief, first = discrete_step(None, [seen], settings=chosen)
    camera = belief.cameras[0]
    assert camera is not None
    left = replace(belief, cameras=(replace(camera, inside=0 * camera.inside, outside=np.ones(1)),))
    after, estimate = discrete_step(left, [seen], settings=chosen)
    assert after.cameras[0] is not None
    np.testing.assert_array_equal(after.cameras[0].outside, 1.0)
    np.testing.assert_allclose(estimate.log_evidence, np.log(0.1))
    np.testing.assert_array_equal(estimate.mean, first.mean)


def test_an_image_in_which_everything_is_impossible_tells_nothing() -> None:
    seen = Observation(np.ones((1, 3, 3), np.float32), np.ones((3, 3), np.float32), SMALL_K, camera_at())
    belief, _ = discrete_step(None, [seen], settings=DiscreteSettings(alpha=1e4, tau=1e-320))
    camera = belief.cameras[0]
    assert camera is not None
    np.testing.assert_allclose(camera.inside.sum() + camera.outside, 1.0)
