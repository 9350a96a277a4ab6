from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bask_data import evaluation
from bask_data.cli.app import app
from bask_data.core.geometry import in_image, invert_rigid, project, transform, unproject
from bask_data.dataset import Dataset, Splits
from bask_data.errors import BadData, UsageError
from bask_data.evaluation import DescriptorSettings, descriptor, evaluated_descriptor
from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.held_out import HeldOut, held_out
from bask_data.evaluation.matches import alike_pairs, candidate_pairs, spread_pairs
from bask_data.evaluation.pair_matches import BINS
from bask_data.evaluation.sweep import about, moved, moved_pixels
from bask_data.kinds import Correspondences, DescriptorNet, PairRow
from tests.datasets import publish_artifact
from tests.described import (
    HALF,
    HEIGHT,
    N_FRAMES,
    WIDTH,
    K,
    ReadsColours,
    ReadsPositions,
    boxes,
    cameras,
    coded,
    described_dataset,
    publish_masks,
    publish_network,
)
from tests.scenes import Scene

LOADED = descriptor._network
"""What really loads a network; the tests replace it."""
NETWORKS = {"main": ReadsColours(), "blind": ReadsPositions()}
SCENES = {"a": boxes(0), "b": boxes(1), "c": boxes(2)}


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Trained on two scenes, tested on the third; never written to."""
    dataset = described_dataset(tmp_path_factory.mktemp("described") / "d", SCENES)
    publish_network(dataset, "blind")
    dataset.set_splits(Splits(test=("c",)))
    return dataset


@pytest.fixture(autouse=True)
def networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(descriptor, "_network", lambda dataset, variant: NETWORKS[variant])


@pytest.fixture(scope="module")
def candidates(shared: Dataset) -> list:
    return candidate_pairs(shared, Frames(shared, "c"), HeldOut(("c",), 1.0, ""), 0)


# Matches --------------------------------------------------------------------------------------------------------------


def shown_point(scene: Scene, world_from_camera: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a ray through each pixel hits: point in the world and number of the object, by the scene's formulas."""
    origin, directions = world_from_camera[:3, 3], unproject(uv, np.ones(len(uv)), K) @ world_from_camera[:3, :3].T
    hits = np.stack([body.cast(origin, directions) for body in scene.background + scene.objects])
    return origin + hits.min(axis=0)[:, None] * directions, hits.argmin(axis=0)


def test_matches_are_one_point_of_one_object_that_both_views_show(candidates: list) -> None:
    poses, n = cameras(2), 0
    for pair in candidates:
        a, b = poses[pair.a.i], poses[pair.b.i]
        point, label = shown_point(SCENES["c"], a, pair.uv_a)
        np.testing.assert_array_equal(label, pair.label)
        uv_b, z_b = project(transform(invert_rigid(b), point), K)
        np.testing.assert_allclose(pair.uv_b, uv_b, atol=0.15)
        np.testing.assert_allclose(pair.points_b, transform(invert_rigid(b), point), atol=1e-3)
        seen, again = shown_point(SCENES["c"], b, pair.uv_b)
        # At an outline the nearest pixel may show the object where the exact position just misses it.
        same = again == label
        n += np.count_nonzero(same & (np.abs(seen - point).max(axis=1) < 0.01))
        z_a = transform(invert_rigid(a), point)[:, 2]
        np.testing.assert_allclose(pair.scale, np.maximum(z_a / z_b, z_b / z_a), rtol=0.01)
    assert n > 0.95 * sum(len(pair.label) for pair in candidates) > 500


def test_matches_stay_away_from_the_edges_of_what_they_are_on(candidates: list) -> None:
    poses = cameras(2)
    for pair in candidates:
        for frame, uv in ((pair.a, pair.uv_a), (pair.b, pair.uv_b)):
            for du, dv in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                beside = np.rint(uv) + np.array([du, dv])
                inside = in_image(beside, HEIGHT, WIDTH)
                _, label = shown_point(SCENES["c"], poses[frame.i], beside[inside])
                np.testing.assert_array_equal(label, pair.label[inside])


