from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bask_data.core.keypoint_scores import PHASES
from bask_data.dataset import Dataset
from bask_data.drawing.plots import Curve, line_plot
from bask_data.evaluation.figures import Measured
from bask_data.evaluation.keypoint_study import FILE
from bask_data.report import study, summarise, write_report
from bask_data.report.chosen import choose

METHODS = ("base: expectation", "ours: expectation", "ours: particle")


def figures(mean: float) -> dict:
    return {"n": 8, "n_unknown": 2, "mean": mean, "deviation": mean / 2, "median": mean, "p90": mean, "close": 0.5}


def method(mean: float) -> dict:
    return {
        "error": {phase: figures(mean) for phase in ("all", *PHASES)},
        "apart": {phase: figures(10 * mean) for phase in ("all", *PHASES)},
        "over_time": {
            f"{what}_{figure}": [mean, None, 2 * mean]
            for what in ("error", "apart")
            for figure in ("mean", "deviation")
        },
    }


def found(measured_with: dict[str, str]) -> dict:
    return {
        "settings": "paper",
        "methods": [{"name": name, "variant": name.split(":")[0]} for name in METHODS],
        "measured_with": measured_with,
        "groups": {
            "lid": {
                "keypoints": [{}] * 3,
                "demonstrations": {"demo-a": {"n_frames": 5}},
                "moments": [0.0, 0.5, 1.0],
                "share_of": {phase: [1.0, 0.5, 0.0] for phase in PHASES},
                "methods": {name: method(0.0321 * (i + 1)) for i, name in enumerate(METHODS)},
            }
        },
    }


@pytest.fixture
def empty(tmp_path: Path) -> Dataset:
    return Dataset.create(tmp_path / "d")


def keep(dataset: Dataset, content: object) -> None:
    (dataset.root / FILE).parent.mkdir(exist_ok=True)
    (dataset.root / FILE).write_text(json.dumps(content))


def sections_of(dataset: Dataset) -> list:
    return study.study(choose(dataset, Measured(dataset), 4))


def test_without_a_study_there_is_no_section(empty: Dataset) -> None:
    assert sections_of(empty) == []


def test_the_page_shows_each_methods_figures_and_curves(empty: Dataset, tmp_path: Path) -> None:
    keep(empty, found({}))
    text = write_report(empty, tmp_path / "r.html").read_text().replace("\u00a0", " ")
    for i, name in enumerate(METHODS):
        [row] = [row for row in text.split("<tr>") if f"{name}</td>" in row]
        assert row.count(f"{32.1 * (i + 1):.1f} mm") == 1 + len(PHASES)
        assert f"{321 * (i + 1):.0f} mm" in row
    assert "Settings of the filters: paper" in text
    assert "Distance to ground truth, cm" in text and "Distance between mean and mode, cm" in text
    assert "Made with other networks" not in text


def test_a_script_gets_the_same_figures(empty: Dataset) -> None:
    assert "study" not in summarise(empty)
    keep(empty, found({}))
    summary = summarise(empty)["study"]["lid"]
    assert list(summary) == list(METHODS)
    assert summary["ours: particle"] == {what: method(3 * 0.0321)[what] for what in ("error", "apart")}
    keep(empty, {"groups": 3})
    assert "study" not in summarise(empty)


def test_what_may_be_claimed_of_the_methods_is_listed(empty: Dataset, tmp_path: Path) -> None:
    result = found({})
    keep(empty, result)
    assert "resampled demonstrations" not in write_report(empty, tmp_path / "r.html").read_text()
    result["groups"]["lid"]["comparisons"] = [{"verdict": "ours: particle < base: expectation by 9.0 mm"}]
    keep(empty, result)
    text = write_report(empty, tmp_path / "r.html").read_text()
    assert "<li>ours: particle &lt; base: expectation by 9.0 mm</li>" in text


def test_a_study_of_changed_inputs_is_marked_stale(empty: Dataset, tmp_path: Path) -> None:
    keep(empty, found({"descriptor/main": "0123"}))
    assert sections_of(empty)[0]["is_stale"]
    assert "Made with other networks or recordings" in write_report(empty, tmp_path / "r.html").read_text()


@pytest.mark.parametrize("content", [[], {"groups": 3}, {"groups": {"a": {}}, "methods": 1}, "{"])
def test_a_file_that_is_no_study_is_an_error_in_its_own_section(
    empty: Dataset, tmp_path: Path, content: object
) -> None:
    keep(empty, content)
    if content == "{":
        (empty.root / FILE).write_text("{")
    text = write_report(empty, tmp_path / "r.html").read_text()
    assert "Accuracy of tracked keypoints" in text
    assert "keypoints.json" in text


def test_a_band_around_a_curve_ends_at_zero() -> None:
    x, y = np.array([0.0, 1.0]), np.array([1.0, 2.0])
    plain = line_plot([Curve(x, y, "#112233")], x_label="x", y_label="y")
    banded = line_plot(
        [Curve(x, y, "#112233", deviation=np.array([5.0, 5.0]))], x_label="x", y_label="y", y_range=(0, 9)
    )
    assert plain.count("#112233") < banded.count("#112233")
    assert "fill: #112233" in banded
