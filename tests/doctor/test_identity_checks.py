from __future__ import annotations

from pathlib import Path

import pytest

from bask_data.dataset import Dataset
from bask_data.doctor.dataset_checks import dataset_findings
from bask_data.evaluation.figures import Measured
from bask_data.evaluation.judging import verdicts
from bask_data.kinds import Identities
from bask_data.kinds.identities import IdentityRow, MemberRow, UnknownRow
from tests.datasets import add_scan, publish_artifact


def publish(dataset: Dataset, identities: list[IdentityRow], unknown: list[UnknownRow]) -> None:
    nothing = {name: [] for name in Identities.tables["pairs.parquet"].columns}

    def fill(out: Path) -> None:
        Identities.write(out, identities=identities, unknown=unknown, pairs=nothing, picture=b"", warnings=[])

    publish_artifact(dataset, Identities, "", fill)


def row(id_: int, *places: tuple[str, int], twins: bool = False) -> IdentityRow:
    members = [MemberRow(scene=scene, instance=instance, confidence=0.9) for scene, instance in places]
    return IdentityRow(id=id_, members=members, twins=twins)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    dataset = Dataset.create(tmp_path / "d")
    add_scan(dataset, "a")
    return dataset


def found(dataset: Dataset) -> list[tuple[str, str, str]]:
    findings, _ = dataset_findings(Dataset(dataset.root), [])
    return [(each.code, each.severity, each.place) for each in findings if each.code.startswith("identity")]


def test_what_identify_could_not_tell_is_a_note_with_its_fix(dataset: Dataset) -> None:
    assert found(dataset) == []
    unknown = [
        UnknownRow(scene="a", instance=3, why="tie", similar="b/2"),
        UnknownRow(scene="b", instance=4, why="no partner"),
    ]
    publish(dataset, [row(1, ("a", 1), ("a", 2), ("b", 1), twins=True)], unknown)
    assert found(dataset) == [
        ("identity-twins", "note", "identities, identity 1"),
        ("identity-unknown", "note", "identities, a/3"),
        ("identity-unknown", "note", "identities, objects"),
    ]
    findings, right = dataset_findings(dataset, [])
    tie = next(each for each in findings if each.place.endswith("a/3"))
    assert f"bask-data identify {dataset.root}: --same a/3=b/2" in tie.fix and "identities.png" in tie.fix
    assert not any("partner" in sentence for sentence in right)


def test_identities_without_doubt_are_said_to_be_right(dataset: Dataset) -> None:
    publish(dataset, [row(1, ("a", 1), ("b", 1))], [])
    findings, right = dataset_findings(dataset, [])
    assert not [each for each in findings if each.code.startswith("identity")]
    assert "every object has a partner in another scan" in right


def test_the_report_has_a_row_for_identities_once_they_are_made(dataset: Dataset) -> None:
    assert "Identities" not in [each.stage for each in verdicts(dataset, Measured(dataset))]
    publish(dataset, [row(1, ("a", 1), ("b", 1))], [UnknownRow(scene="a", instance=2, why="no partner")])
    [of_identities] = [each for each in verdicts(dataset, Measured(dataset)) if each.stage == "Identities"]
    assert of_identities.evidence == "2 of 3 objects recognised in another scan"
    assert [each.code for each in of_identities.findings] == ["identity-unknown"]
    assert of_identities.verdict == "pass"