def test_occlusion_is_the_share_of_the_object_s_pixels_that_are_left(candidates: list) -> None:
    poses, scene = cameras(2), SCENES["c"]
    found, truth = [], []
    for pair in candidates:
        view = scene.render(K, poses[pair.b.i], HEIGHT, WIDTH)
        alone = scene.amodal(K, poses[pair.b.i], HEIGHT, WIDTH)
        for label in np.unique(pair.label):
            found.append(pair.visible[pair.label == label][0])
            truth.append((view.instance == label).sum() / alone[label - 1].sum())
    assert min(truth) < 0.8
    # Images are small: a row of pixels along an outline is some percent of an object.
    assert np.abs(np.subtract(found, truth)).max() < 0.1


def test_rotation_is_that_of_the_colours_around(candidates: list) -> None:
    """On the top of the carton, which no view sees at a grazing angle, the ways of two points of it tell the turn."""
    poses, scene, errors = cameras(2), SCENES["c"], []
    carton = scene.objects[0]
    for pair in candidates:
        a, b = poses[pair.a.i], poses[pair.b.i]
        points, label = shown_point(scene, a, pair.uv_a)
        on_top = (label == 1) & (carton.local(points)[:, 2] > carton.half[2] - 1e-6)
        inner = np.abs(carton.local(points)[:, :2]).max(axis=1) < 0.03
        for i in np.flatnonzero(on_top & inner):
            step = 1e-3 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
            (p, p_x, p_y), (q, q_x, q_y) = (
                project(transform(invert_rigid(one), points[i] + step), K)[0] for one in (a, b)
            )
            warp = np.column_stack([q_x - q, q_y - q]) @ np.linalg.inv(np.column_stack([p_x - p, p_y - p]))
            angle = abs(np.arctan2(warp[1, 0] - warp[0, 1], warp[0, 0] + warp[1, 1]))
            errors.append(abs(angle - pair.rotation[i]))
    assert len(errors) > 30
    # A pixel is a centimetre here, and what is near an edge leans a little to the other side of it.
    assert np.degrees(np.median(errors)) < 0.2
    assert np.degrees(np.quantile(errors, 0.95)) < 5


def test_half_of_the_pairs_are_random_and_the_others_fill_bins(candidates: list) -> None:
    spread = spread_pairs(candidates, 30, 0)
    assert len(spread) == len({(pair.a, pair.b) for pair in spread}) == 30
    assert sum(pair.is_random for pair in spread) == 15
    assert [pair.b for pair in spread] == sorted(pair.b for pair in spread)

    def emptiest(pairs: list) -> int:
        counts = [
            np.concatenate([np.bincount(pair.bins()[name], minlength=len(BINS[name])) for name in BINS])
            for pair in pairs
        ]
        return int(np.sum(counts, axis=0).min())

    chosen = [pair for pair in spread if not pair.is_random]
    blind = [pair for pair in spread if pair.is_random]
    assert emptiest(chosen) > emptiest(blind)
    assert spread_pairs([], 30, 0) == []


def test_pairs_to_be_turned_are_similar_already(candidates: list) -> None:
    pairs = alike_pairs(candidates, 3, 0)
    assert 0 < len(pairs) <= 3
    for pair in pairs:
        assert pair.scale.max() < 1.25 and np.degrees(pair.rotation.max()) < 30


# Networks of which the answer is known --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(shared: Dataset) -> dict:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(descriptor, "_network", lambda dataset, variant: NETWORKS[variant])
        return evaluated_descriptor(shared, ("main", "blind"), DescriptorSettings(pairs=24, sweep=True, keypoints=10))


