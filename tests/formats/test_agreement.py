from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid, pixel_grid, scale_intrinsics, unproject
from bask_data.errors import BadData
from bask_data.formats.agreement import agreement
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.recording import CameraRecording
from bask_data.formats.verdict import Agreement, codes_in, is_doubtful
from tests.scenes import intrinsics, noisy, orbit, tabletop

HEIGHT, WIDTH = 60, 80
K = intrinsics(HEIGHT, WIDTH)
POSES = orbit(12, n_turns=0.4)
OPENGL = POSES @ np.diag([1.0, -1, -1, 1])


@cache
def depth_of(i: int) -> ndarray:
    """Depth as a sensor measures it, 0.1 mm: 2 % noise and 30 % holes."""
    exact = tabletop(3).render(K, POSES[i], HEIGHT, WIDTH).depth
    measured = noisy(exact, 0.0, np.random.default_rng(i), 0.3)
    return np.rint(1e4 * measured * np.random.default_rng(i).normal(1, 0.02, exact.shape)).astype(np.uint16)


def camera(
    poses: Float[ndarray, "t 4 4"] = POSES, scale: float = 1e-4, frames: list[int] | None = None
) -> CameraRecording:
    """The camera that went along `POSES`, with the poses of `poses`."""
    chosen = frames if frames is not None else list(range(len(POSES)))
    n = len(chosen)
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    return CameraRecording(
        name="c",
        K=K,
        height=HEIGHT,
        width=WIDTH,
        depth_scale=scale,
        world_from_cameras=poses[chosen],
        time=np.arange(float(n)),
        read=lambda k: (black, depth_of(chosen[k])),
        read_depth=lambda k: depth_of(chosen[k]),
    )


def readings(given: Float[ndarray, "t 4 4"]) -> dict[str, Float[ndarray, "t 4 4"]]:
    """What else poses written as `given` could mean."""
    flip = np.diag([1.0, -1, -1, 1])
    return {"--axes other": given @ flip, "--pose-is other": invert_rigid(given), "both": invert_rigid(given) @ flip}


OPTIONS = SourceOptions()
"""Of a format that has no options for units and intrinsics."""


def codes(found: Agreement) -> tuple[str, ...]:
    return found.judgement.codes


def test_the_right_reading_is_sure_under_noise_and_holes() -> None:
    found = agreement(camera(), readings(POSES), OPTIONS)
    assert codes(found) == () and not is_doubtful(found.text)
    found.refuse(Path("src"), "c")


@pytest.mark.parametrize(
    ("wrong", "named"),
    [(OPENGL, "--axes other"), (invert_rigid(POSES), "--pose-is other"), (invert_rigid(OPENGL), "both")],
    ids=["axes", "direction", "both"],
)
def test_a_wrong_reading_is_refused_with_the_options_for_the_right_one(wrong: ndarray, named: str) -> None:
    found = agreement(camera(wrong), readings(wrong), OPTIONS)
    assert codes(found) == ("other-reading",) and is_doubtful(found.text)
    with pytest.raises(BadData, match=f"poses of c: expected a reading that depth supports.*fix: pass {named};"):
        found.refuse(Path("src"), "c")


@pytest.mark.parametrize("scale", [1e-3, 5e-4])
def test_depth_in_another_unit_is_refused_with_the_right_scale(scale: float) -> None:
    found = agreement(camera(scale=scale), {}, FramesOptions())
    assert codes(found) == ("other-unit",)
    with pytest.raises(BadData, match="fix: pass --depth-scale 0.0001;"):
        found.refuse(Path("src"), "c")


def test_depth_scale_is_offered_in_the_units_of_the_source() -> None:
    found = agreement(camera(scale=1e-3), {}, FramesOptions(), unit=1.0)
    assert found.judgement.fix(found.offers) == "pass --depth-scale 0.1"


def test_poses_that_lag_by_a_frame_are_noted_but_no_option_mends_them() -> None:
    lagging = POSES[np.maximum(np.arange(len(POSES)) - 1, 0)]
    found = agreement(camera(lagging), {}, OPTIONS)
    assert codes(found) == ("other-clock",) and codes_in(found.text) == ("other-clock",)
    assert "give each frame the pose that stands 1 frame later" in found.text
    found.refuse(Path("src"), "c")


