from __future__ import annotations

import shutil
import threading
import time
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bask_data import progress
from bask_data.artifact import read_manifest
from bask_data.core.calibration import Calibration
from bask_data.core.filters.discrete import DiscreteSettings
from bask_data.core.filters.particle.settings import ParticleSettings
from bask_data.core.geometry import project
from bask_data.dataset import Dataset
from bask_data.engine import make, plan, state_of
from bask_data.kinds import Demonstration, DescriptorNet, KeypointTrack, ReferenceKeypoints, Robot, Truth, arrays
from bask_data.kinds.truth import TruthMetadata
from bask_data.observing import FrameObservations
from bask_data.stages.encode import EncodeParams, _beside, encode, settings_of
from bask_data.tracker import KeypointTracker, TrackedKeypoints
from tests.datasets import publish_artifact
from tests.threads import no_garbage_collector, threads_named
from tests.tracked import (
    HEIGHT,
    LABELS,
    N_FRAMES,
    WIDTH,
    ColourNetwork,
    K,
    dataset_of,
    frames,
    keypoints,
    poses,
    publish_network,
    publish_references,
    side_poses,
)

GOLDEN = Path(__file__).parent / "golden"
ARRAYS = ("mean", "covariance", "mode", "n_eff", "log_evidence")


@pytest.fixture(autouse=True)
def network(monkeypatch: pytest.MonkeyPatch) -> ColourNetwork:
    network = ColourNetwork()
    monkeypatch.setattr(DescriptorNet, "network", lambda self: network)
    return network


def tracked(dataset: Dataset, **options: object) -> KeypointTrack:
    [task] = plan(dataset, encode, options=options)
    outcome = make(task)
    assert outcome.status == "made", outcome.why
    return KeypointTrack(dataset.path(KeypointTrack, "reach", "main"))


def why_not(dataset: Dataset, **options: object) -> str:
    [task] = plan(dataset, encode, options=options)
    outcome = make(task)
    assert outcome.status in ("failed", "blocked")
    return outcome.why


# Keypoints ------------------------------------------------------------------------------------------------------------


def test_keypoints_are_followed_around_away_from_and_back_to_the_table(tmp_path: Path) -> None:
    track = tracked(dataset_of(tmp_path / "d", {"wrist": poses()}))
    error = np.linalg.norm(track.mean - keypoints()[1], axis=-1)
    assert track.names == ["k0", "k1", "k2"]
    assert np.median(error[2:6]) < 0.01
    assert error[6:9].max() < 0.03
    assert np.median(error[9:]) < 0.01
    assert track.observed("wrist")[2:6].mean() > 0.8
    assert not track.observed("wrist")[6:9].any()
    assert track.observed("wrist")[10:].mean() > 0.8


def test_pixels_are_those_of_the_mean_in_the_cameras_image(tmp_path: Path) -> None:
    track = tracked(dataset_of(tmp_path / "d", {"wrist": poses()}))
    world_from_camera = poses()[3]
    uv, _ = project((track.mean[3] - world_from_camera[:3, 3]) @ world_from_camera[:3, :3], K)
    np.testing.assert_allclose(track.pixel("wrist")[3], uv, atol=1e-3)


@pytest.mark.parametrize("filter", ["expectation", "discrete", "particle"])
def test_every_filter_gives_what_it_gave(tmp_path: Path, filter: str) -> None:
    track = tracked(dataset_of(tmp_path / "d", {"wrist": poses()}), filter=filter, n_particles=500)
    assert track.metadata.filter == filter
    golden = np.load(GOLDEN / "encode_v8.npz")
    for name in ARRAYS:
        np.testing.assert_allclose(
            getattr(track, name), golden[f"{filter}.{name}"], rtol=1e-3, atol=1e-5, err_msg=f"{filter} {name}"
        )
    np.testing.assert_allclose(track.pixel("wrist"), golden[f"{filter}.pixel"], rtol=1e-3, atol=1e-2)
    np.testing.assert_array_equal(track.observed("wrist"), golden[f"{filter}.observed"])


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()})
    digests = []
    for seed in (1, 1, 2):
        [task] = plan(dataset, encode, options={"seed": seed, "n_particles": 200})
        digests.append(make(task, force=True).digest)
    # The digest covers the parameters too, so bytes are compared where the seed differs.
    assert digests[0] == digests[1]
    first = tracked(dataset, seed=1, n_particles=200).mean
    assert not np.array_equal(first, tracked(dataset, seed=3, n_particles=200).mean)


