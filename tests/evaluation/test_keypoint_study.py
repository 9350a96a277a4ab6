from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.core.calibration import Calibration
from bask_data.core.filters.calibrated import calibrated_settings
from bask_data.core.geometry import invert_rigid, project, transform
from bask_data.dataset import Dataset, Splits
from bask_data.engine import make, plan
from bask_data.errors import BadData, UsageError
from bask_data.evaluation import StudySettings, evaluated_keypoints
from bask_data.evaluation.keypoint_study import FILE, is_current, margin_distances, plain_settings, save_study
from bask_data.evaluation.study_tracks import methods_of, settings_in
from bask_data.evaluation.tables import keypoint_tables
from bask_data.evaluation.tracked_points import ROUND, points_to_track, true_tracks
from bask_data.kinds import Demonstration, DescriptorNet, KeypointTrack, Pick, ReferenceKeypoints, Scan, Truth
from bask_data.kinds.truth import TruthMetadata
from bask_data.nn.loss import ContrastiveSettings, contrastive
from bask_data.report.study_figure import write_pictures
from bask_data.report.study_style import method_colours
from bask_data.stages.encode import encode
from tests.datasets import publish_artifact, publish_recording
from tests.described import HALF, HEIGHT, NAMES, WIDTH, K, boxes, coded, described_dataset, publish_network, standing
from tests.scenes import Box, Scene, look_at

N = 14
AWAY = range(6, 9)
"""Frames in which the camera looks elsewhere."""


class Colours:
    """A network whose descriptors are the colours: perfect. Or blind: all pixels are the same to it."""

    def __init__(self, is_blind: bool = False) -> None:
        self.settings = SimpleNamespace(descriptor_dim=3)
        self._factor = 0.0 if is_blind else 0.1

    def cells(self, rgb: np.ndarray) -> np.ndarray:
        return rgb

    def distance_maps(self, rgb: np.ndarray, references: np.ndarray) -> np.ndarray:
        return self.maps(self.cells(rgb), references)

    def maps(self, rgb: np.ndarray, references: np.ndarray) -> np.ndarray:
        away = self._factor * rgb.astype(np.float32)[..., None, :, :, :] - references[:, None, None]
        return (np.linalg.norm(away, axis=-1) / np.sqrt(3)).astype(np.float32)

    def descriptors_at(self, rgb: np.ndarray, uv: np.ndarray):
        import torch

        u, v = np.rint(uv).astype(int).T
        return torch.from_numpy(self._factor * rgb[v, u].astype(np.float32))


NETWORKS = {"main": Colours(), "blind": Colours(is_blind=True)}


def tin_at(i_frame: int) -> np.ndarray:
    """It begins to move at the camera's return."""
    return standing(0.08 + 0.004 * max(i_frame - 9, 0), 0.02, 0.4, HALF["tin"][2])


CARTON = standing(-0.06, 0.0, 0.7, HALF["carton"][2])


def demonstration_camera(i_frame: int) -> np.ndarray:
    target = (0.9, 0.4, 0.0) if i_frame in AWAY else (0.02, 0.0, 0.03)
    return look_at((0.02 + 0.004 * i_frame, -0.3, 0.45), target)


def publish_demonstration(dataset: Dataset, name: str, touching: list[tuple[int, int]] = [], names=NAMES) -> None:  # noqa: B006
    """The boxes of the scans, elsewhere, and the tin moving."""
    cameras = np.stack([demonstration_camera(i) for i in range(N)])
    poses = np.stack([[CARTON, tin_at(i)] for i in range(N)])
    scenes = [Scene((Box(HALF["carton"], CARTON), Box(HALF["tin"], tin_at(i)))) for i in range(N)]
    views = [scene.render(K, camera, HEIGHT, WIDTH) for scene, camera in zip(scenes, cameras, strict=True)]
    images = [
        coded(scene, view.depth, view.instance, camera)
        for scene, view, camera in zip(scenes, views, cameras, strict=True)
    ]
    publish_recording(
        dataset,
        name,
        rgb=images,
        depth=[view.depth for view in views],
        K=K,
        world_from_cameras=cameras,
        kind=Demonstration,
    )
    metadata = TruthMetadata(label_names=dict(names), object_labels=list(names), touching=touching)

    def fill(out: Path) -> None:
        with Truth.writer(out, metadata, poses) as writer:
            camera = writer.camera("wrist", N, (HEIGHT, WIDTH), 1e-4)
            for view, world_from_camera in zip(views, cameras, strict=True):
                camera.append(view.instance, np.round(view.depth * 1e4).astype(np.uint16), world_from_camera)

    publish_artifact(dataset, Truth, name, fill)


