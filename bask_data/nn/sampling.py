"""Training batches: each a pure function of the seed and the number of the step.

Batches therefore do not depend on the process or thread that makes them, on their order, or on interruptions. A batch
is planned first: matches, non-matches, augmentation. Its pixels are rendered from the plan, on the CPU or on a GPU.
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
from bask_data.nn.augment import AugmentedView, AugmentSettings, Layer, layer
from bask_data.nn.augment_look import random_ground, random_look
from bask_data.nn.augment_motion import covered, moved, pasting_affine, random_affine, random_window, warped_labels
from bask_data.nn.occluders import occluders

REDRAWS = 8
"""Draws of a non-match that is too close to its match before it is discarded. Even if a tenth of the pixels are too
close, eight draws discard one in 10^8."""

N_OF_ITSELF = 4096
"""Largest number of pixels of an object from which the matches of an image with itself are drawn: 32 times the matches
of a pair by default. Sensitivity not measured."""

LEAST_SHOWN = 0.25
"""Share of the matches in view that must stay visible when an object is pasted; otherwise it is not pasted. Chosen;
sensitivity not measured."""


@dataclass(frozen=True)
class Pair:
    """Two images of one scene, of any sizes, with labels and matches."""

    rgb_a: UInt8[ndarray, "ha wa 3"]
    rgb_b: UInt8[ndarray, "hb wb 3"]
    instance_a: UInt8[ndarray, "ha wa"]
    """Visible instance at each pixel, 0 = none."""
    instance_b: UInt8[ndarray, "hb wb"]
    """The same of the second image."""
    instance: UInt8[ndarray, "m"]
    """Instance of each match."""
    uv_a: Float[ndarray, "m 2"]
    """Matches in the first image, pixels."""
    uv_b: Float[ndarray, "m 2"]
    """Matches in the second image, pixels."""


@runtime_checkable
class PairSource(Protocol):
    """A source of pairs, indexed from 0."""

    @property
    def n_pairs(self) -> int:
        """Number of pairs; each has at least one match."""

    @property
    def scans(self) -> Int[ndarray, "p"]:
        """Number of the scan of each pair; instances are comparable within a scan only."""

    @property
    def n_instances(self) -> Int[ndarray, "p"]:
        """Number of instances with matches in the scan of each pair."""

    @property
    def identities(self) -> Int[ndarray, "s 256"]:
        """Which objects of different scans are the same, by scan and instance; 0: unknown."""

    def pair(self, i_pair: int) -> Pair:
        """The pair with this index."""


@dataclass(frozen=True)
class SampleSettings:
    """Composition of a batch.

    Args:
        size: (height, width) of the network's input.
        n_pairs: pairs in a batch.
        n_matches: matches per pair, drawn with replacement if there are fewer.
        n_non_matches: per match; 0 for a loss that needs none.
        foreground_share: share of non-matches on the sampled instance; `auto` is the share of the image it covers.
        clearance: least distance of a non-match from the true match, pixels.
        self_pairs: probability that both images of a pair are the same image, augmented independently: its matches are
            exact and lie anywhere on the object, while those of two views are only as accurate as the camera poses and
            need depth in both.
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
    """Training data: pairs, and how batches are made from them."""

    source: PairSource
    sample: SampleSettings
    augment: AugmentSettings


@dataclass(frozen=True)
class Batch:
    """Input of one step, arrays or tensors. Images have the network's input size; coordinates are in its pixels."""

    rgb_a: UInt8[ndarray | Tensor, "b h w 3"]
    rgb_b: UInt8[ndarray | Tensor, "b h w 3"]
    uv_a: Float[ndarray | Tensor, "b m 2"]
    uv_b: Float[ndarray | Tensor, "b m 2"]
    non_matches_b: Float[ndarray | Tensor, "b m n 2"]
    foreground: Bool[ndarray | Tensor, "b m n"]
    valid: Bool[ndarray | Tensor, "b m n"]

    def on(self, device: torch.device) -> Batch:
        """The same batch as tensors on a device."""
        return Batch(*(rendering.to_device(getattr(self, field.name), device) for field in fields(self)))


