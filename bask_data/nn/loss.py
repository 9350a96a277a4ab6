"""Losses for descriptor networks: matches close in descriptor space, non-matches far apart.

Distances are z = |a - b| / sqrt(D), the root mean square difference over the D dimensions, so that margins and
temperatures do not depend on D.

Every loss is a mean over pairs of images, and terms are logged as sums with their counts, so that parts of a batch,
computed in sequence or by several processes, add up to the result of the whole batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from bask_data.nn.resnet import STRIDE

TINY = 1e-6
"""Added to the squared distances of heat maps before the square root, whose slope at zero is infinite. Corresponds to a
distance of 0.001; sensitivity not measured."""


@dataclass(frozen=True)
class ContrastiveSettings:
    """Margins and form of the contrastive loss.

    Args:
        form: `squared` is the hinge of the squared distance, max(0, M - z^2), as in the paper; `plain` is the squared
            hinge of the distance, max(0, M - z)^2, as in Dense Object Nets.
        non_match_term: `mean` over the non-matches of each match and over the matches; `sum` over the matches of those
            means, as Eq. 1 is printed; `hard`, the sum over all non-matches of a pair, on the object and off it
            together, divided by the number of those inside their margin, which keep their weight as they become rare.
        normalised: divide distances by sqrt(D); otherwise margins refer to plain Euclidean distances, and the two
            settings below have no effect.
        match_root: divide the squared distances of matches by sqrt(D) instead of D.
        background_normalised: divide the distances of non-matches off the object by sqrt(D), too.
    """

    margin_foreground: float = 0.25
    margin_background: float = 0.75
    form: Literal["squared", "plain"] = "squared"
    non_match_term: Literal["mean", "sum", "hard"] = "mean"
    normalised: bool = True
    match_root: bool = False
    background_normalised: bool = True


@dataclass(frozen=True)
class Terms:
    """A loss and its terms.

    Args:
        logged: by name, the sum of a term and the count to divide it by for the mean; includes `loss`.
    """

    loss: Float[Tensor, ""]
    logged: dict[str, Float[Tensor, "2"]]


def squared_distance(a: Float[Tensor, "*n d"], b: Float[Tensor, "*n d"]) -> Float[Tensor, "*n"]:
    """z^2, the mean squared difference over the dimensions."""
    return (a - b).square().mean(dim=-1)


def contrastive(
    matches_a: Float[Tensor, "b m d"],
    matches_b: Float[Tensor, "b m d"],
    non_matches_b: Float[Tensor, "b m n d"],
    foreground: Bool[Tensor, "b m n"],
    valid: Bool[Tensor, "b m n"],
    settings: ContrastiveSettings = ContrastiveSettings(),
) -> Terms:
    """Mean over matches of z^2, plus the hinge of the non-matches, foreground and background together.

    By default the hinge is averaged over all non-matches. Eq. 1 as printed gives each match the weight 1 / m, and each
    of its n non-matches 1 / n: m times as much as their mean. Other methods divide differently, see
    `ContrastiveSettings`.

    Args:
        non_matches_b: descriptors of the second image that do not correspond to `matches_a`.
        foreground: non-matches on the sampled object, with the smaller margin.
        valid: non-matches to use; the others are ignored.

    Source: von Hartz et al. 2023, Eq. 1 (`squared` and `sum`); Florence et al. 2018, Sec. III (`plain` and `hard`).
    """
    match_unit, unit = _units(settings, matches_a.shape[-1], foreground)
    match = match_unit * squared_distance(matches_a, matches_b)
    z_squared = unit * squared_distance(matches_a[:, :, None].expand_as(non_matches_b), non_matches_b)
    hinge = _hinge(z_squared, foreground, settings) * valid
    inside = hinge.detach() > 0
    groups = {"foreground": valid & foreground, "background": valid & ~foreground}
    if settings.non_match_term == "hard":
        non_match = hinge.sum((1, 2)) / inside.sum((1, 2)).clamp(min=1)
    else:
        of_matches = hinge.sum(-1) / valid.sum(-1).clamp(min=1)
        non_match = of_matches.sum(-1) if settings.non_match_term == "sum" else of_matches.mean(-1)
    loss = match.mean(-1) + non_match
    logged = {"loss": _summed(loss), "loss_match": _summed(match)}
    for name, group in groups.items():
        logged[f"loss_{name}"] = _summed(hinge, group)
        logged[f"share_inside_margin_{name}"] = _summed(inside, group)
    return Terms(loss.mean(), logged)


def _units(
    settings: ContrastiveSettings, dimension: int, foreground: Bool[Tensor, "b m n"]
) -> tuple[float, float | Tensor]:
    """Factors on the mean squared differences of matches and of non-matches."""
    if not settings.normalised:
        return float(dimension), float(dimension)
    match_unit = math.sqrt(dimension) if settings.match_root else 1.0
    return match_unit, 1.0 if settings.background_normalised else torch.where(foreground, 1.0, float(dimension))


def _hinge(
    z_squared: Float[Tensor, "b m n"], foreground: Bool[Tensor, "b m n"], settings: ContrastiveSettings
) -> Float[Tensor, "b m n"]:
    """The hinge of each non-match, with the margin of where it is."""
    margin = torch.where(foreground, settings.margin_foreground, settings.margin_background)
    if settings.form == "squared":
        return F.relu(margin - z_squared)
    # The slope of the root is infinite at zero, and NaN in the gradient even of what `where` does not choose.
    apart = z_squared > 0
    z = z_squared.where(apart, 1.0).sqrt().where(apart, 0.0)
    return F.relu(margin - z).square()


def heat_map_entropy(
    queries: Float[Tensor, "b m d"],
    descriptors: Float[Tensor, "b d h8 w8"],
    uv: Float[Tensor, "b m 2"],
    alpha: float,
    refinement: int = 2,
) -> Float[Tensor, "b m"]:
    """Cross-entropy between the heat map softmax(-alpha z) of each query and its true position.

    This trains the heat map that keypoints are computed from. The true position lies between grid points, so its
    probability is shared among the four around it.

    Args:
        queries: descriptors of the first image at the matches.
        descriptors: descriptors of the second image at stride 8.
        uv: the matches in the second image, pixels.
        alpha: temperature of the heat map.
        refinement: grid points per cell and direction.

    Source: van den Oord et al. 2018 (InfoNCE) with every other pixel as a negative.
    """
    height, width = descriptors.shape[-2] * refinement, descriptors.shape[-1] * refinement
    fine = F.interpolate(descriptors, size=(height, width), mode="bilinear", align_corners=False).flatten(2)
    dimension = queries.shape[-1]
    # |a - b|^2 = |a|^2 + |b|^2 - 2 ab: one matrix product instead of m h w differences of D numbers. Rounding may make
    # it negative.
    product = queries @ fine
    z_squared = queries.square().sum(-1)[..., None] + fine.square().sum(1)[:, None] - 2.0 * product
    logits = -alpha / math.sqrt(dimension) * (z_squared.clamp(min=0.0) + dimension * TINY).sqrt()
    log_heat = F.log_softmax(logits, dim=-1)
    index, weight = bilinear_corners(uv, STRIDE / refinement, height, width)
    return -(log_heat.gather(-1, index) * weight).sum(-1)


def bilinear_corners(
    uv: Float[Tensor, "b m 2"], spacing: float, height: int, width: int
) -> tuple[Tensor, Float[Tensor, "b m 4"]]:
    """Flat indices and weights of the four grid points around each pixel.

    Args:
        spacing: pixels between grid points; the first lies at the centre of the first `spacing` pixels.
        height, width: size of the grid.
    """
    position = (uv + 0.5) / spacing - 0.5
    u = position[..., 0].clamp(0, width - 1)
    v = position[..., 1].clamp(0, height - 1)
    u0, v0 = u.floor().clamp(max=max(width - 2, 0)), v.floor().clamp(max=max(height - 2, 0))
    du, dv = u - u0, v - v0
    u1, v1 = (u0 + 1).clamp(max=width - 1), (v0 + 1).clamp(max=height - 1)
    index = torch.stack([v0 * width + u0, v0 * width + u1, v1 * width + u0, v1 * width + u1], dim=-1).long()
    weight = torch.stack([(1 - du) * (1 - dv), du * (1 - dv), (1 - du) * dv, du * dv], dim=-1)
    return index, weight


def infonce(
    descriptors_a: Float[Tensor, "b d h8 w8"],
    descriptors_b: Float[Tensor, "b d h8 w8"],
    matches_a: Float[Tensor, "b m d"],
    matches_b: Float[Tensor, "b m d"],
    uv_a: Float[Tensor, "b m 2"],
    uv_b: Float[Tensor, "b m 2"],
    alpha: float,
    match_weight: float,
) -> Terms:
    """Cross-entropy of the heat maps in both directions, plus `match_weight` times z^2 of the matches.

    The softmax depends on differences of distances only. The match term keeps the distances of matches near zero, as
    their use in the observation likelihood exp(-alpha z) requires.
    """
    forward = heat_map_entropy(matches_a, descriptors_b, uv_b, alpha)
    backward = heat_map_entropy(matches_b, descriptors_a, uv_a, alpha)
    match = squared_distance(matches_a, matches_b)
    entropy = 0.5 * (forward + backward)
    loss = entropy + match_weight * match
    logged = {"loss": _summed(loss), "loss_match": _summed(match), "loss_heat_map": _summed(entropy)}
    return Terms(loss.mean(), logged)


def _summed(values: Float[Tensor, "*n"] | Bool[Tensor, "*n"], chosen: Bool[Tensor, "*n"] | None = None) -> Tensor:
    """Sum and number of the chosen values; all if None."""
    with torch.no_grad():
        # Doubles: float32 cannot count beyond 16 million, and a few large batches have more non-matches.
        counted = torch.ones_like(values, dtype=torch.bool) if chosen is None else chosen
        return torch.stack([(values * counted).sum(dtype=torch.float64), counted.sum(dtype=torch.float64)])