def test_a_network_that_knows_every_point_finds_it_at_any_scale_rotation_and_occlusion(found: dict) -> None:
    told = found["variants"]["main"]
    for what, rows in {"by_all": {"all": told["all"]}, **told}.items():
        for name, figures in rows.items() if what.startswith("by_") else ():
            if figures["n"] >= 20:
                # Between the pixels of a turned image colours are mixed, those of an outline with the table's.
                assert figures["pck_4"] > (0.85 if what == "by_turn" else 0.95), (what, name)
                assert figures["median_px"] < 1.0, (what, name)
                assert figures["closer_mean"] < 0.02, (what, name)
    assert told["all"]["median_3d_m"] < 0.004
    assert told["all"]["area_error_share"] < 0.02
    # It is sure nearly always, and right.
    assert told["calibration"]["ece"] < 0.05
    assert told["calibration"]["n"][-1] > 0.95 * told["all"]["n"]
    assert set(told["by_object"]) == {"carton", "tin"}
    assert list(told["by_scene"]) == ["c"]
    assert min(told["by_scale"][name]["n"] for name in BINS["scale"]) > 10
    assert min(told["by_rotation"][name]["n"] for name in BINS["rotation"]) > 10


def test_the_best_calibrated_temperature_is_reported(found: dict) -> None:
    for told in found["variants"].values():
        true = told["calibration"]
        assert true["truest_ece"] <= true["ece"]
    # A network that knows positions only is calibrated best where its heat maps are flattest.
    assert found["variants"]["blind"]["calibration"]["truest_alpha"] == 1.0


def test_every_match_is_in_one_bin_of_each_kind(found: dict) -> None:
    for told in found["variants"].values():
        totals = {what: sum(one["n"] for one in told[f"by_{what}"].values()) for what in (*BINS, "object", "scene")}
        assert len(set(totals.values())) == 1
        assert told["all"]["n"] < totals["scene"]


def test_curves_of_all_and_of_each_bin_agree_with_their_figures(found: dict) -> None:
    for told in found["variants"].values():
        thresholds = told["curves"]["error_share"]["threshold"]
        assert thresholds[20] == pytest.approx(0.04)
        assert told["curves"]["error_share"]["share"][20] == pytest.approx(told["all"]["pck_4"], abs=0.01)
        assert set(told["curves_by"]) == {"scale", "rotation", "occlusion", "object", "scene"}
        for what, rows in told["curves_by"].items():
            for name, curves in rows.items():
                figures = told[f"by_{what}"][name]
                assert [len(one) for one in curves.values()] == [101] * 4
                if not figures["n"]:
                    assert set(curves["error_share"]) == {None}
                    continue
                assert curves["error_share"][20] == pytest.approx(figures["pck_4"], abs=0.01)
                above = np.trapezoid(1 - np.array(curves["error_share"]), thresholds)
                assert above == pytest.approx(figures["area_error_share"], abs=0.02)


def test_variants_are_measured_on_the_same_matches(found: dict) -> None:
    main, blind = found["variants"].values()
    assert [one["n"] for one in main["by_rotation"].values()] == [one["n"] for one in blind["by_rotation"].values()]
    assert main["by_turn"]["90"]["n"] == blind["by_turn"]["90"]["n"] > 0


def test_the_same_seed_gives_the_same_figures_and_another_one_other_matches(shared: Dataset) -> None:
    settings = [DescriptorSettings(pairs=2, sweep=True, seed=seed) for seed in (1, 1, 2)]
    one, same, other = (evaluated_descriptor(shared, settings=each) for each in settings)
    assert one == same
    assert one["variants"]["main"]["all"] != other["variants"]["main"]["all"]


def test_a_network_that_knows_positions_only_is_off_by_the_way_of_each_match(
    shared: Dataset, found: dict, candidates: list
) -> None:
    blind = [pair for pair in spread_pairs(candidates, 24, 0) if pair.is_random]
    ways = np.concatenate([np.linalg.norm(pair.uv_a - pair.uv_b, axis=1) for pair in blind])
    told, diagonal = found["variants"]["blind"]["all"], np.hypot(HEIGHT, WIDTH)
    assert told["n"] == len(ways)
    # Maps are eight times finer than the image: a sixteenth of a pixel either way.
    assert told["median_px"] == pytest.approx(np.median(ways), abs=0.1)
    for percent in (4, 8):
        assert told[f"pck_{percent}"] == pytest.approx((ways <= percent / 100 * diagonal).mean(), abs=0.02)
    assert told["area_error_share"] == pytest.approx((ways / diagonal).mean(), abs=0.002)
    # The false positives are the disc around the wrong place, as far as the image goes.
    assert 0 < told["closer_mean"] < np.pi * np.mean(ways**2) / (HEIGHT * WIDTH)


