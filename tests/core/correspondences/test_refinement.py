from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.correspondences.refinement import refined


def test_a_surface_that_is_off_is_corrected_and_one_that_is_not_is_left():
    rng = np.random.default_rng(0)
    rendered = np.full((60, 80), 0.6, np.float32)
    measured = (rendered + rng.normal(scale=0.001, size=rendered.shape)).astype(np.float32)
    measured[20:40, 20:40] += 0.004
    measured[50:, :] = 0.3
    measured[0, 0] = 0.0
    best, contradicted, noise = refined(measured, rendered, (0.01, 0.01))
    # 1 mm, as a share of the tolerance of 1.6 cm that most pixels have.
    assert noise == pytest.approx(0.001 / 0.016, rel=0.1)
    assert best[21:39, 21:39] == pytest.approx(0.604, abs=0.0015)
    flat = best[2:18, 2:18]
    assert (flat == np.float32(0.6)).mean() > 0.9
    assert (best[50:] == np.float32(0.3)).all()
    assert contradicted[50:].all()
    assert best[0, 0] == pytest.approx(0.6, abs=0.001)
    assert not contradicted[:50].any()


def test_exact_measurements_win_over_a_rough_surface_and_noisy_ones_do_not():
    """Bumps of 2 mm on a quarter of the image, which the surface lacks, finer than the window that is averaged over."""
    v, u = np.mgrid[:60, :80]
    rendered = np.full((60, 80), 0.6, np.float32)
    true = (rendered + np.where(u < 60, 0, 0.002 * np.sin(u) * np.sin(v))).astype(np.float32)
    exact, _, _ = refined(true, rendered, (0.01, 0.01))
    assert np.abs(exact - true).max() < 0.002
    assert np.abs(exact - true).mean() < 0.1 * np.abs(rendered - true).mean()
    measured = (rendered + np.random.default_rng(0).normal(scale=0.003, size=rendered.shape)).astype(np.float32)
    noisy, _, _ = refined(measured, rendered, (0.01, 0.01))
    assert np.sqrt(np.mean((noisy - rendered) ** 2)) < 0.25 * 0.003
