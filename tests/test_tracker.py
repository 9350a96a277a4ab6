from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import bask_data
from bask_data.core.calibration import Calibration
from bask_data.core.filters.calibrated import calibrated_settings
from bask_data.core.filters.particle.settings import ParticleSettings
from bask_data.core.filters.table import FilterSettings, settings_named
from bask_data.errors import BadData
from bask_data.kinds import Demonstration, DescriptorNet, KeypointTrack, Pick, ReferenceKeypoints, Robot
from bask_data.observing import FrameObservations, moment_of
from bask_data.stages.encode import EncodeParams, dropped, encode
from bask_data.tracker import KeypointTracker, TrackedKeypoints
from tests.tracked import N_FRAMES, ColourNetwork, dataset_of, keypoints, poses, side_poses

FILTERS = ("expectation", "discrete", "particle")
SEED, DROPOUT = 7, 0.4


def robot() -> Robot:
    """A gripper that passes by the first keypoint."""
    grippers = np.tile(np.eye(4), (N_FRAMES, 1, 1))
    grippers[:, :3, 3] = keypoints()[1][0] + 0.01 * (np.arange(N_FRAMES)[:, None] - 4)
    return Robot(world_from_gripper=grippers)


@pytest.fixture(scope="module")
def reaching(tmp_path_factory: pytest.TempPathFactory) -> bask_data.dataset.Dataset:
    cameras = {"side": side_poses(), "wrist": poses()}
    return dataset_of(tmp_path_factory.mktemp("tracked") / "d", cameras, robot())


@pytest.fixture
def demonstration(reaching) -> Demonstration:
    return Demonstration(reaching.path(Demonstration, "reach"))


@pytest.fixture
def reference(reaching) -> ReferenceKeypoints:
    return ReferenceKeypoints(reaching.path(ReferenceKeypoints))


def settings_of(filter: str) -> FilterSettings:
    return settings_named(filter, n_particles=200) if filter == "particle" else settings_named(filter)


def stepped(tracker: KeypointTracker, demonstration: Demonstration, i_frame: int, names: list[str]) -> TrackedKeypoints:
    cameras = [demonstration.camera(name) for name in names]
    return tracker.step(
        images={camera.name: camera.rgb(i_frame) for camera in cameras},
        depths={camera.name: camera.depth(i_frame) for camera in cameras},
        intrinsics={camera.name: camera.Ks[i_frame] for camera in cameras},
        world_from_cameras={camera.name: camera.world_from_cameras[i_frame] for camera in cameras},
        world_from_gripper=demonstration.robot.world_from_gripper[i_frame],
    )