@pytest.fixture(autouse=True)
def networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DescriptorNet, "network", lambda self: NETWORKS[self.path.name])


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A scan that networks learned from and two demonstrations alike; nothing but the study is written to it."""
    made = described_dataset(tmp_path_factory.mktemp("study") / "d", {"scan": boxes(0)})
    publish_network(made, "blind")
    for name in ("demo-a", "demo-b"):
        publish_demonstration(made, name)
    return made


@pytest.fixture(scope="module")
def found(studied: Dataset) -> dict:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DescriptorNet, "network", lambda self: NETWORKS[self.path.name])
        return evaluated_keypoints(studied, ("main", "blind"), StudySettings(n_keypoints=6))


def test_with_a_perfect_network_every_filter_is_accurate_while_it_sees(found: dict) -> None:
    methods = found["groups"]["carton+tin"]["methods"]
    assert list(methods) == [
        "blind: expectation",
        "main: expectation, no temperature",
        "main: expectation",
        "main: discrete",
        "main: particle",
    ]
    for name in ("main: expectation", "main: discrete", "main: particle"):
        assert methods[name]["error"]["visible"]["median"] < 0.01, name
    assert methods["blind: expectation"]["error"]["visible"]["median"] > 0.03
    assert methods["blind: expectation"]["apart"]["visible"]["mean"] > 0.03


def test_filters_take_what_was_measured_for_the_references_and_presets_do_not(tmp_path: Path) -> None:
    pick = Pick(name="x", recording="a", camera="wrist", frame=0, u=0, v=0)
    measured = Calibration(np.array([3.0]), np.array([0.5]), np.array([32.0]))
    ReferenceKeypoints.write(tmp_path, descriptors=np.zeros((1, 3), np.float32), picks=[pick], calibration=measured)
    reference = ReferenceKeypoints(tmp_path)
    for preset in ("default", "paper", "code"):
        for method in methods_of({"main": 1.0}, preset):
            taken = settings_in(method, reference)
            if preset == "default" and method.belief in ("discrete", "particle"):
                assert taken == calibrated_settings(method.belief, measured)
            else:
                assert taken == method.settings


def test_the_temperature_is_that_of_distances_as_they_were_trained() -> None:
    first, _, ours, *_ = methods_of({"ours": 1.0, "base": 0.25}, "default")
    assert (first.name, ours.name) == ("base: expectation", "ours: expectation")
    assert first.settings.alpha == 4 * ours.settings.alpha
    without = methods_of({"ours": 0.5}, "paper")[0]
    assert (without.name, without.settings.alpha) == ("ours: expectation, no temperature", 2.0)


def test_single_frames_have_their_best_match_as_mode(found: dict) -> None:
    told = found["groups"]["carton+tin"]["methods"]
    assert told["main: expectation"]["error_of_mode"]["visible"]["median"] < 0.01  # A pixel is 8 mm wide.
    single, flat = told["main: expectation"], told["main: expectation, no temperature"]
    medians = [one["error_of_mode"]["visible"]["median"] for one in (single, flat)]
    assert medians[0] == pytest.approx(medians[1], abs=5e-3)  # The same pixel, at a depth that the heat weighs.
    assert single["apart"]["visible"]["mean"] < flat["apart"]["visible"]["mean"]


def test_only_a_filter_with_memory_knows_keypoints_out_of_view(found: dict) -> None:
    error = {name: one["error"] for name, one in found["groups"]["carton+tin"]["methods"].items()}
    assert error["main: particle"]["out of view"]["median"] < 0.03
    assert error["main: expectation"]["out of view"]["median"] > 0.2


def test_phases_and_figures_are_those_of_ground_truth(studied: Dataset, found: dict) -> None:
    group = found["groups"]["carton+tin"]
    picks = [Pick(**{key: one[key] for key in one if key != "object"}) for one in group["keypoints"]]
    assert [one["object"] for one in group["keypoints"]] == ["carton"] * 3 + ["tin"] * 3
    places = true_tracks(studied, picks, "demo-a")
    inside = np.zeros((N, 6), bool)
    for i in range(N):
        uv, _ = project(transform(invert_rigid(demonstration_camera(i)), places[i]), K)
        inside[i] = ((uv > -0.5) & (uv < [WIDTH - 0.5, HEIGHT - 0.5])).all(axis=1)
    assert not inside[list(AWAY)].any() and inside[: AWAY.start].all()
    told = group["methods"]["main: particle"]["error"]
    n = {phase: told[phase]["n"] + told[phase]["n_unknown"] for phase in told}
    assert n["all"] == 2 * N * 6
    assert n["visible"] + n["occluded"] + n["out of view"] + n["not seen yet"] == n["all"]
    assert n["moving"] == 2 * 3 * (N - 10)  # The tin's, from the frame on that finds it elsewhere.
    assert n["out of view"] <= 2 * 6 * len(AWAY)
    assert set(group["methods"]["main: particle"]["by_object"]) == {"carton", "tin"}
    assert set(group["methods"]["main: particle"]["by_demonstration"]) == {"demo-a", "demo-b"}
    assert group["share_of"]["visible"][0] == pytest.approx(n["visible"] / n["all"], abs=0.3)
    assert group["share_of"]["visible"][50] == 0.0


@pytest.mark.parametrize("name", ["default", "paper", "code"])
def test_settings_without_a_limit_are_null(name: str) -> None:
    told = [plain_settings(method.settings) for method in methods_of({"main": 1.0}, name)]
    json.dumps(told, allow_nan=False)
    assert told[-1]["gripper_reach"] == (0.15 if name == "default" else None)


def test_true_points_move_with_their_objects(studied: Dataset) -> None:
    picks = points_to_track(studied, ["carton", "tin"], 4, "", 0)
    scan = Truth(studied.path(Truth, "scan"))
    places = true_tracks(studied, picks, "demo-a")
    for i, (pick, label) in enumerate(zip(picks, (1, 1, 2, 2), strict=True)):
        depth = scan.depth("wrist", pick.frame)[round(pick.v), round(pick.u)]
        camera = Scan(studied.path(Scan, "scan")).camera("wrist")
        ray = np.linalg.inv(camera.Ks[pick.frame]) @ [pick.u, pick.v, 1.0]
        world = transform(scan.world_from_cameras("wrist")[pick.frame], depth * ray)
        on_object = transform(invert_rigid(np.array(scan.metadata.world_from_object[label])), world)
        for t in (0, N - 1):
            pose = CARTON if label == 1 else tin_at(t)
            np.testing.assert_allclose(places[t, i], transform(pose, on_object), atol=2e-3)


def test_points_of_a_demonstration_stay_where_they_were_picked(studied: Dataset) -> None:
    picks = points_to_track(studied, ["tin"], 3, "", 0, ["demo-b"], ["wrist"])
    assert {pick.recording for pick in picks} == {"demo-b"}
    truth = Truth(studied.path(Truth, "demo-b"))
    frame = picks[0].frame
    places = true_tracks(studied, picks, "demo-b")[frame]
    uv, z = project(transform(invert_rigid(demonstration_camera(frame)), places), K)
    np.testing.assert_allclose(uv, [[pick.u, pick.v] for pick in picks], atol=1e-6)
    shown = [truth.depth("wrist", frame)[round(pick.v), round(pick.u)] for pick in picks]
    np.testing.assert_allclose(z, shown, atol=1e-6)


def test_a_point_of_a_round_object_is_where_its_neighbour_was_picked_beside(tmp_path: Path) -> None:
    names = {1: "pan", 2: ROUND[0]}
    dataset = described_dataset(tmp_path / "d", {"scan": boxes(0)}, names)
    publish_demonstration(dataset, "free", names=names)
    publish_demonstration(dataset, "demo", touching=[(1, 2)], names=names)
    scan = Truth(dataset.path(Truth, "scan"))
    pan, lid = (np.array(scan.metadata.world_from_object[label]) for label in (1, 2))
    picks = points_to_track(dataset, [ROUND[0]], 3, "", 0)
    # Without a neighbour in the scan, the lid's own frame is all there is.
    np.testing.assert_array_equal(true_tracks(dataset, picks, "demo"), true_tracks(dataset, picks, "free"))
    own = transform(invert_rigid(tin_at(0)), true_tracks(dataset, picks, "free")[0])
    attributes = dataset.path(Truth, "scan") / "zarr.json"
    attributes.write_text(attributes.read_text().replace('"touching": []', '"touching": [[2, 1]]'))
    places = true_tracks(dataset, picks, "demo")
    beside_pan = transform(invert_rigid(pan) @ lid, own)
    np.testing.assert_allclose(places[0], transform(CARTON, beside_pan), atol=1e-6)
    last = transform(tin_at(N - 1) @ invert_rigid(tin_at(0)), places[0])
    np.testing.assert_allclose(places[-1], last, atol=1e-6)


def test_a_point_of_a_round_object_may_be_picked_after_that_was_carried_away(tmp_path: Path) -> None:
    names = {1: "pan", 2: ROUND[0]}
    dataset = described_dataset(tmp_path / "d", {"scan": boxes(0)}, names)
    for name in ("one", "two"):
        publish_demonstration(dataset, name, touching=[(1, 2)], names=names)
    picked = [
        pick.model_copy(update={"frame": N - 1}) for pick in points_to_track(dataset, [ROUND[0]], 3, "", 0, ["one"])
    ]
    places = true_tracks(dataset, picked, "one")
    # Both began alike, so its place among what it stood on is its place on the object.
    np.testing.assert_allclose(true_tracks(dataset, picked, "two"), places, atol=1e-6)


def test_histograms_distinguish_matches_from_background(found: dict) -> None:
    counts = found["groups"]["carton+tin"]["distances"]["counts"]["main"]
    edges = np.array(found["groups"]["carton+tin"]["distances"]["edges"])
    middle = {name: np.average(np.sqrt(edges[1:] * edges[:-1]), weights=one) for name, one in counts.items()}
    assert middle["near"] < middle["objects"] < middle["background"]


def test_examples_have_the_truth_and_each_methods_pixel(found: dict) -> None:
    examples = found["groups"]["carton+tin"]["examples"]
    assert [one["object"] for one in examples] == ["carton", "tin"]
    first = examples[0]
    np.testing.assert_allclose(first["pixel"]["main: expectation"][0], first["truth"][0], atol=2.0)
    assert first["frames"][0] == 0 and first["frames"][-1] == N - 1


def test_the_same_study_has_the_same_figures_and_another_seed_other_points(studied: Dataset, found: dict) -> None:
    again = evaluated_keypoints(studied, ("main",), StudySettings(demonstrations=["demo-a"], n_keypoints=6))
    alone, both = (one["groups"]["carton+tin"]["methods"]["main: particle"] for one in (again, found))
    assert alone["by_demonstration"]["demo-a"] == both["by_demonstration"]["demo-a"]
    assert points_to_track(studied, ["tin"], 3, "", 0) == points_to_track(studied, ["tin"], 3, "", 0)
    assert points_to_track(studied, ["tin"], 3, "", 0) != points_to_track(studied, ["tin"], 3, "", 1)


def test_with_a_stride_every_method_sees_every_nth_frame_only(studied: Dataset) -> None:
    settings = StudySettings(demonstrations=["demo-a"], n_keypoints=6, stride=3)
    found = evaluated_keypoints(studied, settings=settings)["groups"]["carton+tin"]
    assert found["demonstrations"]["demo-a"]["n_frames"] == len(range(0, N, 3))
    methods = found["methods"]
    assert all(method["error"]["all"]["n"] == 6 * len(range(0, N, 3)) for method in methods.values())
    # The tin moves by 8 mm between these frames: compared with the truth of another one, its pixel would be off.
    tin = found["examples"][1]
    assert tin["frames"] == [*range(0, N, 3)]
    shown = np.flatnonzero(tin["visible"])
    pixel, truth = (
        np.array(values, dtype=float)[shown] for values in (tin["pixel"]["main: expectation"], tin["truth"])
    )
    np.testing.assert_allclose(pixel, truth, atol=2.0)


def test_reference_keypoints_of_the_dataset_can_be_tracked(studied: Dataset) -> None:
    picks = points_to_track(studied, ["carton", "tin"], 4, "", 0)

    def fill(out: Path) -> None:
        ReferenceKeypoints.write(out, descriptors=np.zeros((4, 3), np.float32), picks=picks)

    publish_artifact(studied, ReferenceKeypoints, "", fill)
    assert points_to_track(studied, ["tin"], 16, "main", 0) == picks[2:]
    with pytest.raises(UsageError, match="--reference: expected picks on pan, got none.  fix: leave out the demonstr"):
        points_to_track(studied, ["pan"], 16, "main", 0)
    with pytest.raises(UsageError, match="--reference: expected one of main, made, got other"):
        points_to_track(studied, ["tin"], 16, "other", 0)


def test_what_is_studied_is_what_encode_makes(studied: Dataset) -> None:
    picks = points_to_track(studied, ["carton", "tin"], 4, "", 0)
    camera = Scan(studied.path(Scan, "scan")).camera("wrist")
    uv = np.array([[[pick.u, pick.v]] for pick in picks])
    described = [NETWORKS["main"].descriptors_at(camera.rgb(picks[0].frame), one).numpy()[0] for one in uv]

    def fill(out: Path) -> None:
        ReferenceKeypoints.write(out, descriptors=np.stack(described), picks=picks)

    publish_artifact(studied, ReferenceKeypoints, "", fill)
    [task] = plan(studied, encode, only=["demo-a"])
    assert make(task).status == "made"
    track = KeypointTrack(studied.path(KeypointTrack, "demo-a"))
    error = np.linalg.norm(track.mean - true_tracks(studied, picks, "demo-a"), axis=2)
    told = evaluated_keypoints(studied, settings=StudySettings(demonstrations=["demo-a"], reference="main"))["groups"][
        "carton+tin"
    ]
    studied = told["methods"]["main: particle"]["by_keypoint"]
    assert [one["mean"] for one in studied.values()] == pytest.approx(error.mean(axis=0), abs=1e-6)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"variants": ["none"]}, "--variant: expected one of main, blind"),
        (
            {"demonstrations": ["none"]},
            r"--demonstrations: expected one with ground-truth transforms \(demo-a, demo-b\)",
        ),
        ({"objects": ["spoon"]}, "--objects: expected one of the objects carton, tin, got spoon"),
        ({"pick_in": ["none"]}, "--pick-in: expected one of scan, demo-a, demo-b, got none"),
        ({"cameras": ["overhead"]}, "cameras: expected some of wrist, got overhead"),
    ],
)
def test_what_does_not_exist_is_reported_with_the_choices(studied: Dataset, asked: dict, message: str) -> None:
    variants = asked.get("variants", ["main"])
    settings = StudySettings(**{name: value for name, value in asked.items() if name != "variants"})
    with pytest.raises(UsageError, match=message):
        evaluated_keypoints(studied, variants, settings)


def test_without_ground_truth_or_a_scan_to_pick_in_there_is_no_study(tmp_path: Path) -> None:
    dataset = described_dataset(tmp_path / "d", {"scan": boxes(0)})
    with pytest.raises(
        UsageError, match="expected a demonstration with ground-truth poses of its objects, got none"
    ) as caught:
        evaluated_keypoints(dataset)
    assert "ingest sim OTHER_ROOT" in caught.value.fix and str(dataset.root) not in caught.value.fix
    publish_demonstration(dataset, "demo")
    dataset.set_splits(Splits(test=("scan",)))
    with pytest.raises(
        UsageError,
        match="expected a frame with ground truth that shows carton, tin, to pick keypoints in, got none in the train",
    ):
        evaluated_keypoints(dataset)


def test_a_saved_study_is_current_until_what_it_measured_changes(studied: Dataset, found: dict) -> None:
    path = save_study(studied, found)
    assert path == studied.root / FILE
    kept = json.loads(path.read_text())
    assert kept == json.loads(json.dumps(found))
    assert is_current(studied, kept)
    changed = kept | {"measured_with": kept["measured_with"] | {"descriptor/main": "another"}}
    assert not is_current(studied, changed)
    assert not is_current(studied, kept | {"measured_with": {"descriptor/gone": "0"}})
    assert [one.name for one in path.parent.iterdir()] == ["keypoints.json"]


def test_figures_are_drawn_and_deterministic(studied: Dataset, found: dict, tmp_path: Path) -> None:
    files = write_pictures(studied, found, tmp_path / "a")
    assert [file.name for file in files] == ["carton+tin.png", "carton+tin-likelihood.png"]
    assert sorted(one.name for one in (tmp_path / "a").iterdir()) == sorted(file.name for file in files)
    again = write_pictures(studied, found, tmp_path / "b")
    assert [file.read_bytes() for file in files] == [file.read_bytes() for file in again]
    image = cv2.cvtColor(cv2.imread(str(files[0])), cv2.COLOR_BGR2RGB)
    for colour in method_colours(found).values():
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(image.astype(int) - rgb).max(axis=2) < 12).sum() > 100, colour


def test_a_figure_of_missing_frames_is_an_error(studied: Dataset, found: dict, tmp_path: Path) -> None:
    lost = json.loads(json.dumps(found))
    for one in lost["groups"]["carton+tin"]["keypoints"]:
        one["recording"] = "gone"
    with pytest.raises(BadData, match="frame .* of wrist in gone: expected the frame that the study used, got none"):
        write_pictures(studied, lost, tmp_path)


def test_the_command_prints_and_saves_the_study(studied: Dataset, tmp_path: Path) -> None:
    arguments = [str(studied.root), "--demonstrations", "demo-a", "--objects", "tin", "--keypoints", "2", "--json"]
    answer = CliRunner().invoke(
        app, ["evaluate", "keypoints", *arguments, "--pictures", str(tmp_path)], catch_exceptions=False
    )
    assert answer.exit_code == 0, answer.stderr
    told = json.loads(answer.stdout)
    assert told["command"] == "evaluate keypoints"
    assert list(told["groups"]) == ["tin"]
    assert told["comparisons"] == told["groups"]["tin"]["comparisons"]
    assert any("too few demonstrations for an interval" in line for line in keypoint_tables(told))
    assert [Path(file).exists() for file in told["files"]] == [True] * 3
    assert json.loads((studied.root / FILE).read_text())["groups"] == told["groups"]
    particle = told["groups"]["tin"]["methods"]["main: particle"]["error"]["all"]["mean"]
    line, of_certainty = [line for line in keypoint_tables(told) if line.startswith("    main: particle")]
    certainty = told["groups"]["tin"]["methods"]["main: particle"]["certainty"]
    assert of_certainty.split()[5] == f"{100 * certainty['coverage']['all']['calibration_error']:.1f}"
    assert line.split()[2] == f"{1000 * particle:.0f}"
    assert f"next: bask-data report {studied.root}" in answer.stderr


@pytest.mark.parametrize(
    ("params", "expected"),
    [
        ({"hinge": "squared"}, {"foreground": 0.5, "background": 0.9}),
        ({"hinge": "plain"}, {"foreground": 0.25, "background": 0.81}),
        ({"hinge": "plain", "background_normalised": False}, {"foreground": 0.25, "background": 0.81 / 8}),
        ({"hinge": "plain", "normalised": False}, {"foreground": 0.25 / 8, "background": 0.81 / 8}),
    ],
)
def test_beyond_the_margins_a_non_match_costs_nothing(params: dict[str, Any], expected: dict[str, float]) -> None:
    margins = {"margin_foreground": 0.25, "margin_background": 0.81}
    found = margin_distances({"loss": "contrastive", **margins, **params}, dimension=64)
    assert found == pytest.approx(expected)
    for where, distance in expected.items():
        settings = ContrastiveSettings(
            **margins, **{"form" if name == "hinge" else name: params[name] for name in params}
        )
        is_foreground = torch.full((1, 1, 1), where == "foreground")
        for factor, costs in ((0.999, True), (1.001, False)):
            apart = torch.full((1, 1, 1, 64), factor * distance, dtype=torch.float64)
            a = torch.zeros(1, 1, 64, dtype=torch.float64)
            loss = contrastive(a, a, apart, is_foreground, torch.ones(1, 1, 1, dtype=torch.bool), settings).loss
            assert (loss > 0) == costs


def test_other_losses_have_no_margin() -> None:
    assert margin_distances({"loss": "infonce"}, 64) is None
