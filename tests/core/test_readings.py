from __future__ import annotations

import ast
from functools import cache

import numpy as np
import pytest
from jaxtyping import Float, Float32
from numpy import ndarray

from bask_data.core.geometry import scale_intrinsics
from bask_data.core.readings import JudgeSettings, judge
from bask_data.core.readings_frozen import frozen_runs
from bask_data.core.readings_judgement import Judgement
from bask_data.core.readings_search import K_FACTORS, SAME_SCALE, other_sizes, scales
from bask_data.core.readings_unusual import AXES
from bask_data.core.readings_verdict import beats
from tests.scenes import intrinsics, look_at, noisy, orbit, tabletop

HEIGHT, WIDTH = 48, 64
K = intrinsics(HEIGHT, WIDTH)
N = 24
FEW = JudgeSettings(n_points=300)
"""Fewer points than usual, so that tests are quick."""

SCENE = tabletop(4, seed=5)
START = look_at((0.45, 0.1, 0.5), (0.0, 0.0, 0.03))


def shaken(n: int = N) -> Float[ndarray, "t 4 4"]:
    """A camera around the scene whose speed changes, so that its clock can be told."""
    fraction = (np.arange(n) + 2.5 * np.sin(np.arange(n) / 1.7)) / n
    return orbit(200, n_turns=0.5)[np.clip(200 * (0.1 + 0.8 * fraction), 0, 199).astype(int)]


def along(direction: tuple[float, float, float]) -> Float[ndarray, "t 4 4"]:
    """A camera that moves straight, direction in its own frame."""
    poses = np.tile(START, (N, 1, 1))
    poses[:, :3, 3] += np.linspace(-0.12, 0.12, N)[:, None] * (START[:3, :3] @ np.array(direction))
    return poses


def turning() -> Float[ndarray, "t 4 4"]:
    """A camera that turns about its centre in all directions."""
    time = np.linspace(0, 1, N)
    targets = np.stack([0.25 * np.sin(5 * time), 0.25 * np.cos(7 * time), 0 * time], axis=1)
    return np.stack([look_at(START[:3, 3], target) for target in targets])


MOTIONS = {
    "shaken": shaken,
    "sideways": lambda: along((1, 0, 0)),
    "forward": lambda: along((0, 0, 1)),
    "turning": turning,
}


@cache
def depths(motion: str) -> tuple[Float32[ndarray, "h w"], ...]:
    """Depth that the motion sees, with 1 % noise and 20 % holes."""
    rng = np.random.default_rng(0)
    exact = (SCENE.render(K, pose, HEIGHT, WIDTH).depth for pose in MOTIONS[motion]())
    return tuple((noisy(each, 0.0, rng, 0.2) * rng.normal(1, 0.01, each.shape)).astype(np.float32) for each in exact)


def judged(motion: str, poses: ndarray | None = None, K_told: ndarray = K, factor: float = 1.0) -> Judgement:
    seen = depths(motion)
    told = MOTIONS[motion]() if poses is None else poses
    Ks = np.tile(K_told, (len(told), 1, 1))
    return judge(len(told), lambda i: seen[i] * np.float32(factor), Ks, told, FEW)


def test_a_moving_camera_is_sure_and_nothing_is_found() -> None:
    made = judged("shaken")
    assert made.codes == () and made.findings("a/c") == []
    assert made.sure_of_reading and made.sure_of_unit and made.best.departures == ()


@pytest.mark.parametrize("lag", [-2, 1])
def test_poses_of_other_frames_are_told_with_their_number(lag: int) -> None:
    made = judged("shaken", shaken()[np.clip(np.arange(N) - lag, 0, N - 1)])
    assert "other-clock" in made.codes and made.best.lag == lag


@pytest.mark.parametrize(
    ("words", "inverted"),
    [(words, words.startswith("camera axes x forward")) for words in list(AXES)[::2] + list(AXES)[-1:]],
)
def test_unusual_axes_and_turned_images_are_told_with_what_converts_the_poses(words: str, inverted: bool) -> None:
    told = shaken() @ np.linalg.inv(AXES[words])
    made = judged("shaken", np.linalg.inv(told) if inverted else told)
    [finding] = made.findings("a/c")
    assert (finding.code, made.best.otherwise, made.best.inverted) == ("other-reading", words, inverted)
    assert words in finding.evidence and ("the inverse of each pose" in finding.fix) == inverted
    if "mirrored" in words:
        assert finding.fix == "mirror colour and depth back"
        return
    stated = np.array(ast.literal_eval(finding.fix[finding.fix.index("[[") : finding.fix.index("]]") + 2]))
    np.testing.assert_array_equal(stated, AXES[words][:3, :3])


@pytest.mark.parametrize("size", [(0.5, 0.5), (2.0, 1.5)])
def test_intrinsics_of_another_size_are_told_with_the_right_ones(size: tuple[float, float]) -> None:
    told = scale_intrinsics(K, (HEIGHT, WIDTH), (round(HEIGHT * size[1]), round(WIDTH * size[0])))
    made = judged("shaken", K_told=told)
    assert made.codes == ("other-intrinsics",)
    np.testing.assert_allclose(made.K, K, atol=1e-9)
    [finding] = made.findings("a/c")
    assert finding.severity == "error" and f"{K[0, 0]:.6g}" in finding.fix