def same(one: TrackedKeypoints, other: TrackedKeypoints) -> None:
    for name in ("mean", "covariance", "mode", "n_eff", "log_evidence"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    for name in ("pixel", "observed"):
        mine, its = getattr(one, name), getattr(other, name)
        assert mine.keys() == its.keys()
        for camera in mine:
            np.testing.assert_array_equal(mine[camera], its[camera], err_msg=f"{camera} {name}")


def is_the_track(track: KeypointTrack, i_frame: int, found: TrackedKeypoints) -> None:
    for name in ("mean", "covariance", "mode", "n_eff", "log_evidence"):
        expected = getattr(found, name).astype(np.float32)
        np.testing.assert_array_equal(getattr(track, name)[i_frame], expected, err_msg=f"{i_frame} {name}")
    for camera in track.camera_names:
        np.testing.assert_array_equal(track.pixel(camera)[i_frame], found.pixel[camera].astype(np.float32))
        np.testing.assert_array_equal(track.observed(camera)[i_frame], found.observed[camera])


# As encode ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("filter", FILTERS)
def test_a_tracker_agrees_exactly_with_encode(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    demonstration: Demonstration,
    reference: ReferenceKeypoints,
    filter: str,
    every: int,
) -> None:
    monkeypatch.setattr(DescriptorNet, "network", lambda self: ColourNetwork())
    params = EncodeParams(filter=filter, n_particles=200, seed=SEED, dropout=DROPOUT, every=every)
    encode(demonstration, DescriptorNet(tmp_path), reference, truths=[], params=params, out=tmp_path)
    track = KeypointTrack(tmp_path)
    names = demonstration.camera_names
    tracker = KeypointTracker(ColourNetwork(), reference, settings_of(filter), seed=SEED, cameras=names, every=every)
    missing = dropped(N_FRAMES, len(names), DROPOUT, SEED)
    assert missing[0].any() and missing.all(axis=1).any() and not missing.all()
    for i_frame in range(N_FRAMES):
        shown = [name for name, is_missing in zip(names, missing[i_frame], strict=True) if not is_missing]
        is_the_track(track, i_frame, stepped(tracker, demonstration, i_frame, shown))


def test_a_tracker_with_a_network_agrees_with_encode(tmp_path: Path, demonstration: Demonstration) -> None:
    import torch

    from bask_data.nn.network import DescriptorNetwork, NetworkSettings

    torch.manual_seed(0)
    network = DescriptorNetwork(NetworkSettings("resnet18", descriptor_dim=4, height=32)).eval()
    for name in ("descriptor", "reference", "out"):
        (tmp_path / name).mkdir()
    network.save(tmp_path / "descriptor")
    descriptor = DescriptorNet(tmp_path / "descriptor")
    picked = network.descriptors_at(demonstration.camera("wrist").rgb(0), keypoints()[0].astype(np.float32)).numpy()
    picks = [Pick(name=f"k{i}", recording="reach", camera="wrist", frame=0, u=0, v=0) for i in range(3)]
    ReferenceKeypoints.write(tmp_path / "reference", descriptors=picked, picks=picks)
    reference = ReferenceKeypoints(tmp_path / "reference")
    params = EncodeParams(n_particles=100)
    encode(demonstration, descriptor, reference, truths=[], params=params, out=tmp_path / "out")
    track = KeypointTrack(tmp_path / "out")
    tracker = bask_data.KeypointTracker(
        tmp_path / "descriptor", str(tmp_path / "reference"), ParticleSettings(n_particles=100), device="cpu"
    )
    for i_frame in range(3):
        is_the_track(track, i_frame, stepped(tracker, demonstration, i_frame, ["side", "wrist"]))


# By itself ------------------------------------------------------------------------------------------------------------


def test_a_tracker_without_settings_takes_alpha_and_tau_as_measured(
    tmp_path: Path, demonstration: Demonstration, reference: ReferenceKeypoints
) -> None:
    k = len(reference.picks)
    measured = Calibration(np.linspace(5.0, 6.0, k), np.full(k, 0.5), np.full(k, 32.0))
    ReferenceKeypoints.write(
        tmp_path / "r", descriptors=reference.descriptors, picks=reference.picks, calibration=measured
    )
    own, given, plain = (
        KeypointTracker(ColourNetwork(), ReferenceKeypoints(tmp_path / "r"), settings)
        for settings in (None, calibrated_settings("particle", measured), settings_named("particle"))
    )
    found = stepped(own, demonstration, 0, ["side"])
    same(found, stepped(given, demonstration, 0, ["side"]))
    assert not np.allclose(found.log_evidence, stepped(plain, demonstration, 0, ["side"]).log_evidence)


def test_the_package_exports_the_tracker_and_loads_it_lazily() -> None:
    assert bask_data.KeypointTracker is KeypointTracker
    with pytest.raises(AttributeError, match="module 'bask_data' has no attribute 'Tracker'"):
        _ = bask_data.Tracker
    code = "import bask_data, sys; sys.exit('bask_data.tracker' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize("filter", FILTERS)
def test_a_camera_may_appear_later(demonstration: Demonstration, reference: ReferenceKeypoints, filter: str) -> None:
    tracker = KeypointTracker(ColourNetwork(), reference, settings_named(filter))
    alone = stepped(tracker, demonstration, 0, ["wrist"])
    assert set(alone.pixel) == {"wrist"} and set(tracker.observations) == {"wrist"}
    for i_frame in (1, 2, 3):
        both = stepped(tracker, demonstration, i_frame, ["side", "wrist"])
    assert tracker.cameras == ["wrist", "side"] and tracker.n_steps == 4
    assert both.observed["side"].all()
    assert np.linalg.norm(both.mean - keypoints()[1], axis=1).max() < 0.02
    none = stepped(tracker, demonstration, 4, [])
    assert np.isnan(none.pixel["side"]).all() and not none.observed["wrist"].any()
    if filter != "expectation":
        assert np.linalg.norm(none.mean - keypoints()[1], axis=1).max() < 0.03


@pytest.mark.parametrize("filter", FILTERS)
def test_arrays_may_be_reused_by_the_caller(
    demonstration: Demonstration, reference: ReferenceKeypoints, filter: str
) -> None:
    tracker, reusing = (KeypointTracker(ColourNetwork(), reference, settings_of(filter), seed=SEED) for _ in range(2))
    camera = demonstration.camera("wrist")
    depth, K, pose, gripper = camera.depth(0).copy(), camera.Ks[0].copy(), np.eye(4), np.eye(4)
    for i_frame in range(4):
        depth[:], pose[:] = camera.depth(i_frame), camera.world_from_cameras[i_frame]
        gripper[:] = demonstration.robot.world_from_gripper[i_frame]
        again = reusing.step({"wrist": camera.rgb(i_frame)}, {"wrist": depth}, {"wrist": K}, {"wrist": pose}, gripper)
        same(again, stepped(tracker, demonstration, i_frame, ["wrist"]))


@pytest.mark.parametrize("hole", [np.nan, np.inf, -np.inf])
def test_depth_that_is_not_finite_is_no_measurement(
    demonstration: Demonstration, reference: ReferenceKeypoints, hole: float
) -> None:
    camera = demonstration.camera("wrist")
    found = []
    for value in (0.0, hole):
        tracker = KeypointTracker(ColourNetwork(), reference, settings_of("particle"), seed=SEED)
        depth = camera.depth(0).copy()
        depth[:20] = value
        given = (
            {"wrist": camera.rgb(0)},
            {"wrist": depth},
            {"wrist": camera.Ks[0]},
            {"wrist": camera.world_from_cameras[0]},
        )
        found.append(tracker.step(*given))
    same(*found)


@pytest.mark.parametrize(
    ("gripper", "got"), [(np.full((4, 4), np.nan), "a value that is not finite"), (np.zeros(3), r"\(3,\)")]
)
def test_an_invalid_gripper_pose_is_refused_and_changes_nothing(
    demonstration: Demonstration, reference: ReferenceKeypoints, gripper: np.ndarray, got: str
) -> None:
    tracker, other = (KeypointTracker(ColourNetwork(), reference, seed=SEED) for _ in range(2))
    for one in (tracker, other):
        stepped(one, demonstration, 0, ["wrist"])
    with pytest.raises(ValueError, match=f"world_from_gripper: expected a rigid transform .4, 4., got {got}"):
        tracker.update(FrameObservations({}, {}), gripper)
    same(stepped(tracker, demonstration, 1, ["wrist"]), stepped(other, demonstration, 1, ["wrist"]))


def test_images_whose_size_changes_are_refused(demonstration: Demonstration, reference: ReferenceKeypoints) -> None:
    tracker = KeypointTracker(ColourNetwork(), reference)
    stepped(tracker, demonstration, 0, ["wrist"])
    camera = demonstration.camera("wrist")
    image, depth = np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), np.float32)
    with pytest.raises(ValueError, match=r"camera wrist: image: expected \(\d+, \d+\) as before, got \(8, 8\)"):
        tracker.step({"wrist": image}, {"wrist": depth}, {"wrist": camera.Ks[0]}, {"wrist": np.eye(4)})


