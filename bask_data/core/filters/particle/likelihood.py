"""The observation likelihood: how well each particle agrees with a camera's frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.filters.heatmap import TAU_MOST, unseen_likelihood
from bask_data.core.filters.observation import Observation
from bask_data.core.filters.particle.settings import ParticleSettings
from bask_data.core.filters.per_keypoint import per_keypoint

LEAST_LIKELIHOOD = 1e-30
"""Lower bound of a likelihood, so that weights can be normalised even if no particle explains the frame."""


@dataclass(frozen=True)
class FrameLikelihood:
    """The likelihood of one camera's frame given each particle.

    Attributes:
        likelihood: of the frame.
        seen: the part of it for a particle that is seen.
        tau: likelihood of the frame if the camera does not see the keypoint.
    """

    likelihood: Float[ndarray, "k n"]
    seen: Float[ndarray, "k n"]
    tau: Float[ndarray, "k"]


def frame_likelihood(
    points_world: Float[ndarray, "k n 3"],
    seen: Observation,
    settings: ParticleSettings,
    usual_match: Float[ndarray, "k"] | float = 0.0,
) -> FrameLikelihood:
    """The likelihood of a camera's frame given each particle.

        p = p_o p_f tau + (1 - p_f) tau + (1 - p_o) p_f p_d p_c

    p_o = 1 - Phi((z^d - (x^d - eps)) / sigma), the probability that the particle is hidden, is large where the
    *measured* depth z^d is clearly smaller than the particle's, x^d. p_d is exp(-(z^d - x^d)^2 / 2 sigma^2): its peak
    is one, so that tau has the same weight at every depth. p_f is one inside the image, else zero; p_c is
    exp(-alpha z).

    A pixel without depth is a measurement of infinite noise, the limit of the formula for sigma to infinity: p_o = 1/2
    (`hidden_without_depth`) and p_d = 1.

    Args:
        usual_match: of `ParticleBelief`; gives tau a lower bound.

    Source: von Hartz et al. 2023, Eq. 6 to 10.
    """
    tau = unseen_likelihood(seen.distance, settings.alpha, settings.tau, settings.tau_ratio)
    if settings.tau is None:
        tau = np.maximum(tau, np.minimum(settings.tau_match * usual_match, TAU_MOST))
    alpha = np.ascontiguousarray(per_keypoint(settings.alpha, len(points_world), "alpha"))
    model = np.array(
        [
            settings.depth_noise,
            settings.depth_noise_floor,
            settings.occlusion_margin,
            settings.hidden_without_depth,
        ]
    )
    camera = seen.distance, seen.depth, seen.K, seen.world_from_camera
    total, part = _likelihoods(points_world, *camera, np.array(tau), alpha, model)
    return FrameLikelihood(total, part, tau)


@compiled
def _likelihoods(
    points_world: ndarray,
    distance: ndarray,
    depth: ndarray,
    K: ndarray,
    world_from_camera: ndarray,
    tau: ndarray,
    alpha: ndarray,
    model: ndarray,
) -> tuple[ndarray, ndarray]:
    """`likelihood` and `seen` of `FrameLikelihood`. A particle's depth is that of the nearest pixel, its distance is
    interpolated between four.

    Args:
        model: depth noise as a share of depth, its floor, eps and p_o without depth.
    """
    rotation, position = world_from_camera[:3, :3], world_from_camera[:3, 3]
    total, part = np.empty(points_world.shape[:2]), np.empty(points_world.shape[:2])
    height, width = depth.shape
    map_height, map_width = distance.shape[1:]
    share, floor, margin, hidden = model
    scale_u, scale_v = map_width / width, map_height / height
    right, down = min(map_width - 1, 1), min(map_height - 1, 1)
    for i in range(points_world.shape[0]):
        for j in range(points_world.shape[1]):
            total[i, j], part[i, j] = tau[i], 0.0
            a = points_world[i, j, 0] - position[0]
            b = points_world[i, j, 1] - position[1]
            c = points_world[i, j, 2] - position[2]
            x_d = a * rotation[0, 2] + b * rotation[1, 2] + c * rotation[2, 2]
            if not x_d > 0:
                continue
            x = (a * rotation[0, 0] + b * rotation[1, 0] + c * rotation[2, 0]) / x_d
            y = (a * rotation[0, 1] + b * rotation[1, 1] + c * rotation[2, 1]) / x_d
            u = K[0, 0] * x + K[0, 1] * y + K[0, 2]
            v = K[1, 1] * y + K[1, 2]
            if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                continue
            z_d = depth[min(max(int(np.rint(v)), 0), height - 1), min(max(int(np.rint(u)), 0), width - 1)]
            p_o, p_d = hidden, 1.0
            if z_d > 0:
                sigma = share * x_d + floor
                p_o = 0.5 * math.erfc((z_d - (x_d - margin)) / sigma * math.sqrt(0.5))
                p_d = math.exp(-0.5 * ((z_d - x_d) / sigma) ** 2)
            map_u = min(max((u + 0.5) * scale_u - 0.5, 0.0), map_width - 1.0)
            map_v = min(max((v + 0.5) * scale_v - 0.5, 0.0), map_height - 1.0)
            left, top = min(int(map_u), max(map_width - 2, 0)), min(int(map_v), max(map_height - 2, 0))
            s, t = map_u - left, map_v - top
            upper = (1 - s) * distance[i, top, left] + s * distance[i, top, left + right]
            lower = (1 - s) * distance[i, top + down, left] + s * distance[i, top + down, left + right]
            part[i, j] = (1.0 - p_o) * p_d * math.exp(-alpha[i] * ((1 - t) * upper + t * lower))
            total[i, j] = max(p_o * tau[i] + part[i, j], LEAST_LIKELIHOOD)
    return total, part
