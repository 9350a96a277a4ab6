from __future__ import annotations

import numpy as np
import pytest

from bask_data.dataset import Dataset, Variant
from bask_data.errors import BadData
from bask_data.evaluation.finder import Finder, network_of
from bask_data.evaluation.lookup import find, find_recording
from bask_data.evaluation.search import ALPHA
from bask_data.kinds import DescriptorNet, KeypointTrack, Pick, ReferenceKeypoints
from tests.datasets import copied, publish_artifact
from tests.report.filled import HEIGHT, WIDTH, publish_network


def picks_of(dataset: Dataset) -> list[Pick]:
    return ReferenceKeypoints(dataset.path(ReferenceKeypoints)).picks


def camera_of(dataset: Dataset, name: str):
    recording = find_recording(dataset, name)
    assert recording is not None
    return recording.cameras[0]


def test_a_network_finds_a_point_in_the_image_it_was_picked_in(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    publish_network(dataset)
    dataset.add_variant(DescriptorNet, "other", Variant())
    publish_network(dataset, variant="other")
    picks = picks_of(dataset)
    descriptor = find(dataset, DescriptorNet, "", "other")
    assert descriptor is not None
    finder = Finder(dataset, "other", descriptor, picks)
    assert finder.described.all()
    sight = finder.look(camera_of(dataset, "scan-a").rgb(2), [1, 0])
    np.testing.assert_allclose(sight.best, [[picks[i].u, picks[i].v] for i in (1, 0)], atol=3.0)
    assert (sight.nearest < 0.1).all()
    np.testing.assert_allclose(sight.heat.sum(axis=(1, 2)), 1.0)
    for heat, best in zip(sight.heat, sight.best, strict=True):
        v, u = np.unravel_index(heat.argmax(), heat.shape)
        np.testing.assert_allclose((np.array([u, v]) + 0.5) / heat.shape[::-1], (best + 0.5) / [WIDTH, HEIGHT])


def test_the_reference_descriptors_of_a_network_s_own_variant_are_taken_as_they_are(filled_with_network):
    descriptor = find(filled_with_network, DescriptorNet)
    assert descriptor is not None
    finder = Finder(filled_with_network, "main", descriptor, picks_of(filled_with_network))
    np.testing.assert_array_equal(finder.descriptors, np.eye(2, 8))


def test_picks_in_missing_frames_have_no_descriptor(filled_with_network):
    known = picks_of(filled_with_network)[0]
    strange = [
        known,
        known.model_copy(update={"recording": "nowhere"}),
        known.model_copy(update={"frame": 99}),
        known.model_copy(update={"u": float("nan")}),
        known.model_copy(update={"v": 1e6}),
    ]
    descriptor = find(filled_with_network, DescriptorNet)
    assert descriptor is not None
    assert Finder(filled_with_network, "main", descriptor, strange).described.tolist() == [
        True,
        False,
        False,
        False,
        False,
    ]


def test_a_network_that_does_not_load_or_fit_is_named(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    publish_network(dataset)
    descriptor = find(dataset, DescriptorNet)
    assert descriptor is not None
    picks = picks_of(dataset)
    publish_artifact(
        dataset,
        ReferenceKeypoints,
        "",
        lambda out: ReferenceKeypoints.write(out, descriptors=np.zeros((2, 3), np.float32), picks=picks),
    )
    with pytest.raises(BadData, match="descriptor_dim: expected 3 as the reference keypoints, got 8"):
        Finder(dataset, "main", descriptor, picks)
    (descriptor.path / "weights.safetensors").write_bytes(b"x" * 50)
    with pytest.raises(BadData, match="expected SHA-256 .*fix: make it again"):
        Finder(dataset, "main", descriptor, picks)


def test_a_variant_of_tracks_alone_uses_the_network_it_was_made_with(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    assert network_of(dataset, "main") is None
    publish_network(dataset)
    dataset.add_variant(KeypointTrack, "expectation", Variant())
    track = find(dataset, KeypointTrack, "demo-a")
    assert track is not None
    target = dataset.path(KeypointTrack, "demo-a", "expectation")
    target.parent.mkdir(parents=True)
    target.symlink_to(track.path.resolve())
    for variant in ("main", "expectation"):
        network = network_of(dataset, variant)
        assert network is not None
        assert network.path == dataset.path(DescriptorNet)
    assert Finder(dataset, "main", DescriptorNet(dataset.path(DescriptorNet)), picks_of(dataset)).alpha == ALPHA


# Points ---------------------------------------------------------------------------------------------------------------
