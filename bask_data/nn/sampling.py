"""Training batches: each a pure function of the seed and the number of its step.

So they are the same whoever makes them, in whatever order, and after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from numpy.random import Generator

from bask_data.core.geometry import in_image
from bask_data.nn.augment import AugmentSettings, moved, painted_over, random_affine, recoloured, warped

REDRAWS = 8
"""Times a non-match that came too close to its match is drawn again before it is left out."""


@dataclass(frozen=True)
class Pair:
    """Two images of one scene with their labels and matches, of any sizes."""

    rgb_a: UInt8[ndarray, "ha wa 3"]
    rgb_b: UInt8[ndarray, "hb wb 3"]
    instance_a: UInt8[ndarray, "ha wa"]
    """Visible instance at each pixel, 0 = none."""
    instance_b: UInt8[ndarray, "hb wb"]
    instance: UInt8[ndarray, "m"]
    """Instance of each match."""
    uv_a: Float[ndarray, "m 2"]
    uv_b: Float[ndarray, "m 2"]


@runtime_checkable
class PairSource(Protocol):
    """Where pairs come from."""

    @property
    def n_pairs(self) -> int:
        """Number of pairs; each has at least one match."""

    def pair(self, i_pair: int) -> Pair:
        """One of them."""


@dataclass(frozen=True)
class SampleSettings:
    """What a batch holds.

    Args:
        size: (height, width) of the network's input.
        n_pairs: pairs in a batch.
        n_matches: matches of a pair, repeated where there are fewer.
        n_non_matches: per match; 0 for a loss that needs none.
        foreground_share: share of non-matches on the sampled instance; `auto` is the share of the image it covers.
        clearance: pixels around the true match from which no non-match is taken.
    """

    size: tuple[int, int]
    n_pairs: int = 2
    n_matches: int = 256
    n_non_matches: int = 150
    foreground_share: float | Literal["auto"] = "auto"
    clearance: float = 5.0


@dataclass(frozen=True)
class Batch:
    """Input of one step. Images are of the network's size, coordinates in its pixels."""

    rgb_a: UInt8[ndarray, "b h w 3"]
    rgb_b: UInt8[ndarray, "b h w 3"]
    uv_a: Float[ndarray, "b m 2"]
    uv_b: Float[ndarray, "b m 2"]
    non_matches_b: Float[ndarray, "b m n 2"]
    foreground: Bool[ndarray, "b m n"]
    valid: Bool[ndarray, "b m n"]


def batch_of_step(source: PairSource, seed: int, step: int, sample: SampleSettings, augment: AugmentSettings) -> Batch:
    """The batch that belongs to a step."""
    rng = np.random.default_rng((seed, step))
    examples = [_example(source, sample, augment, rng) for _ in range(sample.n_pairs)]
    return Batch(*(np.stack(column) for column in zip(*examples, strict=True)))


def _example(
    source: PairSource, sample: SampleSettings, augment: AugmentSettings, rng: Generator
) -> tuple[ndarray, ...]:
    pair = source.pair(int(rng.integers(source.n_pairs)))
    # Instances are drawn evenly, not by their number of matches: small objects are not to be forgotten.
    chosen = rng.choice(np.unique(pair.instance))
    of_chosen = np.flatnonzero(pair.instance == chosen)
    anchor = rng.choice(of_chosen)
    flipped = bool(rng.random() < augment.flip)
    images = []
    both = [(pair.rgb_a, pair.instance_a, pair.uv_a), (pair.rgb_b, pair.instance_b, pair.uv_b)]
    # Pairs are listed in one order, but matches are looked for from either side.
    for rgb, instance, uv in both[:: rng.choice([1, -1])]:
        at = uv[anchor].astype(np.float64)
        out_from_in = random_affine(instance.shape, sample.size, at, flipped, augment, rng)
        images.append((*augmented(rgb, instance, out_from_in, sample.size, augment, rng), moved(out_from_in, uv)))
    (rgb_a, _, uv_a), (rgb_b, instance_b, uv_b) = images
    visible = of_chosen[(in_image(uv_a, *sample.size) & in_image(uv_b, *sample.size))[of_chosen]]
    taken = rng.choice(visible, sample.n_matches, replace=len(visible) < sample.n_matches)
    return (
        rgb_a,
        rgb_b,
        uv_a[taken].astype(np.float32),
        uv_b[taken].astype(np.float32),
        *non_matches(instance_b == chosen, uv_b[taken], sample, rng),
    )


def augmented(
    rgb: UInt8[ndarray, "h w 3"],
    instance: UInt8[ndarray, "h w"],
    out_from_in: Float[ndarray, "2 3"],
    size: tuple[int, int],
    settings: AugmentSettings,
    rng: Generator,
) -> tuple[UInt8[ndarray, "h2 w2 3"], UInt8[ndarray, "h2 w2"]]:
    """An image and its labels, warped and recoloured; what the warp leaves empty is painted over."""
    out = warped(rgb, out_from_in, size, smooth=True)
    labels = warped(instance, out_from_in, size, smooth=False)
    if rng.random() < settings.background:
        out = painted_over(out, labels > 0, out, rng)
    else:
        covered = warped(np.full(instance.shape, 255, np.uint8), out_from_in, size, smooth=False) > 0
        if not covered.all():
            out = painted_over(out, covered, out, rng)
    return recoloured(out, settings, rng), labels


def non_matches(
    mask: Bool[ndarray, "h w"], uv: Float[ndarray, "m 2"], sample: SampleSettings, rng: Generator
) -> tuple[Float[ndarray, "m n 2"], Bool[ndarray, "m n"], Bool[ndarray, "m n"]]:
    """Pixels of the second image that do not show what the first shows at each match.

    Args:
        mask: the sampled instance in the second image.
        uv: the matches in the second image.

    Returns:
        Pixels, whether each is on the instance, and whether it counts: not, where even repeated draws came too close.
    """
    m, n = len(uv), sample.n_non_matches
    flat = mask.ravel()
    on, off = np.flatnonzero(flat), np.flatnonzero(~flat)
    share = len(on) / flat.size if sample.foreground_share == "auto" else sample.foreground_share
    n_foreground = round(share * n)
    if len(on) == 0 or len(off) == 0:
        n_foreground = n if len(on) else 0
    foreground = np.broadcast_to(np.arange(n) < n_foreground, (m, n)).copy()
    pixels = np.empty((m, n, 2), np.float32)
    redraw = np.ones((m, n), bool)
    for _ in range(REDRAWS):
        for pool, wanted in ((on, redraw & foreground), (off, redraw & ~foreground)):
            drawn = rng.choice(pool, int(wanted.sum())) if wanted.any() else np.empty(0, int)
            pixels[wanted] = np.stack([drawn % mask.shape[1], drawn // mask.shape[1]], axis=-1)
        redraw = np.linalg.norm(pixels - uv[:, None], axis=-1) < sample.clearance
        if not redraw.any():
            break
    return pixels, foreground, ~redraw
