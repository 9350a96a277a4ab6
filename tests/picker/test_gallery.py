from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from bask_data.core.geometry import invert_rigid, project, transform
from bask_data.errors import UsageError
from bask_data.picker import gallery as module
from bask_data.picker.gallery import FrameName, Gallery
from tests.nn import pairs
from tests.picker.pickable import HEIGHT, N_VIEWS, WIDTH, frame, recordings_of, untrained


@pytest.fixture(scope="module")
def recordings(pickable):
    return recordings_of(pickable)


@pytest.fixture
def gallery(recordings) -> Gallery:
    return Gallery(recordings, untrained())


def test_recordings_and_their_cameras_are_listed(gallery) -> None:
    camera = {"name": "wrist", "width": WIDTH, "height": HEIGHT}
    assert gallery.listed() == [
        {"name": "a", "scope": "scene", "cameras": [{**camera, "n_frames": N_VIEWS}]},
        {"name": "b", "scope": "scene", "cameras": [{**camera, "n_frames": N_VIEWS}]},
        {"name": "lift", "scope": "demonstration", "cameras": [{**camera, "n_frames": 2}]},
    ]


def test_distances_equal_those_of_the_network_to_the_descriptor_of_the_stage(gallery, recordings) -> None:
    rgb = recordings["a"].camera("wrist").rgb(1)
    descriptor = gallery.descriptor_at(frame("a", 1), 40.5, 50.0)
    expected = untrained().descriptors_at(rgb, np.array([[40.5, 50.0]], np.float32))[0]
    torch.testing.assert_close(descriptor, expected, atol=1e-5, rtol=1e-5)
    for other in (frame("a", 1), frame("lift", 0)):
        z = gallery.find(descriptor, other).z
        rgb = recordings[other.recording].camera("wrist").rgb(other.frame)
        [full] = untrained().distance_maps(rgb, expected[None].numpy())
        assert z.shape == full.shape == (48, 64)
        np.testing.assert_allclose(z, full, atol=2e-3)


def test_the_best_match_of_a_pixel_in_its_own_frame_is_itself(gallery) -> None:
    # The network halves the image: centres of its pixels lie between the image's.
    found = gallery.find(gallery.descriptor_at(frame("a", 0), 40.5, 50.5), frame("a", 0))
    np.testing.assert_allclose(found.best, [40.5, 50.5])
    assert found.z_best < 1e-3


def test_a_large_map_is_reduced_without_losing_its_smallest_distance(gallery, monkeypatch) -> None:
    descriptor = gallery.descriptor_at(frame("a", 0), 40.5, 50.5)
    whole = gallery.find(descriptor, frame("b", 2))
    monkeypatch.setattr(module, "MOST_PIXELS", 500)
    small = gallery.find(descriptor, frame("b", 2))
    assert small.z.shape == (16, 21)
    np.testing.assert_allclose(small.z, whole.z[:, :63].reshape(16, 3, 21, 3).min(axis=(1, 3)))
    assert (small.best, small.z_best) == (whole.best, whole.z_best)


def test_pictures_are_the_frames(gallery, recordings) -> None:
    decoded = cv2.imdecode(np.frombuffer(gallery.picture(frame("b", 3)), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    difference = decoded.astype(int) - recordings["b"].camera("wrist").rgb(3)
    # The surfaces are noise, which JPEG smooths; swapped channels would differ more.
    assert np.abs(difference).mean() < 10
    assert np.abs(difference.mean(axis=(0, 1))).max() < 1


def test_ground_truth_is_known_only_in_frames_of_the_same_scan(gallery) -> None:
    _, world_from_cameras, images = pairs.views(N_VIEWS, 0)
    image = images[0]
    others = [frame("a", i) for i in range(1, N_VIEWS)]
    n_seen = 0
    for row, column in np.argwhere(image.instance > 0)[::40].tolist():
        depth = float(image.depth[row, column])
        point = np.array([(column - 63.5) / 120.0 * depth, (row - 47.5) / 120.0 * depth, depth])
        places = gallery.same_place(frame("a", 0), column, row, [*others, frame("b", 0), frame("lift", 0)])
        assert places[-2:] == [None, None]
        for i, place in enumerate(places[:-2], start=1):
            in_world = transform(world_from_cameras[0], point[None])
            uv, z = project(transform(invert_rigid(world_from_cameras[i]), in_world), pairs.K)
            (u, v) = np.rint(uv[0]).astype(int)
            inside = 0 <= u < WIDTH and 0 <= v < HEIGHT
            if inside and abs(images[i].depth[v, u] - z[0]) < 0.015:
                np.testing.assert_allclose(place, uv[0], atol=0.05)
                n_seen += 1
            elif not inside or abs(images[i].depth[v, u] - z[0]) > 0.025:
                assert place is None
    assert n_seen > 10


def test_ground_truth_of_a_demonstration_is_known_only_at_the_same_time(gallery) -> None:
    moment = frame("lift", 0)
    [own, later] = gallery.same_place(moment, 60.0, 50.0, [moment, frame("lift", 1)])
    np.testing.assert_allclose(own, [60.0, 50.0], atol=1e-6)
    assert later is None


def test_without_depth_there_is_no_ground_truth(recordings, monkeypatch) -> None:
    gallery = Gallery(recordings, untrained())
    monkeypatch.setattr(gallery, "_depth", lambda frame: np.zeros((HEIGHT, WIDTH), np.float32))
    assert gallery.same_place(frame("a", 0), 60.0, 50.0, [frame("a", 0), frame("a", 1)]) == [None, None]


def test_memory_is_bounded_and_the_frames_used_last_stay(recordings) -> None:
    n_bytes = Gallery(recordings, untrained()).describe(frame("a", 0)).n_bytes
    gallery = Gallery(recordings, untrained(), most_bytes=2 * n_bytes)
    for i in (0, 1, 0, 2):
        gallery.describe(frame("a", i))
    assert [gallery.is_described(frame("a", i)) for i in range(3)] == [True, False, True]
    least = Gallery(recordings, untrained(), most_bytes=1)
    least.describe(frame("a", 0))
    assert least.is_described(frame("a", 0))


def test_a_frame_is_described_once(recordings) -> None:
    network = untrained()
    seen = []
    cells = network.cells
    network.cells = lambda rgb: (seen.append(1), cells(rgb))[1]  # type: ignore[method-assign]
    gallery = Gallery(recordings, network)
    descriptor = gallery.descriptor_at(frame("a", 0), 3.0, 3.0)
    gallery.find(descriptor, frame("a", 0))
    gallery.describe(frame("a", 0))
    assert len(seen) == 1


@pytest.mark.parametrize(
    "name",
    [FrameName("z", "wrist", 0), FrameName("a", "top", 0), FrameName("a", "wrist", 4), FrameName("a", "wrist", -1)],
)
def test_frames_that_do_not_exist_are_refused(gallery, name) -> None:
    with pytest.raises(UsageError, match="frame: expected a frame of the dataset, got " + ":".join(map(str, name))):
        gallery.picture(name)


@pytest.mark.parametrize(("u", "v"), [(-0.6, 3.0), (128.0, 3.0), (3.0, 95.5), (float("nan"), 3.0)])
def test_pixels_outside_are_refused(gallery, u: float, v: float) -> None:
    with pytest.raises(UsageError, match=r"pixel: expected u 0..127, v 0..95, got"):
        gallery.descriptor_at(frame("a", 0), u, v)