def test_zoomed_and_turned_views_know_where_the_match_has_gone(found: dict) -> None:
    """What is fixed to the image is lost by just the way on which zoom and turn lead."""
    told = found["variants"]["blind"]
    assert told["by_zoom"]["1"] == told["by_turn"]["0"]
    turned = [told["by_turn"][angle]["median_px"] for angle in ("0", "45", "90", "135", "180")]
    assert turned[1] < turned[2] < turned[3] < turned[4]
    assert {one["n"] for what in ("zoom", "turn") for one in told[f"by_{what}"].values()} == {told["by_turn"]["0"]["n"]}


def test_an_image_is_moved_with_its_pixels() -> None:
    scene, camera = SCENES["a"], cameras(0)[3]
    view = scene.render(K, camera, HEIGHT, WIDTH)
    rgb = coded(scene, view.depth, view.instance, camera)
    v, u = np.nonzero(view.instance)
    uv = np.stack([u, v], axis=1).astype(float)
    for zoom, turn in ((1.0, 0.0), (2.0, 0.0), (1.0, 90.0), (1.0, 180.0)):
        way = about(np.array([31.5, 23.5]), zoom, turn)
        there = moved_pixels(uv, way)
        inside = in_image(there, HEIGHT, WIDTH) & np.isclose(there, there.round()).all(axis=1)
        shown = moved(rgb, way)[tuple(there[inside].round().astype(int)[:, ::-1].T)]
        if zoom == 1:
            assert inside.sum() > 0.6 * len(uv)
            np.testing.assert_array_equal(shown, rgb[v[inside], u[inside]])
    np.testing.assert_allclose(moved_pixels(np.array([[5.0, 7.0]]), about(np.array([5.0, 7.0]), 2.0, 30.0)), [[5, 7]])
    np.testing.assert_allclose(moved_pixels(np.array([[6.0, 7.0]]), about(np.array([5.0, 7.0]), 2.0, 90.0)), [[5, 9]])
    blown_up = moved(rgb, about(np.array([20.0, 20.0]), 2.0, 0.0))
    np.testing.assert_array_equal(blown_up[20::2, 20::2][:10, :10], rgb[20:30, 20:30])


# Keypoints of one view ------------------------------------------------------------------------------------------------


def test_a_network_that_knows_every_point_finds_keypoints(found: dict) -> None:
    [row] = found["variants"]["main"]["keypoints"].values()
    assert list(row) == ["training", "unseen view"]
    # The view they were picked in is none of those they are looked for in.
    for told, n_views in zip(row.values(), (2 * N_FRAMES - 1, N_FRAMES), strict=True):
        assert told["views"] == n_views
        assert told["seen"] + told["hidden"] + told["outside"] == 10 * n_views
        assert min(told["seen"], told["hidden"]) > 15
        assert told["mean"] < 0.015
    [blind] = found["variants"]["blind"]["keypoints"].values()
    assert blind["training"]["mean"] > 0.15
    # What a flat heat map expects lies in the middle, and is nearer to most things than a corner is.
    assert blind["training"]["seen"] == row["training"]["seen"]


def test_keypoints_are_looked_for_on_other_instances_at_the_same_share_of_their_boxes(
    shared: Dataset, tmp_path: Path
) -> None:
    larger = {name: tuple(1.4 * one for one in half) for name, half in HALF.items()}
    others = {
        "same": described_dataset(tmp_path / "same", {"x": boxes(7)}),
        "larger": described_dataset(tmp_path / "larger", {"x": boxes(8, larger), "y": boxes(9, larger)}),
    }
    found = evaluated_descriptor(shared, settings=DescriptorSettings(pairs=1, keypoints=12), against=others)
    [row] = found["variants"]["main"]["keypoints"].values()
    assert list(row) == ["training", "unseen view", "same", "larger"]
    assert row["same"]["mean"] < 0.015
    assert row["larger"]["views"] == 2 * N_FRAMES
    # The larger ones are seen as far as views show them, and snapped to a sample of their surface.
    assert row["larger"]["mean"] < 0.03
    assert row["larger"]["seen"] > 50


