from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bask_data.dataset import Dataset
from bask_data.engine import make, plan
from bask_data.kinds import DescriptorNet, KeypointTrack
from bask_data.stages.encode import encode
from bask_data.view import item
from bask_data.view.beliefs import N_PARTICLES
from bask_data.view.choice import Choice
from bask_data.view.saving import save_recording
from tests.tracked import N_FRAMES, ColourNetwork, dataset_of, poses, publish_references
from tests.view.recordings import Recording

pytest.importorskip("rerun")


@pytest.fixture(autouse=True)
def network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DescriptorNet, "network", lambda self: ColourNetwork())
    # Heat maps have their own tests.
    monkeypatch.setattr(item, "draw_heat", lambda *_: None)


def tracked_dataset(root: Path, **options) -> Dataset:
    """The demonstration `reach`, tracked."""
    dataset = dataset_of(root, {"wrist": poses()})
    [task] = plan(dataset, encode, options={"n_particles": 300, **options})
    make(task)
    return dataset


def test_particles_of_each_frame_lie_around_the_tracks_mean_and_where_the_images_show_them(tmp_path: Path) -> None:
    dataset = tracked_dataset(tmp_path / "d")
    shown = save_recording(dataset, tmp_path / "a.rrd", Choice(["reach"], beliefs=True))
    assert "beliefs" in shown["reach"].layers
    saved, track = Recording(tmp_path / "a.rrd"), KeypointTrack(dataset.path(KeypointTrack, "reach"))
    assert sorted(saved.all("/reach/world/particles", "Points3D:positions")) == list(range(N_FRAMES))
    for i in (3, N_FRAMES - 1):
        particles = saved.array("/reach/world/particles", "Points3D:positions", i).reshape(3, N_PARTICLES, 3)
        away = np.linalg.norm(particles.mean(axis=1) - track.mean[i], axis=1)
        assert (away < 0.01).all()
    assert len(saved.all("/reach/world/cameras/wrist/particles", "Points2D:positions")[0]) > N_PARTICLES
    # The camera looks elsewhere; a few particles are always drawn from the observation.
    assert len(saved.all("/reach/world/cameras/wrist/particles", "Points2D:positions")[7]) < 0.02 * 3 * N_PARTICLES


@pytest.mark.parametrize("filter", ["discrete", "expectation"])
def test_filters_without_particles_show_a_map_for_each_keypoint(tmp_path: Path, filter: str) -> None:
    dataset = tracked_dataset(tmp_path / "d", filter=filter)
    save_recording(dataset, tmp_path / "a.rrd", Choice(["reach"], every=5, beliefs=True))
    saved = Recording(tmp_path / "a.rrd")
    maps = sorted(path for path in saved.entities if "/belief/" in path)
    assert maps == [f"/reach/belief/wrist/{i + 1}\\ k{i}" for i in range(3)]
    assert sorted(saved.all(maps[0], "EncodedImage:blob")) == [0, 5, 10]


def test_a_track_that_differs_when_tracked_again_is_reported(tmp_path: Path) -> None:
    dataset = tracked_dataset(tmp_path / "d")
    publish_references(dataset, shift=30.0)
    shown = save_recording(dataset, tmp_path / "a.rrd", Choice(["reach"], every=4, beliefs=True))
    assert "beliefs (keypoints differ when tracked again: bask-data encode --force)" in shown["reach"].missing


def test_a_track_of_ground_truth_has_no_belief(tmp_path: Path) -> None:
    dataset = tracked_dataset(tmp_path / "d")
    manifest = dataset.path(KeypointTrack, "reach") / "artifact.json"
    manifest.write_text(manifest.read_text().replace('"source": "network"', '"source": "truth"'))
    shown = save_recording(dataset, tmp_path / "a.rrd", Choice(["reach"], beliefs=True))
    assert any(layer.startswith("beliefs (the track's network or references") for layer in shown["reach"].missing)