def test_before_any_frame_nothing_is_known(demonstration: Demonstration, reference: ReferenceKeypoints) -> None:
    tracker = KeypointTracker(ColourNetwork(), reference)
    found = stepped(tracker, demonstration, 0, [])
    assert found.names == ("k0", "k1", "k2")
    assert found.mean.shape == (3, 3) and np.isnan(found.mean).all()


def test_a_reset_tracker_repeats_its_results(demonstration: Demonstration, reference: ReferenceKeypoints) -> None:
    tracker = KeypointTracker(ColourNetwork(), reference, ParticleSettings(n_particles=100))
    first = [stepped(tracker, demonstration, i, ["wrist", "side"][: i + 1]) for i in (0, 1)]
    tracker.reset()
    assert tracker.belief is None and tracker.n_steps == 0 and tracker.cameras == []
    for i, one in enumerate(first):
        same(one, stepped(tracker, demonstration, i, ["wrist", "side"][: i + 1]))


def test_a_gripper_pose_missing_in_a_frame_gives_the_whole_motion_at_the_next_one(
    demonstration: Demonstration, reference: ReferenceKeypoints
) -> None:
    tracker = KeypointTracker(ColourNetwork(), reference)
    nothing = ({}, {}, {}, {})
    far = np.eye(4)
    far[:3, 3] = [0.1, 0.0, 0.0]
    assert tracker._moved(None) is None and tracker._moved(np.eye(4)) is None
    tracker.step(*nothing)
    moved = tracker._moved(far)
    np.testing.assert_array_equal(moved.world_from_gripper_before, np.eye(4))
    np.testing.assert_array_equal(moved.world_from_gripper, far)


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("n_before", [0, 2])
def test_a_tracker_continues_from_its_file(
    tmp_path: Path, demonstration: Demonstration, reference: ReferenceKeypoints, filter: str, n_before: int
) -> None:
    # One camera at first: a belief may lack cameras without a frame so far.
    begun = KeypointTracker(ColourNetwork(), reference, settings_of(filter), seed=SEED, cameras=["side", "wrist"])
    for i_frame in range(n_before):
        stepped(begun, demonstration, i_frame, ["wrist"])
    begun.save(tmp_path / "state")
    again = KeypointTracker(ColourNetwork(), reference, settings_of(filter), cameras=["side", "wrist"])
    again.load(tmp_path / "state")
    assert again.n_steps == n_before and [one.name for one in tmp_path.iterdir()] == ["state"]
    for i_frame in range(n_before, n_before + 3):
        both = [stepped(one, demonstration, i_frame, ["side", "wrist"]) for one in (begun, again)]
        same(*both)


