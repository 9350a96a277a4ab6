from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from bask_data.artifact import MANIFEST
from bask_data.core.geometry import invert_rigid, project, transform
from bask_data.dataset import Dataset, Splits, Variant
from bask_data.evaluation.finder import Finder
from bask_data.evaluation.lookup import find_recording
from bask_data.evaluation.reference_points import TruePlaces
from bask_data.kinds import DescriptorNet, KeypointTrack, Pick, ReferenceKeypoints, Truth, VisibleMasks
from bask_data.report import summarise, write_report
from bask_data.report.heat import _frames_that_show
from bask_data.report.words import duration, millimetres, number, percent, size
from tests.datasets import publish_artifact
from tests.report.filled import (
    LABELS,
    OFFSET,
    filled_dataset,
    make_views,
    publish_frames,
    publish_network,
    publish_truth,
    true_places,
)

VOID = {"meta", "img", "br", "link", "input"}
SECTIONS = {
    "frames",
    "reconstruction",
    "objects",
    "masks",
    "matches",
    "training",
    "evaluation",
    "reference",
    "heat",
    "keypoints",
}


class Page(HTMLParser):
    """A page's tags, checked to be closed in order, its text, and its attributes."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.tags: set[str] = set()
        self.words: list[str] = []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).replace("\u00a0", " ").split())

    @property
    def sections(self) -> set[str]:
        return {value for tag, name, value in self.attributes if tag == "section" and name == "id"} - {
            "summary",
            "verdicts",
        }


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    dataset = filled_dataset(tmp_path_factory.mktemp("full") / "dataset")
    publish_network(dataset)
    return dataset


@pytest.fixture(scope="module")
def full_html(full: Dataset, tmp_path_factory: pytest.TempPathFactory) -> str:
    out = tmp_path_factory.mktemp("page") / "deep" / "report.html"
    assert write_report(full, out) == out
    assert [file.name for file in out.parent.iterdir()] == ["report.html"]
    return out.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def found(full: Dataset) -> dict:
    return json.loads(json.dumps(summarise(full), allow_nan=False))


def test_a_full_dataset_has_every_section(full_html):
    page = Page(full_html)
    assert page.sections == SECTIONS
    assert "could not be read" not in page.text


def test_verdicts_come_first_and_are_those_of_the_summary(full_html, found):
    text = Page(full_html).text
    assert full_html.index('id="verdicts"') < full_html.index('id="frames"')
    stages = found["verdicts"]["stages"]
    assert {row["verdict"] for row in stages} <= {"pass", "look", "fail", "not made"}
    for row in stages:
        assert row["evidence"] in text
    assert found["verdicts"]["next"]["why"] in text
    surface = next(row for row in stages if row["stage"] == "Surface")
    assert (surface["verdict"], [finding["code"] for finding in surface["findings"]]) == (
        "look",
        ["frames-disagree", "unmeasured"],
    )


def test_the_page_tells_what_error_to_expect_of_each_keypoint(full_html):
    text = Page(full_html).text
    assert "Ambiguous , because several places look the same to the network: side." in text
    assert "2 43.0 47.0 2 23.4 mm 60 % 5 frames of scan-a; ambiguous" in text
    assert "1 corner scan-a wrist 2 84.0 47.0 1 – – not measured" in text


def test_the_page_loads_nothing_and_runs_only_the_script_that_its_policy_names(full_html):
    page = Page(full_html)
    for tag, name, value in page.attributes:
        if name in ("src", "href", "xlink:href", "action", "data", "poster", "srcset"):
            assert value.startswith(("data:image/jpeg;base64,", "#")), (tag, name, value[:80])
    assert not page.tags & {"iframe", "link", "object", "embed", "base", "form"}
    (script,) = re.findall(r"<script>(.*?)</script>", full_html, re.DOTALL)
    assert full_html.count("<script") == 1
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = dict(
        value.split(" ", 1)
        for _, name, value in page.attributes
        if name == "content" and "script-src" in value
        for value in value.split("; ")
    )
    assert policy == {
        "default-src": "'none'",
        "img-src": "data:",
        "style-src": "'unsafe-inline'",
        "script-src": f"'sha256-{digest}'",
    }
    assert not re.search(r"https?:|@import|url\((?!#)", full_html)
    assert len(full_html) < 8e6


def test_every_picture_decodes_and_has_an_alternative_text(full_html):
    import cv2

    page = Page(full_html)
    sources = [value for tag, name, value in page.attributes if (tag, name) == ("img", "src")]
    assert len(sources) > 40
    assert len([value for tag, name, value in page.attributes if (tag, name) == ("img", "alt") and value]) == len(
        sources
    )
    for source in sources:
        data = np.frombuffer(base64.b64decode(source.split(",", 1)[1]), np.uint8)
        assert cv2.imdecode(data, cv2.IMREAD_COLOR).std() > 1


def test_ids_on_the_page_are_unique_and_every_reference_leads_somewhere(full_html):
    page = Page(full_html)
    ids = [value for _, name, value in page.attributes if name == "id"]
    assert len(ids) == len(set(ids))
    local = {value[1:] for _, name, value in page.attributes if name in ("href", "xlink:href") and value[0] == "#"}
    assert local | set(re.findall(r"url\(#([^)]*)\)", full_html)) <= set(ids)


def test_same_dataset_same_page(full, full_html, tmp_path):
    assert write_report(full, tmp_path / "again.html").read_text(encoding="utf-8") == full_html


def test_an_empty_dataset_says_what_is_missing(tmp_path):
    page = Page(write_report(Dataset.create(tmp_path / "d"), tmp_path / "r.html").read_text(encoding="utf-8"))
    assert page.sections == set()
    for sentence in ("No scan.", "No descriptor network yet.", "No reference keypoints yet.", "No demonstration"):
        assert sentence in page.text
    assert summarise(Dataset(tmp_path / "d")) == {"dataset": "d", "artifacts": []}


def test_many_scenes_show_the_first_few_and_say_how_many_are_left_out(tmp_path):
    dataset = Dataset.create(tmp_path / "d")
    for i in range(5):
        publish_frames(dataset, f"scene-{i}", make_views(0.3, 2))
    page = Page(write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8"))
    assert page.sections == {"frames"}
    assert "5 scenes: the first 3 are shown, 2 are left out" in page.text
    assert "scene-2 (scan)" in page.text
    assert "scene-3 (scan)" not in page.text
    assert "No ground truth for scene-0" in page.text
    assert "No reconstruction yet: scene-0, scene-1, scene-2." in page.text
    assert set(summarise(dataset)["recordings"]) == {f"scene-{i}" for i in range(5)}


def test_a_page_that_grows_too_large_shows_fewer_frames(full, full_html, tmp_path, monkeypatch):
    monkeypatch.setattr("bask_data.report.page.MOST_PAGE_BYTES", len(full_html) - 1)
    smaller = write_report(full, tmp_path / "r.html").read_text(encoding="utf-8")
    assert Page(smaller).sections == SECTIONS
    assert len(smaller) < len(full_html)
    assert smaller.count('alt="colour of frame') == 8
    assert full_html.count('alt="colour of frame') == 11


def test_hostile_names_stay_text(tmp_path):
    tag, breakout = "<script>alert(1)</script>", "\"><img src=x onerror='alert(1)'>"
    dataset = filled_dataset(tmp_path / "d", names=(tag, breakout), label_name=breakout, title=tag + "{{ 7 * 7 }}")
    publish_network(dataset, loss_name="$\\frac$ <b>loss</b>", validated_on=tag)
    html = write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8")
    page = Page(html)
    assert html.count("<script") == 1, "only ours"
    assert "<b>loss" not in html
    assert not [one for one in page.attributes if one[1].startswith("on")]
    assert all(value.startswith("data:") for tag, name, value in page.attributes if name == "src")
    for text in (tag, breakout, "$\\frac$ <b>loss</b>", "{{ 7 * 7 }}"):
        assert text in page.text


def test_the_error_is_the_distance_from_where_the_objects_poses_put_keypoints(full, found):
    track = KeypointTrack(full.path(KeypointTrack, "demo-a"))
    places = true_places(make_views(0.3, 6), make_views(0.8, 5))
    numbers = found["keypoints"]["main"]["demo-a"]
    expected = np.linalg.norm(track.mean - places, axis=2)
    assert numbers["error_m"]["median"] == pytest.approx(np.median(expected), abs=1e-6)
    assert numbers["error_m"]["median"] == pytest.approx(OFFSET, abs=1e-6)
    assert numbers["error_m"]["n"] == 10
    assert numbers["n_keypoints_with_place"] == 2
    assert (numbers["within_2cm"], numbers["within_5cm"]) == (1.0, 1.0)
    assert [row["object"] for row in numbers["keypoints"]] == ["stems", "tissue box"]
    assert numbers["truth_error_m"] == {"stems": 0.004, "tissue box": 0.004}


def test_the_share_on_the_correct_object_counts_pixels_of_ground_truth_labels(found):
    seen = make_views(0.8, 5)
    places = true_places(make_views(0.3, 6), seen) + np.array([0, 0, OFFSET])
    right, labels = [], []
    for i_frame, world_from_camera in enumerate(seen.world_from_cameras):
        for point, label in zip(places, LABELS, strict=True):
            (u, v), _ = project(transform(np.linalg.inv(world_from_camera), point), seen.K)
            right.append(seen.labels(i_frame)[round(v), round(u)] == label)
            labels.append((seen.labels(i_frame) == label).mean())
    shares = found["keypoints"]["main"]["demo-a"]["on_object"]
    assert shares["n"] == len(right)
    assert shares["right"] == pytest.approx(np.mean(right))
    assert shares["chance"] == pytest.approx(np.mean(labels))


def test_mask_iou_is_that_of_the_masks_and_labels_on_disk(full, found):
    masks, truth = VisibleMasks(full.path(VisibleMasks, "scan-a")), Truth(full.path(Truth, "scan-a"))
    pairs = [(masks.camera("wrist").instance(i), truth.instance("wrist", i)) for i in range(6)]
    for row, instance in zip(found["masks"]["scan-a"]["labels"], (1, 2), strict=True):
        both = sum(((m == instance) & (t == row["label"])).sum() for m, t in pairs)
        either = sum(((m == instance) | (t == row["label"])).sum() for m, t in pairs)
        assert row["instance"] == instance
        assert row["iou"] == pytest.approx(both / either)
        assert row["shared"] is False


def test_figures_on_the_page_are_those_of_the_summary(full_html, found):
    text = Page(full_html).text
    track = found["keypoints"]["main"]["demo-a"]
    for expected in (
        f"median {millimetres(track['error_m']['median'])}, mean {millimetres(track['error_m']['mean'])}",
        f"{millimetres(track['error_m']['median'])} median keypoint error in demo-a",
        f"{percent(track['on_object']['right'])} of keypoint positions on the correct object",
        f"Counted: {track['error_m']['n']} frames × keypoints, of 2 of 2 keypoints",
        *(f"{row['iou']:.3f}" for row in found["masks"]["scan-a"]["labels"]),
        f"{found['correspondences']['scan-a']['n_matches']} matches in 3 pairs",
        f"{number(found['reconstruction']['scan-a']['n_vertices'])} vertices",
        "Validated on: held-out frames of scan-a. 99 steps; the weights are those of step 80",
        "2 small clusters were dropped",
        "most matches: wrist frame",
        "outside the second image",
    ):
        assert expected.replace("\u00a0", " ") in text


def test_without_truth_no_error_is_given_and_the_reason_is(tmp_path):
    import shutil

    dataset = filled_dataset(tmp_path / "d")
    shutil.rmtree(dataset.root / "truth")
    text = Page(write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8")).text
    assert "No error is given: there is no ground truth for this demonstration." in text
    assert "No share on the correct object is given: there is no ground truth for this demonstration." in text
    assert "No ground truth for this scene" in text
    assert "No heat maps: the descriptor network of the reference keypoints is missing." in text
    assert summarise(dataset)["keypoints"]["main"]["demo-a"]["error_m"]["median"] is None


def test_labels_without_poses_give_the_share_alone(tmp_path):
    dataset = filled_dataset(tmp_path / "d")
    seen = make_views(0.8, 5)
    publish_artifact(
        dataset,
        Truth,
        "demo-a",
        lambda out: Truth.write(out, {LABELS[0]: "stems"}, {"wrist": (5, (96, 128), seen.labels)}),
    )
    numbers = summarise(dataset)["keypoints"]["main"]["demo-a"]
    assert numbers["error_m"]["n"] == 0
    assert numbers["why_no_error"] == "the ground truth of this demonstration has no poses of its objects"
    assert numbers["on_object"]["n"] == 10


def test_picks_outside_the_dataset_or_the_image_are_not_followed(tmp_path):
    dataset = filled_dataset(tmp_path / "d")
    places = [("../../etc", "..", -3, 1e9), ("scan-a", "wrist", 2, float("inf"))]
    picks = [
        Pick(name=name, recording=recording, camera=camera, frame=frame, u=u, v=-u)
        for name, (recording, camera, frame, u) in zip(("corner", "side"), places, strict=True)
    ]
    publish_network(dataset)
    publish_artifact(
        dataset,
        ReferenceKeypoints,
        "",
        lambda out: ReferenceKeypoints.write(out, descriptors=np.zeros((2, 8), np.float32), picks=picks[:1]),
    )
    text = Page(write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8")).text
    assert "Picked in frames that are not in this dataset: ../../etc, .., frame -3." in text
    assert "no label is known for any reference keypoint's object" in text


def test_a_broken_artifact_affects_only_its_own_section(tmp_path):
    dataset = filled_dataset(tmp_path / "d")
    broken = dataset.path(VisibleMasks, "scan-a") / "zarr.json"
    broken.write_text(broken.read_text().replace('"n_instances"', '"n_things"'))
    for file in (dataset.path(VisibleMasks, "scan-a") / "wrist" / "instance").rglob("c/*/*/*"):
        file.write_bytes(b"x" * 50)
    page = Page(write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "This could not be read" in page.text
    assert page.sections == SECTIONS - {"training", "evaluation"}
    assert "error" in summarise(dataset)["masks"]["scan-a"]


@pytest.mark.parametrize(("n_frames", "size"), [(3, (96, 128)), (5, (48, 64))])
def test_labels_of_other_frames_than_the_track_s_are_an_error(tmp_path, n_frames, size):
    dataset = filled_dataset(tmp_path / "d")
    labels = np.full(size, LABELS[0], np.uint8)
    publish_artifact(
        dataset,
        Truth,
        "demo-a",
        lambda out: Truth.write(out, {LABELS[0]: "stems"}, {"wrist": (n_frames, size, lambda i: labels)}),
    )
    assert "error" in summarise(dataset)["keypoints"]["main"]["demo-a"]
    page = Page(write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "This could not be read" in page.text
    assert page.sections == SECTIONS - {"training", "evaluation"}


def test_heat_maps_are_of_keypoints_whose_object_is_in_the_recording(tmp_path, monkeypatch):
    monkeypatch.setattr("bask_data.report.heat.N_HEAT_POINTS", 1)
    dataset = filled_dataset(tmp_path / "d")
    publish_network(dataset)
    seen = make_views(0.8, 5)
    publish_artifact(
        dataset,
        Truth,
        "demo-a",
        lambda out: Truth.write(out, {LABELS[1]: "tissue box"}, {"wrist": (5, (96, 128), seen.labels)}),
    )
    html = write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8")
    in_demonstration = html[html.index("demo-a, wrist: a demonstration") :]
    assert in_demonstration.count('alt="heat map of side, frame') == 4
    assert 'alt="heat map of corner' not in in_demonstration


def test_heat_maps_are_of_all_networks_in_held_out_scenes_first(tmp_path):
    dataset = filled_dataset(tmp_path / "d")
    seen = make_views(0.5, 4)
    for name in ("scan-b", "scan-c"):
        publish_frames(dataset, name, seen)
    publish_truth(dataset, "scan-c", seen, "tissue box")
    dataset.set_splits(Splits(train=("scan-a",), test=("scan-b", "scan-c")))
    for seed, variant in enumerate(("main", "florence")):
        dataset.add_variant(DescriptorNet, variant, Variant())
        publish_network(dataset, variant=variant, seed=seed)
    html = write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8")
    html = html[html.index('<section id="heat">') :]
    page = Page(html[: html.index("</section>") + len("</section>")])
    titles = ["scan-c, wrist: a held-out scene", "scan-a, wrist: the scan they were picked in", "demo-a, wrist: a demo"]
    assert sorted(titles, key=page.text.index) == titles, "scan-b has no ground truth"
    alts = [value for tag, name, value in page.attributes if (tag, name) == ("img", "alt")]
    n_frames = sum(min(len(frames_that_show(dataset, name, [0, 1])), 4) for name in ("scan-c", "scan-a", "demo-a"))
    for point in ("corner", "side"):
        assert sum(alt.startswith(f"heat map of {point}, frame") for alt in alts) == 2 * n_frames
        assert alts.count(f"where {point} was picked") == 3
    assert "main: α = 4; florence: α = 4" in page.text
    # The frame of the picks is left out.
    own = page.text[page.text.index(titles[1]) : page.text.index(titles[2])]
    assert "frame 2" not in own
    # The error of the best match is its distance from where the object's pose puts the keypoint.
    finder = Finder(dataset, "florence", DescriptorNet(dataset.path(DescriptorNet, "", "florence")), picks_of(dataset))
    i_frame = frames_that_show(dataset, "scan-c", [0, 1])[0]
    best = finder.look(seen.views[i_frame].rgb, [0]).best[0]
    (u, v), _ = project(
        transform(invert_rigid(seen.world_from_cameras[i_frame]), true_places(make_views(0.3, 6), seen)[0]), seen.K
    )
    error = np.linalg.norm(best - [u, v])
    (text,) = {alt for alt in alts if alt.startswith(f"heat map of corner, frame {i_frame}, {error:.1f} px off")}
    assert text.endswith(f"nearest {finder.look(seen.views[i_frame].rgb, [0]).nearest[0]:.2f}")


def picks_of(dataset: Dataset) -> list[Pick]:
    return ReferenceKeypoints(dataset.path(ReferenceKeypoints)).picks


def frames_that_show(dataset: Dataset, name: str, indices: list[int]) -> list[int]:
    """Of a short recording, those that show most of some reference points, but for frame 2 of their own scan."""
    recording = find_recording(dataset, name)
    assert recording is not None
    (camera,) = recording.cameras
    places = TruePlaces(dataset, picks_of(dataset), name)
    n_seen = {
        i: sum(places.pixels(camera, i).states[j] == "visible" for j in indices)
        for i in range(camera.n_frames)
        if (name, i) != ("scan-a", 2)
    }
    return [i for i, n in n_seen.items() if n > max(n_seen.values()) / 2]


def test_frames_that_show_a_point_are_chosen_and_not_the_one_it_was_picked_in(full):
    n_left_out = 0
    for name in ("scan-a", "demo-a"):
        recording, places = find_recording(full, name), TruePlaces(full, picks_of(full), name)
        assert recording is not None
        for i in (0, 1):
            expected = frames_that_show(full, name, [i])
            assert _frames_that_show(recording, places, picks_of(full), [i], 9)[1] == expected
            n_left_out += recording.cameras[0].n_frames - len(expected)
    assert n_left_out > 2, "not only the frame it was picked in"


def test_an_unreadable_network_leaves_the_heat_maps_of_others(tmp_path):
    dataset = filled_dataset(tmp_path / "d")
    for variant in ("main", "broken"):
        dataset.add_variant(DescriptorNet, variant, Variant())
        publish_network(dataset, variant=variant)
    (dataset.path(DescriptorNet, "", "broken") / "weights.safetensors").write_bytes(b"x" * 50)
    html = write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8")
    heat = html[html.index('<section id="heat">') :]
    assert "This could not be read" in heat
    assert heat.count('alt="heat map of side, frame') >= 4


def test_a_broken_manifest_is_listed_as_such(tmp_path):
    dataset = filled_dataset(tmp_path / "d")
    (dataset.path(Truth, "scan-a") / MANIFEST).write_text("{")
    assert "unreadable manifest" in Page(write_report(dataset, tmp_path / "r.html").read_text(encoding="utf-8")).text


def test_figures_are_formatted_for_readers():
    assert [number(value) for value in (None, float("nan"), 1234567, 0.123456, 5.0, [1.0, 2], "x", True)] == [
        *("–", "–", "1,234,567", "0.123", "5", "1, 2", "x", "yes")
    ]
    assert [percent(value).replace("\u00a0", " ") for value in (None, 0.0, 0.0123, 0.5, 1.0)] == [
        *("–", "0 %", "1.2 %", "50 %", "100 %")
    ]
    assert [millimetres(value).replace("\u00a0", " ") for value in (0.0123, 0.5, 2.0)] == [
        "12.3 mm",
        "500 mm",
        "2.00 m",
    ]
    assert [size(value).replace("\u00a0", " ") for value in (900, 2_500_000, 3e9)] == ["1 kB", "2.5 MB", "3.0 GB"]
    assert duration(125.0).replace("\u00a0", " ") == "2 min 05 s"


def test_the_template_ships_with_the_package():
    import bask_data.report

    assert (Path(bask_data.report.__file__).parent / "page.html.j2").is_file()