def test_all_cameras_are_used_or_those_asked_for(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "d", {"side": side_poses(), "wrist": poses()})
    track = tracked(dataset)
    assert track.observed("side")[6:9].mean() > 0.5
    assert np.median(np.linalg.norm(track.mean - keypoints()[1], axis=-1)[6:9]) < 0.01
    assert tracked(dataset, cameras=("wrist",)).camera_names == ["wrist"]
    assert "cameras: expected some of side, wrist, got front" in why_not(dataset, cameras=("front",))


def test_a_gripper_far_from_the_keypoints_moves_none_of_them(tmp_path: Path) -> None:
    grippers = np.tile(np.eye(4), (N_FRAMES, 1, 1))
    grippers[:, :3, 3] = np.array([5.0, 5.0, 5.0]) + 0.02 * np.arange(N_FRAMES)[:, None]
    track = tracked(dataset_of(tmp_path / "d", {"wrist": poses()}, Robot(world_from_gripper=grippers)))
    assert np.linalg.norm(track.mean - keypoints()[1], axis=-1)[6:9].max() < 0.03


def test_frames_that_are_dropped_cost_the_particle_filter_little(tmp_path: Path, network: ColourNetwork) -> None:
    dataset = dataset_of(tmp_path / "d", {"side": side_poses(), "wrist": poses()})
    track = tracked(dataset, dropout=0.5)
    assert 6 <= network.n_images <= 18
    blind = np.isnan(track.pixel("side")[:, 0, 0]) & np.isnan(track.pixel("wrist")[:, 0, 0])
    assert blind.any()
    assert np.linalg.norm(track.mean - keypoints()[1], axis=-1)[3:].max() < 0.03


# Settings and keys ----------------------------------------------------------------------------------------------------


def test_settings_have_names_and_options_go_before_them() -> None:
    assert settings_of(EncodeParams()) == ParticleSettings()
    code = settings_of(EncodeParams(settings="code", walk=0.5, grid=(3, 4)))
    assert isinstance(code, ParticleSettings)
    assert (code.n_particles, code.walk) == (250, 0.5)
    discrete = settings_of(EncodeParams(filter="discrete", grid=(3, 4), walk_px=2.0, n_particles=10))
    assert discrete == DiscreteSettings(grid=(3, 4), walk_px=2.0)
    for grid in ((3,), (3, 0), (1, 2, 3), (5000, 5)):
        with pytest.raises(ValueError, match="rows and columns, 1 to 4096 of each"):
            EncodeParams(grid=grid)


def test_what_a_track_depends_on_is_never_served_stale(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()})
    tracked(dataset)

    def state(**options: object) -> tuple[str, str]:
        [task] = plan(dataset, encode, options=options)
        found = state_of(task)
        return found.status, found.why

    assert state() == ("up to date", "")
    others = {
        "filter": "discrete",
        "settings": "code",
        "cameras": ("wrist",),
        "alpha": 5.0,
        "tau": 0.1,
        "tau_match": 0.2,
    }
    others |= {"n_particles": 100, "walk": 0.1, "walk_px": 2.0, "gripper_probability": 0.1, "gripper_reach": 1.0}
    others |= {"dropout": 0.1, "seed": 5, "grid": (4, 4), "every": 2, "scale": 0.5, "calibrated": False}
    assert {*others, "source"} == {*EncodeParams.model_fields}
    for name, value in others.items():
        assert state(**{name: value})[1].startswith(f"changed: {name} "), name
    publish_references(dataset, shift=1.0)
    assert state() == ("stale", "changed: reference/main")
    tracked(dataset)
    publish_network(dataset, b"other weights")
    assert state() == ("stale", "changed: descriptor/main")


