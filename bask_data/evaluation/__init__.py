"""Evaluation of a dataset's artifacts against ground truth: the figures that `bask-data evaluate` prints.

Only evaluation reads ground truth; no stage that makes data does.
"""

from __future__ import annotations

from bask_data.evaluation.correspondences import evaluated_correspondences
from bask_data.evaluation.descriptor import DescriptorSettings, evaluated_descriptor
from bask_data.evaluation.keypoint_study import StudySettings, evaluated_keypoints
from bask_data.evaluation.masks import count_masks, evaluated_masks, label_groups

__all__ = [
    "DescriptorSettings",
    "StudySettings",
    "count_masks",
    "evaluated_correspondences",
    "evaluated_descriptor",
    "evaluated_keypoints",
    "evaluated_masks",
    "label_groups",
]
