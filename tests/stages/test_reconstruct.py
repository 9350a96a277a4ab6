from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bask_data.dataset import Dataset, Source
from bask_data.kinds import Reconstruction, Scan
from bask_data.stage import Outcome, make, plan
from bask_data.stages.reconstruct import reconstruct
from tests.datasets import publish_artifact, publish_recording
from tests.scenes import Box, Plane, Scene, Sphere, intrinsics, look_at, noisy, orbit

GOLDEN = Path(__file__).parent / "golden" / "reconstruct_v1.npz"
HEIGHT, WIDTH = 96, 128
K = intrinsics(HEIGHT, WIDTH)
SCENE = Scene(
    (Sphere((0.0, 0.0, 0.0), 0.06), Box((0.03, 0.04, 0.03), look_at((0.15, 0.05, 0.03)))), (Plane(extent=0.25),)
)
OPTIONS = {"voxel_size": 0.006}


def scan_of(root: Path, n_frames: int = 9, blind: tuple[int, ...] = (), sigma: float = 0.001) -> Dataset:
    """A dataset with one scan of the scene; `blind` frames measure nothing."""
    dataset = Dataset.create(root)
    rng = np.random.default_rng(0)
    cameras = orbit(n_frames, radius=0.5)
    views = [SCENE.render(K, camera, HEIGHT, WIDTH) for camera in cameras]
    depth = [noisy(view.depth, sigma, rng) * (i not in blind) for i, view in enumerate(views)]
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
    assert mesh.metadata.quality["frames_fused"] == 9
    assert mesh.metadata.quality["workspace"] == "estimated"


def test_same_scan_gives_the_same_digest_twice(tmp_path: Path) -> None:
    assert made(scan_of(tmp_path / "a")).digest == made(scan_of(tmp_path / "b")).digest


def test_mesh_stays_in_the_workspace_given(tmp_path: Path) -> None:
    box = (-0.1, -0.1, -0.02, 0.1, 0.1, 0.1)
    mesh = result(scan_of(tmp_path / "d"), workspace=box)
    assert mesh.metadata.bounds == box
    assert mesh.metadata.quality["workspace"] == "given"
    assert (mesh.vertices >= np.array(box[:3], np.float32)).all()
    assert (mesh.vertices <= np.array(box[3:], np.float32)).all()


def test_frames_without_depth_are_counted(tmp_path: Path) -> None:
    quality = result(scan_of(tmp_path / "d", blind=(2, 5))).metadata.quality
    assert quality["frames"] == 9
    assert quality["frames_fused"] == 7
    assert quality["frames_without_depth_in_the_workspace"] == 2


def test_views_that_hardly_differ_are_left_out_when_asked(tmp_path: Path) -> None:
    quality = result(scan_of(tmp_path / "d"), min_angle_deg=150.0).metadata.quality
    assert quality["frames"] == 9
    assert 1 < quality["frames_of_distinct_views"] < 9
    assert quality["frames_fused"] == quality["frames_of_distinct_views"]


def test_result_is_that_of_this_version(tmp_path: Path) -> None:
    # If this differs, mend the code or raise the stage's version; never only write the file anew.
    mesh = result(scan_of(tmp_path / "d", sigma=0.0))
    golden = np.load(GOLDEN)
    assert mesh.manifest.stage_version == golden["version"]
    assert len(mesh.vertices) == len(golden["vertices"])
    assert np.allclose(mesh.vertices, golden["vertices"], atol=1e-5)
    assert np.array_equal(mesh.triangles, golden["triangles"])
    assert np.abs(mesh.colors.astype(int) - golden["colors"]).max() <= 1


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
                K=matrix,
                world_from_cameras=poses,
                time=np.arange(len(raw)) / 30.0,
                depth_scale=1e-4,
                size=raw[0].shape,
                read=lambda i, seen=seen, raw=raw: (seen[i].rgb, raw[i]),
            )

    dataset.add("scene", "a", Source(format="test", path="none"))
    publish_artifact(dataset, Scan, "a", fill)
    quality = result(dataset).metadata.quality
    assert quality["frames"] == 9
    assert quality["frames_fused"] == 9


PRINT_PEAK = """
import sys
from pathlib import Path
from bask_data.kinds import Scan
from bask_data.stages.reconstruct import ReconstructParams, reconstruct
reconstruct(scan=Scan(Path(sys.argv[1])), params=ReconstructParams(voxel_size=0.006), out=Path(sys.argv[2]))
# Not `getrusage`: a process inherits the peak of the one that started it.
status = Path("/proc/self/status").read_text()
print(status.split("VmHWM:")[1].split()[0])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak from /proc")
def test_peak_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path) -> None:
    fine_K, cameras = intrinsics(240, 320), orbit(12, radius=0.5)
    views = [SCENE.render(fine_K, camera, 240, 320) for camera in cameras]
    peaks = []
    for n_frames in (60, 300):
        order = np.arange(n_frames) % 12
        dataset = Dataset.create(tmp_path / str(n_frames))
        path = publish_recording(
            dataset,
            "a",
            rgb=[views[i].rgb for i in order],
            depth=[views[i].depth for i in order],
            K=fine_K,
            world_from_cameras=cameras[order],
        )
        out = tmp_path / f"out-{n_frames}"
        out.mkdir()
        run = subprocess.run(
            [sys.executable, "-c", PRINT_PEAK, str(path), str(out)], capture_output=True, text=True, check=True
        )
        peaks.append(int(run.stdout.split()[-1]))
    # 240 more frames would be 130 MB; a process with Open3D begins at 250.
    assert peaks[1] < 1.05 * peaks[0]
