from __future__ import annotations

import numpy as np
import pytest

from bask_data import progress
from bask_data.core.calibration import LEAST_SIGHTINGS
from bask_data.dataset import Dataset
from bask_data.kinds import Demonstration, Pick, Scan
from bask_data.stages.keypoint_evidence import N_MEASURED_VIEWS, ScanViews, calibration_text, measured, measured_frames
from tests.nn import pairs
from tests.picker.pickable import untrained
from tests.stages.learning import publish_views

N_VIEWS = 12


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Dataset:
    """The same views as a scan and as a demonstration."""
    dataset = Dataset.create(tmp_path_factory.mktemp("evidence") / "d")
    _, world_from_cameras, views = pairs.views(N_VIEWS, 0)
    publish_views(dataset, "a", pairs.K, world_from_cameras, views)
    publish_views(dataset, "few", pairs.K, world_from_cameras[:2], views[:2])
    publish_views(dataset, "lift", pairs.K, world_from_cameras, views, Demonstration)
    return dataset


def picks_in(dataset: Dataset, recording: str) -> tuple[list[Pick], np.ndarray]:
    """Two pixels of the scan's first frame as picks in a recording, and their descriptors."""
    camera, picks = Scan(dataset.path(Scan, "a")).camera("wrist"), []
    uv = np.array([[64.0, 48.0], [50.0, 60.0]], dtype=np.float32)
    for i, (u, v) in enumerate(uv.tolist()):
        depth = camera.depth(0)[round(v), round(u)]
        point = camera.points_world(0, np.array([[u, v]]), np.array([float(depth)]))[0]
        where = {"recording": recording, "camera": "wrist", "frame": 0, "u": u, "v": v}
        picks.append(Pick(name=f"k{i}", point_world=tuple(point.tolist()), **where))
    return picks, untrained().descriptors_at(camera.rgb(0), uv).numpy()


def test_keypoints_of_a_scan_are_calibrated_in_its_other_frames(recorded) -> None:
    picks, descriptors = picks_in(recorded, "a")
    notes: list[str] = []
    progress.listen(lambda *_: None, notes.append)
    try:
        found = measured(picks, descriptors, {"a": Scan(recorded.path(Scan, "a"))}, untrained())
    finally:
        progress.listen(None)
    assert found is not None
    assert found.alpha.shape == found.tau_ratio.shape == found.sharp_alpha.shape == (2,)
    assert notes == [calibration_text(found)]
    assert notes[0].startswith("alpha and tau: measured, alpha ")


def test_a_pick_without_depth_or_elsewhere_is_like_the_average_one(recorded) -> None:
    picks, descriptors = picks_in(recorded, "a")
    others = [picks[1].model_copy(update={"point_world": None}), picks[1].model_copy(update={"recording": "lift"})]
    scans = {"a": Scan(recorded.path(Scan, "a")), "lift": Demonstration(recorded.path(Demonstration, "lift"))}
    found = measured([picks[0], *others], descriptors[[0, 1, 1]], scans, untrained())
    assert found is not None
    assert found.alpha[1] == found.alpha[2]


@pytest.mark.parametrize("recording", ["lift", "few"])
def test_demonstrations_and_short_scans_calibrate_nothing(recorded, recording) -> None:
    picks, descriptors = picks_in(recorded, recording)
    kind = Demonstration if recording == "lift" else Scan
    notes: list[str] = []
    progress.listen(lambda *_: None, notes.append)
    try:
        assert measured(picks, descriptors, {recording: kind(recorded.path(kind, recording))}, untrained()) is None
    finally:
        progress.listen(None)
    assert notes == [calibration_text(None)]
    assert "filters use their defaults" in notes[0]


def test_views_are_read_with_the_distances_of_the_network(recorded) -> None:
    _, descriptors = picks_in(recorded, "a")
    views = ScanViews(Scan(recorded.path(Scan, "a")), descriptors, untrained())
    first, again = list(views), list(views)
    assert len(first) == N_VIEWS >= LEAST_SIGHTINGS
    camera = Scan(recorded.path(Scan, "a")).camera("wrist")
    expected = untrained().maps(untrained().cells(camera.rgb(3)), descriptors)
    np.testing.assert_allclose(first[3].distance, expected, atol=1e-5)
    np.testing.assert_array_equal(first[3].distance, again[3].distance)
    np.testing.assert_array_equal(first[3].depth, camera.depth(3))


class _Camera:
    def __init__(self, n_frames: int) -> None:
        self.n_frames = n_frames


def test_frames_are_spread_over_cameras_and_time() -> None:
    short, long = _Camera(3), _Camera(100)
    frames = measured_frames([short, long], 8)  # type: ignore[list-item]
    assert [i for camera, i in frames if camera is short] == [0, 1, 2]
    assert [i for camera, i in frames if camera is long] == [0, 25, 50, 75]
    assert len(measured_frames([long], N_MEASURED_VIEWS)) == N_MEASURED_VIEWS  # type: ignore[list-item]
