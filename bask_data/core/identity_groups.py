"""Grouping of the objects of several scans by identity, from the odds of each pair; nothing is matched by force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

STRONGEST = 6.0
"""Log odds beyond which evidence of a pair counts no more, either way: one pair of views must not outvote all others.
Chosen, sensitivity not measured."""
CONTRAST = 1.5
"""Log odds by which the pairs of two groups may be less similar than those within either group, on average. Objects
that merely look alike, such as boxes of one colour and size, are likely the same pair by pair, but differ evenly from
group to group. On simulated tables with look-alikes (seed 1): precision 1.00 at 1.5 and 0.80 at 2, recall 0.83 and
0.89; without it 0.68 and 0.92."""


@dataclass(frozen=True)
class IdentityGroup:
    """Objects of several scans that are one and the same, or twins.

    Args:
        members: their indices, ascending.
        confidences: of each member, the probability that it is the same as the others.
        twins: whether some scan has two of them, so that which one is which cannot be told.
    """

    members: tuple[int, ...]
    confidences: tuple[float, ...]
    twins: bool


@dataclass(frozen=True)
class Grouping:
    """Groups, and objects that belong to none.

    Args:
        alone: objects without a likely partner.
        tied: objects with two or more likely partners that exclude each other, by object.
    """

    groups: tuple[IdentityGroup, ...]
    alone: tuple[int, ...]
    tied: dict[int, tuple[int, ...]] = field(default_factory=dict)


def grouped(
    scans: Int[ndarray, "n"],
    log_odds: Float[ndarray, "n n"],
    confidence: float,
    same: Sequence[tuple[int, int]] = (),
    different: Sequence[tuple[int, int]] = (),
) -> Grouping:
    """Objects grouped so that those of a group are likely the same, and no scan has two of them, except twins.

    The most similar groups are merged first, by the mean log odds of their pairs. Two groups that share a scan exclude
    each other; where a group has two such partners and neither is `confidence` more likely than the other, it is merged
    with neither, unless further scans decide between them. Two groups of several objects are not merged if their pairs
    are clearly less similar than those within either.

    Args:
        scans: number of the scan of each object.
        log_odds: that two objects are the same, symmetric; within a scan, that they look the same.
        confidence: least probability to call two groups the same, and one partner likelier than another; 0.5 to 1.
        same, different: pairs that are known.

    Raises:
        ValueError: `confidence` is outside its range, or what is stated contradicts itself.
    """
    if not 0.5 < confidence < 1:
        raise ValueError(f"confidence: expected above 0.5 and below 1, got {confidence:g}")
    least = float(np.log(confidence / (1 - confidence)))
    unbounded = log_odds
    log_odds = np.clip(log_odds, -STRONGEST, STRONGEST)
    for pairs, stated in ((same, STRONGEST), (different, -STRONGEST)):
        for a, b in pairs:
            log_odds[a, b] = log_odds[b, a] = stated
    merging = _Merging(scans, log_odds, unbounded)
    for a, b in same:
        merging.merge(a, b)
    merging.exclude(different)
    alike = np.argwhere(np.triu((scans[:, None] == scans[None]) & (log_odds >= least), 1))
    for a, b in alike[np.argsort(-unbounded[tuple(alike.T)], kind="stable")].tolist():
        # Twins: a group that both belong to is certain, which one is which is not.
        if not merging.excluded[merging.of[a], merging.of[b]]:
            merging.merge(a, b)
    merging.exclude_within_scans()
    while (pair := merging.best(least)) is not None:
        merging.merge(*pair)
    return merging.grouping(least)


class _Merging:
    """Groups under construction, each known by the lowest index of its members."""

    def __init__(
        self, scans: Int[ndarray, "n"], log_odds: Float[ndarray, "n n"], unbounded: Float[ndarray, "n n"]
    ) -> None:
        self._scans, self._log_odds = scans, log_odds
        n = len(scans)
        self.of = np.arange(n)
        self.excluded: Bool[ndarray, "n n"] = np.eye(n, dtype=bool)
        across = scans[:, None] != scans[None]
        self._sums, self._counts = np.where(across, log_odds, 0.0), across.astype(np.int64)
        self._unbounded = np.where(across, unbounded, 0.0)

    def merge(self, a: int, b: int) -> None:
        """Make one group of those of two objects."""
        kept, gone = sorted(self.of[[a, b]])
        if kept == gone:
            return
        self.of[self.of == gone] = kept
        for table in (self._sums, self._counts, self._unbounded):
            table[kept] += table[gone]
            table[:, kept] += table[:, gone]
        self.excluded[kept] |= self.excluded[gone]
        self.excluded[:, kept] |= self.excluded[:, gone]
        self.excluded[gone] = self.excluded[:, gone] = True

    def exclude(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Keep the groups of these objects apart; `ValueError` if they are one."""
        for a, b in pairs:
            if self.of[a] == self.of[b]:
                raise ValueError(f"objects {a} and {b} are stated to be the same and to be different")
            self.excluded[self.of[a], self.of[b]] = self.excluded[self.of[b], self.of[a]] = True

    def exclude_within_scans(self) -> None:
        """Keep groups apart that have objects of one scan."""
        for scan in np.unique(self._scans):
            present = np.unique(self.of[self._scans == scan])
            self.excluded[np.ix_(present, present)] = True

    @property
    def scores(self) -> Float[ndarray, "n n"]:
        """Mean log odds between groups; -inf where no pair is of different scans, or one is no group any more."""
        scores = np.where(self._counts > 0, self._sums / np.maximum(self._counts, 1), -np.inf)
        gone = self.of != np.arange(len(self.of))
        scores[gone] = scores[:, gone] = -np.inf
        np.fill_diagonal(scores, -np.inf)
        return scores

    def best(self, least: float) -> tuple[int, int] | None:
        """The likeliest pair of groups that may be merged and has no rival; None if there is none."""
        scores = self.scores
        allowed = np.argwhere(np.triu((scores >= least) & ~self.excluded & ~self.contrasting, 1))
        # Many scores are equal, at the bound.
        order = np.lexsort((-self.means[tuple(allowed.T)], -scores[tuple(allowed.T)]))
        for a, b in allowed[order].tolist():
            if not (len(self.rivals(scores, a, b, least)) or len(self.rivals(scores, b, a, least))):
                return a, b
        return None

    @property
    def contrasting(self) -> Bool[ndarray, "n n"]:
        """Groups of several objects each whose pairs are clearly less similar than those within either."""
        # Merging has added the pairs within a group to the diagonal, which has none for a single object.
        within, several = np.diag(self.means), np.diag(self._counts) > 0
        lowest = np.minimum(within[:, None], within[None])
        return several[:, None] & several[None] & (self.means < lowest - CONTRAST)

    @property
    def means(self) -> Float[ndarray, "n n"]:
        """Mean log odds between groups, without bound; 0 where no pair is of different scans."""
        return self._unbounded / np.maximum(self._counts, 1)

    def rivals(self, scores: Float[ndarray, "n n"], group: int, partner: int, least: float) -> Int[ndarray, "r"]:
        """Other partners of a group that exclude this one and are nearly as likely or more so."""
        nearly = ~self.excluded[group] & (scores[group] > max(scores[group, partner] - least, 0.0))
        nearly &= self.excluded[partner]
        nearly[[group, partner]] = False
        return np.flatnonzero(nearly)

    def grouping(self, least: float) -> Grouping:
        """What the groups are when no more are merged."""
        scores, groups, alone, tied = self.scores, [], [], {}
        for group in np.unique(self.of):
            members = np.flatnonzero(self.of == group)
            if len(np.unique(self._scans[members])) > 1:
                twins = len(np.unique(self._scans[members])) < len(members)
                groups.append(IdentityGroup(tuple(members.tolist()), self._confidences(members), twins))
                continue
            partners = np.flatnonzero((scores[group] >= least) & ~self.excluded[group])
            for member in members.tolist():
                if len(partners):
                    tied[member] = tuple(np.flatnonzero(np.isin(self.of, partners)).tolist())
                else:
                    alone.append(member)
        return Grouping(tuple(groups), tuple(sorted(alone)), tied)

    def _confidences(self, members: Int[ndarray, "m"]) -> tuple[float, ...]:
        """Of each member, the probability by its mean log odds with those of other scans."""
        own = self._log_odds[np.ix_(members, members)]
        across = self._scans[members][:, None] != self._scans[members][None]
        means = (own * across).sum(axis=1) / np.maximum(across.sum(axis=1), 1)
        return tuple((1 / (1 + np.exp(-means))).tolist())