def test_only_scenes_with_ground_truth_transforms_are_searched_for_keypoints(shared: Dataset, tmp_path: Path) -> None:
    other = Dataset.create(tmp_path / "empty")
    with pytest.raises(UsageError, match="--against: expected scenes with ground-truth transforms, got none"):
        evaluated_descriptor(shared, settings=DescriptorSettings(pairs=1, keypoints=4), against={"other": other})


# What is held out -----------------------------------------------------------------------------------------------------


def test_test_scenes_come_before_validation_and_those_before_frames(tmp_path: Path) -> None:
    dataset = described_dataset(tmp_path / "d", SCENES)
    publish_network(dataset, "half", held_out=0.5)
    publish_network(dataset, "third", held_out=1 / 3)
    assert held_out(dataset, ["main"]) == HeldOut(
        ("a", "b", "c"), 1.0, "frames that were trained on: nothing is held out"
    )
    told = "frames that were trained on: nothing is held out from main"
    assert held_out(dataset, ["half", "main"]) == HeldOut(("a", "b", "c"), 1.0, told)
    both = held_out(dataset, ["half", "third"])
    assert both.words == "held-out frames: the last 33% of each camera's, of scenes that were trained on"
    # The frames that neither saw are those that the greedier one left.
    assert both.frames(Frames(dataset, "a"), 99) == [Frame("wrist", i) for i in range(8, 12)]
    assert [frame.i for frame in held_out(dataset, ["half"]).frames(Frames(dataset, "a"), 2)] == [6, 11]
    dataset.set_splits(Splits(validation=("b",)))
    assert held_out(dataset, ["half"]) == HeldOut(("b",), 1.0, "held-out scenes (validation): b")
    dataset.set_splits(Splits(validation=("b",), test=("c",)))
    assert held_out(dataset, ["half"]) == HeldOut(("c",), 1.0, "held-out scenes (test): c")
    asked = held_out(dataset, ["half"], ["a", "c"])
    assert asked == HeldOut(("a", "c"), 1.0, "scenes asked for: a, c; trained on: a")
    with pytest.raises(UsageError, match="--scenes: expected each scene once, got c more than once"):
        held_out(dataset, ["half"], ["c", "a", "c"])
    assert held_out(dataset, ["half"], ["c"]).words == "scenes asked for: c; none of them was trained on"


def test_scenes_that_a_network_learned_from_before_the_split_changed_are_not_held_out(tmp_path: Path) -> None:
    dataset = described_dataset(tmp_path / "d", SCENES)
    publish_network(dataset, "old", learned_from=("b", "c"))
    dataset.set_splits(Splits(test=("c",)))
    expected = r"descriptor/old: c: expected scenes that the network was not trained on, got training scenes: the split"
    with pytest.raises(UsageError, match=expected):
        held_out(dataset, ["main", "old"])
    assert held_out(dataset, ["main"]).scenes == ("c",)


def test_keypoints_of_held_out_frames_are_distinguished_from_those_trained_on(tmp_path: Path) -> None:
    dataset = described_dataset(tmp_path / "d", {"a": boxes(0)})
    publish_network(dataset, held_out=0.25)
    found = evaluated_descriptor(dataset, settings=DescriptorSettings(pairs=4, keypoints=6))
    [row] = found["variants"]["main"]["keypoints"].values()
    # The view they were picked in is one of the nine.
    assert [told["views"] for told in row.values()] == [8, 3]


def test_what_is_missing_is_an_error(tmp_path: Path) -> None:
    dataset = described_dataset(tmp_path / "d", {"a": boxes(0)})
    with pytest.raises(UsageError, match="--scenes: expected one of a, got z"):
        held_out(dataset, ["main"], ["z"])
    with pytest.raises(UsageError, match="--variant: expected one of main, got other.  fix: bask-data train .*other"):
        held_out(dataset, ["other"])
    with pytest.raises(UsageError, match="--variant: expected one of main, got none.  fix: bask-data train .*main"):
        held_out(dataset, [])
    (dataset.path(Correspondences, "a").parent.parent / "truth" / "a" / "artifact.json").unlink()
    with pytest.raises(UsageError, match="a: expected a scene with masks, got none.  fix: bask-data run"):
        held_out(dataset, ["main"])


