"""The report's part on certainty, from a study whose figures are made by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bask_data.core.coverage import LEVELS
from bask_data.dataset import Dataset
from bask_data.evaluation.certainty import OF_CERTAINTY
from bask_data.evaluation.keypoint_study import FILE
from bask_data.report import summarise, write_report
from bask_data.report.certainty import certainty
from tests.report.test_study import METHODS, found


def certain(error: float | None) -> dict:
    measured = [None if error is None else level - error for level in LEVELS]
    of_all = {"n": 800, "n_unknown": 7, "n_invalid": 1, "within_sigmas": [0.1234, 0.5678, 0.8765]}
    of_all |= {"nominal": list(LEVELS), "measured": measured, "calibration_error": error}
    claim = {"n": 8, "n_claimed": 4, "n_true": 4, "precision": 0.625, "recall": None}
    coverage = {"all": of_all, **{phase: {**of_all, "calibration_error": None} for phase in OF_CERTAINTY}}
    return {"coverage": coverage, "localised": claim, "observed": {"wrist": claim, "over<head": claim}}


@pytest.fixture
def study() -> dict:
    made = found({})
    for i, figures in enumerate(made["groups"]["lid"]["methods"].values()):
        figures["certainty"] = certain(0.0432 if i else None)
    return made


def written(study: dict, tmp_path: Path) -> Dataset:
    dataset = Dataset.create(tmp_path / "d")
    (dataset.root / FILE).parent.mkdir()
    (dataset.root / FILE).write_text(json.dumps(study))
    return dataset


def test_the_page_shows_shares_and_calibration_error_of_each_method(study: dict, tmp_path: Path) -> None:
    text = write_report(written(study, tmp_path), tmp_path / "r.html").read_text().replace("\u00a0", " ")
    rows = [row for row in text.split("<tr>") if ">12 %<" in row and ">88 %<" in row]
    assert [name for row in rows for name in METHODS if f"{name}</td>" in row] == list(METHODS)
    assert "4.3 %" in rows[1] and "4.3 %" not in rows[0]
    assert rows[1].count("62 % / –") == 3
    assert "observed, over&lt;head" in text
    assert "Certainty: measured against nominal shares" in text


def test_the_curve_is_measured_against_nominal_beside_the_diagonal(study: dict) -> None:
    colours = dict(zip(METHODS, ("#110000", "#220000", "#330000"), strict=True))
    part = certainty(study["groups"]["lid"], colours)
    assert part is not None
    assert [entry["name"] for entry in part["plot"]["legend"]] == ["calibrated", *METHODS]
    for colour in ("#220000", "#330000"):
        assert colour in part["plot"]["svg"]
    np.testing.assert_allclose(part["rows"][1]["measured"], np.array(LEVELS) - 0.0432)


def test_a_study_without_certainty_has_no_such_part(tmp_path: Path) -> None:
    old = found({})
    assert certainty(old["groups"]["lid"], dict.fromkeys(METHODS, "#110000")) is None
    text = write_report(written(old, tmp_path), tmp_path / "r.html").read_text()
    assert "nominal shares" not in text and METHODS[0] in text


def test_a_script_gets_the_certainty_too(study: dict, tmp_path: Path) -> None:
    summary = summarise(written(study, tmp_path))["study"]["lid"]
    assert summary[METHODS[1]]["certainty"]["coverage"]["all"]["calibration_error"] == 0.0432