def test_a_network_or_keypoints_of_another_name_are_missing_and_those_that_exist_are_named(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()})

    def why(**options: object) -> str:
        [task] = plan(dataset, encode, **options)
        return state_of(task).why

    assert why(variant="other") == "descriptor/other is missing; there is --descriptor main"
    assert why(variant_inputs={"reference": "nope"}) == "reference/nope is missing; there is --reference main"
    shutil.rmtree(dataset.path(ReferenceKeypoints))
    assert why() == "reference/main is missing"


def test_a_robot_with_another_number_of_frames_is_refused(tmp_path: Path) -> None:
    grippers = np.tile(np.eye(4), (N_FRAMES - 2, 1, 1))
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()}, Robot(world_from_gripper=grippers))
    assert "robot/world_from_gripper: expected one transform for each of the 12 frames, got 10" in why_not(dataset)


def test_cameras_with_different_numbers_of_frames_are_refused(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "d", {"side": poses()[:5], "wrist": poses()})
    assert "camera wrist: expected as many frames as camera side (5), got 12" in why_not(dataset)


# Any length -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("filter", ["expectation", "discrete", "particle"])
@pytest.mark.parametrize("where", ["describing", "saving"])
def test_an_interrupted_track_goes_on_with_the_same_bytes(
    tmp_path: Path, network: ColourNetwork, monkeypatch: pytest.MonkeyPatch, filter: str, where: str
) -> None:
    monkeypatch.setattr(arrays, "CHUNK_ROWS", 4)
    grippers = np.tile(np.eye(4), (N_FRAMES, 1, 1))
    grippers[:, 0, 3] = 0.02 * np.arange(N_FRAMES)
    robot = Robot(world_from_gripper=grippers)
    whole, cut = (dataset_of(tmp_path / name, {"wrist": poses()}, robot) for name in ("whole", "cut"))
    options = {"filter": filter, "n_particles": 100}
    tracked(whole, **options)
    [task] = plan(cut, encode, options=options)
    with monkeypatch.context() as broken:
        _break_after_eight_frames(broken, network, where)
        with pytest.raises(KeyboardInterrupt):
            make(task)
    (scratch,) = (tmp_path / "cut" / ".scratch").glob("resume~keypoints~*~reach~*[0-9a-f]")
    # What a kill leaves of files that were being written.
    (scratch / "state.safetensors.part").write_bytes(b"half")
    (scratch / "mean" / "zarr.1234.partial").write_bytes(b"half")
    network.n_images = 0
    tracked(cut, **options)
    assert network.n_images == (4 if where == "describing" else 8)
    made = [read_manifest(one.path(KeypointTrack, "reach")).files for one in (whole, cut)]
    assert made[0] == made[1]
    assert not any("state" in name or "part" in name for name in made[1])


def test_a_state_that_a_disk_has_spoilt_costs_no_more_than_time(
    tmp_path: Path, network: ColourNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrays, "CHUNK_ROWS", 4)
    whole, cut = (dataset_of(tmp_path / name, {"wrist": poses()}) for name in ("whole", "cut"))
    tracked(whole, n_particles=100)
    [task] = plan(cut, encode, options={"n_particles": 100})
    with monkeypatch.context() as broken:
        _break_after_eight_frames(broken, network, "describing")
        with pytest.raises(KeyboardInterrupt):
            make(task)
    (state,) = (tmp_path / "cut" / ".scratch").glob("resume~keypoints~*/state.safetensors")
    state.write_bytes(b"junk")
    tracked(cut, n_particles=100)
    made = [read_manifest(one.path(KeypointTrack, "reach")).files for one in (whole, cut)]
    assert made[0] == made[1]


