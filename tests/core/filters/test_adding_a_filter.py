"""A filter from outside takes part everywhere, by the file `toy.py` and one entry of the table."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pydantic import Field

from bask_data.core.filters.table import FILTERS, FilterEntry, alpha_of_one_frame, filter_of, settings_named
from bask_data.evaluation.keypoint_study import methods_of
from bask_data.kinds import Demonstration, KeypointTrack, ReferenceKeypoints
from bask_data.observing import moment_of
from bask_data.stages.encode import EncodeParams, settings_of
from bask_data.tracker import KeypointTracker
from tests.core.filters.toy import ToyBelief, ToySettings
from tests.tracked import ColourNetwork, dataset_of, keypoints, poses

ENTRY = FilterEntry("tests.core.filters.toy", "the most likely pixel, smoothed.")

RUN = """
from bask_data.core.filters.table import FILTERS, FilterEntry
FILTERS["toy"] = FilterEntry("tests.core.filters.toy", "the most likely pixel, smoothed.")
from bask_data.kinds import DescriptorNet
from tests.tracked import ColourNetwork
DescriptorNet.network = lambda self: ColourNetwork()
from bask_data.cli import main
main()
"""


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FILTERS, "toy", ENTRY)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return dataset_of(tmp_path / "d", {"wrist": poses()}).root


def command(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", RUN, *map(str, arguments)], capture_output=True, text=True)


def test_encode_offers_it_and_tracks_with_it(tmp_path: Path, root: Path) -> None:
    shown = command("encode", "--help")
    words = " ".join(shown.stdout.replace("│", " ").split())
    assert "toy: the most likely pixel, smoothed." in words and "particle|toy" in words
    done = command("encode", root, "--filter", "toy", "--walk", 0.25)
    assert done.returncode == 0, done.stderr
    track = KeypointTrack(root / "keypoints" / "main" / "reach")
    assert track.metadata.filter == "toy" and track.manifest.params["walk"] == 0.25
    assert np.linalg.norm(track.mean[4] - keypoints()[1], axis=1).max() < 0.02
    again = command("encode", root, "--filter", "toy", "--walk", 0.25, "--json")
    assert again.returncode == 0 and "up to date" in again.stdout + again.stderr
    tracker = KeypointTracker(
        ColourNetwork(), ReferenceKeypoints(root / "reference" / "main"), ToySettings(walk=0.25), cameras=["wrist"]
    )
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(FILTERS, "toy", ENTRY)
        demonstration = Demonstration(root / "demonstration" / "reach")
        for i_frame in range(3):
            found = tracker.step(*moment_of(demonstration.cameras, i_frame))
            np.testing.assert_array_equal(track.mean[i_frame], found.mean.astype(np.float32))


@pytest.mark.usefixtures("toy")
def test_a_tracker_goes_on_from_its_file_with_it(tmp_path: Path, root: Path) -> None:
    reference, demonstration = (
        ReferenceKeypoints(root / "reference" / "main"),
        Demonstration(root / "demonstration" / "reach"),
    )
    begun, again = (KeypointTracker(ColourNetwork(), reference, settings_named("toy")) for _ in range(2))
    for i_frame in range(2):
        begun.step(*moment_of(demonstration.cameras, i_frame))
    begun.save(tmp_path / "state")
    again.load(tmp_path / "state")
    assert isinstance(again.belief, ToyBelief) and again.belief.n_frames == 2
    mine, its = (one.step(*moment_of(demonstration.cameras, 2)) for one in (begun, again))
    np.testing.assert_array_equal(mine.mean, its.mean)
    [maps] = begun.hypotheses().maps
    np.testing.assert_allclose(maps.sum(axis=(1, 2)), 1.0)


@pytest.mark.usefixtures("toy")
def test_it_is_evaluated_beside_the_others() -> None:
    names = [one.name for one in methods_of({"main": 1.0, "base": 1.0}, "paper")]
    assert names == [
        "base: expectation",
        "main: expectation, no temperature",
        "main: expectation",
        "main: discrete",
        "main: particle",
        "main: toy",
    ]
    assert methods_of({"main": 1.0}, "paper")[-1].settings == ToySettings()


@pytest.mark.usefixtures("toy")
def test_its_heat_maps_are_drawn_at_its_temperature() -> None:
    assert alpha_of_one_frame("toy") == 30.0
    assert alpha_of_one_frame("toy", "paper", 7.0) == 7.0
    assert filter_of(ToySettings()).belief is ToyBelief


def test_an_option_for_a_further_filter_leaves_all_keys_as_they_are() -> None:
    class Wider(EncodeParams):
        depth_noise: float | None = Field(None, gt=0, exclude_if=lambda value: value is None)

    assert json.dumps(Wider().model_dump(mode="json")) == json.dumps(EncodeParams().model_dump(mode="json"))
    assert settings_of(Wider(depth_noise=0.5)) == settings_named("particle", depth_noise=0.5)


def test_a_setting_that_is_no_filters_is_refused() -> None:
    with pytest.raises(
        ValueError, match="settings: expected those of expectation, discrete, particle, got ToySettings"
    ):
        filter_of(ToySettings())