def along_rays() -> CameraRecording:
    rays = np.linalg.norm(unproject(pixel_grid(HEIGHT, WIDTH), np.ones((HEIGHT, WIDTH)), K), axis=-1)
    return replace(camera(), read_depth=lambda k: np.rint(depth_of(k) * rays).astype(np.uint16))


def test_depth_along_the_ray_is_told_from_z() -> None:
    found = agreement(along_rays(), readings(POSES), OPTIONS)
    assert codes(found) == ("other-depth",)
    assert found.judgement.fix(found.offers) == "pass --depth-is ray"


def test_intrinsics_of_other_images_are_refused_with_the_right_ones() -> None:
    double = scale_intrinsics(K, (HEIGHT, WIDTH), (2 * HEIGHT, 2 * WIDTH))
    found = agreement(replace(camera(), K=double), readings(POSES), FramesOptions())
    assert codes(found) == ("other-intrinsics",)
    values = ",".join(f"{value:.6g}" for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    with pytest.raises(BadData, match=f"fix: pass --intrinsics {values};"):
        found.refuse(Path("src"), "c")


def test_poses_of_another_recording_are_refused() -> None:
    found = agreement(camera(POSES[::-1] @ invert_rigid(POSES[3])), {}, OPTIONS)
    assert codes(found) == ("poses-unrelated",)
    with pytest.raises(BadData, match="no reading, unit, clock or size of intrinsics gives more.*belong.*--trust"):
        found.refuse(Path("src"), "c")


def test_a_camera_that_does_not_move_tells_nothing() -> None:
    still = camera(np.tile(POSES[:1], (len(POSES), 1, 1)), frames=[0] * 6)
    found = agreement(still, {"--axes other": np.tile(OPENGL[:1], (6, 1, 1))}, OPTIONS)
    assert codes(found) == ("hardly-moves",) and "the camera does not move" in found.text and is_doubtful(found.text)
    found.refuse(Path("src"), "c")


@pytest.mark.parametrize("factor", [0.37, 2.2])
def test_poses_of_no_metric_scale_are_refused_with_the_factor(factor: float) -> None:
    poses = POSES.copy()
    poses[:, :3, 3] *= factor
    found = agreement(camera(poses), readings(poses), OPTIONS)
    assert codes(found) == ("other-unit",)
    with pytest.raises(BadData, match="scale the positions of the poses to metres") as refused:
        found.refuse(Path("src"), "c")
    assert float(str(refused.value).split("by about ")[1].split(",")[0]) == pytest.approx(1 / factor, rel=0.04)


def test_a_unit_of_depth_that_no_option_states_is_refused_with_what_to_correct() -> None:
    found = agreement(camera(scale=1e-3), {}, OPTIONS)
    with pytest.raises(BadData, match="correct the unit of depth in the files: depth 0.1 times as large"):
        found.refuse(Path("src"), "c")


def test_equal_poses_of_a_camera_that_moved_are_refused_if_depth_is_sure() -> None:
    moved = camera(np.tile(POSES[:1], (len(POSES), 1, 1)))
    found = agreement(moved, {}, OPTIONS)
    assert codes(found) == ("camera-moved",)
    with pytest.raises(BadData, match="all poses are the same, but only.*one for each frame"):
        found.refuse(Path("src"), "c")


def test_what_is_trusted_is_read_and_recorded() -> None:
    found = agreement(camera(OPENGL), readings(OPENGL), SourceOptions(trust=True))
    found.refuse(Path("src"), "c")
    assert codes_in(found.text) == ("other-reading", "trusted")
    assert [finding.code for finding in found.findings("c")] == ["other-reading", "trusted"]


def test_a_single_frame_tells_nothing_and_that_is_said() -> None:
    found = agreement(camera(frames=[0]), {}, OPTIONS)
    assert codes(found) == ("few-views",)
    assert found.text.startswith("cannot tell: a single frame") and is_doubtful(found.text)
