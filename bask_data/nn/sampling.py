"""Training batches: each a pure function of the seed and the number of its step.

So they are the same whoever makes them, in whatever order, and after an interruption. A batch is planned first: which
matches, which non-matches, how each image is changed. Its pixels are made from the plan, here or on a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor

from bask_data.core.geometry import in_image
from bask_data.nn import rendering
from bask_data.nn.augment import (
    AugmentedView,
    AugmentSettings,
    Layer,
    covered,
    layer,
    moved,
    pasting_affine,
    random_affine,
    random_ground,
    random_look,
    random_window,
    warped_labels,
)

REDRAWS = 8
"""Times a non-match that came too close to its match is drawn again before it is left out. Even where a tenth of the
pool is too close, eight draws leave out one in 10^8."""

N_OF_ITSELF = 4096
"""Pixels of an object, at most, of which the matches of an image with itself are taken: 32 times the matches of a pair
by default. Sensitivity not measured."""

LEAST_SHOWN = 0.25
"""Share of the matches in view that a pasted object has to leave visible; else the pair goes without it. Chosen;
sensitivity not measured."""


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

    @property
    def scans(self) -> Int[ndarray, "p"]:
        """The scan each pair is of, as a number: instances mean the same within a scan alone."""

    @property
    def n_instances(self) -> Int[ndarray, "p"]:
        """Instances with matches in the scan each pair is of."""

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
        self_pairs: probability that both images of a pair are the same one, changed apart: its matches are exact, where
            those of two views are as far off as the cameras' poses, and lie anywhere on the object, where those of two
            views need depth in both.
    """

    size: tuple[int, int]
    n_pairs: int = 2
    n_matches: int = 256
    n_non_matches: int = 150
    foreground_share: float | Literal["auto"] = "auto"
    clearance: float = 5.0
    self_pairs: float = 0.0


@dataclass(frozen=True)
class Examples:
    """What a training learns from: pairs, and what becomes of them in a batch."""

    source: PairSource
    sample: SampleSettings
    augment: AugmentSettings


@dataclass(frozen=True)
class Batch:
    """Input of one step, arrays or tensors. Images are of the network's size, coordinates in its pixels."""

    rgb_a: UInt8[ndarray | Tensor, "b h w 3"]
    rgb_b: UInt8[ndarray | Tensor, "b h w 3"]
    uv_a: Float[ndarray | Tensor, "b m 2"]
    uv_b: Float[ndarray | Tensor, "b m 2"]
    non_matches_b: Float[ndarray | Tensor, "b m n 2"]
    foreground: Bool[ndarray | Tensor, "b m n"]
    valid: Bool[ndarray | Tensor, "b m n"]

    def on(self, device: torch.device) -> Batch:
        """The same as tensors on a device."""
        return Batch(*(rendering.to_device(getattr(self, field.name), device) for field in fields(self)))


@dataclass(frozen=True)
class Plan:
    """A batch before its images are made: what each of them shows, and the rest of `Batch` as it is."""

    views_a: tuple[AugmentedView, ...]
    views_b: tuple[AugmentedView, ...]
    uv_a: Float[ndarray, "b m 2"]
    uv_b: Float[ndarray, "b m 2"]
    non_matches_b: Float[ndarray, "b m n 2"]
    foreground: Bool[ndarray, "b m n"]
    valid: Bool[ndarray, "b m n"]


def batch_of_step(
    source: PairSource,
    seed: int,
    step: int,
    sample: SampleSettings,
    augment: AugmentSettings,
    examples: range | None = None,
) -> Batch:
    """The batch that belongs to a step.

    Args:
        examples: some of the step's pairs instead of all, for one of several processes or a part of a step. What an
            example is depends on the seed, the step and its own number alone.
    """
    plan = plan_of_step(source, seed, step, sample, augment, examples)
    rgb_a, rgb_b = (np.stack([rendering.drawn(view) for view in views]) for views in (plan.views_a, plan.views_b))
    return Batch(rgb_a, rgb_b, plan.uv_a, plan.uv_b, plan.non_matches_b, plan.foreground, plan.valid)


def plan_of_step(
    source: PairSource,
    seed: int,
    step: int,
    sample: SampleSettings,
    augment: AugmentSettings,
    examples: range | None = None,
) -> Plan:
    """The batch that belongs to a step, its images not made yet."""
    chosen = range(sample.n_pairs) if examples is None else examples
    found = [_example(source, sample, augment, np.random.default_rng((seed, step, i))) for i in chosen]
    views_a, views_b, *arrays = zip(*found, strict=True)
    return Plan(views_a, views_b, *(np.stack(column) for column in arrays))


