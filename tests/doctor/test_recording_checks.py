from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bask_data.doctor.recording_checks import stamp_findings
from bask_data.findings import Finding
from tests.doctor.recordings import Recorded, clean, moved_by, with_depth, with_errors, with_rgb


def only(recorded: Recorded, code: str) -> Finding:
    """The single finding of a recording."""
    findings = recorded.findings()
    assert [finding.code for finding in findings] == [code]
    return findings[0]


@pytest.mark.parametrize(
    ("seed", "noise", "arc_deg"), [(0, 0.003, 35.0), (1, 0.0005, 35.0), (2, 0.003, 80.0), (3, 0.008, 15.0)]
)
def test_nothing_is_said_of_a_clean_recording(seed: int, noise: float, arc_deg: float) -> None:
    assert clean(seed=seed, noise=noise, arc_deg=arc_deg).codes == []


def test_frames_of_one_colour_are_named() -> None:
    recorded = with_rgb(clean(), lambda i, rgb: rgb * 0 + 3 if i in (5, 6, 12) else rgb)
    assert only(recorded, "frames-black").evidence.startswith("3 frames: 5-6, 12: grey level 3 to 3")


def test_a_colour_image_that_comes_again_while_the_camera_moves_is_named() -> None:
    recorded = clean()
    again = with_rgb(recorded, lambda i, rgb: recorded.rgb[9] if i in (10, 11) else rgb)
    assert only(again, "frames-duplicate").evidence.startswith("frames 10-11 repeat")


def test_a_depth_image_that_comes_again_is_named() -> None:
    recorded = clean()
    again = with_depth(recorded, lambda i, depth: recorded.depth[9] if i in (10, 11, 12) else depth)
    by_code = {finding.code: finding for finding in again.findings()}
    assert by_code["depth-stuck"].evidence.startswith("frames 10-12 repeat")


def test_frames_that_change_nothing_are_a_note() -> None:
    recorded = clean()
    index = np.minimum(np.arange(16), 10)
    resting = Recorded(
        recorded.rgb[index], recorded.depth[index], recorded.Ks, recorded.world_from_cameras[index], recorded.time
    )
    finding = only(resting, "frames-resting")
    assert finding.severity == "note"
    assert finding.evidence.startswith("frames 11-15")


@pytest.mark.parametrize("factor", [0.5, 1.6])
def test_a_jump_of_the_exposure_is_named(factor: float) -> None:
    recorded = with_rgb(clean(), lambda i, rgb: rgb * (0.6 * factor if i >= 8 else 0.6))
    finding = only(recorded, "exposure-jump")
    assert finding.evidence.startswith("frame 8")
    assert float(finding.evidence.split("up to ")[1].split(" ")[0]) == pytest.approx(factor, rel=0.05)


def test_a_blurred_frame_is_a_note() -> None:
    recorded = with_rgb(clean(), lambda i, rgb: cv2.GaussianBlur(rgb, (0, 0), 3) if i == 8 else rgb)
    finding = only(recorded, "frames-blurred")
    assert finding.severity == "note"
    assert "frame 8" in finding.evidence


def test_frames_without_depth_and_with_little_of_it_are_named() -> None:
    empty = with_depth(clean(), lambda i, depth: depth * (i != 4))
    assert only(empty, "depth-none").evidence == "frame 4"
    patchy = with_depth(clean(), lambda i, depth: depth * (np.arange(160) < 50) if i in (4, 9) else depth)
    assert only(patchy, "depth-sparse").evidence.startswith("2 frames: 4, 9: down to")


def test_depth_that_covers_little_is_told_with_its_share() -> None:
    keep = np.random.default_rng(1).random((120, 160)) < 0.4
    sparse = with_depth(clean(), lambda i, depth: depth * keep)
    findings = {finding.code: finding for finding in sparse.findings()}
    assert findings["depth-sparse"].evidence.startswith("39% of the pixels")


@pytest.mark.parametrize("far", [0.7, 0.9])
def test_depth_that_stands_at_the_end_of_a_range_is_told_with_the_value(far: float) -> None:
    clipped = with_depth(clean(), lambda i, depth: np.minimum(depth, far))
    findings = {finding.code: finding for finding in clipped.findings()}
    assert f"exactly {far} m, the end of a range" in findings["depth-saturated"].evidence


def test_a_mark_for_no_measurement_is_told_from_a_distance() -> None:
    marked = with_depth(clean(), lambda i, depth: np.where(depth == 0, 65.535, depth))
    assert "65.535 m, which is no distance but a mark" in only(marked, "depth-saturated").evidence


def test_coarse_depth_is_told_with_its_step() -> None:
    recorded = with_depth(clean(), lambda i, depth: np.round(depth / 0.02) * 0.02)
    findings = {finding.code: finding for finding in recorded.findings()}
    assert findings["depth-quantised"].evidence.startswith("neighbouring values are 20.0 mm apart")


@pytest.mark.parametrize("noise", [0.02, 0.04])
def test_noise_is_told_in_its_amount(noise: float) -> None:
    findings = {finding.code: finding for finding in clean(noise=noise).findings()}
    share = float(findings["depth-noise"].evidence.split("m, ")[1].split("%")[0]) / 100
    assert share == pytest.approx(noise, rel=0.15)


def bent(depth: np.ndarray, K: np.ndarray, edge: float) -> np.ndarray:
    """Depth that errs by a share `edge` at the left and right edge."""
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    half = depth.shape[1] / 2 / K[0, 0]
    return depth * (1 + edge * (x**2 + y**2) / half**2)


