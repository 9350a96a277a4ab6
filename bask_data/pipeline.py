"""All stages, ordered so that inputs are made first."""

from __future__ import annotations

from bask_data.engine import Stage, in_order
from bask_data.stages.correspondences import correspondences
from bask_data.stages.encode import encode
from bask_data.stages.identify import identify
from bask_data.stages.masks import masks
from bask_data.stages.objects import objects
from bask_data.stages.reconstruct import reconstruct
from bask_data.stages.reference import reference
from bask_data.stages.train import train

STAGES: tuple[Stage, ...] = tuple(
    in_order([reconstruct, objects, masks, correspondences, train, reference, encode, identify])
)
