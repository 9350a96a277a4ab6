from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest

from bask_data.dataset import Dataset, Source
from bask_data.engine import Outcome, make, plan
from bask_data.errors import UsageError
from bask_data.kinds import CameraFrames, Reconstruction, Scan
from bask_data.stages.fusion_memory import WORKING_BYTES
from bask_data.stages.reconstruct import reconstruct
from tests.datasets import publish_artifact, publish_recording
from tests.scenes import Box, Plane, Scene, Sphere, intrinsics, look_at, noisy, orbit

GOLDEN = Path(__file__).parent / "golden" / "reconstruct_v4.npz"
HEIGHT, WIDTH = 96, 128
K = intrinsics(HEIGHT, WIDTH)
SCENE = Scene(
    (Sphere((0.0, 0.0, 0.0), 0.06), Box((0.03, 0.04, 0.03), look_at((0.15, 0.05, 0.03)))), (Plane(extent=0.25),)
)
OPTIONS = {"voxel_size": 0.006}


def scan_of(
    root: Path,
    n_frames: int = 9,
    blind: tuple[int, ...] = (),
    sigma: float = 0.001,
    offset: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0),
    scene: Scene = SCENE,
) -> Dataset:
    """A dataset with one scan of the scene, moved by `offset`; `blind` frames measure nothing."""
    dataset = Dataset.create(root)
    rng = np.random.default_rng(0)
    cameras = orbit(n_frames, radius=0.5)
    views = [scene.render(K, camera, HEIGHT, WIDTH) for camera in cameras]
    depth = [noisy(view.depth, sigma, rng) * (i not in blind) for i, view in enumerate(views)]
    cameras[:, :3, 3] += offset
    publish_recording(dataset, "a", rgb=[view.rgb for view in views], depth=depth, K=K, world_from_cameras=cameras)
    return dataset


def made(dataset: Dataset, **options: object) -> Outcome:
    [task] = plan(dataset, reconstruct, options={**OPTIONS, **options})
    return make(task)


def result(dataset: Dataset, **options: object) -> Reconstruction:
    outcome = made(dataset, **options)
    assert outcome.status == "made", outcome.why
    return Reconstruction(Path(outcome.path))


def test_scan_becomes_a_mesh_on_the_surface(tmp_path: Path) -> None:
    mesh = result(scan_of(tmp_path / "d"))
    assert np.median(SCENE.surface_distance(mesh.vertices.astype(float))) < 0.5 * 0.006
    assert len(mesh.triangles) > 3000
    assert mesh.colors.shape == mesh.vertices.shape
    assert mesh.voxel_size == 0.006
    quality = mesh.metadata.quality
    assert (quality.frames, quality.frames_fused, quality.workspace) == (9, 9, "estimated")
    assert quality.explained > 0.95
    assert abs(quality.residual) < 0.0005
    assert 0.0003 < quality.residual_abs < 0.0015, "the noise is 1 mm"
    assert quality.seen_from_behind < 0.05
    assert mesh.metadata.warnings == []
    assert mesh.metadata.unmeasured == []


def test_same_scan_gives_the_same_digest_twice(tmp_path: Path) -> None:
    assert made(scan_of(tmp_path / "a")).digest == made(scan_of(tmp_path / "b")).digest


def test_mesh_stays_in_the_workspace_given(tmp_path: Path) -> None:
    box = (-0.1, -0.1, -0.02, 0.1, 0.1, 0.1)
    mesh = result(scan_of(tmp_path / "d"), workspace=box)
    assert mesh.metadata.bounds == box
    assert mesh.metadata.quality.workspace == "given"
    assert (mesh.vertices >= np.array(box[:3], np.float32)).all()
    assert (mesh.vertices <= np.array(box[3:], np.float32)).all()


