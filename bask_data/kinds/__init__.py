"""The kinds of artifact, one module each: typed handle, schema, reading and writing."""

from __future__ import annotations

from bask_data.artifact import Artifact
from bask_data.kinds.cameras import Camera, CameraFrames, Recording, Scan
from bask_data.kinds.correspondences import Correspondences, PairRow
from bask_data.kinds.demonstration import Demonstration, Robot
from bask_data.kinds.descriptor import DescriptorNet
from bask_data.kinds.identities import Identities
from bask_data.kinds.keypoints import KeypointTrack
from bask_data.kinds.masks import VisibleMasks
from bask_data.kinds.objects import InstanceRow, ObjectInstances
from bask_data.kinds.reconstruction import Reconstruction
from bask_data.kinds.reference import Pick, Recognition, ReferenceKeypoints
from bask_data.kinds.refinement import PoseRefinement, RefinedCamera, ResidualRow
from bask_data.kinds.truth import Truth

KINDS: tuple[type[Artifact], ...] = (
    Scan,
    Demonstration,
    Truth,
    PoseRefinement,
    Reconstruction,
    ObjectInstances,
    VisibleMasks,
    Correspondences,
    Identities,
    DescriptorNet,
    ReferenceKeypoints,
    KeypointTrack,
)

__all__ = [
    "KINDS",
    "Camera",
    "CameraFrames",
    "Correspondences",
    "Demonstration",
    "DescriptorNet",
    "Identities",
    "InstanceRow",
    "KeypointTrack",
    "ObjectInstances",
    "PairRow",
    "Pick",
    "PoseRefinement",
    "Recognition",
    "Reconstruction",
    "Recording",
    "ReferenceKeypoints",
    "RefinedCamera",
    "ResidualRow",
    "Robot",
    "Scan",
    "Truth",
    "VisibleMasks",
]