@dataclass(frozen=True)
class Plan:
    """A batch before rendering: a view for each image, and the other fields of `Batch`."""

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
    """The batch of a step.

    Args:
        examples: numbers of the examples to compute, for one of several processes or a part of a step; default: all.
            An example depends on the seed, the step and its own number only.
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
    """The batch of a step before rendering; arguments as for `batch_of_step`."""
    numbers = range(sample.n_pairs) if examples is None else examples
    planned = [_example(source, sample, augment, np.random.default_rng((seed, step, i))) for i in numbers]
    views_a, views_b, *arrays = zip(*planned, strict=True)
    return Plan(views_a, views_b, *(np.stack(column) for column in arrays))


def rendered(plan: Plan, device: torch.device) -> Batch:
    """The planned batch as tensors, its images rendered on the device."""
    rgb = rendering.drawn_on([*plan.views_a, *plan.views_b], device)
    arrays = (plan.uv_a, plan.uv_b, plan.non_matches_b, plan.foreground, plan.valid)
    return Batch(*rgb.chunk(2), *(rendering.to_device(array, device) for array in arrays))


@dataclass(frozen=True)
class _Subject:
    """Subject of an example: an instance in a pair of images, and whether both are mirrored."""

    i_pair: int
    instance: int
    flipped: bool


@dataclass
class _Side:
    """One image of a pair, with its place in an `AugmentedView` under construction."""

    rgb: UInt8[ndarray, "h w 3"]
    instance: UInt8[ndarray, "h w"]
    out_from_in: Float[ndarray, "2 3"]
    uv: Float[ndarray, "m 2"]
    """The matches, pixels of the view."""
    labels: UInt8[ndarray, "h2 w2"]
    """Visible instances in the view; 0 under pasted objects and outside the crop."""
    shown: Bool[ndarray, "h2 w2"] | None
    """Pixels of the view that show the image; None: all."""
    pasted: Layer | None = None

    def shows(self, instance: int) -> Bool[ndarray, "m"]:
        """Matches at whose pixel the instance is visible."""
        height, width = self.labels.shape
        inside = in_image(self.uv, height, width)
        u, v = np.rint(np.where(inside[:, None], self.uv, 0)).astype(int).T
        # Rounding takes -0.5 to 0, but takes the opposite edge beyond the last pixel.
        return inside & (self.labels[np.minimum(v, height - 1), np.minimum(u, width - 1)] == instance)


def _example(
    source: PairSource, sample: SampleSettings, augment: AugmentSettings, rng: Generator
) -> tuple[AugmentedView | ndarray, ...]:
    i_pair = int(rng.integers(source.n_pairs))
    pair = source.pair(i_pair)
    # Instances are drawn uniformly, not by their number of matches, or small objects would be neglected.
    chosen = int(rng.choice(np.unique(pair.instance)))
    of_chosen = pair.instance == chosen
    anchor = int(rng.choice(np.flatnonzero(of_chosen)))
    flipped = bool(rng.random() < augment.flip)
    # Pairs are listed in one order; either image may be the first.
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
        # Matches at the very edge of an object may all round to pixels outside it. They are still correct.
        visible = of_chosen & in_image(a.uv, *sample.size) & in_image(b.uv, *sample.size)
    elif rng.random() < augment.composition:
        visible = _composed(a, b, visible, source, _Subject(i_pair, chosen, flipped), augment, rng)
    candidates = np.flatnonzero(visible)
    drawn = rng.choice(candidates, sample.n_matches, replace=len(candidates) < sample.n_matches)
    others = non_matches(b.labels == chosen, b.uv[drawn], sample, rng)
    # Looks are drawn last, so that positions of matches do not depend on colour augmentation.
    return _view(a, augment, rng), _view(b, augment, rng), a.uv[drawn], b.uv[drawn], *others


def _pixels_of(mask: Bool[ndarray, "h w"], rng: Generator) -> Float[ndarray, "m 2"]:
    """Pixels (u, v) of a mask, drawn uniformly."""
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
    """An image placed at random in its view, with the anchor (an index into `uv`) in view."""
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
    """Paste another object over both views, in place; return the matches that are still visible.

    It is pasted in front of the sampled object, not behind it, to train for partial occlusion.
    """
    scan, is_alone = int(source.scans[subject.i_pair]), source.n_instances[subject.i_pair] == 1
    allowed = occluders(source.identities, scan, subject.instance, bool(is_alone))
    partners = np.flatnonzero(np.isin(source.scans, np.nonzero(allowed)[0]))
    if len(partners) == 0:
        return visible
    i_other = int(rng.choice(partners))
    other = source.pair(i_other)
    candidates = np.unique(other.instance)
    candidates = candidates[allowed[source.scans[i_other], candidates]]
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
    """An object pasted at random over a view; None if none of it is visible."""
    if not mask.any():
        return None
    size = side.labels.shape
    affine = pasting_affine(mask, size, flipped, augment, rng)
    shown = warped_labels(mask.view(np.uint8), affine, size) > 0
    if side.shown is not None and augment.crop == "padded":
        shown &= side.shown
    return layer(rgb, affine, shown) if shown.any() else None


def _view(side: _Side, augment: AugmentSettings, rng: Generator) -> AugmentedView:
    """The view of an image: pixels that it does not cover, or all off the objects, show a random background."""
    size = side.labels.shape
    shown = side.labels > 0 if rng.random() < augment.background else side.shown
    ground = () if shown is None else (random_ground(size, side.rgb, side.instance, rng),)
    pasted = () if side.pasted is None else (side.pasted,)
    layers = (*ground, layer(side.rgb, side.out_from_in, shown), *pasted)
    return AugmentedView(size, layers, random_look(side.rgb, augment, rng))


def non_matches(
    mask: Bool[ndarray, "h w"], uv: Float[ndarray, "m 2"], sample: SampleSettings, rng: Generator
) -> tuple[Float[ndarray, "m n 2"], Bool[ndarray, "m n"], Bool[ndarray, "m n"]]:
    """Non-matches: for each match, pixels of the second image that show a different point.

    Args:
        mask: the sampled instance in the second image.
        uv: the matches in the second image.

    Returns:
        Pixels (u, v); whether each is on the instance; whether it is valid, i.e. not too close after all redraws.
    """
    m, n = len(uv), sample.n_non_matches
    on, off = np.flatnonzero(mask), np.flatnonzero(~mask)
    share = len(on) / mask.size if sample.foreground_share == "auto" else sample.foreground_share
    n_foreground = round(share * n)
    if len(on) == 0 or len(off) == 0:
        n_foreground = n if len(on) else 0
    foreground = np.tile(np.arange(n) < n_foreground, m)
    # Both kinds are in one list, pixels on the instance first, so that both need only one draw.
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