def test_workspace_auto_holds_the_support_and_what_stands_on_it(tmp_path: Path) -> None:
    chair = Box((0.1, 0.1, 0.1), np.array([[1.0, 0, 0, 0], [0, 1, 0, 0.5], [0, 0, 1, -0.3], [0, 0, 0, 1]]))
    room = Scene(SCENE.objects, (Plane(extent=0.25), Plane(offset=0.4, centre=(0.0, 0.4, -0.4), extent=0.2), chair))
    scan = scan_of(tmp_path / "d", scene=room)
    estimated, auto = result(scan).metadata, result(scan, workspace="auto").metadata
    assert estimated.bounds[2] < -0.3
    np.testing.assert_allclose(auto.bounds[:2], (-0.27, -0.27), atol=0.02)
    np.testing.assert_allclose(auto.bounds[3:5], (0.27, 0.27), atol=0.02)
    assert -0.04 < auto.bounds[2] < -0.01
    assert 0.05 < auto.bounds[5] < 0.12
    assert auto.quality.workspace == "estimated"
    assert auto.warnings == []


def test_workspace_auto_without_a_support_is_what_several_frames_see(tmp_path: Path) -> None:
    ball = scan_of(tmp_path / "d", scene=Scene((Sphere((0.0, 0.0, 0.0), 0.06),), ()))
    auto = result(ball, workspace="auto").metadata
    assert auto.bounds == result(ball).metadata.bounds
    assert "may be the face of an object" in auto.warnings[0]
    assert "the workspace is what several frames see" in auto.warnings[0]


def test_frames_without_depth_are_counted(tmp_path: Path) -> None:
    mesh = result(scan_of(tmp_path / "d", blind=(2, 5)))
    quality = mesh.metadata.quality
    assert (quality.frames, quality.frames_fused) == (9, 7)
    assert quality.frames_without_depth == 2
    assert quality.frames_without_depth_in_the_workspace == 2
    assert mesh.metadata.warnings == [
        "2 of 9 frames have no depth between 0.15 and 4 m and were skipped: wrist 2, wrist 5."
    ]


def test_views_that_hardly_differ_are_left_out_when_asked(tmp_path: Path) -> None:
    quality = result(scan_of(tmp_path / "d"), min_angle_deg=150.0).metadata.quality
    assert quality.frames == 9
    assert 1 < quality.frames_of_distinct_views < 9
    assert quality.frames_fused == quality.frames_of_distinct_views


def test_result_is_that_of_this_version(tmp_path: Path) -> None:
    # If this differs, mend the code or raise the stage's version; never only write the file anew.
    mesh = result(scan_of(tmp_path / "d", sigma=0.0))
    golden = np.load(GOLDEN)
    assert mesh.manifest.stage_version == golden["version"]
    assert len(mesh.vertices) == len(golden["vertices"])
    assert np.allclose(mesh.vertices, golden["vertices"], atol=1e-5)
    assert np.array_equal(mesh.triangles, golden["triangles"])
    assert np.abs(mesh.colors.astype(int) - golden["colors"]).max() <= 1


def test_a_scene_gives_the_same_surface_wherever_its_world_begins(tmp_path: Path) -> None:
    offset = np.array([47.502, -46.513, 45.087])
    near = result(scan_of(tmp_path / "near"))
    far = result(scan_of(tmp_path / "far", offset=offset))
    assert np.allclose(np.subtract(far.metadata.bounds, near.metadata.bounds), np.tile(offset, 2), atol=1e-6)
    assert np.abs(far.vertices - offset - near.vertices).max() < 1e-5
    assert np.array_equal(far.triangles, near.triangles)


def test_what_cannot_be_is_said_in_words(tmp_path: Path) -> None:
    dataset = scan_of(tmp_path / "d")
    for options, message in (
        ({"near": 2.0, "far": 1.0}, r"reconstruct: near: expected less than far \(1.0 m\), got 2.0 m"),
        (
            {"near": 3.0},
            "depth: expected measurements between near 3.0 m and far 4.0 m, got none in 9 frames looked at",
        ),
        (
            {"workspace": (5, 5, 5, 6, 6, 6)},
            "surface: expected a surface inside the workspace, got none from 0 of 9 frames",
        ),
    ):
        outcome = made(dataset, **options)
        assert outcome.status == "failed"
        with pytest.raises(type(outcome.error), match=message):
            raise outcome.error