def test_intrinsics_between_the_usual_sizes_are_not_claimed_as_one_of_them() -> None:
    told = scale_intrinsics(K, (HEIGHT, WIDTH), (2 * HEIGHT, round(1.5 * WIDTH)))
    made = judged("shaken", K_told=told)
    assert made.codes[-1] == "intrinsics-unknown" and not made.sure_of_intrinsics


def test_wrong_unit_and_wrong_intrinsics_are_told_together() -> None:
    made = judged("shaken", K_told=scale_intrinsics(K, (HEIGHT, WIDTH), (2 * HEIGHT, 2 * WIDTH)), factor=10.0)
    assert made.codes == ("other-unit", "other-intrinsics")
    assert made.best.depth_factor == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("motion", "code"), [("sideways", "axes-unknown"), ("forward", "axes-unknown"), ("turning", "unit-unknown")]
)
def test_a_motion_that_does_not_tell_is_said_to(motion: str, code: str) -> None:
    made = judged(motion)
    assert made.codes == (code,) and not made.sure_of_unit and not made.objections
    assert made.findings("a/c")[0].severity == "warning"


def test_a_camera_that_shakes_in_place_hardly_moves() -> None:
    rng = np.random.default_rng(3)
    poses = np.tile(START, (N, 1, 1))
    poses[:, :3, 3] += rng.normal(0, 0.001, (N, 3))
    seen = [depths("sideways")[N // 2] * rng.normal(1, 0.01, (HEIGHT, WIDTH)) for _ in range(N)]
    made = judge(N, lambda i: seen[i].astype(np.float32), np.tile(K, (N, 1, 1)), poses, FEW)
    assert made.codes == ("hardly-moves",) and made.findings("a/c")[0].severity == "note"


def test_poses_that_stop_while_depth_goes_on_are_told_with_their_frames() -> None:
    poses = shaken()
    poses[16:] = poses[16]
    made = judged("shaken", poses)
    assert "poses-repeated" in made.codes and "16 to 23" in made.reasons["poses-repeated"]
    assert "poses-repeated" not in judged("shaken").codes


def test_frozen_runs_are_the_longest_ones_and_not_all_frames() -> None:
    poses = shaken(12)
    poses[2:5], poses[7:9] = poses[2], poses[7]
    assert frozen_runs(poses) == [(2, 4)]
    assert frozen_runs(np.tile(START, (12, 1, 1))) == []


def test_noise_alone_does_not_make_poses_unrelated() -> None:
    rng = np.random.default_rng(1)
    seen = [(each * rng.normal(1, 0.07, each.shape)).astype(np.float32) for each in depths("shaken")]
    made = judge(N, lambda i: seen[i], np.tile(K, (N, 1, 1)), shaken(), FEW)
    assert made.share < 0.25 and not made.objections
    strange = judge(N, lambda i: depths("shaken")[i], np.tile(K, (N, 1, 1)), shaken()[::-1] @ START, FEW)
    assert strange.codes[0] in ("poses-unrelated", "reading-unknown") and not strange.sure_of_reading


def test_few_frames_are_never_sure() -> None:
    seen = depths("shaken")
    for n in (1, 2, 3):
        made = judge(n, lambda i: seen[i], np.tile(K, (n, 1, 1)), shaken()[:n])
        assert made.codes == ("few-views",) and not made.sure_of_reading


def test_few_frames_of_a_long_recording_are_read_in_order_and_once() -> None:
    seen, read, n = depths("shaken"), [], 400

    def depth(i: int) -> Float32[ndarray, "h w"]:
        read.append(i)
        return seen[i % N]

    judge(n, depth, np.tile(K, (n, 1, 1)), np.tile(shaken(), (17, 1, 1))[:n])
    assert read == sorted(set(read)) and len(read) <= 80


def test_scales_hold_every_common_unit_and_none_twice() -> None:
    found = np.log(scales())
    for ratio in (1, 10, 0.1, 1000, 0.001, 1 / 256, 1 / 1024, 1 / 4000, 1 / 5000, 1e-4, 0.2, 5, 0.25, 4):
        assert np.abs(found - np.log(ratio)).min() < SAME_SCALE / 2, ratio
    apart = np.abs(found[:, None] - found) + np.eye(len(found))
    assert apart.min() > SAME_SCALE / 2


def test_a_centred_principal_point_leaves_no_other_size() -> None:
    assert other_sizes(K, (HEIGHT, WIDTH)) == ()
    double = scale_intrinsics(K, (HEIGHT, WIDTH), (2 * HEIGHT, 2 * WIDTH))
    assert (0.5, 0.5) in other_sizes(double, (HEIGHT, WIDTH)) and set(other_sizes(double, (HEIGHT, WIDTH))) < set(
        K_FACTORS
    )


def test_a_winner_needs_pairs_gain_and_little_scatter() -> None:
    rng = np.random.default_rng(0)
    base = rng.uniform(0.3, 0.6, 36)
    assert beats(base + 0.05, base)
    assert not beats(base + 0.005, base), "gain below 0.01"
    assert not beats(base[:3] + 0.05, base[:3]), "too few pairs"
    assert not beats(base + 0.02 + np.resize([0.1, -0.1], 36), base), "scatter"