@pytest.mark.parametrize("alpha", [-1.0, float("inf"), float("nan")])
def test_an_invalid_temperature_is_refused(shared: Dataset, alpha: float) -> None:
    with pytest.raises(UsageError, match="--alpha: expected a finite number, 0 or more, got"):
        evaluated_descriptor(shared, settings=DescriptorSettings(alpha=alpha))


def test_a_network_that_does_not_load_is_an_error(shared: Dataset) -> None:
    with pytest.raises(BadData, match="descriptor/main: expected a network that loads, got .*make it again"):
        LOADED(shared, "main")


def test_a_network_of_an_older_version_or_with_a_damaged_manifest_is_an_error(tmp_path: Path) -> None:
    dataset = described_dataset(tmp_path / "d", {"a": boxes(0)})
    manifest = dataset.path(DescriptorNet) / "artifact.json"
    now = DescriptorNet.schema_version
    older = json.loads(manifest.read_text()) | {"schema_version": now - 1}
    manifest.write_text(json.dumps(older))
    expected = rf"schema: expected descriptor v{now}, got descriptor v{now - 1}.  fix: make it again: `bask-data run`"
    with pytest.raises(BadData, match=expected):
        held_out(dataset, ["main"])
    manifest.write_text("{")
    with pytest.raises(BadData, match="artifact.json: expected a JSON document"):
        held_out(dataset, ["main"])


def test_a_dataset_without_a_scene_to_measure_on_is_an_error(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    publish_network(dataset)
    with pytest.raises(UsageError, match="splits: expected a scene to measure on, got none"):
        held_out(dataset, ["main"])


def test_frames_that_share_nothing_are_an_error(tmp_path: Path) -> None:
    dataset = described_dataset(tmp_path / "d", {"a": boxes(0)})
    publish_network(dataset, held_out=1 / N_FRAMES)
    with pytest.raises(
        UsageError, match="expected frames that see the same objects, got none in held-out frames"
    ) as caught:
        evaluated_descriptor(dataset)
    assert f"`bask-data split {dataset.root} --validation SCENE`" in caught.value.fix


def test_where_no_two_held_out_frames_are_joined_pairs_of_one_may_be_measured_and_are_named(tmp_path: Path) -> None:
    dataset = described_dataset(tmp_path / "d", {"a": boxes(0)})
    publish_network(dataset, held_out=1 / N_FRAMES)
    found = evaluated_descriptor(dataset, settings=DescriptorSettings(pairs=4, one_may_be_learned=True))
    assert found["measured_on"] == (
        "pairs of a held-out frame and one that was trained on, as no matches join two held-out frames: the last 8% of "
        "each camera's, of scenes that were trained on"
    )
    assert found["n_pairs"] == 4
    joined = held_out(dataset, ["main"]).joined_with_learned()
    pairs = candidate_pairs(dataset, Frames(dataset, "a"), joined, 0)
    last = N_FRAMES - 1
    assert len(pairs) > 4 and all((pair.a.i == last) != (pair.b.i == last) for pair in pairs)


# Without truth --------------------------------------------------------------------------------------------------------


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Dataset, dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]]:
    """A scene without truth: the same images with correct cameras, masks and matches."""
    from tests.datasets import publish_recording

    scene, poses = SCENES["a"], cameras(0)
    views = [scene.render(K, camera, HEIGHT, WIDTH) for camera in poses]
    dataset = Dataset.create(tmp_path / "recorded")
    colours = [coded(scene, view.depth, view.instance, camera) for view, camera in zip(views, poses, strict=True)]
    depth = [view.depth for view in views]
    publish_recording(dataset, "a", rgb=colours, depth=depth, K=K, world_from_cameras=poses)
    fractions = np.random.default_rng(0).random((N_FRAMES, 2))
    publish_masks(dataset, "a", [view.instance for view in views], 2, fractions)
    stored = {}
    rng = np.random.default_rng(0)

    def fill(out: Path) -> None:
        with Correspondences.writer(out) as writer:
            for a, b in ((0, 1), (3, 2), (5, 6), (1, 8), (9, 10), (11, 10)):
                v, u = np.nonzero(views[a].instance)
                uv_a = np.stack([u, v], axis=1)[rng.permutation(len(u))[:60]].astype(float)
                points, label = shown_point(scene, poses[a], uv_a)
                uv_b = project(transform(invert_rigid(poses[b]), points), K)[0]
                again, _ = shown_point(scene, poses[b], uv_b)
                good = in_image(uv_b, HEIGHT, WIDTH) & (np.linalg.norm(again - points, axis=1) < 1e-3)
                stored[a, b] = uv_a[good], uv_b[good]
                columns = {"instance": label[good].astype(np.uint8)}
                for one, uv in (("a", uv_a[good]), ("b", uv_b[good])):
                    columns |= {f"u_{one}": uv[:, 0].astype(np.float32), f"v_{one}": uv[:, 1].astype(np.float32)}
                row = PairRow(
                    camera_a="wrist", frame_a=a, camera_b="wrist", frame_b=b, n_attempts=60, distance=0.1, angle=0.1
                )
                writer.append(row, columns)

    publish_artifact(dataset, Correspondences, "a", fill)
    publish_network(dataset)
    return dataset, stored


