from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.calibration import TEMPERATURES, Evidence
from bask_data.core.filters.observation import Observation
from bask_data.core.rivals import APART, measured_evidence

K = np.array([[80.0, 0, 39.5], [0, 80.0, 29.5], [0, 0, 1]])
HEIGHT, WIDTH = 60, 80
NOWHERE = np.full(1, -1)


def wall(shift: int, marks: dict[tuple[int, int], float], background: float = 1.0, scale: int = 1) -> Observation:
    """A wall, 1 m in front of a camera that is `shift` pixels to the right, and distances at some of its pixels, named
    by the pixel in the unshifted view. With `scale`, depth is finer than the distance map by that factor."""
    distance = np.full((1, HEIGHT, WIDTH), background, dtype=np.float32)
    for (u, v), z in marks.items():
        if 0 <= u - shift < WIDTH:
            distance[0, v, u - shift] = z
    world_from_camera = np.eye(4)
    world_from_camera[0, 3] = shift / 80.0
    fine = np.diag([scale, scale, 1.0]) @ K
    fine[:2, 2] += (scale - 1) / 2
    depth = np.ones((HEIGHT * scale, WIDTH * scale), dtype=np.float32)
    return Observation(distance, depth, fine, world_from_camera)


def at(u: int, v: int) -> np.ndarray:
    """The point of the wall at a pixel of the unshifted view."""
    return np.array([[(u - 39.5) / 80, (v - 29.5) / 80, 1.0]])


def sorted_rivals(found: Evidence) -> list[float]:
    return sorted(np.round(found.rival, 3).tolist())


@pytest.mark.parametrize("scale", [1, 2])
def test_keypoint_and_best_other_place_are_looked_up_in_the_other_views(scale: int) -> None:
    # The rival of view 0 is at (60, 40), that of view 1 at (20, 10): each is looked up where the other was found.
    views = [
        wall(0, {(30, 20): 0.1, (60, 40): 0.3, (20, 10): 0.5}, scale=scale),
        wall(5, {(30, 20): 0.2, (60, 40): 0.7, (20, 10): 0.4}, scale=scale),
    ]
    found = measured_evidence(at(30, 20), views, NOWHERE)
    assert found.true == pytest.approx([0.1, 0.2])
    assert sorted_rivals(found) == [0.5, 0.7]
    assert found.true_of.tolist() == found.rival_of.tolist() == [0, 0]


def test_the_view_of_the_pick_says_nothing_of_the_keypoint() -> None:
    views = [wall(0, {(30, 20): 0.0, (60, 40): 0.3}), wall(5, {(30, 20): 0.2, (60, 40): 0.4})]
    found = measured_evidence(at(30, 20), views, np.zeros(1, dtype=int))
    assert found.true == pytest.approx([0.2])
    assert sorted_rivals(found) == [0.3, 0.4]


def test_a_match_beside_the_keypoint_is_no_rival() -> None:
    beside = int(APART * np.hypot(HEIGHT, WIDTH))
    views = [wall(0, {(30 + beside, 20): 0.0, (60, 40): 0.3}), wall(5, {(60, 40): 0.4})]
    assert sorted_rivals(measured_evidence(at(30, 20), views, NOWHERE)) == [0.3, 0.4]
    views = [wall(0, {(30 + beside + 1, 20): 0.0}), wall(5, {})]
    assert measured_evidence(at(30, 20), views, NOWHERE).rival[0] == pytest.approx(1.0)


def test_views_that_do_not_show_the_keypoint_have_rivals_too() -> None:
    views = [wall(0, {(60, 40): 0.3}), wall(5, {(60, 40): 0.4})]
    found = measured_evidence(np.array([[9.0, 0.0, 1.0]]), views, NOWHERE)
    assert not len(found.true)
    assert sorted_rivals(found) == [0.3, 0.4]


def test_hidden_places_and_places_without_depth_are_not_looked_up() -> None:
    views = [wall(0, {(30, 20): 0.1, (60, 40): 0.3}), wall(0, {(30, 20): 0.2, (60, 40): 0.4}), wall(0, {})]
    views[1].depth[35:45, 55:65] = 0.5  # something in front of the rival
    views[2].depth[...] = 0.0
    found = measured_evidence(at(30, 20), views, NOWHERE)
    assert found.true == pytest.approx([0.1, 0.2])
    assert 0.4 not in sorted_rivals(found)
    assert len(found.off) == 2


def test_an_unknown_keypoint_has_no_samples() -> None:
    found = measured_evidence(np.full((1, 3), np.nan), [wall(0, {}), wall(5, {})], NOWHERE)
    assert not len(found.true)
    assert not len(found.rival)


def test_a_rival_that_stays_is_a_match_and_one_that_does_not_is_background() -> None:
    rng = np.random.default_rng(0)
    stays = [wall(i, {(30, 20): 0.2, (60, 40): 0.3}) for i in range(5)]
    changes = [wall(i, {(30, 20): 0.2, (int(rng.integers(20, 70)), 50): 0.3}) for i in range(5)]
    assert np.mean(measured_evidence(at(30, 20), stays, NOWHERE).rival) == pytest.approx(0.3)
    assert np.mean(measured_evidence(at(30, 20), changes, NOWHERE).rival) > 0.9


def test_the_mean_pixel_is_nearer_with_the_temperature_that_suits_the_map() -> None:
    found = measured_evidence(at(31, 21), [wall(0, {(31, 21): 0.9}), wall(5, {(31, 21): 0.9})], NOWHERE)
    assert found.off.shape == (2, len(TEMPERATURES))
    sharp = measured_evidence(at(30, 20), [wall(0, {(30, 20): 0.0}), wall(2, {(30, 20): 0.0})], NOWHERE).off
    assert (np.diff(sharp, axis=1) <= 1e-9).all()
    assert sharp[:, -1] == pytest.approx(0.0, abs=1e-6)


def test_the_level_of_a_frame_is_that_of_its_mean_likelihood() -> None:
    # Every second row and column counts.
    views = [wall(0, {(30, 20): 0.2}), wall(2, {(30, 20): 0.2, (60, 40): 0.4})]
    found = measured_evidence(at(30, 20), views, NOWHERE)
    n = HEIGHT * WIDTH / 4
    for i, alpha in enumerate(TEMPERATURES):
        mean = np.exp(-alpha * 1.0) + (np.exp(-alpha * 0.2) - np.exp(-alpha * 1.0)) / n
        assert found.true_level[0, i] == pytest.approx(-np.log(mean) / alpha, rel=1e-4)
    assert (found.rival_level[:, 0] < found.rival_level[:, 0].max() + 1e-6).all()
    assert len(found.rival_level) == len(found.rival)


def test_views_that_can_be_read_once_only_are_refused() -> None:
    with pytest.raises(ValueError, match="views: expected a list or the like"):
        measured_evidence(at(30, 20), iter([wall(0, {})]), NOWHERE)
