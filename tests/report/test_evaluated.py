from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bask_data.dataset import Dataset, Variant
from bask_data.drawing.plots import Curve, line_plot
from bask_data.evaluation import DescriptorSettings, evaluated_descriptor
from bask_data.kinds import Correspondences, DescriptorNet
from bask_data.report import evaluated, measure, summarise, write_report
from bask_data.report.words import number, percent
from tests.datasets import copied
from tests.report.filled import publish_network
from tests.report.test_report import Page

MEASURED_BY = "bask_data.evaluation.network_figures.evaluated_descriptor"


@pytest.fixture(scope="module")
def two_networks(filled: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    dataset = copied(filled, tmp_path_factory.mktemp("full") / "dataset")
    for seed, variant in enumerate(("main", "florence")):
        dataset.add_variant(DescriptorNet, variant, Variant())
        publish_network(dataset, variant=variant, seed=seed, chosen_by=None if seed else "validation_pck_4")
    return dataset


@pytest.fixture(scope="module")
def found(two_networks: Dataset) -> dict[str, Any]:
    return json.loads(json.dumps(summarise(two_networks), allow_nan=False))["evaluation"]


def section(html: str, name: str) -> str:
    begin = html.index(f'<section id="{name}">')
    return html[begin : html.index("</section>", begin) + len("</section>")]


def test_networks_are_measured_as_the_command_does_and_only_once_for_page_and_json(
    two_networks, found, tmp_path, monkeypatch
):
    told = evaluated_descriptor(
        two_networks, ("main", "florence"), DescriptorSettings(pairs=48, sweep=True, one_may_be_learned=True)
    )
    assert found == json.loads(json.dumps(told))
    asked: list[object] = []
    monkeypatch.setattr(MEASURED_BY, lambda *a: asked.append(a) or told)
    measured = measure(two_networks)
    html = write_report(two_networks, tmp_path / "r.html", measured).read_text(encoding="utf-8")
    summarise(two_networks, measured)
    assert len(asked) == 1
    page = Page(section(html, "evaluation"))
    assert f"Measured on: {found['measured_on']}. {found['n_pairs']} pairs of frames" in page.text
    for name, one in found["variants"].items():
        shares = " ".join(percent(one["all"][f"pck_{p}"]) for p in (1, 2, 4, 8)).replace("\u00a0", " ")
        assert f"{name} {one['all']['n']} {shares} {number(one['all']['median_px'])}" in page.text
    first = found["variants"]["main"]["by_rotation"]["0-30"]
    other = found["variants"]["florence"]["by_rotation"]["0-30"]
    cells = " ".join(f"{percent(one['pck_4'])} {number(one['median_px'])} px" for one in (first, other))
    assert f"0-30 {first['n']} {cells}".replace("\u00a0", " ") in page.text
    assert page.text.count("share of the matches") > 4
    assert "main: rotation in the image, degrees" in page.text
    assert (
        f"{percent(found['variants']['main']['all']['pck_4'])} of true matches found within 4 %".replace("\u00a0", " ")
        in Page(html).text
    )


def test_scenes_share_the_pairs_and_only_some_of_many_are_measured(two_networks, monkeypatch):
    asked: list[DescriptorSettings] = []
    monkeypatch.setattr(MEASURED_BY, lambda *a: asked.append(a[2]) or {})
    for n in (4, 9):
        names = tuple(f"scene-{i}" for i in range(n))
        monkeypatch.setattr(
            "bask_data.evaluation.network_figures.held_out", lambda *a, names=names: type("", (), {"scenes": names})
        )
        measure(two_networks).descriptors()
    assert [(len(one.scenes), one.pairs) for one in asked] == [(0, 12), (8, 6)]


def test_bins_without_matches_and_groups_of_one_are_left_out():
    def bins(*counts: int) -> dict[str, Any]:
        return {"by_scale": {str(i): {"n": n, "pck_4": i / 4} for i, n in enumerate(counts)}}

    variants = {"a": bins(3, 0, 5), "b": bins(3, 0, 5)}
    rows = evaluated._rows(variants, "by_scale")
    assert [(row["name"], row["n"], [cell["pck_4"] for cell in row["cells"]]) for row in rows] == [
        ("0", 3, [0, 0]),
        ("2", 5, [0.5, 0.5]),
    ]
    assert evaluated._rows({"a": bins(3)}, "by_scale") == []
    assert evaluated._rows(variants, "by_zoom") == []


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[tuple[list[Curve], dict[str, Any]]]:
    calls: list[tuple[list[Curve], dict[str, Any]]] = []
    for section in ("evaluated", "networks"):
        where = f"bask_data.report.{section}.line_plot"
        monkeypatch.setattr(where, lambda curves, **how: calls.append((curves, how)) or "")
    return calls


def test_cumulative_curves_end_where_all_matches_are(drawn):
    def told(share: list[float | None]) -> dict[str, Any]:
        curve = {"threshold": [0.0, 0.25, 0.5, 0.75, 1.0], "share": share}
        return {"curves": {"error_share": curve}, "all": {"area_error_share": 0.3}}

    quick, slow, never = [0.0, 1.0, 1.0, 1.0, 1.0], [0.0, 0.1, 0.5, 0.999, 1.0], [None] * 5
    for shares, end in (([quick, slow], 0.75), ([quick], 0.25), ([quick, never], 1.0)):
        variants = {str(i): told(share) for i, share in enumerate(shares)}
        plot = evaluated._curve_plot(variants, "error_share", dict.fromkeys(variants, "#123456"))
        curves, how = drawn.pop()
        assert how["x_range"] == (0.0, end)
        np.testing.assert_array_equal(curves[0].y, quick)
        assert [entry["last"] for entry in plot["legend"]] == [0.3] * len(shares)


def test_there_is_a_curve_for_each_bin_with_matches(drawn):
    def told(**bins: list[float | None]) -> dict[str, Any]:
        return {
            "curves": {"error_share": {"threshold": [0.0, 1.0], "share": [0.0, 1.0]}},
            "curves_by": {
                "scale": {name: {"error_share": share} for name, share in bins.items()},
                "rotation": {"0-30": {"error_share": [0.0, 1.0]}},
                "occlusion": {},
            },
            "by_scale": {name: {"area_error_share": 0.1 * i} for i, name in enumerate(bins)},
        }

    plots = evaluated._split_plots({"a": told(near=[0.5, 1.0], none=[None, None], far=[0.0, 0.25])})
    (((near, far), _),) = drawn
    assert (near.y.tolist(), far.y.tolist(), near.x.tolist()) == ([0.5, 1.0], [0.0, 0.25], [0.0, 1.0])
    assert [plot["title"] for plot in plots] == ["a: change of scale"]
    assert [(entry["name"], entry["last"]) for entry in plots[0]["legend"]] == [("near", 0.0), ("far", 0.2)]


def test_the_reliability_diagram_shows_bins_with_matches_and_the_diagonal(drawn):
    calibration = {"n": [4, 0, 2], "confidence": [0.1, None, 0.8], "accuracy": [0.3, None, 0.5], "ece": 0.23}
    plot = evaluated._reliability_plot({"main": {"calibration": calibration}}, {"main": "#123456"}, 0.04)
    (diagonal, curve), how = drawn.pop()
    assert (diagonal.x.tolist(), diagonal.y.tolist()) == ([0, 1], [0, 1])
    assert (curve.x.tolist(), curve.y.tolist()) == ([0.1, 0.8], [0.3, 0.5])
    assert (how["x_range"], how["y_range"][0]) == ((0.0, 1.0), 0)
    assert plot["legend"][0]["last"] == 0.23
    assert "within 4% of the image's diagonal" in plot["caption"]


def test_networks_that_cannot_be_measured_say_why(filled, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    dataset.add_variant(DescriptorNet, "broken", Variant())
    for variant in ("main", "broken"):
        publish_network(dataset, variant=variant)
    (dataset.path(DescriptorNet, "", "broken") / "weights.safetensors").write_bytes(b"x" * 50)
    page = Page(section(write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8"), "evaluation"))
    assert "broken This could not be read" in page.text
    assert "Measured on: " in page.text, "the other network is measured"
    (dataset.path(Correspondences, "scan-a") / "artifact.json").unlink()
    page = Page(section(write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8"), "evaluation"))
    assert "not measured This could not be read" in page.text
    assert "expected a scene with correspondences, got none" in page.text
    assert "Measured on: " not in page.text


def test_the_step_of_the_saved_weights_is_stated_and_marked(two_networks, tmp_path, drawn):
    html = section(write_report(two_networks, tmp_path / "r.html").read_text(encoding="utf-8"), "training")
    text = Page(html).text
    best = "where the PCK in validation, within 4 % of the diagonal, was best"
    assert f"99 steps; the weights are those of step 80, {best} (dotted line)" in text
    assert "99 steps; the weights are those of the last step" in text
    marked = [how["marked_x"] for _, how in drawn if how.get("x_label") == "optimiser steps"]
    assert marked == [80, 80, None, None]


def test_a_marked_position_is_a_dotted_line(tmp_path: Path):
    x = np.arange(50.0)
    plain, marked = (line_plot([Curve(x, x, "")], x_label="x", y_label="y", marked_x=at) for at in (None, 20.0))
    assert marked.count("stroke-dasharray") == plain.count("stroke-dasharray") + 1


def test_a_range_of_x_is_kept():
    svg = line_plot([Curve(np.arange(5.0), np.arange(5.0), "")], x_label="x", y_label="y", x_range=(0.0, 40.0))
    assert ">40<" in svg
