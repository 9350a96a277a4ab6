"""What the page shows of the quality that each stage reports."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.dataset import Dataset
from bask_data.drawing.mask_pictures import mask_picture
from bask_data.drawing.plots import histogram
from bask_data.evaluation.artifact_figures import view_changes
from bask_data.kinds import Demonstration, Truth
from bask_data.kinds.masks import CameraMasks
from bask_data.report import measure, summarise, write_report
from tests.datasets import copied, publish_artifact
from tests.report.filled import HEIGHT, LABELS, WIDTH, make_views, publish_frames, publish_scene
from tests.report.test_report import Page


@pytest.fixture(scope="module")
def found(filled: Dataset) -> dict:
    return json.loads(json.dumps(summarise(filled), allow_nan=False))


@pytest.fixture(scope="module")
def page(filled: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Page:
    return page_of(filled, tmp_path_factory.mktemp("page"))


def page_of(dataset: Dataset, folder: Path) -> Page:
    return Page(write_report(dataset, folder / "r.html").read_text(encoding="utf-8"))


# Reconstruction and objects -------------------------------------------------------------------------------------------


def test_frames_that_the_mesh_does_not_explain_are_suspect(filled, found, page, tmp_path):
    suspects = found["reconstruction"]["scan-a"]["suspect_frames"]
    assert [(row["camera"], row["frame"]) for row in suspects] == [("wrist", 3)]
    assert suspects[0]["residual_abs"] == pytest.approx(0.03)
    assert "Suspect frames" in page.text
    assert "wrist 3 30.0 mm 20 %" in page.text
    assert "5 of 6 frames fused 1 without depth 90 % of the measurements lie on the mesh" in page.text
    assert "2.0 % of the surface seen from behind only" in page.text
    assert "frame 4 of wrist was left out" in page.text
    html = write_report(filled, tmp_path / "r.html").read_text(encoding="utf-8")
    plot = html[html.index("Distance of each frame from the mesh") :]
    assert "#e0453a" in plot[: plot.index("</figure>")], "a red dot"


def test_regions_without_measurements_are_listed(found, page):
    assert found["reconstruction"]["scan-a"]["unmeasured"] == [
        {"centre": [0.1, 0.2, 0.03], "size": [0.08, 0.06, 0.1], "volume": 2e-4}
    ]
    assert "0.10, 0.20, 0.03 8.0 × 6.0 × 10.0 0.2" in page.text


def test_planes_and_near_neighbours_are_listed(found, page):
    objects = found["objects"]["scan-a"]
    assert [row["role"] for row in objects["planes"]] == ["support", "structure"]
    assert objects["neighbours"] == [{"a": 1, "b": 2, "gap_m": 0.011}]
    assert "support 0.00, 0.00, 1.00 5,000 0.7 mm" in page.text
    assert "Objects that nearly touch" in page.text
    assert "1 and 2 11.0 mm" in page.text


# Masks ----------------------------------------------------------------------------------------------------------------


def test_touching_bodies_count_as_one_and_the_robot_as_none(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    seen = make_views(0.3, 6)

    def labels(i_frame: int) -> np.ndarray:
        image = seen.labels(i_frame).copy()
        image[: HEIGHT // 3] = 255
        return image

    def fill(out: Path) -> None:
        names = {LABELS[0]: "pan", LABELS[1]: "lid", 255: "gripper"}
        Truth.write(out, names, {"wrist": (6, (HEIGHT, WIDTH), labels)})
        content = json.loads((out / "zarr.json").read_text())
        content["attributes"]["bask"]["touching"] = [LABELS]
        (out / "zarr.json").write_text(json.dumps(content))

    publish_artifact(dataset, Truth, "scan-a", fill)
    masks = summarise(dataset)["masks"]["scan-a"]
    assert [(row["name"], row["label"]) for row in masks["labels"]] == [("pan + lid", LABELS[0])]
    instances = [seen.views[i].instance.copy() for i in range(6)]
    for instance in instances:
        instance[HEIGHT // 2 :][instance[HEIGHT // 2 :] == 2] = 0
    on_robot = sum((instance[: HEIGHT // 3] > 0).sum() for instance in instances)
    assert masks["on_robot_share"] == pytest.approx(on_robot / sum((one > 0).sum() for one in instances))
    assert "of the masks' pixels show the robot" in page_of(dataset, tmp_path).text


def test_the_measured_share_of_a_mask_is_reported(found):
    seen = make_views(0.3, 6)
    shares = []
    for view in seen.views:
        mask = view.instance == 1
        shares.append(mask[:, WIDTH // 3 :].sum() / mask.sum() if mask.any() else np.nan)
    row = found["masks"]["scan-a"]["instances"][0]
    assert row["measured_fraction"]["median"] == pytest.approx(np.nanmedian(shares), abs=1e-6)


def test_inferred_pixels_are_hatched():
    rgb = np.full((40, 60, 3), 200, np.uint8)
    instance = np.ones((40, 60), np.uint8)
    measured = np.ones((40, 60), bool)
    measured[:, 30:] = False
    plain, hatched = mask_picture(rgb, instance, None, 60), mask_picture(rgb, instance, None, 60, measured)
    changed = (plain != hatched).any(axis=2)
    assert not changed[:, :30].any()
    assert 0.2 < changed[5:35, 32:58].mean() < 0.5


def test_masks_are_read_once_for_page_and_json(filled, tmp_path, monkeypatch):
    looked: list[tuple[str, int]] = []
    read = CameraMasks.instance

    def counted(self: CameraMasks, i_frame: int) -> np.ndarray:
        looked.append((self.name, i_frame))
        return read(self, i_frame)

    monkeypatch.setattr(CameraMasks, "instance", counted)
    measure(filled).masks("scan-a")
    assert len(looked) == 6
    looked.clear()
    # Three sizes are tried before a page this large is given up on.
    monkeypatch.setattr("bask_data.report.page.MOST_PAGE_BYTES", 1)
    ended = CliRunner().invoke(app, ["report", str(filled.root), "--out", str(tmp_path / "r.html"), "--json"])
    assert json.loads(ended.stdout)["masks"]["scan-a"]["n_frames"] == 6
    assert len(looked) == 6 + 6 + 4 + 2, "once to measure, and what each size of the page shows"


def test_long_recordings_are_measured_on_frames_spread_over_them(filled: Dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("bask_data.evaluation.artifact_figures.MOST_MEASURED", 3)
    dataset = copied(filled, tmp_path / "d")
    masks = summarise(dataset)["masks"]["scan-a"]
    assert (masks["n_frames"], masks["n_measured_frames"], masks["n_labelled_frames"]) == (6, 3, 3)
    assert "Pixels are counted in 3 frames." in page_of(dataset, tmp_path).text


# Matches --------------------------------------------------------------------------------------------------------------


def test_change_of_scale_and_rotation_are_those_of_the_matches():
    rng = np.random.default_rng(0)
    scale, angle = np.array([0.5, 1.0, 3.0]), np.deg2rad([0, 170, -40])
    columns: dict[str, list] = {name: [] for name in ("pair", "u_a", "v_a", "u_b", "v_b")}
    for i in range(3):
        uv = rng.uniform(0, 300, (50, 2))
        turn = scale[i] * np.array([[np.cos(angle[i]), -np.sin(angle[i])], [np.sin(angle[i]), np.cos(angle[i])]])
        other = uv @ turn.T + rng.uniform(-50, 50, 2)
        for name, values in (
            ("pair", np.full(50, 7 * i)),
            ("u_a", uv[:, 0]),
            ("v_a", uv[:, 1]),
            ("u_b", other[:, 0]),
            ("v_b", other[:, 1]),
        ):
            columns[name] += list(values)
    # A single match says nothing.
    for name, value in (("pair", 99), ("u_a", 1.0), ("v_a", 1.0), ("u_b", 1.0), ("v_b", 1.0)):
        columns[name].append(value)
    change = view_changes(pa.table(columns))
    np.testing.assert_allclose(change.scale, scale, rtol=1e-5)
    np.testing.assert_allclose(change.rotation, angle, atol=1e-5)


def test_rejections_are_listed_by_object_and_reason(found, page):
    matches = found["correspondences"]["scan-a"]
    assert matches["rejections"] == {"hidden_in_b": 321, "outside_b": 45, "cycle": 6}
    assert matches["rejections_per_instance"] == {
        "1": {"hidden_in_b": 300, "outside_b": 45},
        "2": {"cycle": 6, "hidden_in_b": 21},
    }
    n = matches["matches_per_instance"]["2"]
    assert f"2 {n + 27:,} {n:,} {100 * n / (n + 27):.0f} % " in page.text
    for title in (
        "Change of scale",
        "Rotation in the image",
        "Distance between the cameras",
        "Angle between the cameras",
    ):
        assert title in page.text


@pytest.mark.parametrize("values", [[], [1.0], [np.nan], [0.5, 1.0, 2.0], [3.0] * 5])
@pytest.mark.parametrize("logarithmic", [False, True])
def test_a_histogram_is_drawn_of_whatever_there_is(values, logarithmic):
    svg = histogram(np.array(values), x_label="x", y_label="n", logarithmic=logarithmic)
    assert svg.startswith("<svg")
    assert svg.endswith("</svg>")


# Any dataset ----------------------------------------------------------------------------------------------------------


def test_scans_alone_and_demonstrations_alone_make_whole_pages(tmp_path):
    scans, demonstrations = Dataset.create(tmp_path / "s"), Dataset.create(tmp_path / "d")
    for i in range(2):
        publish_frames(scans, f"scene{i}", make_views(0.3, 2))
        publish_scene(scans, f"scene{i}", make_views(0.3, 6))
        publish_frames(demonstrations, f"demo{i}", make_views(0.3, 2), Demonstration)
    page = page_of(scans, tmp_path)
    assert page.sections == {"frames", "reconstruction", "objects", "masks", "matches"}
    assert "No demonstration, so there is nothing to track keypoints in." in page.text
    page = page_of(demonstrations, tmp_path)
    assert page.sections == {"frames"}
    assert "No scan." in page.text
    assert "No keypoints yet: demo0, demo1." in page.text