@pytest.mark.parametrize("edge", [0.015, -0.03])
def test_a_bowl_is_told_in_its_depth(edge: float) -> None:
    recorded = with_depth(table_from_above(), lambda i, depth: bent(depth, table_from_above().Ks[0], edge))
    finding = {finding.code: finding for finding in recorded.findings()}["depth-bowl"]
    share = float(finding.evidence.split("m, ")[1].split("%")[0]) / 100
    assert share == pytest.approx(abs(edge), rel=0.2)
    assert ("too far" if edge > 0 else "too near") in finding.evidence


def table_from_above() -> Recorded:
    """A recording that shows little but a table."""
    from tests.doctor import recordings
    from tests.scenes import Plane, Scene, intrinsics, look_at

    rng = np.random.default_rng(0)
    K = intrinsics(120, 160)
    poses = np.stack([look_at((0.1 * k / 8, 0.2 - 0.03 * k, 0.6 + 0.02 * k), (0.0, 0.02, 0.0)) for k in range(8)])
    views = [Scene((), (Plane(),)).render(K, pose, 120, 160) for pose in poses]
    depth = np.stack([recordings._measured(view.depth, 0.002, rng) for view in views])
    rgb = np.stack([view.rgb for view in views])
    return Recorded(rgb, depth, np.tile(K, (8, 1, 1)), poses, np.arange(8) / 10.0)


@pytest.mark.parametrize(
    ("frame", "shift_mm", "turn_deg"), [(0, 40, 4.0), (7, 15, 0.0), (7, 0, 2.0), (7, 300, 20.0), (15, 40, 4.0)]
)
def test_a_frame_with_a_wrong_pose_is_named(frame: int, shift_mm: float, turn_deg: float) -> None:
    recorded = with_errors(clean(), {frame: moved_by(shift_mm, turn_deg)})
    assert only(recorded, "frame-off").evidence.startswith(f"frame {frame}:")


def test_the_error_of_a_wrong_pose_is_told_in_millimetres_and_degrees() -> None:
    recorded = with_errors(clean(noise=0.001), {7: moved_by(0, 3.0)})
    degrees = float(only(recorded, "frame-off").evidence.split(" mm and ")[1].split(" ")[0])
    assert degrees == pytest.approx(3.0, abs=0.3)


@pytest.mark.parametrize("start", [4, 10])
def test_poses_that_hang_at_the_end_are_blamed_not_the_good_frames(start: int) -> None:
    recorded = clean()
    poses = recorded.world_from_cameras[np.minimum(np.arange(16), start)]
    finding = only(replace(recorded, world_from_cameras=poses), "poses-repeated")
    assert f"frames {start}-15" in finding.evidence


def test_a_step_of_the_path_that_stays_is_named_where_it_is() -> None:
    recorded = clean()
    step = moved_by(40, 3.0)
    poses = recorded.world_from_cameras.copy()
    poses[9:] = step @ poses[9:]
    finding = only(replace(recorded, world_from_cameras=poses), "pose-jump")
    assert finding.evidence.startswith("between frames 8 and 9:")


@pytest.mark.parametrize("drifted_mm", [20, 40])
def test_drift_is_found_when_places_are_seen_again(drifted_mm: float) -> None:
    recorded = clean(n_frames=24, n_turns_back=1, arc_deg=30.0)
    poses = np.stack([moved_by(drifted_mm * k / 23, 0.0) @ pose for k, pose in enumerate(recorded.world_from_cameras)])
    finding = only(replace(recorded, world_from_cameras=poses), "drift")
    assert "neighbours by" in finding.evidence
    assert clean(n_frames=24, n_turns_back=1, arc_deg=30.0).codes == []


def test_missing_stamps_are_told_with_their_place() -> None:
    recorded = clean()
    time = recorded.time + np.where(np.arange(16) > 9, 1.5, 0.0)
    assert only(replace(recorded, time=time), "time-gap").evidence.startswith("1.60 s after frame 9;")


def test_stamps_that_go_back_are_told() -> None:
    recorded = clean()
    time = recorded.time.copy()
    time[8] = time[7]
    assert only(replace(recorded, time=time), "time-backwards").evidence.startswith("after frame 7 ")


def test_irregular_stamps_are_a_note() -> None:
    time = np.cumsum(np.random.default_rng(0).choice([0.02, 0.1, 0.15], 16))
    assert only(replace(clean(), time=time), "time-jitter").severity == "note"


def test_cameras_that_were_not_taken_at_the_same_time_are_told() -> None:
    time = np.arange(20) / 10
    assert stamp_findings("demo", {"a": time, "b": time + 0.01}) == []
    (finding,) = stamp_findings("demo", {"a": time, "b": time + 0.3})
    assert finding.code == "time-apart"
    assert "a and b: 0.300 s apart" in finding.evidence


def test_a_long_recording_is_sampled_and_says_so() -> None:
    recorded = clean(n_frames=40)
    dark = with_rgb(with_errors(recorded, {21: moved_by(60, 5.0)}), lambda i, rgb: rgb * 0 if i < 2 else rgb)
    findings = dark.findings(most_frames=18)
    by_code = {finding.code: finding for finding in findings}
    assert by_code["frame-off"].evidence.startswith("frame 21:")
    assert by_code["frames-black"].evidence.endswith("of 40 frames looked at)")


def test_a_resting_simulated_camera_is_no_fault_though_its_depth_is_noisy() -> None:
    recorded = clean()
    still = replace(
        recorded,
        rgb=np.repeat(recorded.rgb[:1], 16, axis=0),
        depth=np.stack([np.where(d > 0, recorded.depth[0], 0) for d in recorded.depth]),
        world_from_cameras=np.repeat(recorded.world_from_cameras[:1], 16, axis=0),
    )
    assert still.codes == []
