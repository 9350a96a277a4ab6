from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bask_data.core.static_truth import Visibility
from tests.scenes import intrinsics, orbit, tabletop

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import static_scenes
import static_truth
from static_tracks import RETURNED, STEADY, phases

T, SEEN, TOLERANCE = 40, Visibility.VISIBLE, 0.01


def points(*states: np.ndarray) -> static_scenes.Points:
    k = len(states)
    return static_scenes.Points(np.zeros((k, 3)), np.stack(states, axis=1), np.zeros(k, dtype=int))


def state(**parts: tuple[int, int]) -> np.ndarray:
    """Seen but for spans of frames."""
    values = np.full(T, SEEN, dtype=np.int8)
    for name, (a, b) in parts.items():
        values[a:b] = getattr(Visibility, name)
    return values


def test_frames_are_divided_block_by_block() -> None:
    reported = static_scenes.reported_frames(100)
    assert reported.sum() == 50 and not reported[:10].any() and reported[10:20].all()
    assert len([*static_scenes.runs(reported)]) == static_scenes.N_BLOCKS // 2


def test_a_point_is_gone_out_of_view_or_occluded_and_not_where_no_depth_was_measured() -> None:
    found = phases(points(state(OUT_OF_VIEW=(10, 12), OCCLUDED=(15, 17), UNKNOWN=(20, 22))))
    assert np.flatnonzero(found["gone"][:, 0]).tolist() == [10, 11, 15, 16]


def test_what_has_not_been_seen_yet_is_not_gone() -> None:
    assert not phases(points(state(OUT_OF_VIEW=(0, 12))))["gone"].any()


def test_a_point_is_seen_once_it_was_for_long_enough_and_returns_after_it_was_gone_for_long() -> None:
    found = phases(points(state(OUT_OF_VIEW=(10, 20), OCCLUDED=(30, 33))))
    steady = [*range(STEADY, 10), *range(20 + STEADY, 30), *range(33 + STEADY, T)]
    assert np.flatnonzero(found["seen"][:, 0]).tolist() == steady
    assert np.flatnonzero(found["returned"][:, 0]).tolist() == [*range(20, 20 + RETURNED)]


def test_points_that_leave_and_return_are_preferred_and_others_fill_up() -> None:
    half = points(state(), state(OUT_OF_VIEW=(25, T)), state(OUT_OF_VIEW=(10, 20)), state(), state(OCCLUDED=(5, 30)))
    for n, expected in ((2, {2, 4}), (3, {1, 2, 4})):
        chosen = static_scenes.drawn(half, n, np.random.default_rng(0))
        assert {tuple(one) for one in chosen.state.T} == {tuple(half.state[:, i]) for i in expected}
    assert len(static_scenes.drawn(half, 16, np.random.default_rng(0)).world) == 5


@pytest.fixture(scope="module")
def camera() -> SimpleNamespace:
    """A camera that circles a ray-cast table."""
    K, world_from_cameras = intrinsics(240, 320), orbit(20)
    views = [tabletop(4, seed=1).render(K, at, 240, 320) for at in world_from_cameras]

    def points_world(i: int, uv: np.ndarray, depth: np.ndarray) -> np.ndarray:
        rays = np.concatenate([(uv - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((len(uv), 1))], axis=1)
        return (rays * depth[:, None]) @ world_from_cameras[i][:3, :3].T + world_from_cameras[i][:3, 3]

    return SimpleNamespace(
        n_frames=len(views),
        height=240,
        width=320,
        Ks=np.tile(K, (20, 1, 1)),
        world_from_cameras=np.stack(world_from_cameras),
        rgb=lambda i: views[i].rgb,
        depth=lambda i: views[i].depth.astype(np.float32),
        points_world=points_world,
    )


def test_the_halves_share_no_place_and_points_are_picked_in_frames_that_are_not_reported(
    camera: SimpleNamespace,
) -> None:
    fitted, reported = static_scenes.halves(camera, TOLERANCE)
    assert min(len(fitted.world), len(reported.world)) >= 5
    apart = np.linalg.norm(fitted.world[:, None] - reported.world[None], axis=2)
    assert apart.min() >= TOLERANCE / static_scenes.N_SIGMAS
    for half in (fitted, reported):
        assert not static_scenes.reported_frames(camera.n_frames)[half.picked_in].any()
        assert half.seen[half.picked_in, np.arange(len(half.world))].all()


def test_points_are_on_the_surface_that_frames_show(camera: SimpleNamespace) -> None:
    fitted, _ = static_scenes.halves(camera, TOLERANCE)
    for i, point in zip(fitted.picked_in.tolist(), fitted.world, strict=True):
        # Within a cell of the distance map: what shows the top of a box from one side shows its edge from another.
        at = static_scenes.pixels(camera, i, point[None])[0]
        u, v = np.mgrid[-2:3, -2:3].reshape(2, -1) + np.rint(at).astype(int)[:, None]
        around = camera.points_world(i, np.stack([u, v], axis=1).astype(float), camera.depth(i)[v, u])
        assert np.linalg.norm(around - point, axis=1).min() < TOLERANCE


def test_a_recording_of_no_set_is_taken_for_a_part_of_7_scenes_unless_said_otherwise(tmp_path: Path) -> None:
    usual = static_scenes.unnamed(tmp_path, (), 0.05)
    assert usual.ingest[:4] == ("--intrinsics", "585,585,320,240", "--color", "frame-*.color.png")
    (tmp_path / "camera-intrinsics.txt").touch()
    (tmp_path / "frame-000000.color.jpg").touch()
    found = static_scenes.unnamed(tmp_path, (), 0.05)
    assert found.ingest[:4] == ("--intrinsics", str(tmp_path / "camera-intrinsics.txt"), "--color", "frame-*.color.jpg")
    assert static_scenes.unnamed(tmp_path, ("--fps", "5"), 0.05).ingest == ("--fps", "5")


def test_the_bars_are_those_of_the_issue_and_phases_without_data_have_none() -> None:
    def of(seen: float | None, gone: float | None, returned: float | None) -> dict:
        return {"seen": [seen], "gone": [gone], "returned": [returned]}

    medians = {"expectation": of(0.06, 1.2, 0.1), "discrete": of(0.06, 0.2, 0.1), "particle": of(0.05, 0.3, 0.105)}
    assert static_truth.verdicts("office", medians) == {"seen <= 6.0 cm": True, "gone <= 40.0 cm": True}
    assert static_truth.verdicts("sevenscenes_redkitchen", medians) == {
        "seen <= 6.0 cm": True,
        "gone <= 13.0 cm": False,
        "returned <= 11.0 cm": True,
    }
    nothing = {name: of(None, None, None) for name in medians}
    assert static_truth.verdicts("office", nothing) == {}
