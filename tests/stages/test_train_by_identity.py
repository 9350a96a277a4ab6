from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bask_data.artifact import digest_of
from bask_data.dataset import Dataset, Splits
from bask_data.engine import make, plan
from bask_data.engine.state import key_parts, state_of
from bask_data.kinds import Correspondences, DescriptorNet, Identities, Scan, VisibleMasks
from bask_data.stages.pairs import ScanPairs, divided
from bask_data.stages.train import train
from tests.datasets import copied, publish_identities
from tests.stages.learning import SMALL


@pytest.fixture
def dataset(learnable: Dataset, tmp_path: Path) -> Dataset:
    return copied(learnable, tmp_path / "d")


def task_of(dataset: Dataset, **options):
    [task] = plan(dataset, train, options={**SMALL, "steps": 1, "validations": 1, "composition": 1.0, **options})
    return task


def test_networks_do_not_depend_on_identities_that_are_not_used(dataset: Dataset) -> None:
    before = key_parts(task_of(dataset))
    assert "by_identity" not in before["params"]
    publish_identities(dataset, {"box": [("a", 1), ("b", 2)]})
    assert key_parts(task_of(dataset)) == before


def test_identities_that_are_used_must_exist_and_are_part_of_the_key(dataset: Dataset) -> None:
    state = state_of(task_of(dataset, by_identity=True))
    assert (state.status, state.why) == ("blocked", "identities/main is missing")
    keys = set()
    for members in ({"box": [("a", 1), ("b", 2)]}, {"box": [("a", 1), ("b", 3)]}):
        publish_identities(dataset, members)
        parts = key_parts(task_of(dataset, by_identity=True))
        assert parts["inputs"]["identities/main"] == Identities(dataset.path(Identities)).manifest.digest
        keys.add(digest_of(parts))
    assert len(keys) == 2


def test_training_by_identity_records_what_it_used(dataset: Dataset) -> None:
    publish_identities(dataset, {"box": [("a", 1), ("b", 2)]})
    outcome = make(task_of(dataset, by_identity=True))
    assert outcome.status == "made", outcome.why
    manifest = DescriptorNet(dataset.path(DescriptorNet)).manifest
    assert manifest.params["by_identity"] is True and "identities/main" in manifest.inputs


def test_identities_are_known_by_the_number_of_the_scan(dataset: Dataset) -> None:
    publish_identities(dataset, {"can": [("b", 3)], "box": [("b", 2), ("a", 1)]})
    known = Identities(dataset.path(Identities)).of_scans()
    scans = [
        ScanPairs(*(kind(dataset.path(kind, name)) for kind in (Scan, VisibleMasks, Correspondences)), known[name])
        for name in ("b", "a")
    ]
    learned = divided(scans, Splits(), 0.0).learned
    assert learned.identities.shape == (2, 256)
    of_b, of_a = (learned.identities[learned.scans[i]] for i in (0, -1))
    assert of_a[:4].tolist() == [0, 2, 0, 0]
    assert of_b[:4].tolist() == [0, 0, 2, 1]
    assert np.count_nonzero(learned.identities) == 3
