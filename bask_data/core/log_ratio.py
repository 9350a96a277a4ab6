"""The ratio of two densities, fitted to samples of both."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import minimize

MISTAKEN = 0.02
"""Share of the samples assumed to be of the other sort, because a pose, a depth or a pick is wrong: no frame then
counts more than about 49 to 1, and distributions that do not overlap have a slope. Chosen, sensitivity not measured."""

LEAST_SCALE = 1e-3
"""Least standard deviation of distances, so that equal ones can be fitted."""


def log_ratio(
    true: Float[ndarray, "n"],
    rival: Float[ndarray, "m"],
    true_weight: Float[ndarray, "n"] | None = None,
    rival_weight: Float[ndarray, "m"] | None = None,
    mistaken: float = MISTAKEN,
    least: float = 1e-3,
    most: float = np.inf,
) -> tuple[float, float]:
    """Slope alpha and crossing z_0 of the line -alpha (z - z_0) that fits log f_true(z) / f_rival(z) best.

    It is a logistic regression, which estimates a ratio of densities without either of them. For two normal
    distributions of equal variance the line is exact: alpha is the difference of their means over the variance, z_0 the
    middle between them.

    Args:
        true_weight, rival_weight: of the samples; default: equal ones. Both sorts weigh the same together.
        mistaken: share of the samples that are of the other sort.
        least, most: bounds of alpha, positive.
    """
    z = np.concatenate([true, rival]).astype(np.float64)
    weight = np.concatenate([_normalised(true, true_weight), _normalised(rival, rival_weight)])
    target = np.repeat([1 - mistaken, mistaken], [len(true), len(rival)])
    middle = weight @ z / 2
    scale = max(float(np.sqrt(weight @ (z - middle) ** 2 / 2)), LEAST_SCALE)
    x = (middle - z) / scale

    def loss(line: Float[ndarray, "2"]) -> tuple[float, Float[ndarray, "2"]]:
        ratio = line[0] * x + line[1]
        rest = weight * (1 / (1 + np.exp(-ratio)) - target)
        return float(weight @ (np.logaddexp(0, ratio) - target * ratio)), np.array([rest @ x, rest.sum()])

    limits = [(least * scale, most * scale), (None, None)]
    slope, offset = minimize(loss, np.array([limits[0][0], 0.0]), jac=True, bounds=limits, tol=1e-12).x
    return float(slope / scale), float(middle + offset / slope * scale)


def _normalised(samples: Float[ndarray, "n"], weight: Float[ndarray, "n"] | None) -> Float[ndarray, "n"]:
    """Weights that sum to one."""
    weight = np.ones(len(samples)) if weight is None else weight
    return weight / weight.sum()