def test_without_truth_the_dataset_s_own_matches_are_looked_for(recorded: tuple) -> None:
    dataset, stored = recorded
    frames = Frames(dataset, "a")
    pairs = candidate_pairs(dataset, frames, HeldOut(("a",), 1.0, ""), 0)
    assert {(pair.a.i, pair.b.i) for pair in pairs} == {key for key, (uv, _) in stored.items() if len(uv) >= 6}
    for pair in pairs:
        uv_a, uv_b = stored[pair.a.i, pair.b.i]
        both = np.concatenate([uv_a, uv_b], axis=1)
        assert 0 < len(pair.uv_a) <= 24
        for match in np.concatenate([pair.uv_a, pair.uv_b], axis=1):
            assert np.abs(both - match).max(axis=1).min() < 1e-4
        visible = frames.masks.camera("wrist").visible_fraction[pair.b.i]
        np.testing.assert_allclose(pair.visible, visible[pair.label - 1])
        z_a, z_b = (
            transform(invert_rigid(cameras(0)[one]), shown_point(SCENES["a"], cameras(0)[pair.a.i], pair.uv_a)[0])[:, 2]
            for one in (pair.a.i, pair.b.i)
        )
        np.testing.assert_allclose(pair.scale, np.maximum(z_a / z_b, z_b / z_a), rtol=0.02)
    found = evaluated_descriptor(dataset)
    assert found["matches_by"] == {"a": "correspondences"}
    told = found["variants"]["main"]
    assert told["all"]["pck_4"] > 0.95 and told["all"]["median_3d_m"] < 0.004
    assert set(told["by_object"]) <= {"a 1", "a 2"}


def test_a_match_without_depth_has_a_scale_and_a_rotation_all_the_same(recorded: tuple) -> None:
    dataset, _ = recorded
    frames = Frames(dataset, "a")
    whole = candidate_pairs(dataset, frames, HeldOut(("a",), 1.0, ""), 0)
    measured = frames.depth

    def with_gaps(frame: Frame) -> np.ndarray:
        depth = measured(frame).copy()
        depth[:, ::2] = 0
        return depth

    frames.depth = with_gaps
    pairs = candidate_pairs(dataset, frames, HeldOut(("a",), 1.0, ""), 0)
    for pair, one in zip(pairs, whole, strict=True):
        np.testing.assert_array_equal(pair.uv_a, one.uv_a)
        assert np.isfinite(pair.scale).all() and np.isfinite(pair.rotation).all()
        assert np.median(np.abs(pair.scale - one.scale)) < 0.02
        assert np.median(np.abs(pair.rotation - one.rotation)) < 0.1
        # The 3D error of a best match is known only where the depth of the true point was measured.
        assert np.isnan(pair.points_b[:, 2]).any()