def _break_after_eight_frames(broken: pytest.MonkeyPatch, network: ColourNetwork, where: str) -> None:
    """Two chunks are on disk, and the state of the filter then or before it."""
    if where == "describing":
        describe, already = network.cells, network.n_images

        def cells(images: np.ndarray) -> np.ndarray:
            if network.n_images - already == 10:
                raise KeyboardInterrupt
            return describe(images)

        broken.setattr(network, "cells", cells)
        return
    save = KeypointTracker.save

    def half_saved(self: KeypointTracker, file: Path) -> None:
        if self.n_steps == 8:
            raise KeyboardInterrupt
        save(self, file)

    broken.setattr(KeypointTracker, "save", half_saved)


def test_no_frame_is_taken_after_one_that_failed() -> None:
    taken, is_waiting = [], threading.Event()

    def frames() -> Iterator[int]:
        yield from (0, 1)
        is_waiting.set()
        time.sleep(0.2)  # Long enough for the thread to take the second.
        yield 2

    def fail(i_frame: int) -> None:
        taken.append(i_frame)
        is_waiting.wait(10)
        raise ValueError(f"frame {i_frame}")

    with pytest.raises(ValueError, match="frame 0"):
        list(_beside(fail, frames()))
    assert taken == [0]


@pytest.mark.parametrize("fails_at", [0, 3])
def test_what_fails_before_there_is_a_state_leaves_nothing_behind(
    tmp_path: Path, network: ColourNetwork, monkeypatch: pytest.MonkeyPatch, fails_at: int
) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()})
    maps, n_before = network.maps, []

    def broken(images: np.ndarray, references: np.ndarray) -> np.ndarray:
        n_before.append(1)
        if len(n_before) > fails_at:
            raise ValueError("broken")
        return maps(images, references)

    monkeypatch.setattr(network, "maps", broken)
    with no_garbage_collector():
        assert "broken" in why_not(dataset)
        assert not threads_named("encode")
    assert "cameras: expected some of wrist, got front" in why_not(dataset, cameras=("front",))
    assert not [entry for entry in (tmp_path / "d" / ".scratch").iterdir() if entry.is_dir()]


@pytest.mark.parametrize("source", ["network", "truth"])
def test_what_another_attempt_left_without_a_state_is_not_gone_on_with(tmp_path: Path, source: str) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()}, has_truth=True)
    publish_truth(dataset)
    out = tmp_path / "out"
    (out / "mean" / "c" / "0").mkdir(parents=True)
    (out / "mean" / "zarr.json").write_text("{}")
    (out / "mean" / "c" / "0" / "old").write_bytes(b"old")
    (out / "other").write_bytes(b"old")
    inputs = (
        Demonstration(dataset.path(Demonstration, "reach")),
        DescriptorNet(dataset.path(DescriptorNet)),
        ReferenceKeypoints(dataset.path(ReferenceKeypoints)),
    )
    truths = [Truth(dataset.path(Truth, "reach"))]
    encode(*inputs, truths=truths, params=EncodeParams(n_particles=100, source=source), out=out)
    assert not (out / "other").exists() and not (out / "mean" / "c" / "0" / "old").exists()
    assert np.isfinite(KeypointTrack(out).mean).all()


