from __future__ import annotations

from typing import Any

import pytest

from bask_data.artifact import Artifact
from bask_data.kinds import (
    KINDS,
    Correspondences,
    DescriptorNet,
    Identities,
    KeypointTrack,
    ObjectInstances,
    Reconstruction,
    ReferenceKeypoints,
    Scan,
    VisibleMasks,
)
from bask_data.kinds.headlines import HEADLINES, headline


def stating(kind: type[Artifact], **metadata: Any) -> Artifact:
    """An artifact that states this of itself."""
    artifact = kind("nowhere")
    artifact.__dict__["metadata"] = kind.metadata_model.model_validate(metadata)
    return artifact


def objects(n: int, **fields: object) -> Artifact:
    row = {**fields, "n_vertices": 1, "area_m2": 0.1, "centroid": (0, 0, 0), "extents": (0, 0, 0)}
    return stating(ObjectInstances, instances=[{"id": i + 1, **row} for i in range(n)])


def reconstruction(explained: float | None, residual: float | None) -> Artifact:
    quality = {"explained": explained, "residual_abs": residual}
    return stating(Reconstruction, voxel_size=0.004, bounds=(0, 0, 0, 1, 1, 1), quality=quality)


def matches(n_pairs: int, n_attempts: int, n_matches: int) -> Artifact:
    return stating(Correspondences, n_pairs=n_pairs, n_attempts=n_attempts, n_matches=n_matches, rejections={})


def track(*names: str, filter: str) -> Artifact:
    return stating(KeypointTrack, names=list(names), filter=filter)


PIXELS = {"measured_and_agreeing": 80, "not_measured_and_kept": 20, "measured_in_front": 25, "measured_through": 7}
PICK = {"name": "rim", "recording": "a", "camera": "wrist", "frame": 0, "u": 1.0, "v": 1.0}
RECOGNITION = {"error": 0.0126, "share_found": 0.8, "n_frames": 5, "scans": ["b", "c"], "is_ambiguous": True}
NET = {"validated_on": "scene c", "step": 3, "chosen_by": None}
METRICS = {"loss": 0.2, "validation_median_error_px": 2.25, "validation_pck_4": 0.913}


@pytest.mark.parametrize(
    ("artifacts", "line"),
    [
        (
            [reconstruction(0.9, 0.001), reconstruction(0.96, 0.003), reconstruction(None, None)],
            "93.0 % of the measured depth lies on the mesh, with an error of 2.0 mm (medians)",
        ),
        ([reconstruction(None, None)], ""),
        ([objects(3), objects(4)], "7 objects, 3 to 4 a scene"),
        ([objects(1)], "1 object"),
        ([objects(1), objects(1, flags=["cut"])], "2 objects, 1 of them flagged"),
        ([objects(0), objects(0)], "0 objects"),
        (
            [stating(VisibleMasks, n_instances=2, pixels=PIXELS)] * 2,
            "80 % of the objects' pixels are visible, 80 % of these confirmed by measured depth",
        ),
        ([stating(VisibleMasks, n_instances=0)], ""),
        ([matches(10, 40000, 9000), matches(20, 60000, 3500)], "12,500 matches in 30 pairs of frames; 12 % of the"),
        ([matches(1, 0, 0)], "0 matches in 1 pair of frames"),
        (
            [stating(DescriptorNet, metrics=METRICS, **NET)],
            "median error 2.2 px, 91.3 % of the matches within 4 % of the diagonal, on scene c",
        ),
        ([stating(DescriptorNet, metrics={"loss": 0.2}, **NET)], ""),
        ([stating(ReferenceKeypoints, picks=[PICK, PICK])], "2 keypoints"),
        (
            [stating(ReferenceKeypoints, picks=[PICK, {**PICK, "recognition": RECOGNITION}])],
            "2 keypoints; expected error 13 mm (median); 1 ambiguous",
        ),
        (
            [
                stating(KeypointTrack, names=["a", "b"], filter="particle"),
                stating(KeypointTrack, names=["a"], filter="truth"),
            ],
            "1 to 2 keypoints in 2 demonstrations, by particle, truth",
        ),
        (
            [stating(Identities, identities=[], unknown=[{"scene": "a", "instance": 1, "why": "no partner"}])],
            "0 objects in several scans, 1 unknown",
        ),
        ([Scan("nowhere")], ""),
        ([], ""),
    ],
)
def test_artifacts_of_a_kind_are_summarised_in_a_line(artifacts: list[Artifact], line: str) -> None:
    assert headline(artifacts).startswith(line) and bool(headline(artifacts)) == bool(line)


def test_every_kind_that_a_stage_makes_has_a_line() -> None:
    from bask_data.pipeline import STAGES

    assert {stage.makes for stage in STAGES} == set(HEADLINES) <= set(KINDS)