def rendered(plan: Plan, device: torch.device) -> Batch:
    """The planned batch as tensors, its images made on the device."""
    rgb = rendering.drawn_on([*plan.views_a, *plan.views_b], device)
    arrays = (plan.uv_a, plan.uv_b, plan.non_matches_b, plan.foreground, plan.valid)
    return Batch(*rgb.chunk(2), *(rendering.to_device(array, device) for array in arrays))


@dataclass(frozen=True)
class _Subject:
    """What an example is of: an instance of a pair of images, and whether both are mirrored."""

    i_pair: int
    instance: int
    flipped: bool


@dataclass
class _Side:
    """One image of a pair on its way to an `AugmentedView`."""

    rgb: UInt8[ndarray, "h w 3"]
    instance: UInt8[ndarray, "h w"]
    out_from_in: Float[ndarray, "2 3"]
    uv: Float[ndarray, "m 2"]
    """The matches in the view."""
    labels: UInt8[ndarray, "h2 w2"]
    """Visible instances in the view; 0 where something was pasted and off the crop."""
    shown: Bool[ndarray, "h2 w2"] | None
    """Where the image has pixels for the view; None: everywhere."""
    pasted: Layer | None = None

    def shows(self, instance: int) -> Bool[ndarray, "m"]:
        """Matches at whose pixel the instance is seen."""
        height, width = self.labels.shape
        inside = in_image(self.uv, height, width)
        u, v = np.rint(np.where(inside[:, None], self.uv, 0)).astype(int).T
        # Rounding takes -0.5 to 0, but the far edge beyond the last pixel.
        return inside & (self.labels[np.minimum(v, height - 1), np.minimum(u, width - 1)] == instance)


def _example(
    source: PairSource, sample: SampleSettings, augment: AugmentSettings, rng: Generator
) -> tuple[AugmentedView | ndarray, ...]:
    i_pair = int(rng.integers(source.n_pairs))
    pair = source.pair(i_pair)
    # Instances are drawn evenly, not by their number of matches: small objects are not to be forgotten.
    chosen = int(rng.choice(np.unique(pair.instance)))
    of_chosen = pair.instance == chosen
    anchor = int(rng.choice(np.flatnonzero(of_chosen)))
    flipped = bool(rng.random() < augment.flip)
    # Pairs are listed in one order, but matches are looked for from either side.
    both = [(pair.rgb_a, pair.instance_a, pair.uv_a), (pair.rgb_b, pair.instance_b, pair.uv_b)][:: rng.choice([1, -1])]
    if sample.self_pairs and rng.random() < sample.self_pairs:
        rgb, instance, uv = both[0]
        mask = instance == chosen
        if mask.any():
            uv = _pixels_of(mask, rng)
            of_chosen, anchor = np.ones(len(uv), bool), 0
        both = [(rgb, instance, uv)] * 2
    a, b = (_placed(*image, anchor, flipped, sample.size, augment, rng) for image in both)
    visible = of_chosen & a.shows(chosen) & b.shows(chosen)
    if not visible.any():
        # Matches at an object's very edge may all round to pixels beyond it. They are right all the same.
        visible = of_chosen & in_image(a.uv, *sample.size) & in_image(b.uv, *sample.size)
    elif rng.random() < augment.composition:
        visible = _composed(a, b, visible, source, _Subject(i_pair, chosen, flipped), augment, rng)
    candidates = np.flatnonzero(visible)
    taken = rng.choice(candidates, sample.n_matches, replace=len(candidates) < sample.n_matches)
    others = non_matches(b.labels == chosen, b.uv[taken], sample, rng)
    # Looks are drawn last, so that where a match lies does not depend on how images are coloured.
    return _view(a, augment, rng), _view(b, augment, rng), a.uv[taken], b.uv[taken], *others


def _pixels_of(mask: Bool[ndarray, "h w"], rng: Generator) -> Float[ndarray, "m 2"]:
    """Pixels of a mask, evenly drawn."""
    on = np.flatnonzero(mask)
    v, u = np.divmod(rng.choice(on, min(N_OF_ITSELF, len(on)), replace=False), mask.shape[1])
    return np.stack([u, v], axis=1).astype(np.float64)


def _placed(
    rgb: UInt8[ndarray, "h w 3"],
    instance: UInt8[ndarray, "h w"],
    uv: Float[ndarray, "m 2"],
    anchor: int,
    flipped: bool,
    size: tuple[int, int],
    augment: AugmentSettings,
    rng: Generator,
) -> _Side:
    """An image's place in its view."""
    out_from_in = random_affine(instance.shape, size, uv[anchor].astype(np.float64), flipped, augment, rng)
    labels = warped_labels(instance, out_from_in, size)
    shown = covered(instance.shape, out_from_in, size)
    uv_view = moved(out_from_in, uv).astype(np.float32)
    if augment.crop == "padded":
        window = np.zeros(size, bool)
        window[random_window(size, uv_view[anchor], augment, rng)] = True
        labels[~window] = 0
        shown = window if shown is None else shown & window
    return _Side(rgb, instance, out_from_in, uv_view, labels, shown)