def test_memory_does_not_grow_with_the_length(
    tmp_path: Path, network: ColourNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrays, "CHUNK_ROWS", 8)
    dataset = dataset_of(tmp_path / "d", {"wrist": np.tile(poses(), (6, 1, 1))})
    images, rows, most = [], [], {"images": 0, "rows": 0}
    distances, update = network.maps, KeypointTracker.update

    def watched_maps(given: np.ndarray, references: np.ndarray) -> np.ndarray:
        maps = distances(given, references)
        images.append(weakref.ref(maps))
        return maps

    def watched_update(
        self: KeypointTracker, look: FrameObservations, world_from_gripper: np.ndarray | None = None
    ) -> TrackedKeypoints:
        found = update(self, look, world_from_gripper)
        rows.append(weakref.ref(found.covariance))
        for name, kept in (("images", images), ("rows", rows)):
            most[name] = max(most[name], sum(one() is not None for one in kept))
        return found

    monkeypatch.setattr(network, "maps", watched_maps)
    monkeypatch.setattr(KeypointTracker, "update", watched_update)
    track = tracked(dataset, filter="expectation")
    assert len(track.mean) == len(rows) == len(images) == 6 * N_FRAMES
    # Those that are used, and some ahead of them.
    assert most["images"] <= 8 and most["rows"] <= 4


def test_it_tells_how_many_frames_a_second_it_did(tmp_path: Path) -> None:
    dataset, heard, told = dataset_of(tmp_path / "d", {"wrist": poses()}), [], []
    progress.listen(lambda label, done, total: told.append((label, done, total)), heard.append)
    try:
        tracked(dataset, filter="expectation")
    finally:
        progress.listen(None)
    assert ("tracking keypoints", N_FRAMES, N_FRAMES) in told
    assert heard[0] == "alpha 20"
    assert len(heard) == 2 and heard[1].startswith("12 frames of 1 camera in ") and heard[1].endswith(" a second")


def test_alpha_and_tau_are_those_measured_for_the_references_unless_told_otherwise(tmp_path: Path) -> None:
    dataset, heard = dataset_of(tmp_path / "d", {"wrist": poses()}), []
    before = tracked(dataset).log_evidence
    reference = ReferenceKeypoints(dataset.path(ReferenceKeypoints))
    picks, descriptors, k = reference.picks, reference.descriptors, len(reference.picks)
    measured = Calibration(np.linspace(5.0, 6.0, k), np.full(k, 0.5), np.full(k, 32.0))
    publish_artifact(
        dataset,
        ReferenceKeypoints,
        "",
        lambda out: ReferenceKeypoints.write(out, descriptors=descriptors, picks=picks, calibration=measured),
    )
    progress.listen(lambda *_: None, heard.append)
    try:
        after = tracked(dataset).log_evidence
        without = tracked(dataset, calibrated=False).log_evidence
    finally:
        progress.listen(None)
    assert not np.allclose(after, before)
    np.testing.assert_array_equal(without, before)
    assert heard[0].startswith("alpha 5 to 6 (measured), tau 0.5 (measured) times")
    assert heard[2].startswith("alpha 2, tau 2 times")
    assert settings_of(EncodeParams(settings="paper"), measured) == settings_of(EncodeParams(settings="paper"))


def test_a_temperature_beyond_single_precision_is_refused() -> None:
    with pytest.raises(ValueError, match="less than or equal to 1000000"):
        EncodeParams(alpha=1e308)


# Truth ----------------------------------------------------------------------------------------------------------------


def shifts() -> np.ndarray:
    """How far the first object has gone in each frame, as truth says (t, 3): nothing else knows that it moved."""
    return 0.01 * np.arange(N_FRAMES)[:, None] * np.array([1.0, 0.0, 0.0])


def publish_truth(dataset: Dataset, labels: tuple[int, ...] = LABELS) -> None:
    _, depth, instance = frames(poses())
    world_from_objects = np.tile(np.eye(4), (N_FRAMES, len(labels), 1, 1))
    if labels:
        world_from_objects[:, 0, :3, 3] = shifts()

    def fill(out: Path) -> None:
        names = {label: f"object {label}" for label in LABELS}
        metadata = TruthMetadata(label_names=names, object_labels=list(labels))
        with Truth.writer(out, metadata, world_from_objects) as writer:
            camera = writer.camera("wrist", N_FRAMES, (HEIGHT, WIDTH), 1e-4)
            for i, pose in enumerate(poses()):
                camera.append(instance[i], np.round(depth[i] * 1e4).astype(np.uint16), pose)

    publish_artifact(dataset, Truth, "reach", fill)