def test_a_state_that_cannot_be_written_leaves_nothing(tmp_path: Path, reference: ReferenceKeypoints) -> None:
    (tmp_path / "state").mkdir()
    with pytest.raises(OSError, match="state"):
        KeypointTracker(ColourNetwork(), reference).save(tmp_path / "state")
    assert [one.name for one in tmp_path.iterdir()] == ["state"]


@pytest.mark.parametrize("content", [b"", b"12345678 nothing"])
def test_a_file_that_is_not_a_state_is_refused(tmp_path: Path, reference: ReferenceKeypoints, content: bytes) -> None:
    (tmp_path / "state").write_bytes(content)
    with pytest.raises(BadData, match="state: expected a tracker's state, got "):
        KeypointTracker(ColourNetwork(), reference).load(tmp_path / "state")


def test_a_state_of_other_keypoints_is_refused(
    tmp_path: Path, demonstration: Demonstration, reference: ReferenceKeypoints
) -> None:
    tracker = KeypointTracker(ColourNetwork(), reference)
    stepped(tracker, demonstration, 0, ["wrist"])
    tracker.names = tracker.names[1:]
    tracker.save(tmp_path / "state")
    with pytest.raises(BadData, match="expected a tracker's state, got ValueError"):
        tracker.load(tmp_path / "state")


def test_a_state_of_another_filter_is_refused(
    tmp_path: Path, demonstration: Demonstration, reference: ReferenceKeypoints
) -> None:
    discrete = KeypointTracker(ColourNetwork(), reference, settings_named("discrete"))
    stepped(discrete, demonstration, 0, ["wrist"])
    discrete.save(tmp_path / "state")
    with pytest.raises(BadData, match="expected a tracker's state, got KeyError"):
        KeypointTracker(ColourNetwork(), reference, settings_named("particle")).load(tmp_path / "state")


# Refused inputs -------------------------------------------------------------------------------------------------------


