"""Injected faults, found end to end by `bask-data doctor`; `benchmarks/injected_faults.py` runs all of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from bask_data.findings import CODES
from benchmarks.injected_faults import examined, of_frames
from tests.faulty_datasets import DATASET_FAULTS, Content, Taken, take, write_dataset
from tests.faulty_recordings import FAULTS, Frames, clean_frames

RECORDING_FAULTS = {fault.name: fault for fault in FAULTS}
FAULTS_OF_DATASETS = {fault.name: fault for fault in DATASET_FAULTS}


@pytest.fixture(scope="module")
def clean() -> Frames:
    return clean_frames(4, n_frames=24)


@pytest.fixture(scope="module")
def seen() -> tuple[Taken, Taken, Taken]:
    return take(1, 12), take(2, 12), take(3, 12)


def test_every_fault_is_told_by_codes_that_exist() -> None:
    for fault in (*FAULTS, *DATASET_FAULTS):
        assert set(fault.codes) <= set(CODES), fault.name


def test_a_clean_recording_has_neither_errors_nor_warnings(clean: Frames, tmp_path: Path) -> None:
    assert [found for found in of_frames(clean, tmp_path) if found[0] != "note"] == []


@pytest.mark.parametrize("name", ["OpenGL axes", "black frames", "one pose wrong"])
def test_a_fault_of_a_recording_is_found(clean: Frames, name: str, tmp_path: Path) -> None:
    fault = RECORDING_FAULTS[name]
    assert {code for _, code in of_frames(fault.inject(clean), tmp_path)} & set(fault.codes)


def test_poses_that_hang_are_said_once(clean: Frames, tmp_path: Path) -> None:
    codes = [code for _, code in of_frames(RECORDING_FAULTS["poses frozen at the end"].inject(clean), tmp_path)]
    assert codes.count("poses-repeated") == 1


@pytest.mark.parametrize("name", ["clock off by two frames"])
def test_frames_are_not_blamed_for_poses_that_are_wrong_as_a_whole(clean: Frames, name: str, tmp_path: Path) -> None:
    found = of_frames(RECORDING_FAULTS[name].inject(clean), tmp_path)
    assert {"other-clock"} == {code for severity, code in found if severity != "note"}


def test_a_clean_dataset_has_no_errors(seen: tuple[Taken, Taken, Taken], tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path / "dataset", seen, Content(splits=True))
    assert [found for found in examined(dataset.root) if found[0] == "error"] == []


@pytest.mark.parametrize("name", ["split leak"])
def test_a_fault_of_a_dataset_is_found(seen: tuple[Taken, Taken, Taken], name: str, tmp_path: Path) -> None:
    fault = FAULTS_OF_DATASETS[name]
    dataset = write_dataset(tmp_path / "dataset", seen, fault.content)
    assert {code for _, code in examined(dataset.root)} & set(fault.codes)