def test_true_keypoints_go_where_their_objects_go(tmp_path: Path, network: ColourNetwork) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()}, has_truth=True)
    publish_truth(dataset)
    track = tracked(dataset, source="truth")
    expected = np.tile(keypoints()[1], (N_FRAMES, 1, 1))
    expected[:, 0] += shifts()
    np.testing.assert_allclose(track.mean, expected, atol=2e-4)
    np.testing.assert_array_equal(track.mode, track.mean)
    assert track.metadata.filter == "truth" and network.n_images == 0
    assert not track.covariance.any() and not track.log_evidence.any() and (track.n_eff == 1).all()
    for i in (0, 3, 11):
        uv, _ = project((expected[i] - poses()[i][:3, 3]) @ poses()[i][:3, :3], K)
        np.testing.assert_allclose(track.pixel("wrist")[i], uv, atol=0.1)
    assert track.observed("wrist")[0].all() and not track.observed("wrist")[6:9].any()


def test_a_true_keypoint_behind_something_is_not_observed(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()}, has_truth=True)
    publish_truth(dataset)
    by_depth = tracked(dataset, source="truth").observed("wrist")[:, 0]
    # The first object's keypoint moves to the right within the table's plane, and by and by into what stands there.
    points = keypoints()[1][0] + shifts()
    _, depth, _ = frames(poses())
    for i, point in enumerate(points):
        uv, z = project((point - poses()[i][:3, 3]) @ poses()[i][:3, :3], K)
        inside = bool(np.isfinite(uv).all() and (uv > -0.5).all() and uv[0] < WIDTH - 0.5 and uv[1] < HEIGHT - 0.5)
        shown = depth[i][round(uv[1]), round(uv[0])] if inside else 0
        assert by_depth[i] == (inside and not 0 < shown < z - 0.02), i


def test_keypoints_without_a_known_place_are_nan_and_some_place_must_be_known(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()}, has_truth=True)
    publish_truth(dataset, LABELS[:2])
    track = tracked(dataset, source="truth")
    assert np.isfinite(track.mean[:, :2]).all() and np.isnan(track.mean[:, 2]).all()
    assert not track.observed("wrist")[:, 2].any() and (track.n_eff[:, 2] == 0).all()
    publish_truth(dataset, ())
    assert "picks: expected a keypoint on an object whose transform is known in reach" in why_not(
        dataset, source="truth"
    )


def test_true_keypoints_need_truth_and_belong_to_it(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()})
    assert why_not(dataset, source="truth") == "the dataset has no truth"
    publish_truth(dataset)
    assert tracked(dataset, source="truth").metadata.filter == "truth"
    dataset = dataset_of(tmp_path / "e", {"wrist": poses()}, has_truth=True)
    assert why_not(dataset, source="truth") == "truth/reach is missing"
    publish_truth(dataset)
    tracked(dataset)
    publish_truth(dataset, LABELS[:2])
    [by_network], [by_truth] = plan(dataset, encode), plan(dataset, encode, options={"source": "truth"})
    assert state_of(by_network).status == "up to date"
    make(by_truth)
    publish_truth(dataset)
    assert state_of(by_truth).why == "changed: truth/reach"


def test_a_demonstration_without_truth_has_no_true_keypoints(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "d", {"wrist": poses()}, has_truth=True)
    publish_truth(dataset)
    inputs = (
        Demonstration(dataset.path(Demonstration, "reach")),
        DescriptorNet(dataset.path(DescriptorNet)),
        ReferenceKeypoints(dataset.path(ReferenceKeypoints)),
    )
    with pytest.raises(Exception, match="reach: truth: expected objects' transforms, got none"):
        encode(*inputs, truths=[], params=EncodeParams(source="truth"), out=tmp_path / "out")