def test_references_of_another_network_are_refused(tmp_path: Path) -> None:
    picks = [Pick(name="a", recording="reach", camera="wrist", frame=0, u=0, v=0)]
    ReferenceKeypoints.write(tmp_path / "r", descriptors=np.zeros((1, 4), np.float32), picks=picks)
    with pytest.raises(BadData, match="descriptors: expected 3 values each, as from the network, got 4"):
        KeypointTracker(ColourNetwork(), tmp_path / "r")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"images": np.zeros((8, 8, 3))}, r"camera a: image: expected \(h, w, 3\) uint8, got \(8, 8, 3\) float64"),
        ({"images": np.zeros((8, 8), np.uint8)}, r"image: expected \(h, w, 3\) uint8, got \(8, 8\) uint8"),
        ({"depths": None}, r"camera a: depth: expected \(8, 8\) in metres, as for the image, got none"),
        ({"depths": np.ones((4, 8))}, r"depth: expected \(8, 8\) in metres, as for the image, got \(4, 8\) float64"),
        ({"depths": np.ones((8, 8), np.uint16)}, r"in metres, as for the image, got \(8, 8\) uint16"),
        ({"intrinsics": None}, r"camera a: intrinsics: expected \(3, 3\), got none"),
        ({"intrinsics": np.eye(4)}, r"intrinsics: expected \(3, 3\), got \(4, 4\)"),
        ({"intrinsics": np.zeros((3, 3))}, r"intrinsics: expected finite numbers and positive focal lengths, got"),
        ({"intrinsics": np.full((3, 3), np.nan)}, r"intrinsics: expected finite numbers and positive focal"),
        ({"images": np.zeros((0, 8, 3), np.uint8)}, r"image: expected \(h, w, 3\) uint8, got \(0, 8, 3\)"),
        ({"world_from_cameras": None}, r"world_from_camera: expected a rigid transform \(4, 4\), got none"),
        ({"world_from_cameras": np.eye(3)}, r"expected a rigid transform \(4, 4\), got \(3, 3\)"),
        ({"world_from_cameras": 2 * np.eye(4)}, r"expected a rigid transform \(4, 4\), got last row"),
    ],
)
def test_inputs_that_would_corrupt_the_belief_are_refused(
    reference: ReferenceKeypoints, changed: dict[str, object], message: str
) -> None:
    given = {
        "images": np.zeros((8, 8, 3), np.uint8),
        "depths": np.ones((8, 8), np.float32),
        "intrinsics": np.eye(3),
        "world_from_cameras": np.eye(4),
    }
    given |= changed
    arguments = {name: {} if value is None else {"a": value} for name, value in given.items()}
    with pytest.raises(ValueError, match=message):
        KeypointTracker(ColourNetwork(), reference).step(**arguments)


def test_a_single_name_for_the_cameras_is_refused(reference: ReferenceKeypoints) -> None:
    with pytest.raises(ValueError, match="cameras: expected a list of names, got 'wrist'"):
        KeypointTracker(ColourNetwork(), reference, cameras="wrist")


@pytest.mark.parametrize("argument", ["images", "depths", "intrinsics", "world_from_cameras"])
def test_an_argument_that_is_not_by_camera_is_refused(
    demonstration: Demonstration, reference: ReferenceKeypoints, argument: str
) -> None:
    tracker = KeypointTracker(ColourNetwork(), reference)
    moment = moment_of([demonstration.camera("wrist")], 0)._asdict()
    for value, got in ((moment[argument]["wrist"], r"an array \(.*\)"), ([moment[argument]["wrist"]], "a list")):
        with pytest.raises(ValueError, match=f"^{argument}: expected a dict by camera name, got {got}$"):
            tracker.step(**(moment | {argument: value}))
    assert tracker.n_steps == 0


def test_a_path_without_the_artifact_is_refused_and_those_there_are_named(
    reaching: bask_data.dataset.Dataset, tmp_path: Path
) -> None:
    root = reaching.root
    descriptor, reference = reaching.path(DescriptorNet), reaching.path(ReferenceKeypoints)
    for wrong in (root / "reference" / "mian", root / "reference", root):
        with pytest.raises(BadData, match="expected an artifact of kind 'reference', got ") as caught:
            KeypointTracker(ColourNetwork(), wrong)
        assert caught.value.fix == f"pass one of {reference}."
    with pytest.raises(
        BadData, match="expected an artifact of kind 'descriptor', got one of kind 'reference'"
    ) as caught:
        KeypointTracker(reference, descriptor)
    assert caught.value.fix == f"pass one of {descriptor}."
    with pytest.raises(BadData, match="got no such folder.  fix: pass ROOT/descriptor/VARIANT"):
        KeypointTracker(tmp_path / "nowhere", reference)


def test_a_tracker_shows_its_keypoints_filter_cameras_and_steps(
    demonstration: Demonstration, reference: ReferenceKeypoints
) -> None:
    tracker = KeypointTracker(ColourNetwork(), reference, settings_of("expectation"))
    kind = type(settings_of("expectation")).__name__
    assert repr(tracker) == f"KeypointTracker(3 keypoints, {kind}, cameras: none yet, steps: 0)"
    stepped(tracker, demonstration, 0, ["side", "wrist"])
    assert repr(tracker) == f"KeypointTracker(3 keypoints, {kind}, cameras: side, wrist, steps: 1)"
