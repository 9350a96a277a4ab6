from __future__ import annotations

from pathlib import Path

import pytest

from bask_data.cli.calls import StageCall
from bask_data.dataset import Dataset, Variant
from bask_data.engine import RunRequest
from bask_data.kinds import ReferenceKeypoints
from bask_data.pipeline import STAGES

REFERENCE = next(stage for stage in STAGES if stage.makes is ReferenceKeypoints)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "--reference a"),
        ({"descriptor": "main"}, "--reference a"),
        ({"descriptor": "b"}, "--reference a --descriptor b"),
    ],
)
def test_the_next_command_reads_what_the_variant_was_made_from(
    tmp_path: Path, given: dict[str, str], words: str
) -> None:
    dataset = Dataset.create(tmp_path / "d")
    dataset.add_variant(ReferenceKeypoints, "a", Variant(inputs={"descriptor": "main"}))
    call = StageCall(dataset, REFERENCE, RunRequest(variant="a", variant_inputs=given))
    assert call.following == f"bask-data encode {dataset.root} {words}"