def test_a_scan_with_a_broken_transform_is_refused_by_frame(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    cameras = orbit(3, radius=0.5)
    cameras[1, :3, :3] *= 1.1
    view = SCENE.render(K, cameras[0], HEIGHT, WIDTH)
    publish_recording(dataset, "a", rgb=[view.rgb] * 3, depth=[view.depth] * 3, K=K, world_from_cameras=cameras)
    outcome = made(dataset)
    assert outcome.status == "failed"
    with pytest.raises(
        type(outcome.error), match="wrist: world_from_camera 1: expected a rigid transform, got a scaled"
    ):
        raise outcome.error


def test_all_cameras_of_a_scan_are_fused(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    cameras = orbit(6, radius=0.5)
    views = [SCENE.render(K, camera, HEIGHT, WIDTH) for camera in cameras]
    small_K = intrinsics(60, 80)
    above = look_at((0.0, 0.0, 0.6))
    small = SCENE.render(small_K, above, 60, 80)

    def fill(out: Path) -> None:
        group = Scan.start(out, "test", {})
        for name, matrix, seen, poses in (
            ("overhead", small_K, [small] * 3, np.stack([above] * 3)),
            ("wrist", K, views, cameras),
        ):
            raw = [np.round(view.depth * 1e4).astype(np.uint16) for view in seen]
            Scan.write_camera(
                group,
                name,
                CameraFrames(
                    K=matrix,
                    world_from_cameras=poses,
                    time=np.arange(len(raw)) / 30.0,
                    depth_scale=1e-4,
                    size=raw[0].shape,
                    read=lambda i, seen=seen, raw=raw: (seen[i].rgb, raw[i]),
                ),
            )

    dataset.add("scene", "a", Source(format="test", path="none"))
    publish_artifact(dataset, Scan, "a", fill)
    mesh = result(dataset)
    assert (mesh.metadata.quality.frames, mesh.metadata.quality.frames_fused) == (9, 9)
    frames = mesh.frames.to_pydict()
    assert list(zip(frames["camera"], frames["frame"], strict=True)) == [
        *(("overhead", i) for i in range(3)),
        *(("wrist", i) for i in range(6)),
    ]


def test_table_of_frames_says_how_the_mesh_explains_each(tmp_path: Path) -> None:
    frames = result(scan_of(tmp_path / "d", blind=(2,))).frames.to_pydict()
    assert frames["frame"] == list(range(9))
    assert frames["fused"] == [i != 2 for i in range(9)]
    assert not any(frames["suspect"])
    for i in range(9):
        if i == 2:
            assert (frames["valid_depth"][i], frames["n_judged"][i]) == (0, 0)
            assert np.isnan(frames["explained"][i])
            continue
        assert frames["valid_depth"][i] > 0.3
        assert frames["n_judged"][i] > 300
        assert frames["explained"][i] > 0.9
        assert frames["residual_abs"][i] < 0.0015


def off_by_10_cm(root: Path, i_bad: int) -> Dataset:
    """A scan of which one frame's camera was 10 cm elsewhere."""
    dataset = Dataset.create(root)
    rng, cameras = np.random.default_rng(0), orbit(12, radius=0.5)
    views = [SCENE.render(K, camera, HEIGHT, WIDTH) for camera in cameras]
    depth = [noisy(view.depth, 0.001, rng) for view in views]
    cameras = cameras.copy()
    cameras[i_bad, :3, 3] += 0.1 * np.array([0.6, 0.0, 0.8])
    publish_recording(dataset, "a", rgb=[view.rgb for view in views], depth=depth, K=K, world_from_cameras=cameras)
    return dataset


@pytest.mark.parametrize("i_bad", [0, 5, 11])
def test_a_frame_with_a_wrong_pose_stands_out_and_is_left_out(tmp_path: Path, i_bad: int) -> None:
    dataset = off_by_10_cm(tmp_path / "d", i_bad)
    mesh = result(dataset)
    frames = mesh.frames.to_pydict()
    assert [frame for frame, odd in zip(frames["frame"], frames["suspect"], strict=True) if odd] == [i_bad]
    assert [frame for frame, fused in zip(frames["frame"], frames["fused"], strict=True) if not fused] == [i_bad]
    assert frames["explained"][i_bad] < 0.5
    quality = mesh.metadata.quality
    assert (quality.frames_suspect, quality.frames_fused) == (1, 11)
    assert quality.explained > 0.95
    [warning] = mesh.metadata.warnings
    assert "1 of 12 frames disagree with the others, which have 9" in warning
    assert f"wrist {i_bad} (" in warning
    assert warning.endswith("They were left out of the mesh; --no-drop-suspects keeps them.")
    assert np.median(SCENE.surface_distance(mesh.vertices.astype(float))) < 0.5 * 0.006
    without = result(dataset, exclude=[f"wrist:{i_bad}"])
    quality = without.metadata.quality
    assert (quality.frames, quality.frames_excluded, quality.frames_fused, quality.frames_suspect) == (12, 1, 11, 0)
    assert without.metadata.warnings == []
    assert without.vertices.tobytes() == mesh.vertices.tobytes()


def with_hanging_tail(root: Path, n_frames: int, first: int) -> Dataset:
    """A scan whose poses stay those of frame `first` until the end, though the camera moves on."""
    dataset = Dataset.create(root)
    rng, cameras = np.random.default_rng(0), orbit(n_frames, radius=0.5, n_turns=0.5)
    views = [SCENE.render(K, camera, HEIGHT, WIDTH) for camera in cameras]
    depth = [noisy(view.depth, 0.001, rng) for view in views]
    cameras = cameras[np.minimum(np.arange(n_frames), first)]
    publish_recording(dataset, "a", rgb=[view.rgb for view in views], depth=depth, K=K, world_from_cameras=cameras)
    return dataset


def test_a_tail_of_hanging_poses_is_left_out_and_no_good_frame_with_it(tmp_path: Path) -> None:
    dataset = with_hanging_tail(tmp_path / "d", 14, 8)
    mesh = result(dataset)
    frames = mesh.frames.to_pydict()
    assert [frame for frame, odd in zip(frames["frame"], frames["suspect"], strict=True) if odd] == [9, 10, 11, 12, 13]
    assert frames["fused"] == [frame < 9 for frame in frames["frame"]]
    [warning] = mesh.metadata.warnings
    assert warning.startswith("frames 9-13 of wrist have the pose of frame 8, but the surface moved by ")
    assert np.median(SCENE.surface_distance(mesh.vertices.astype(float))) < 0.5 * 0.006
    kept = result(dataset, drop_suspects=False)
    assert kept.metadata.quality.frames_fused == 14
    assert any(one.endswith("To leave them out: --exclude wrist:9-13") for one in kept.metadata.warnings)


def test_a_camera_that_pauses_or_rests_keeps_its_frames(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    cameras = orbit(6, radius=0.5)[[0, 1, 2, 2, 2, 2, 3, 4, 5]]
    depth = [
        noisy(SCENE.render(K, camera, HEIGHT, WIDTH).depth, 0.001, np.random.default_rng(i))
        for i, camera in enumerate(cameras)
    ]
    rgb = [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 9
    publish_recording(dataset, "a", rgb=rgb, depth=depth, K=K, world_from_cameras=cameras)
    quality = result(dataset).metadata.quality
    assert (quality.frames_fused, quality.frames_suspect) == (9, 0)


def test_a_suspect_frame_is_kept_when_asked_and_doubles_the_surface(tmp_path: Path) -> None:
    mesh = result(off_by_10_cm(tmp_path / "d", 5), drop_suspects=False)
    assert mesh.metadata.quality.frames_suspect == 1
    assert mesh.metadata.quality.frames_fused == 12
    assert any(one.endswith("To leave them out: --exclude wrist:5") for one in mesh.metadata.warnings)
    assert mesh.metadata.quality.explained < 0.6


def test_frames_are_left_out_one_by_one_and_in_ranges(tmp_path: Path) -> None:
    mesh = result(scan_of(tmp_path / "d"), exclude=["wrist:0", "wrist:3-5"])
    assert mesh.frames.to_pydict()["frame"] == [1, 2, 6, 7, 8]


@pytest.mark.parametrize("wrong", ["wrist:9", "wrist:5-3", "wrist:7-9", "hand:1", "4", "wrist:x"])
def test_a_frame_to_leave_out_that_does_not_exist_is_refused(tmp_path: Path, wrong: str) -> None:
    outcome = made(scan_of(tmp_path / "d"), exclude=[wrong])
    assert outcome.status == "failed"
    assert f"exclude: expected frames of a, which has wrist:0-8, got {wrong}." in outcome.why


def test_poses_that_do_not_fit_at_all_are_told(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    rng, cameras = np.random.default_rng(0), orbit(12, radius=0.5)
    views = [SCENE.render(K, camera, HEIGHT, WIDTH) for camera in cameras]
    cameras = cameras.copy()
    cameras[:, :3, 3] += rng.normal(scale=0.06, size=(12, 3))
    publish_recording(
        dataset,
        "a",
        rgb=[view.rgb for view in views],
        depth=[view.depth for view in views],
        K=K,
        world_from_cameras=cameras,
    )
    warnings = result(dataset, min_views=1).metadata.warnings
    assert any(
        re.match(r"only \d+% of the depth lies on the surface, it is off by [\d.]+ cm in the median: check", one)
        for one in warnings
    )


def test_glass_on_the_table_is_named_with_its_place_and_clay_is_not(tmp_path: Path) -> None:
    K, cameras = intrinsics(240, 320), orbit(24, radius=0.6)
    box = np.eye(4)
    box[:3, 3] = [-0.1, 0.1, 0.05]
    for name, glass in (("clay", False), ("glass", True)):
        dataset = Dataset.create(tmp_path / name)
        views = [
            Scene((Box((0.03, 0.03, 0.05), box), *SCENE.objects), (Plane(extent=0.4),)).render(K, camera, 240, 320)
            for camera in cameras
        ]
        depth = [np.where(glass & (view.instance == 1), np.float32(0), view.depth) for view in views]
        publish_recording(dataset, "a", rgb=[view.rgb for view in views], depth=depth, K=K, world_from_cameras=cameras)
        metadata = result(dataset).metadata
        assert len(metadata.unmeasured) == len(metadata.warnings) == int(glass)
    [region], [warning] = metadata.unmeasured, metadata.warnings
    assert region.centre == pytest.approx((-0.1, 0.1, 0.05), abs=0.025)
    assert region.size == pytest.approx((0.06, 0.06, 0.1), abs=0.05)
    assert warning.startswith("the cameras could not measure what stands at -0.1")
    assert warning.endswith("transparent, shiny or black? Masks there cannot be trusted.")


def test_too_little_memory_is_refused_before_the_run_and_the_remedy_works(tmp_path: Path) -> None:
    dataset = scan_of(tmp_path / "d")
    made(dataset, voxel_size=0.001)  # What libraries take when they are first used is not the volume's.
    held = psutil.Process().memory_info().rss
    limit = f"{(held + WORKING_BYTES + 40e6) / 1e6:.0f}MB"
    outcome = made(dataset, voxel_size=0.0008, max_memory=limit)
    assert outcome.status == "failed"
    assert isinstance(outcome.error, UsageError)
    assert re.search(r"max_memory: expected at most .*B, got a need of about .*B at voxels of 0.8 mm", outcome.why)
    voxel_size = re.search(r"fix: --voxel-size (\S+), or a --workspace smaller than [\d. x]+ m, or", outcome.why)
    assert voxel_size
    assert result(dataset, voxel_size=float(voxel_size[1]), max_memory=limit).voxel_size == float(voxel_size[1])
    needed = re.search(r"--max-memory (\S+)\.$", outcome.why)
    assert needed
    assert result(dataset, voxel_size=0.0008, max_memory=needed[1]).voxel_size == 0.0008


def test_no_voxel_size_is_named_when_none_would_fit(tmp_path: Path) -> None:
    outcome = made(scan_of(tmp_path / "d"), max_memory="1MB")
    assert outcome.status == "failed"
    assert re.search(r"at most 1MB, got a need of about .*fix: --max-memory \S+\.$", outcome.why)


def test_memory_that_the_first_look_did_not_foresee_is_refused_when_it_is_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bask_data.stages.reconstruct.most_blocks", lambda survey, max_memory: survey.n_blocks // 2)
    outcome = made(scan_of(tmp_path / "d"), max_memory="2GB")
    assert outcome.status == "failed"
    assert "max_memory: expected at most 2GB, got a need of about" in outcome.why


def test_the_limit_of_memory_does_not_make_a_result_stale(tmp_path: Path) -> None:
    dataset = scan_of(tmp_path / "d")
    assert made(dataset, max_memory="3GB").status == "made"
    assert made(dataset).status == "up to date"
    assert made(dataset, max_memory=4).status == "up to date", "a configuration may say 4 and mean GB"
    with pytest.raises(UsageError, match="max_memory: expected"):
        made(dataset, max_memory="much")


PEAK = """
import sys
from pathlib import Path
from bask_data.kinds import Scan
from bask_data.stages import fusion_memory, reconstruct as stage
seen = []
def noted(survey, max_memory):
    seen.append((survey.n_blocks, fusion_memory.resident_bytes()))
    return fusion_memory.most_blocks(survey, max_memory)
stage.most_blocks = noted
params = stage.ReconstructParams(voxel_size=float(sys.argv[3]))
stage.reconstruct(scan=Scan(Path(sys.argv[1])), params=params, out=Path(sys.argv[2]))
from bask_data.core.tsdf import peak_bytes
[(n_blocks, held)] = seen
# Not `getrusage`: a process inherits the peak of the one that started it.
peak = int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) * 1024
print(peak, held + fusion_memory.WORKING_BYTES + peak_bytes(n_blocks))
"""


def peak_and_prediction(path: Path, out: Path, voxel_size: float) -> tuple[int, int]:
    """Peak resident bytes of `reconstruct` in a process of its own, and what it foresaw."""
    out.mkdir()
    run = subprocess.run(
        [sys.executable, "-c", PEAK, str(path), str(out), str(voxel_size)], capture_output=True, text=True, check=True
    )
    peak, predicted = map(int, run.stdout.split()[-2:])
    return peak, predicted


def room_scan(root: Path, n_frames: int, n_views: int = 40) -> Path:
    """A walk through a room, 240 x 320, its views repeated until there are enough frames."""
    walls = (Plane(), Plane((1.0, 0.0, 0.0), 1.2), Plane((0.0, 1.0, 0.0), 1.2), Plane((-1.0, 0.0, 0.0), 1.2))
    furniture = tuple(
        Box((0.2, 0.15, 0.3), look_at((x, y, 0.3), (0.0, 0.0, 0.3))) for x, y in ((0.7, 0.5), (-0.7, 0.6), (0.1, -0.8))
    )
    room, K = Scene(furniture, walls), intrinsics(240, 320)
    angles = np.linspace(0, 2 * np.pi, n_views, endpoint=False)
    cameras = np.stack(
        [look_at((0.3 * np.cos(a), 0.3 * np.sin(a), 1.0), (np.cos(a + 0.7), np.sin(a + 0.7), 0.3)) for a in angles]
    )
    views = [room.render(K, camera, 240, 320) for camera in cameras]
    order = np.arange(n_frames) % n_views
    return publish_recording(
        Dataset.create(root),
        "a",
        rgb=[views[i].rgb for i in order],
        depth=[views[i].depth for i in order],
        K=K,
        world_from_cameras=cameras[order],
    )


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak from /proc")
def test_peak_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path) -> None:
    few, _ = peak_and_prediction(room_scan(tmp_path / "200", 200), tmp_path / "out-200", 0.01)
    many, _ = peak_and_prediction(room_scan(tmp_path / "1000", 1000), tmp_path / "out-1000", 0.01)
    # 800 more frames would be 180 MB as they are stored and 800 MB as they are fused.
    assert many < 1.05 * few


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak from /proc")
@pytest.mark.parametrize("voxel_size", [0.008, 0.004])
def test_the_memory_foreseen_is_that_taken(tmp_path: Path, voxel_size: float) -> None:
    peak, predicted = peak_and_prediction(room_scan(tmp_path / "d", 40), tmp_path / "out", voxel_size)
    assert peak < 1.1 * predicted, "a limit must hold"
    assert predicted < 1.3 * peak