def _composed(
    a: _Side,
    b: _Side,
    visible: Bool[ndarray, "m"],
    source: PairSource,
    subject: _Subject,
    augment: AugmentSettings,
    rng: Generator,
) -> Bool[ndarray, "m"]:
    """Paste another object over both views; gives the matches that are still visible.

    It is pasted over and not behind: what the sampled object is to learn is to be half hidden.
    """
    several = source.n_instances[subject.i_pair] > 1
    same = source.scans == source.scans[subject.i_pair]
    # A non-match on the same object would be wrong. Within a scan, another number is another object. The objects of
    # another scan may well be the same ones again, so only scans of one object, each scan another, take from others.
    partners = np.flatnonzero(same if several else ~same)
    if len(partners) == 0:
        return visible
    other = source.pair(int(rng.choice(partners)))
    candidates = np.unique(other.instance)
    candidates = candidates[candidates != subject.instance] if several else candidates
    if len(candidates) == 0:
        return visible
    instance = int(rng.choice(candidates))
    for side, rgb, mask in ((a, other.rgb_a, other.instance_a), (b, other.rgb_b, other.instance_b)):
        pasted = _pasted(side, rgb, mask == instance, subject.flipped, augment, rng)
        if pasted is None:
            continue
        assert pasted.shown is not None
        labels = np.where(pasted.shown, np.uint8(0), side.labels)
        left = visible & replace(side, labels=labels).shows(subject.instance)
        if left.sum() >= LEAST_SHOWN * visible.sum():
            side.labels, side.pasted, visible = labels, pasted, left
    return visible


def _pasted(
    side: _Side,
    rgb: UInt8[ndarray, "h w 3"],
    mask: Bool[ndarray, "h w"],
    flipped: bool,
    augment: AugmentSettings,
    rng: Generator,
) -> Layer | None:
    """An object, somewhere over a view; None if there is nothing of it."""
    if not mask.any():
        return None
    size = side.labels.shape
    affine = pasting_affine(mask, size, flipped, augment, rng)
    shown = warped_labels(mask.view(np.uint8), affine, size) > 0
    if side.shown is not None and augment.crop == "padded":
        shown &= side.shown
    return layer(rgb, affine, shown) if shown.any() else None


def _view(side: _Side, augment: AugmentSettings, rng: Generator) -> AugmentedView:
    """The view of an image: what it does not cover, or all but the objects, is painted over."""
    size = side.labels.shape
    shown = side.labels > 0 if rng.random() < augment.background else side.shown
    ground = () if shown is None else (random_ground(size, side.rgb, side.instance, rng),)
    pasted = () if side.pasted is None else (side.pasted,)
    layers = (*ground, layer(side.rgb, side.out_from_in, shown), *pasted)
    return AugmentedView(size, layers, random_look(side.rgb, augment, rng))


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
    on, off = np.flatnonzero(mask), np.flatnonzero(~mask)
    share = len(on) / mask.size if sample.foreground_share == "auto" else sample.foreground_share
    n_foreground = round(share * n)
    if len(on) == 0 or len(off) == 0:
        n_foreground = n if len(on) else 0
    foreground = np.tile(np.arange(n) < n_foreground, m)
    # Both kinds are in one list, those on the instance first, so that one draw serves both.
    pool = np.concatenate([on, off]).astype(np.int32)
    first, length = np.where(foreground, 0, len(on)), np.where(foreground, len(on), len(off))
    pixels, valid = np.empty((m * n, 2), np.float32), np.zeros(m * n, bool)
    redrawn: slice | ndarray = slice(None)
    at_match = np.repeat(uv, n, axis=0)
    for _ in range(REDRAWS):
        spans = length[redrawn]
        flat = pool[first[redrawn] + (rng.random(len(spans)) * spans).astype(np.int32)]
        drawn = np.column_stack([flat % mask.shape[1], flat // mask.shape[1]]).astype(np.float32)
        pixels[redrawn] = drawn
        offset = drawn - at_match[redrawn]
        valid[redrawn] = offset[:, 0] ** 2 + offset[:, 1] ** 2 >= sample.clearance**2
        redrawn = np.flatnonzero(~valid)
        if len(redrawn) == 0:
            break
    return pixels.reshape(m, n, 2), foreground.reshape(m, n), valid.reshape(m, n)
