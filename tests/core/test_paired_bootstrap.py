from __future__ import annotations

import math

import numpy as np
import pytest

from bask_data.core.paired_bootstrap import Difference, paired_difference


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def everywhere(tracks: list[np.ndarray]) -> list[np.ndarray]:
    return [np.ones(track.shape, dtype=bool) for track in tracks]


def demonstrations(random: np.random.Generator, n: int, effect: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Errors of two methods that share what is hard about a demonstration, and differ by `effect` on average; frames
    and keypoints of a demonstration go wrong together."""
    a, b = [], []
    for hard in random.uniform(0.01, 0.2, n):
        shape = (int(random.integers(10, 20)), 4)
        common = hard + random.normal(0, 0.01, shape)
        a.append(common + effect + random.normal(0, 0.02))
        b.append(common)
    return a, b


def test_a_constant_difference_has_an_interval_of_no_width() -> None:
    b = [np.full((n, 3), 0.05) for n in (4, 9, 6)]
    a = [track - 0.01 for track in b]
    found = paired_difference(a, b, everywhere(a), rng())
    assert (found.mean, found.low, found.high) == pytest.approx((-0.01,) * 3)
    assert (found.n, found.n_demonstrations, found.is_shown) == (3 * 19, 3, True)


def test_the_mean_is_the_difference_of_the_means_of_the_table() -> None:
    a, b = demonstrations(rng(), 5, -0.03)
    chosen = [rng().random(track.shape) < 0.5 for track in a]
    found = paired_difference(a, b, chosen, rng())
    means = [np.concatenate([track[mask] for track, mask in zip(of, chosen, strict=True)]).mean() for of in (a, b)]
    assert found.mean == pytest.approx(means[0] - means[1])
    assert found.low < found.mean < found.high


def test_pairing_shows_what_the_spread_of_demonstrations_would_hide() -> None:
    a, b = demonstrations(rng(), 20, -0.03)
    per_demonstration = [track.mean() for track in b]
    found = paired_difference(a, b, everywhere(a), rng())
    assert np.std(per_demonstration) > 0.03
    assert found.high - found.low < 0.03 and found.is_shown


@pytest.mark.parametrize("n", [5, 20])
def test_without_an_effect_the_interval_covers_zero_at_the_nominal_rate(n: int) -> None:
    random, n_trials = rng(), 400
    shown = 0
    for _ in range(n_trials):
        a, b = demonstrations(random, n, 0.0)
        shown += paired_difference(a, b, everywhere(a), random).is_shown
    # Three standard deviations of the binomial distribution around 5 %.
    assert abs(shown / n_trials - 0.05) < 3 * math.sqrt(0.05 * 0.95 / n_trials)


def test_a_frame_without_one_of_the_estimates_counts_for_neither() -> None:
    a, b = [np.array([[0.1], [np.nan], [0.3]])] * 2, [np.array([[0.2], [0.2], [np.nan]])] * 2
    found = paired_difference(a, b, everywhere(a), rng())
    assert (found.n, found.mean) == (2, pytest.approx(-0.1))


def test_one_demonstration_shows_no_difference_and_none_has_no_mean() -> None:
    track = [np.full((3, 2), 0.1)]
    alone = paired_difference(track, [track[0] + 1], everywhere(track), rng())
    assert alone.mean == pytest.approx(-1.0) and math.isnan(alone.low) and not alone.is_shown
    nothing = paired_difference(track, track, [np.zeros((3, 2), dtype=bool)], rng())
    assert math.isnan(nothing.mean) and nothing.n == nothing.n_demonstrations == 0 and not nothing.is_shown


def test_demonstrations_without_such_frames_do_not_count() -> None:
    a, b = demonstrations(rng(), 6, -0.03)
    chosen = everywhere(a)
    chosen[2][:] = chosen[5][:] = False
    assert paired_difference(a, b, chosen, rng()).n_demonstrations == 4


def test_the_same_seed_gives_the_same_interval() -> None:
    a, b = demonstrations(rng(), 6, 0.0)
    found: list[Difference] = [paired_difference(a, b, everywhere(a), rng()) for _ in range(2)]
    assert found[0] == found[1]


def test_a_level_is_a_probability() -> None:
    with pytest.raises(ValueError, match="level: expected between 0 and 1, got 95.0"):
        paired_difference([], [], [], rng(), 95.0)
