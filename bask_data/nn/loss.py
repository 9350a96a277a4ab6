"""What a descriptor network is trained for: matches alike, everything else apart.

Distances are z = |a - b| / sqrt(D), the root mean square difference over the D dimensions, so that margins and
temperatures mean the same for every D.

Every loss is a mean over pairs of images, and what is logged are sums beside their counts: parts of a batch, computed
one after the other or by several processes, add up to what the whole would have given.
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
"""Squared distance of descriptors below which the square root is flattened: its slope at zero is infinite. A thousandth
in the distance itself, far below the margins of 0.25 and 0.75; sensitivity not measured."""


@dataclass(frozen=True)
class ContrastiveSettings:
    """Margins, and the form of the hinge.

    Args:
        form: `squared` hinges the squared distance, max(0, M - z^2), as the paper has it; `plain` squares the hinge of
            the distance, max(0, M - z)^2, as Dense Object Nets did before.
        hard_negatives: non-matches on the object and off it have a mean each, over those of the whole pair that lie
            inside the margin: they keep their weight while such non-matches get rare.
        normalised: distances are divided by sqrt(D). Without, margins are of plain Euclidean distances.
    """

    margin_foreground: float = 0.25
    margin_background: float = 0.75
    form: Literal["squared", "plain"] = "squared"
    hard_negatives: bool = False
    normalised: bool = True


@dataclass(frozen=True)
class Terms:
    """A loss and what it is made of.

    Args:
        logged: by name, a sum and the count it is divided by to give the term's mean; `loss` is among them.
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
    """Mean over matches of z^2, plus the mean over non-matches of the hinge.

    Each match carries its own mean over its non-matches, foreground and background together: their share is decided
    where they are drawn, not here. `hard_negatives` counts otherwise.

    Args:
        non_matches_b: descriptors of the second image that do not correspond to `matches_a`.
        foreground: non-matches on the sampled object, with the smaller margin.
        valid: non-matches that count.

    Source: von Hartz et al. 2023, Eq. 1 (`squared`; the mean over matches is taken of both terms); Florence et al.
        2018, Sec. III (`plain` and `hard_negatives`).
    """
    unit = 1 if settings.normalised else matches_a.shape[-1]
    match = unit * squared_distance(matches_a, matches_b)
    z_squared = unit * squared_distance(matches_a[:, :, None].expand_as(non_matches_b), non_matches_b)
    margin = torch.where(foreground, settings.margin_foreground, settings.margin_background)
    if settings.form == "squared":
        hinge = F.relu(margin - z_squared)
    else:
        hinge = F.relu(margin - (z_squared + TINY).sqrt()).square()
    hinge = hinge * valid
    inside = hinge.detach() > 0
    groups = {"foreground": valid & foreground, "background": valid & ~foreground}
    if settings.hard_negatives:
        hard = [(hinge * group).sum((1, 2)) / (inside & group).sum((1, 2)).clamp(min=1) for group in groups.values()]
        non_match = hard[0] + hard[1]
    else:
        non_match = (hinge.sum(-1) / valid.sum(-1).clamp(min=1)).mean(-1)
    loss = match.mean(-1) + non_match
    logged = {"loss": _summed(loss), "loss_match": _summed(match)}
    for name, group in groups.items():
        logged[f"loss_{name}"] = _summed(hinge, group)
        logged[f"share_inside_margin_{name}"] = _summed(inside, group)
    return Terms(loss.mean(), logged)


def heat_map_entropy(
    queries: Float[Tensor, "b m d"],
    descriptors: Float[Tensor, "b d h8 w8"],
    uv: Float[Tensor, "b m 2"],
    alpha: float,
    refinement: int = 2,
) -> Float[Tensor, "b m"]:
    """Cross-entropy between the heat map softmax(-alpha z) of each query and where it truly is.

    This trains for exactly what keypoints are read from. The true position falls between grid points, so its
    probability is shared among the four around it.

    Args:
        queries: descriptors of the first image at the matches.
        descriptors: the second image's, at stride 8.
        uv: the matches in the second image, pixels.
        refinement: grid points per cell and direction.

    Source: van den Oord et al. 2018 (InfoNCE) with every other pixel as a negative.
    """
    height, width = descriptors.shape[-2] * refinement, descriptors.shape[-1] * refinement
    fine = F.interpolate(descriptors, size=(height, width), mode="bilinear", align_corners=False).flatten(2)
    dimension = queries.shape[-1]
    # |a - b|^2 = |a|^2 + |b|^2 - 2 ab: one matrix product instead of m h w differences of D numbers. Rounding may take
    # it below zero.
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
        spacing: pixels between grid points; the first stands for the first `spacing` pixels.
        height, width: of the grid.
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
    """Cross-entropy of the heat maps in both directions, plus a share of the matches' z^2.

    The softmax does not care how far matches are apart as long as all else is farther. The match term keeps them near
    zero, where exp(-alpha z) is read as a likelihood.
    """
    forward = heat_map_entropy(matches_a, descriptors_b, uv_b, alpha)
    backward = heat_map_entropy(matches_b, descriptors_a, uv_a, alpha)
    match = squared_distance(matches_a, matches_b)
    entropy = 0.5 * (forward + backward)
    loss = entropy + match_weight * match
    logged = {"loss": _summed(loss), "loss_match": _summed(match), "loss_heat_map": _summed(entropy)}
    return Terms(loss.mean(), logged)


def _summed(values: Float[Tensor, "*n"] | Bool[Tensor, "*n"], chosen: Bool[Tensor, "*n"] | None = None) -> Tensor:
    """The sum of what is chosen, and how many that is."""
    with torch.no_grad():
        # Doubles: a float stops counting in ones at 16 million, which a few large batches have of non-matches.
        counted = torch.ones_like(values, dtype=torch.bool) if chosen is None else chosen
        return torch.stack([(values * counted).sum(dtype=torch.float64), counted.sum(dtype=torch.float64)])