def test_matches_of_frames_that_were_trained_on_are_left_out(recorded: tuple) -> None:
    dataset, _ = recorded
    pairs = candidate_pairs(dataset, Frames(dataset, "a"), HeldOut(("a",), 0.25, ""), 0)
    assert {(pair.a.i, pair.b.i) for pair in pairs} == {(9, 10), (11, 10)}


def test_matches_of_one_frame_that_was_trained_on_are_taken_where_asked_for(recorded: tuple) -> None:
    dataset, _ = recorded
    aside = HeldOut(("a",), 1 / 3, "")
    both, one = (
        candidate_pairs(dataset, Frames(dataset, "a"), each, 0) for each in (aside, aside.joined_with_learned())
    )
    assert {(pair.a.i, pair.b.i) for pair in both} == {(9, 10), (11, 10)}
    assert {(pair.a.i, pair.b.i) for pair in one} == {(1, 8), (9, 10), (11, 10)}


def test_without_depth_scale_and_rotation_are_in_no_bin(candidates: list) -> None:
    from dataclasses import replace

    nothing = np.full(len(candidates[0].label), np.nan)
    assert (replace(candidates[0], scale=nothing, rotation=nothing, visible=nothing).bins()["scale"] == -1).all()


# The command ----------------------------------------------------------------------------------------------------------


def test_the_command_prints_tables_for_people_and_everything_for_scripts(
    shared: Dataset, found: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = {}

    def evaluated(dataset: Dataset, variants: list[str], settings: DescriptorSettings, **options: object) -> dict:
        asked.update({"root": dataset.root, "variants": variants, "settings": settings, **options})
        return found

    monkeypatch.setattr(evaluation, "evaluated_descriptor", evaluated)
    command = ["evaluate", "descriptor", str(shared.root), "--variant", "main,blind", "--pairs", "24", "--json"]
    more = ["--no-sweep", "--keypoints", "10", "--against", f"there={shared.root}", "--scenes", "c", "--seed", "3"]
    shown = CliRunner().invoke(app, [*command, *more])
    assert shown.exit_code == 0, shown.stderr
    assert json.loads(shown.stdout) == {"command": "evaluate descriptor", **json.loads(json.dumps(found))}
    assert asked.pop("against")["there"].root == asked.pop("root") == shared.root
    assert asked == {
        "variants": ["main", "blind"],
        "settings": DescriptorSettings(scenes=["c"], pairs=24, sweep=False, keypoints=10, alpha=4.0, seed=3),
    }
    shown = CliRunner().invoke(app, command[:-1])
    told = found["variants"]["blind"]
    words = [
        "measured on held-out scenes (test): c",
        "c: matches from exact depth and cameras",
        "by rotation",
        "by turn",
    ]
    keypoints = told["keypoints"]["carton+tin"]["unseen view"]
    words.append(
        f"unseen view                  {keypoints['mean']:.3f} +- {keypoints['std']:.3f}  ({keypoints['seen']}, "
    )
    true = told["calibration"]
    words.append(f"(ECE) of blind: {100 * true['ece']:.1f} % at alpha 4; best {100 * true['truest_ece']:.1f} % at")
    words.append(f" % at alpha {true['truest_alpha']:g}\n")
    words.append(f"{100 * told['by_turn']['90']['pck_8']:9.1f}")
    for one in words:
        assert one in shown.stdout


def test_a_dataset_to_compare_with_needs_a_name(shared: Dataset) -> None:
    shown = CliRunner().invoke(app, ["evaluate", "descriptor", str(shared.root), "--against", "elsewhere"])
    assert shown.exit_code == UsageError.exit_code
    assert "--against: expected NAME=ROOT, got elsewhere" in shown.stderr
    twice = [part for _ in range(2) for part in ("--against", f"o={shared.root}")]
    shown = CliRunner().invoke(app, ["evaluate", "descriptor", str(shared.root), *twice])
    assert shown.exit_code == UsageError.exit_code
    assert "--against: expected each name once, got o twice" in shown.stderr
