"""Objects that may be pasted over another one in training, without a true match among the non-matches."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

N_INSTANCES = 256
"""Labels of an instance image, which is uint8; 0 is none."""


def occluders(identities: Int[ndarray, "s 256"], scan: int, instance: int, is_alone: bool) -> Bool[ndarray, "s 256"]:
    """Objects, by scan and instance, that are surely or by assumption another one than the given one.

    A non-match on the same object would be a wrong label. Within a scan, another number is another object. Other scans
    may show the same objects again: they give those whose identity some scan shows together with the given one's. Scans
    of a single object are assumed to show a different one each, as far as their identities do not say otherwise.

    Args:
        identities: by scan and instance; 0 is unknown. Objects of one identity never occlude each other, twins of one
            scan included.
        is_alone: the scan has no other object.
    """
    own = int(identities[scan, instance])
    allowed = np.full(identities.shape, is_alone)
    if own and not is_alone:
        together = np.setdiff1d(identities[(identities == own).any(axis=1)], [0, own])
        allowed = np.isin(identities, together)
    allowed[scan] = not is_alone
    allowed[scan, instance] = False
    if own:
        allowed &= identities != own
    return allowed
